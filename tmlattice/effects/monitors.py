"""Errors of monitors: see `Monitors` for all of them together."""

from typing import ClassVar

from tmlattice.effects.effect import ReadingEffect, register
from tmlattice.effects.reading import Monitors


class _Offset(ReadingEffect):
    headline = True
    unit = "m"
    sign = "reading minus beam"
    recommended_action = "correct the offset of {}"
    to_check = (
        "Find its offset by steering the beam through the centre of the adjacent quadrupole; check "
        "for a lost offset in its electronics."
    )
    background = 2e-4
    largest = 2e-3
    plane: int

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Add to the offset."""
        monitors.offset[at, self.plane] += amount


@register
class MonitorOffsetX(_Offset):
    """A horizontal offset of a monitor."""

    name = "monitor_offset_x"
    words = "horizontal offset of a BPM"
    quantity = "offset in x"
    plane = 0


@register
class MonitorOffsetY(_Offset):
    """A vertical offset of a monitor."""

    name = "monitor_offset_y"
    words = "vertical offset of a BPM"
    quantity = "offset in y"
    plane = 1


class _Gain(ReadingEffect):
    multiplies = True
    headline = True
    calibrates = True
    recommended_action = "calibrate {}"
    to_check = (
        "Check its attenuators, gains and cables; near -200 % two cables of the plane are "
        "swapped, near -100 % a signal is lost."
    )
    unit = "relative"
    sign = "reading = (1 + amount) beam; -2 is a reversed one"
    background = 0.025
    largest = 2.0
    plane: int

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Multiply the gain."""
        monitors.gain[at, self.plane] = (1 + monitors.gain[at, self.plane]) * (1 + amount) - 1


@register
class MonitorGainX(_Gain):
    """A wrong gain of a monitor in x."""

    name = "monitor_gain_x"
    responds = True
    words = "wrong horizontal gain of a BPM"
    quantity = "gain in x"
    plane = 0


@register
class MonitorGainY(_Gain):
    """A wrong gain of a monitor in y."""

    name = "monitor_gain_y"
    responds = True
    words = "wrong vertical gain of a BPM"
    quantity = "gain in y"
    plane = 1


@register
class MonitorRoll(ReadingEffect):
    """A monitor turned about the beam axis."""

    name = "monitor_roll"
    responds = True
    words = "BPM rolled about the beam axis"
    quantity = "roll"
    recommended_action = "turn {} upright, or its readings"
    to_check = "Measure its roll, and check the mounting of its pick-ups."
    calibrates = True
    unit = "rad"
    sign = "x_read = x cos + y sin, y_read = -x sin + y cos"
    background = 5e-3
    largest = 0.3

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Add to the angle."""
        monitors.roll[at] += amount


@register
class MonitorCoupling(ReadingEffect):
    """A monitor whose electronics mix the planes."""

    name = "monitor_coupling"
    responds = True
    words = "BPM that mixes its planes"
    quantity = "coupling of its planes"
    recommended_action = "calibrate the electronics of {}"
    to_check = "Measure crosstalk between its channels; compare the gains of its four buttons."
    calibrates = True
    unit = "relative"
    sign = "x_read += amount y, y_read += amount x"
    background = 5e-3
    largest = 0.3

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Add to the coupling."""
        monitors.coupling[at] += amount


@register
class MonitorSwap(ReadingEffect):
    """A monitor with swapped planes."""

    name = "monitor_swap"
    responds = True
    words = "BPM with swapped planes"
    quantity = "planes swapped"
    recommended_action = "swap the cables of {} back"
    to_check = "Follow its cables from the pick-ups to the electronics: x and y are swapped."
    calibrates = True
    unit = "discrete"
    sign = "1: x and y are swapped"
    largest = 1.0
    discrete = True

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Swap the planes (0 does not)."""
        monitors.swapped[at] ^= amount != 0


@register
class MonitorTurnOffset(ReadingEffect):
    """A monitor with a wrong turn count."""

    name = "monitor_turn_offset"
    words = "BPM with a wrong turn count"
    quantity = "count of turns"
    recommended_action = "set the turn count of {}"
    to_check = "Check its trigger and the delay of its turn clock."
    unit = "turns"
    sign = "what it calls turn t is the beam's turn t + amount"
    largest = 3.0
    curved = True
    usual = False
    of_turns = True
    whole = True

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Add to the turn offset."""
        monitors.late[at] += amount


@register
class MonitorDead(ReadingEffect):
    """A monitor without a signal, or one whose reading is frozen."""

    name = "monitor_dead"
    words = "dead BPM"
    quantity = "readings"
    recommended_action = "repair {}"
    to_check = "Check its cables, power and electronics, and whether its data are refreshed."
    calibrates = True
    modelled = False
    forms: ClassVar = {1.0: "no signal", 2.0: "frozen readings"}
    unit = "discrete"
    sign = "1: no signal; 2: frozen at its first reading of the measurement"
    largest = 2.0
    discrete = True

    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Silence or freeze the monitor."""
        (monitors.frozen if amount == 2 else monitors.silent)[at] = amount != 0
