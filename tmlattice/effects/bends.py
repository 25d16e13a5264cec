"""What goes wrong with bends: the design geometry stays, the field differs from it.

OCELOT's `tilt` and `angle` change the geometry, so neither is an error: a bend's errors are kicks
spread over its body.
"""

from tmlattice.effects.build import Build
from tmlattice.effects.effect import RingEffect, register
from tmlattice.lattice import Element


class _OnBend(RingEffect):
    group = "bends"
    headline = True
    sits_on_text = "bends"

    def sits_on(self, element: Element) -> bool:
        """Bends with an angle."""
        return element.kind == "bend" and element.angle != 0


@register
class DipoleField(_OnBend):
    """A bend's field is off."""

    name = "dipole_field"
    words = "wrong field of a bending magnet"
    unit = "relative"
    sign = "px -= angle x amount: a stronger field bends towards the inside"
    quantity = "field"
    recommended_action = "set or repair the field of {}"
    to_check = (
        "Read back the current of its supply and of its trim winding; look for a shorted turn."
    )
    background = 5e-4
    largest = 5e-3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A horizontal kick."""
        return element.with_errors(kick_x=-element.angle * amount)

    def build(self, it: Build, amount: float) -> None:
        """Another field."""
        it.scale *= 1 + amount

    def undone(self, element: Element, amount: float) -> Element | None:
        """The opposite kick: the design's geometry stays."""
        return self.changed(element, -amount, 0.0)


@register
class DipoleRoll(_OnBend):
    """A bend turned about the beam axis: its field has a horizontal part."""

    name = "dipole_roll"
    words = "bending magnet rolled about the beam axis"
    unit = "rad"
    sign = "kick (amount^2 angle / 2, -amount angle)"
    quantity = "roll"
    recommended_action = "turn {} upright"
    to_check = "Measure its roll with a level or the survey; look at its supports."
    background = 2e-4
    largest = 5e-3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A vertical kick, and a second-order horizontal one."""
        return element.with_errors(
            kick_x=amount**2 * element.angle / 2, kick_y=-amount * element.angle
        )

    def build(self, it: Build, amount: float) -> None:
        """A turned magnet."""
        it.roll += amount


@register
class BendGradient(_OnBend):
    """A bend's gradient is not the model's: of combined-function magnets it is a strength."""

    name = "bend_gradient"
    responds = True
    headline = False
    words = "wrong gradient of a bending magnet"
    unit = "1/m2"
    sign = "k1 becomes k1 + amount, over the whole body"
    quantity = "additional gradient"
    recommended_action = "correct the gradient of {}"
    to_check = (
        "Compare its gradient and its edges in the lattice file with what was measured; look for a "
        "beam that passes beside its axis."
    )
    largest = 0.1
    usual = False  # in responses, where a family of it is fitted, or where somebody names it

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Another gradient."""
        return element.changed(k1=element.k1 + amount)

    def build(self, it: Build, amount: float) -> None:
        """Another gradient."""
        it.k1 += amount

    def undone(self, element: Element, amount: float) -> Element | None:
        """As much less."""
        return self.changed(element, -amount, 0.0)
