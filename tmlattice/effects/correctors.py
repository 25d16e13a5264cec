"""Errors of correctors: their design kick is zero, their setting is each shot's."""

import math
from typing import ClassVar

from tmlattice.effects.effect import ErrorEffect, RingEffect, StrengthEffect, register
from tmlattice.lattice import Element, Kind


class _OnCorrector(RingEffect):
    group = "correctors"
    sits_on_text = "correctors"

    def sits_on(self, element: Element) -> bool:
        """Whether an element is a corrector."""
        return element.is_corrector


class _Kick(_OnCorrector):
    headline = True
    unit = "rad"
    largest = 2e-4
    recommended_action = "remove the kick of {}"
    to_check = (
        "Read back its current at setting zero: an offset of the supply, a setting that was not "
        "recorded, a stray field near it, or a neighbour with a wrong field."
    )
    own: ClassVar[Kind]

    def compensated(self, element: Element, amount: float) -> Element | None:
        """Return the opposite setting, if the kick is in the plane of an upright corrector."""
        plane = 0.0 if self.own == "hcorrector" else math.pi / 2  # OCELOT tilts a vertical one
        if element.kind != self.own or abs(element.tilt + element.errors.roll - plane) > 1e-9:
            return None
        return element.changed(angle=element.angle - amount)


@register
class CorrectorKickX(_Kick, ErrorEffect):
    """A horizontal kick beyond the setting."""

    name = "corrector_kick_x"
    words = "corrector that kicks horizontally beyond its setting"
    error = "kick_x"
    sign = "px += amount, whatever the setting"
    quantity = "horizontal kick beyond its setting"
    own = "hcorrector"


@register
class CorrectorKickY(_Kick, ErrorEffect):
    """A vertical kick beyond the setting."""

    name = "corrector_kick_y"
    words = "corrector that kicks vertically beyond its setting"
    error = "kick_y"
    sign = "py += amount, whatever the setting"
    quantity = "vertical kick beyond its setting"
    own = "vcorrector"


@register
class CorrectorCalibration(_OnCorrector, StrengthEffect):
    """A wrong ratio of a corrector's kick to its setting."""

    name = "corrector_calibration"
    responds = True
    words = "wrong calibration of a corrector"
    acts_on_settings = True
    calibrates = True
    strength = "angle"
    sign = "kick = (1 + amount) x setting; -2 is a reversed one"
    quantity = "calibration"
    recommended_action = "calibrate {}"
    to_check = (
        "Step its setting and read back its current; near -200 % its polarity is reversed, near "
        "-100 % it is off, or kicks in the other plane if that was not read."
    )
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
    quantity = "roll"
    recommended_action = "turn {} upright"
    to_check = "Measure its roll; check whether the cables of its two planes are swapped."
    background = 1e-2
    largest = 0.1


@register
class CorrectorPosition(_OnCorrector, ErrorEffect):
    """A misplaced corrector: its field is not at the position in the lattice."""

    name = "corrector_position"
    responds = True
    words = "misplaced corrector (its field is at another s)"
    acts_on_settings = True
    error = "ds"
    unit = "m"
    sign = "positive is further down: the kick comes so much later"
    quantity = "place along the beam"
    recommended_action = "correct the position of the field of {} in the lattice"
    to_check = "Measure its position; nearby iron displaces its field."
    largest = 0.1
    usual = False  # in responses, if a family of it is fitted, or on request
