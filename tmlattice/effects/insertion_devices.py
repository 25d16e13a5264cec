"""What goes wrong with wigglers and undulators."""

from tmlattice.effects.effect import RingEffect, register
from tmlattice.lattice import Element


@register
class InsertionDeviceFocusing(RingEffect):
    """A wiggler focuses otherwise than its matrix says."""

    name = "insertion_device_focusing"
    unit = "1/m"
    sign = "integrated gradient k1 L, thin, at the entrance: px -= amount x, py += amount y"
    largest = 0.03
    sits_on_text = "wigglers"

    def sits_on(self, element: Element) -> bool:
        """Wigglers."""
        return element.kind == "wiggler"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A thin quadrupole at the entrance."""
        return element.with_errors(entrance_k1l=amount)
