"""What goes wrong with wigglers and undulators."""

from tmlattice.effects.build import Build
from tmlattice.effects.effect import ErrorEffect, register
from tmlattice.lattice import Element


@register
class InsertionDeviceFocusing(ErrorEffect):
    """A wiggler focuses otherwise than its matrix says."""

    name = "insertion_device_focusing"
    words = "unmodelled focusing of an insertion device"
    group = "insertion devices"
    responds = True
    headline = True
    error = "entrance_k1l"
    unit = "1/m"
    sign = "integrated gradient k1 L, thin, at the entrance: px -= amount x, py += amount y"
    quantity = "additional integrated gradient"
    remedy = "correct the focusing of {}"
    to_check = (
        "Read its gap and its end coils; compare the focusing in the lattice file with the one "
        "measured, and make it good with the quadrupoles beside it."
    )
    largest = 0.03
    sits_on_text = "wigglers"

    def build(self, it: Build, amount: float) -> None:
        """A thin quadrupole."""
        it.add_gradient("entrance", normal=amount)

    def sits_on(self, element: Element) -> bool:
        """Wigglers."""
        return element.kind == "wiggler"
