"""What goes wrong with correctors: their design kick is zero, their setting is each shot's own."""

from tmlattice.effects.effect import ErrorEffect, RingEffect, StrengthEffect, register
from tmlattice.lattice import Element


class _OnCorrector(RingEffect):
    group = "correctors"
    sits_on_text = "correctors"

    def sits_on(self, element: Element) -> bool:
        """Horizontal and vertical correctors."""
        return element.kind in ("hcorrector", "vcorrector")


class _Kick(_OnCorrector):
    headline = True
    unit = "rad"
    largest = 2e-4


@register
class CorrectorKickX(_Kick, ErrorEffect):
    """A horizontal kick that nobody set."""

    name = "corrector_kick_x"
    words = "corrector that kicks horizontally beyond its setting"
    error = "kick_x"
    sign = "px += amount, whatever the setting"


@register
class CorrectorKickY(_Kick, ErrorEffect):
    """A vertical kick that nobody set."""

    name = "corrector_kick_y"
    words = "corrector that kicks vertically beyond its setting"
    error = "kick_y"
    sign = "py += amount, whatever the setting"


@register
class CorrectorCalibration(_OnCorrector, StrengthEffect):
    """A corrector kicks more or less than it is told to."""

    name = "corrector_calibration"
    responds = True
    words = "wrong calibration of a corrector"
    acts_on_settings = True
    calibrates = True
    strength = "angle"
    unit = "relative"
    sign = "kick = (1 + amount) x setting; -2 is a reversed one"
    background = 0.04
    largest = 2.0


@register
class CorrectorRoll(_OnCorrector, ErrorEffect):
    """A corrector turned about the beam axis."""

    name = "corrector_roll"
    responds = True
    words = "corrector rolled about the beam axis"
    acts_on_settings = True
    calibrates = True
    error = "roll"
    unit = "rad"
    sign = "positive turns the kick from x towards y"
    background = 1e-2
    largest = 0.1
