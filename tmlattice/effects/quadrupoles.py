"""What goes wrong with quadrupoles, and with gradients anywhere."""

from collections import Counter

from tmlattice.effects.build import Build
from tmlattice.effects.effect import ErrorEffect, RingEffect, StrengthEffect, register
from tmlattice.lattice import Element, Ring


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
    background = 1e-3
    largest = 0.3


class _Gradient(RingEffect):
    group = "quadrupoles"
    responds = True
    unit = "1/m"
    largest = 0.03
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
    sign = "integrated k1 L, thin, in the middle: px -= amount x, py += amount y"

    def build(self, it: Build, amount: float) -> None:
        """A thin quadrupole."""
        it.add_gradient("middle", normal=amount)


@register
class SkewGradient(_Gradient, ErrorEffect):
    """A skew gradient."""

    name = "skew_gradient"
    words = "skew quadrupole field in the middle of an element"
    error = "k1sl"
    sign = "integrated k1s L, thin, in the middle: px += amount y, py += amount x"

    def build(self, it: Build, amount: float) -> None:
        """A thin skew quadrupole."""
        it.add_gradient("middle", skew=amount)


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
    background = 1e-4
    largest = 2e-3


@register
class FamilyGradient(_OnQuadrupole, StrengthEffect):
    """The power supply of a family of quadrupoles is off: all of them have the same error."""

    name = "family_gradient"
    responds = True
    words = "wrong strength of a whole family of quadrupoles"
    strength = "k1"
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
