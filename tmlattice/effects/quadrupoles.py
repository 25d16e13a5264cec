"""Errors of quadrupoles, and gradients anywhere."""

from tmlattice.effects.effect import (
    ErrorEffect,
    FamilyEffect,
    OffsetX,
    OffsetY,
    RingEffect,
    StrengthEffect,
    register,
)
from tmlattice.lattice import Element


class _OnQuadrupole(RingEffect):
    group = "quadrupoles"
    sits_on_text = "quadrupoles with k1 not 0"

    def sits_on(self, element: Element) -> bool:
        """Whether an element is a powered quadrupole."""
        return element.kind == "quadrupole" and element.k1 != 0


@register
class QuadrupoleGradient(_OnQuadrupole, StrengthEffect):
    """A wrong strength of a quadrupole."""

    name = "quadrupole_gradient"
    responds = True
    words = "wrong strength of a quadrupole"
    headline = True
    strength = "k1"
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
        """Whether an element is a marker, or a magnet that may contain a gradient."""
        return element.kind in ("quadrupole", "sextupole", "wiggler", "marker")


@register
class GradientAbsolute(_Gradient, ErrorEffect):
    """A gradient beyond the model's."""

    name = "gradient_absolute"
    words = "focusing error (quadrupole field) in the middle of an element"
    error = "k1l"
    quantity = "additional integrated gradient"
    recommended_action = "remove the quadrupole field at {}"
    to_check = (
        "Look for a quadrupole field that is not in the model: a shorted turn, a trim winding, "
        "iron near the beam, or a neighbour with a wrong gradient."
    )
    sign = "integrated k1 L, thin, in the middle: px -= amount x, py += amount y"

    def corrected_as(self, element: Element) -> tuple[str, float]:
        """Return a powered quadrupole's own gradient, or a wiggler's focusing."""
        if element.kind == "quadrupole" and element.k1 * element.length != 0:
            return QuadrupoleGradient.name, 1 / (element.k1 * element.length)
        if element.kind == "wiggler":
            return "insertion_device_focusing", 1.0
        return self.name, 1.0

    def compensated(self, element: Element, amount: float) -> Element | None:
        """Return the element with the opposite change of a powered quadrupole's gradient."""
        if self.corrected_as(element)[0] != QuadrupoleGradient.name:
            return None
        return element.changed(k1=element.k1 - amount / element.length)


@register
class SkewGradient(_Gradient, ErrorEffect):
    """A skew gradient."""

    name = "skew_gradient"
    words = "skew quadrupole field in the middle of an element"
    error = "k1sl"
    quantity = "integrated skew gradient"
    recommended_action = "remove the skew quadrupole field at {}"
    to_check = (
        "Look for a powered skew quadrupole, a magnet that has turned, or iron on one side of the "
        "beam."
    )
    sign = "integrated k1s L, thin, in the middle: px += amount y, py += amount x"

    def corrected_as(self, element: Element) -> tuple[str, float]:
        """Return the roll of a powered quadrupole: theta has k1s L = -2 theta k1 L."""
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
        "Measure its roll with a level or the survey; if it is upright, look for a skew field: "
        "poles powered unevenly."
    )
    background = 2e-4
    largest = 0.03


@register
class QuadrupoleOffsetX(_OnQuadrupole, OffsetX):
    """A horizontal misalignment of a quadrupole."""

    name = "quadrupole_offset_x"
    words = "quadrupole displaced horizontally"
    headline = True
    to_check = "Survey its horizontal position against its neighbours; look at its supports."
    largest = 2e-3


@register
class QuadrupoleOffsetY(_OnQuadrupole, OffsetY):
    """A vertical misalignment of a quadrupole."""

    name = "quadrupole_offset_y"
    words = "quadrupole displaced vertically"
    headline = True
    to_check = "Survey its height against its neighbours; look at its supports and its girder."
    largest = 2e-3


@register
class FamilyGradient(_OnQuadrupole, FamilyEffect):
    """A wrong current of a quadrupole family's power supply: a common error of its members."""

    name = "family_gradient"
    responds = True
    words = "wrong strength of a whole family of quadrupoles"
    strength = "k1"
    sign = "k1 of every member becomes (1 + amount) k1"
    quantity = "integrated gradient of every member"
    largest = 0.05
    sits_on_text = (
        "families of two or more quadrupoles with k1 not 0, by the family's name, or groups of "
        "equal design strength"
    )
