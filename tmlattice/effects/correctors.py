"""What goes wrong with correctors: their design kick is zero, their setting is each shot's own."""

import math
from typing import ClassVar

from tmlattice.effects.effect import ErrorEffect, RingEffect, StrengthEffect, register
from tmlattice.lattice import Element, Kind


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
    recommended_action = "take the kick of {} away"
    to_check = (
        "Read back its current at setting zero: an offset of the supply, a setting that was not "
        "recorded, a stray field beside it, or a neighbour that bends wrongly."
    )
    own: ClassVar[Kind]

    def undone(self, element: Element, amount: float) -> Element | None:
        """The opposite setting, where it is its own plane and the corrector is upright."""
        plane = 0.0 if self.own == "hcorrector" else math.pi / 2  # OCELOT tilts a vertical one
        if element.kind != self.own or abs(element.tilt + element.errors.roll - plane) > 1e-9:
            return None
        return element.changed(angle=element.angle - amount)


@register
class CorrectorKickX(_Kick, ErrorEffect):
    """A horizontal kick that nobody set."""

    name = "corrector_kick_x"
    words = "corrector that kicks horizontally beyond its setting"
    error = "kick_x"
    sign = "px += amount, whatever the setting"
    quantity = "horizontal kick beyond its setting"
    own = "hcorrector"


@register
class CorrectorKickY(_Kick, ErrorEffect):
    """A vertical kick that nobody set."""

    name = "corrector_kick_y"
    words = "corrector that kicks vertically beyond its setting"
    error = "kick_y"
    sign = "py += amount, whatever the setting"
    quantity = "vertical kick beyond its setting"
    own = "vcorrector"


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
    quantity = "calibration"
    recommended_action = "calibrate {}"
    to_check = (
        "Step its setting and read back its current; near -200 % its cables are exchanged, near "
        "-100 % it is off, or kicks in the other plane where that was not read."
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
    to_check = "Measure its roll; look whether its two planes' cables are mixed up."
    background = 1e-2
    largest = 0.1


@register
class CorrectorPosition(_OnCorrector, ErrorEffect):
    """The field of a corrector is not where the lattice has it: iron beside it draws it away."""

    name = "corrector_position"
    responds = True
    words = "field of a corrector elsewhere along the beam"
    acts_on_settings = True
    error = "ds"
    unit = "m"
    sign = "positive is further down: the kick comes so much later"
    quantity = "place along the beam"
    recommended_action = "enter the place of the field of {} into the lattice"
    to_check = "Measure where it stands; iron beside it draws its field away."
    largest = 0.1
    usual = False  # in responses, where a family of it is fitted, or where somebody names it
