"""What goes wrong with correctors: their design kick is zero, their setting is each shot's own."""

from tmlattice.effects.effect import RingEffect, register
from tmlattice.lattice import Element


class _OnCorrector(RingEffect):
    sits_on_text = "correctors"

    def sits_on(self, element: Element) -> bool:
        """Horizontal and vertical correctors."""
        return element.kind in ("hcorrector", "vcorrector")


class _Kick(_OnCorrector):
    unit = "rad"
    largest = 2e-4


@register
class CorrectorKickX(_Kick):
    """A horizontal kick that nobody set."""

    name = "corrector_kick_x"
    sign = "px += amount, whatever the setting"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A horizontal kick."""
        return element.with_errors(kick_x=amount)


@register
class CorrectorKickY(_Kick):
    """A vertical kick that nobody set."""

    name = "corrector_kick_y"
    sign = "py += amount, whatever the setting"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """A vertical kick."""
        return element.with_errors(kick_y=amount)


@register
class CorrectorCalibration(_OnCorrector):
    """A corrector kicks more or less than it is told to."""

    name = "corrector_calibration"
    unit = "relative"
    sign = "kick = (1 + amount) x setting; -2 is a reversed one"
    background = 0.04
    largest = 2.0

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """The set kick times 1 + amount."""
        if element.angle == 0:
            return element
        return element.changed(angle=element.angle * (1 + amount))


@register
class CorrectorRoll(_OnCorrector):
    """A corrector turned about the beam axis."""

    name = "corrector_roll"
    unit = "rad"
    sign = "positive turns the kick from x towards y"
    background = 1e-2
    largest = 0.1

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Turned, with whatever kick it has."""
        return element.with_errors(roll=amount)
