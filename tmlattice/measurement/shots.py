"""Shots of a stored beam as its monitors read them: a part of them, and other monitors."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

from tmlattice.measurement.checks import monitor_places, shot_places, spread
from tmlattice.measurement.shown import Shown


class Shots(Shown):
    """A record with shots, settings, monitors and noise; see `ClosedOrbit`.

    Its field `READ` holds what was read, [shot, ..., monitor, 2].
    """

    READ: ClassVar[str]

    def in_order_of(self, monitors: Sequence[str]) -> Self:
        """The same with other monitors, such as a ring's: NaN where one was not read.

        Raises:
            UnknownNameError: this measurement has a monitor that is not among them.
        """
        own: Any = self
        places, number = monitor_places(monitors, own.monitors), len(monitors)
        changed = {
            self.READ: spread(getattr(own, self.READ), places, number),
            "monitors": tuple(monitors),
            "noise": spread(own.noise, places, number),
        }
        return replace(own, **changed)  # type: ignore[no-any-return]

    def select(
        self, shots: Sequence[int] | None = None, monitors: Sequence[str] | None = None
    ) -> Self:
        """A part of the shots and monitors, in the order asked for; None: all.

        Raises:
            UnknownNameError: a monitor that is not there.
            MeasurementError: a shot that is not there, or nothing is left.
        """
        own: Any = self
        at = shot_places(own.shots, own.shots if shots is None else shots)
        here = monitor_places(own.monitors, own.monitors if monitors is None else monitors)
        changed = {
            self.READ: getattr(own, self.READ)[at][..., here, :],
            "monitors": tuple(own.monitors[i] for i in here),
            "noise": None if own.noise is None else own.noise[here],
            "settings": tuple(own.settings[i] for i in at) if own.settings else (),
            "shots": tuple(own.shots[i] for i in at),
        }
        return replace(own, **changed)  # type: ignore[no-any-return]
