"""Errors of wigglers and undulators."""

from tmlattice.effects.effect import ErrorEffect, ThinKickEffect, register
from tmlattice.lattice import Element


@register
class InsertionDeviceFocusing(ErrorEffect):
    """A wrong focusing of a wiggler, or of another element given by its matrix."""

    name = "insertion_device_focusing"
    words = "unmodelled focusing of an insertion device"
    group = "insertion devices"
    responds = True
    headline = True
    error = "entrance_k1l"
    unit = "1/m"
    sign = "integrated gradient k1 L, thin, at the entrance: px -= amount x, py += amount y"
    quantity = "additional integrated gradient"
    recommended_action = "correct the focusing of {}"
    to_check = (
        "Read its gap and its end coils; compare the focusing in the lattice file with the one "
        "measured, and compensate the difference with the adjacent quadrupoles."
    )
    largest = 0.03
    sits_on_text = "wigglers, matrix elements"

    def sits_on(self, element: Element) -> bool:
        """Whether an element is a wiggler, or a matrix of any name."""
        return element.kind in ("wiggler", "matrix")


@register
class VerticalFocusing(ThinKickEffect):
    """Vertical focusing alone, as of a planar undulator or of a dipole's edges."""

    name = "vertical_focusing"
    words = "vertical focusing of an insertion device or of a dipole's edges"
    group = "insertion devices"
    unit = "1/m"
    sign = "thin, in the middle: py -= amount y"
    slopes = (0.0, 0.0, 0.0, -1.0)
    quantity = "integrated vertical focusing"
    recommended_action = "correct the vertical focusing at {}"
    to_check = (
        "Read the gap of the insertion device there, and compensate its focusing with the adjacent "
        "quadrupoles; of a dipole, compare edge angles and fringe integrals with the lattice "
        "file's."
    )
    largest = 0.03
    sits_on_text = "dipoles, wigglers, markers, drifts of half a metre or more"
    usual = False  # in responses, if a family of it is fitted, or on request

    def sits_on(self, element: Element) -> bool:
        """Whether an element is or may contain an insertion device, or is a dipole."""
        return element.kind in ("wiggler", "marker", "bend") or (
            element.kind == "drift" and element.length >= 0.5
        )
