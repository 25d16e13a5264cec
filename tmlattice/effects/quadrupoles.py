"""What goes wrong with quadrupoles, and with gradients anywhere."""

from collections import Counter

from tmlattice.effects.effect import RingEffect, register
from tmlattice.lattice import Element, Ring


class _OnQuadrupole(RingEffect):
    sits_on_text = "quadrupoles with k1 not 0"

    def sits_on(self, element: Element) -> bool:
        """Powered quadrupoles."""
        return element.kind == "quadrupole" and element.k1 != 0


@register
class QuadrupoleGradient(_OnQuadrupole):
    """A quadrupole's strength is not what its setting says."""

    name = "quadrupole_gradient"
    unit = "relative"
    sign = "k1 becomes (1 + amount) k1"
    background = 1e-3
    largest = 0.3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """k1 times 1 + amount."""
        return element.changed(k1=element.k1 * (1 + amount))


class _Gradient(RingEffect):
    unit = "1/m"
    largest = 0.03
    sits_on_text = "quadrupoles, skew quadrupoles, sextupoles, wigglers, markers"

    def sits_on(self, element: Element) -> bool:
        """Magnets that may hide a gradient, and markers."""
        return element.kind in ("quadrupole", "sextupole", "wiggler", "marker")


@register
class GradientAbsolute(_Gradient):
    """A gradient where the model has none, or more than it has."""

    name = "gradient_absolute"
    sign = "integrated k1 L, thin, in the middle: px -= amount x, py += amount y"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A thin quadrupole in the middle."""
        return element.with_errors(k1l=amount)


@register
class SkewGradient(_Gradient):
    """A skew gradient."""

    name = "skew_gradient"
    sign = "integrated k1s L, thin, in the middle: px += amount y, py += amount x"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A thin skew quadrupole in the middle."""
        return element.with_errors(k1sl=amount)


@register
class QuadrupoleRoll(_OnQuadrupole):
    """A quadrupole turned about the beam axis."""

    name = "quadrupole_roll"
    unit = "rad"
    sign = "positive turns the magnet's x axis towards y"
    background = 2e-4
    largest = 0.03

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Turned."""
        return element.with_errors(roll=amount)


@register
class QuadrupoleOffsetX(_OnQuadrupole):
    """A quadrupole that stands beside its axis."""

    name = "quadrupole_offset_x"
    unit = "m"
    sign = "x of the magnet's centre"
    background = 1e-4
    largest = 2e-3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Shifted in x."""
        return element.with_errors(dx=amount)


@register
class QuadrupoleOffsetY(_OnQuadrupole):
    """A quadrupole that stands above or below its axis."""

    name = "quadrupole_offset_y"
    unit = "m"
    sign = "y of the magnet's centre"
    background = 1e-4
    largest = 2e-3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Shifted in y."""
        return element.with_errors(dy=amount)


@register
class FamilyGradient(_OnQuadrupole):
    """The power supply of a family of quadrupoles is off: all of them have the same error."""

    name = "family_gradient"
    unit = "relative"
    sign = "k1 of every member becomes (1 + amount) k1"
    largest = 0.05
    sits_on_text = "families of two or more quadrupoles with k1 not 0, by the family's name"

    def places(self, ring: Ring) -> list[str | None]:
        """Families in the order of their first members."""
        count = Counter(e.family for e in ring.elements if self.sits_on(e))
        return [family for family, members in count.items() if members > 1]

    def members(self, ring: Ring, place: str | None) -> list[int]:
        """All quadrupoles of the family."""
        family = (place or "").casefold()
        return [
            i
            for i, e in enumerate(ring.elements)
            if e.family.casefold() == family and self.sits_on(e)
        ]

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """k1 times 1 + amount."""
        return element.changed(k1=element.k1 * (1 + amount))
