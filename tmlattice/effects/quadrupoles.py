"""What goes wrong with quadrupoles, and with gradients anywhere."""

from tmlattice.effects.build import Build
from tmlattice.effects.effect import (
    ErrorEffect,
    FamilyEffect,
    RingEffect,
    StrengthEffect,
    register,
)
from tmlattice.lattice import Element


class _OnQuadrupole(RingEffect):
    group = "quadrupoles"
    sits_on_text = "quadrupoles with k1 not 0"

    def sits_on(self, element: Element) -> bool:
        """Powered quadrupoles."""
        return element.kind == "quadrupole" and element.k1 != 0


@register
class QuadrupoleGradient(_OnQuadrupole, StrengthEffect):
    """A quadrupole's strength is not what its setting says."""

    name = "quadrupole_gradient"
    responds = True
    words = "wrong strength of a quadrupole"
    headline = True
    strength = "k1"
    unit = "relative"
    sign = "k1 becomes (1 + amount) k1"
    quantity = "integrated gradient"
    recommended_action = "set or repair the gradient of {}"
    to_check = (
        "Read back the current of its supply, and compare setting, calibration and cabling; then "
        "look for a shorted turn or a wrong tap."
    )
    background = 1e-3
    largest = 0.3


class _Gradient(RingEffect):
    group = "quadrupoles"
    responds = True
    unit = "1/m"
    largest = 0.03
    odds = 0.1
    sits_on_text = "quadrupoles, skew quadrupoles, sextupoles, wigglers, markers"

    def sits_on(self, element: Element) -> bool:
        """Magnets that may hide a gradient, and markers."""
        return element.kind in ("quadrupole", "sextupole", "wiggler", "marker")


@register
class GradientAbsolute(_Gradient, ErrorEffect):
    """A gradient where the model has none, or more than it has."""

    name = "gradient_absolute"
    words = "focusing error (quadrupole field) in the middle of an element"
    error = "k1l"
    quantity = "additional integrated gradient"
    recommended_action = "take the quadrupole field at {} away"
    to_check = (
        "Look for a quadrupole field that the model has not: a shorted turn, a trim winding, iron "
        "beside the beam, or a neighbour whose gradient is wrong."
    )
    sign = "integrated k1 L, thin, in the middle: px -= amount x, py += amount y"

    def build(self, it: Build, amount: float) -> None:
        """A thin quadrupole."""
        it.add_gradient("middle", normal=amount)

    def stands_for(self, element: Element) -> tuple[str, float]:
        """A powered quadrupole's own gradient, or a wiggler's focusing."""
        if element.kind == "quadrupole" and element.k1 * element.length != 0:
            return QuadrupoleGradient.name, 1 / (element.k1 * element.length)
        if element.kind == "wiggler":
            return "insertion_device_focusing", 1.0
        return self.name, 1.0

    def undone(self, element: Element, amount: float) -> Element | None:
        """As much less of a powered quadrupole's own gradient."""
        if self.stands_for(element)[0] != QuadrupoleGradient.name:
            return None
        return element.changed(k1=element.k1 - amount / element.length)


@register
class SkewGradient(_Gradient, ErrorEffect):
    """A skew gradient."""

    name = "skew_gradient"
    words = "skew quadrupole field in the middle of an element"
    error = "k1sl"
    quantity = "integrated skew gradient"
    recommended_action = "take the skew quadrupole field at {} away"
    to_check = (
        "Look for a skew quadrupole that is powered, a magnet that has turned, or iron that stands "
        "on one side of the beam."
    )
    sign = "integrated k1s L, thin, in the middle: px += amount y, py += amount x"

    def build(self, it: Build, amount: float) -> None:
        """A thin skew quadrupole."""
        it.add_gradient("middle", skew=amount)

    def stands_for(self, element: Element) -> tuple[str, float]:
        """The roll of a powered quadrupole: by theta it has k1s L = -2 theta k1 L."""
        if element.kind == "quadrupole" and element.k1 * element.length != 0:
            return QuadrupoleRoll.name, -1 / (2 * element.k1 * element.length)
        return self.name, 1.0


@register
class QuadrupoleRoll(_OnQuadrupole, ErrorEffect):
    """A quadrupole turned about the beam axis."""

    name = "quadrupole_roll"
    responds = True
    words = "quadrupole rolled about the beam axis"
    headline = True
    error = "roll"
    unit = "rad"
    sign = "positive turns the magnet's x axis towards y"
    quantity = "roll"
    recommended_action = "turn {} upright"
    to_check = (
        "Measure its roll with a level or the survey; if it stands upright, look for a skew field: "
        "poles powered unevenly."
    )
    background = 2e-4
    largest = 0.03


@register
class QuadrupoleOffsetX(_OnQuadrupole, ErrorEffect):
    """A quadrupole that stands beside its axis."""

    name = "quadrupole_offset_x"
    words = "quadrupole displaced horizontally"
    headline = True
    error = "dx"
    unit = "m"
    sign = "x of the magnet's centre"
    quantity = "horizontal displacement"
    recommended_action = "move {} back horizontally"
    to_check = "Survey its horizontal position against its neighbours; look at its supports."
    background = 1e-4
    largest = 2e-3


@register
class QuadrupoleOffsetY(_OnQuadrupole, ErrorEffect):
    """A quadrupole that stands above or below its axis."""

    name = "quadrupole_offset_y"
    words = "quadrupole displaced vertically"
    headline = True
    error = "dy"
    unit = "m"
    sign = "y of the magnet's centre"
    quantity = "vertical displacement"
    recommended_action = "move {} back vertically"
    to_check = "Survey its height against its neighbours; look at its supports and its girder."
    background = 1e-4
    largest = 2e-3


@register
class FamilyGradient(_OnQuadrupole, FamilyEffect):
    """The power supply of a family of quadrupoles is off: all of them have the same error."""

    name = "family_gradient"
    responds = True
    words = "wrong strength of a whole family of quadrupoles"
    strength = "k1"
    unit = "relative"
    sign = "k1 of every member becomes (1 + amount) k1"
    quantity = "integrated gradient of every member"
    recommended_action = "set or repair the supply of the family {}"
    to_check = (
        "Read back the current of the family's common supply with a second instrument; compare its "
        "setting with the lattice file."
    )
    largest = 0.05
    sits_on_text = (
        "families of two or more quadrupoles with k1 not 0, by the family's name, or of what the "
        "design has alike"
    )
