"""What the beam's own fields do in a chamber that is not smooth."""

from tmlattice.effects.effect import ThinKickEffect, register
from tmlattice.lattice import Element


class _WakeKick(ThinKickEffect):
    group = "beam"
    unit = "1/m"
    largest = 0.03
    sits_on_text = "cavities, wigglers and their narrow chambers, markers (collimators, tapers)"
    recommended_action = "find what drives the wake field at {}"
    to_check = "Repeat at another charge: a wake field grows with it; look at the chamber there."
    usual = False  # a pulse that is injected to be threaded is too weak for it

    def sits_on(self, element: Element) -> bool:
        """Where a chamber is not smooth; a collimator or a taper is a marker in most lattices."""
        return element.kind in ("cavity", "wiggler", "marker")


@register
class WakeKickX(_WakeKick):
    """A horizontal kick in proportion to the horizontal displacement."""

    name = "wake_kick_x"
    words = "horizontal wake field"
    sign = "thin, in the middle: px += amount x"
    slopes = (1.0, 0.0, 0.0, 0.0)


@register
class WakeKickY(_WakeKick):
    """A vertical kick in proportion to the vertical displacement."""

    name = "wake_kick_y"
    words = "vertical wake field"
    sign = "thin, in the middle: py += amount y"
    slopes = (0.0, 0.0, 0.0, 1.0)
