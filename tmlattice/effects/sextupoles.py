"""What goes wrong with sextupoles."""

from tmlattice.effects.effect import RingEffect, register
from tmlattice.lattice import Element


class _OnSextupole(RingEffect):
    sits_on_text = "sextupoles with k2 not 0"

    def sits_on(self, element: Element) -> bool:
        """Powered sextupoles."""
        return element.kind == "sextupole" and element.k2 != 0


@register
class SextupoleStrength(_OnSextupole):
    """A sextupole's strength is not what its setting says."""

    name = "sextupole_strength"
    unit = "relative"
    sign = "k2 becomes (1 + amount) k2; -2 is a reversed one"
    background = 5e-3
    largest = 2.0

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """k2 times 1 + amount."""
        return element.changed(k2=element.k2 * (1 + amount))


@register
class SextupoleOffsetX(_OnSextupole):
    """A sextupole that stands beside its axis."""

    name = "sextupole_offset_x"
    unit = "m"
    sign = "x of the magnet's centre"
    background = 1e-4
    largest = 3e-3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Shifted in x."""
        return element.with_errors(dx=amount)


@register
class SextupoleOffsetY(_OnSextupole):
    """A sextupole that stands above or below its axis."""

    name = "sextupole_offset_y"
    unit = "m"
    sign = "y of the magnet's centre"
    background = 1e-4
    largest = 3e-3

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Shifted in y."""
        return element.with_errors(dy=amount)
