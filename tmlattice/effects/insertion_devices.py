"""What goes wrong with wigglers and undulators."""

from tmlattice.effects.build import Build
from tmlattice.effects.effect import ErrorEffect, ThinKickEffect, register
from tmlattice.lattice import Element


@register
class InsertionDeviceFocusing(ErrorEffect):
    """A wiggler, or another element that is given by its matrix, has another focusing."""

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
        "measured, and make it good with the quadrupoles beside it."
    )
    largest = 0.03
    sits_on_text = "wigglers, matrix elements"

    def build(self, it: Build, amount: float) -> None:
        """A thin quadrupole."""
        it.add_gradient("entrance", normal=amount)

    def sits_on(self, element: Element) -> bool:
        """Wigglers, and elements that are a matrix, whatever their name."""
        return element.kind in ("wiggler", "matrix")


@register
class VerticalFocusing(ThinKickEffect):
    """What a planar undulator does, and a dipole's edges: vertical focusing alone."""

    name = "vertical_focusing"
    words = "vertical focusing of an insertion device or of a dipole's edges"
    group = "insertion devices"
    unit = "1/m"
    sign = "thin, in the middle: py -= amount y"
    slopes = (0.0, 0.0, 0.0, -1.0)
    quantity = "integrated vertical focusing"
    recommended_action = "make the vertical focusing at {} good"
    to_check = (
        "Read the gap of the insertion device that stands there, and make its focusing good with "
        "the quadrupoles beside it; of a dipole, compare edge angles and fringe integrals with the "
        "lattice file's."
    )
    largest = 0.03
    sits_on_text = "dipoles, wigglers, markers, drifts of half a metre or more"
    usual = False  # in responses, where a family of it is fitted, or where somebody names it

    def sits_on(self, element: Element) -> bool:
        """Where an insertion device is, or may stand; and dipoles."""
        return element.kind in ("wiggler", "marker", "bend") or (
            element.kind == "drift" and element.length >= 0.5
        )
