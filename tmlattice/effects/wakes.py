"""Wake fields of the beam in a chamber that is not smooth."""

from tmlattice.effects.effect import ThinKickEffect, register
from tmlattice.lattice import Element


class _WakeKick(ThinKickEffect):
    group = "beam"
    unit = "1/m"
    largest = 0.03
    sits_on_text = "cavities, wigglers and their narrow chambers, markers (collimators, tapers)"
    recommended_action = "find the source of the wake field at {}"
    to_check = "Repeat at another charge: a wake field is proportional to it; check the chamber."
    usual = False  # too weak for a single injected pulse

    def sits_on(self, element: Element) -> bool:
        """Whether an element has a chamber that is not smooth; markers may be collimators."""
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
