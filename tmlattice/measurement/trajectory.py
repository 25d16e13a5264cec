"""Trajectories as the monitors read them: the first turn, or turn by turn."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.measurement.arrays import Unit, names_of, readings_of
from tmlattice.measurement.monitors import Settings
from tmlattice.measurement.shots import Shots

COORDINATES = ("x", "px", "y", "py", "delta")
"""Of a launch: m, and units of the reference momentum; delta is the relative energy deviation."""

UNKNOWN_LAUNCH = (np.inf, np.inf, np.inf, np.inf, 0.0)
"""The sigma of a launch of which nothing is known, but that the energy is the nominal one."""


@dataclass(frozen=True)
class Comparison:
    """Readings less a model. Planes are (x, y); NaN where nothing was read.

    Attributes:
        residual: reading - model, m, [shot, turn, monitor, 2].
        rms: over everything that was read, m.
        rms_by_plane: m, [2].
        rms_by_monitor: m, [monitor, 2].
        rms_by_shot: m, [shot, 2].
        chi2_per_dof: mean of (residual / noise)^2 over the readings whose noise is known, each
            counted as a degree of freedom; None where no noise is known.
        readings: number of readings compared.
    """

    residual: Array
    rms: float
    rms_by_plane: Array
    rms_by_monitor: Array
    rms_by_shot: Array
    chi2_per_dof: float | None
    readings: int


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Shots):
    """Readings of one or more shots, each launched at the start of the ring.

    Attributes:
        launches: nominal (x, px, y, py, delta) at the start of the lattice sequence, [shot, 5],
            m and rad; given as [shot, 4], delta is 0.
        readings: (x, y) in m, [shot, turn, monitor, 2]; NaN where missing. Turn 0 is the first.
        monitors: names, in the order of the readings.
        noise: rms of one reading, m, [monitor, 2], NaN where unknown; None: all unknown. A pair
            (x, y), or a mapping of pairs by monitor, is taken too.
        launch_sigma: rms of the launches, [shot, 5]; inf: unknown, fitted with no prior;
            0: exact. Given as [shot, 4], delta is exact. None: unknown, delta exact.
        settings: of each shot, what was changed from the design: `{name: {"kick": rad}}`, or
            "k1_relative", "k2_relative", or "frequency_relative" under the name "rf"; () for
            the design's in every shot.
        shots: their ids; () for 0, 1, ...
        lattice, energy: what the data state about them (GeV); hints.
        devices: names that the control system has for monitors and correctors, by the names here;
            empty: unknown.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, or no reading at all.
    """

    OF_SHOTS: ClassVar[tuple[str, ...]] = ("launches", "launch_sigma")

    launches: Array
    readings: Array
    monitors: tuple[str, ...]
    noise: Array | None = None
    launch_sigma: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None
    devices: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_arrays(
        cls,
        x: ArrayLike | None,
        y: ArrayLike | None,
        monitors: Iterable[Any],
        *,
        unit: Unit = "m",
        noise: Any = None,
        launches: ArrayLike | None = None,
        launch_sigma: ArrayLike | None = None,
        settings: Sequence[Settings] = (),
        shots: Sequence[int] = (),
    ) -> Self:
        """Return the readings of one or more first turns; launches are unknown unless stated.

        Args:
            x, y: [shot, turn, monitor], [turn, monitor] or [monitor]; NaN where missing; None: not
                read.
            monitors: names, or elements of a ring.
            launches: [shot, 4 or 5], m and rad; None: unknown.
            launch_sigma: their rms, see the attributes; None: unknown.

        Raises:
            MeasurementError: shapes that do not fit, or numbers that cannot be.
        """
        names = names_of(monitors)
        readings = readings_of(x, y, names, ("shot", "turn"), unit)
        number = len(readings)
        if launches is None:
            launches, launch_sigma = np.zeros((number, 5)), np.tile(UNKNOWN_LAUNCH, (number, 1))
        return cls(
            np.asarray(launches, dtype=float), readings, names, noise,
            None if launch_sigma is None else np.asarray(launch_sigma, dtype=float),
            tuple(settings), tuple(shots),
        )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        number = len(self.readings)
        launches = _five(self.launches, number, "launches")
        if not np.isfinite(launches).all():
            raise MeasurementError("a launch is not finite; give x, px, y, py of every shot")
        self._keep(launches=launches)
        if self.launch_sigma is not None:
            sigma = _five(self.launch_sigma, number, "launch_sigma")
            if not (sigma >= 0).all():
                raise MeasurementError("a launch_sigma is negative or NaN; it is an rms, or inf")
            self._keep(launch_sigma=sigma)

    def states(self, dimension: int) -> Array:
        """The launches in the coordinates of a network.

        Args:
            dimension: 4 for (x, px, y, py), 6 for OCELOT's (x, px, y, py, tau, p), with tau = 0
                and p = delta (dE / p0 c and dE / E0 differ by 4e-9 at 6 GeV).

        Returns:
            [shot, dimension].

        Raises:
            MeasurementError: four coordinates for a launch off the nominal energy.
        """
        if dimension == 4:
            off = np.flatnonzero(self.launches[:, 4])
            if len(off):
                raise MeasurementError(
                    f"shot {self.shots[off[0]]} is launched with delta = "
                    f"{self.launches[off[0], 4]:g}, which four coordinates do not know; "
                    "take a network of six: TaylorNetwork.from_ring(ring, 6)"
                )
            return self.launches[:, :4].copy()
        if dimension != 6:
            raise MeasurementError(f"a state has 4 or 6 coordinates, not {dimension}")
        return np.insert(self.launches, 4, 0.0, axis=1)

    def select(
        self,
        shots: Sequence[int] | None = None,
        monitors: Sequence[str] | None = None,
        turns: Sequence[int] | None = None,
    ) -> Self:
        """A part of the measurement, shots and monitors in the order asked for; None: all.

        Args:
            monitors: names.
            turns: from 0. A turn keeps its place, for turn 0 is the first: turns that are not
                named are NaN, those behind the last named one are cut.

        Raises:
            MeasurementError: a shot or turn that is not there, or no reading left.
            UnknownNameError: a monitor that is not there.
        """
        part = super().select(shots, monitors)
        if turns is None:
            return part
        there = self.readings.shape[1]
        outside = [turn for turn in turns if not 0 <= turn < there]
        if outside or not len(turns):
            raise MeasurementError(
                f"no turn {outside[0] if outside else 'named'}; there are 0 to {there - 1}"
            )
        readings = part.readings[:, : max(turns) + 1].copy()
        readings[:, np.setdiff1d(np.arange(max(turns) + 1), turns)] = np.nan
        return replace(part, readings=readings)

    def split(self, holdout: float, seed: int = 0) -> tuple["Measurement", "Measurement | None"]:
        """Shots to fit, and held-out shots for validation; both in their order.

        Args:
            holdout: part of the shots to hold out, in [0, 1), rounded to whole shots: one at
                least where it is not 0, and one at least stays in the fit. Only shots with
                a reading are held out.

        Returns:
            Fit, held out; the second is None where nothing is held out: a holdout of 0, or one
            shot.

        Raises:
            MeasurementError: another holdout.
        """
        if not 0 <= holdout < 1:
            raise MeasurementError(f"a holdout of {holdout:g} cannot be; it is in [0, 1)")
        read = np.flatnonzero(np.isfinite(self.readings).any(axis=(1, 2, 3)))
        number = min(max(round(holdout * len(self.shots)), 1), len(read) - 1)
        if holdout == 0 or number < 1:
            return self, None
        out = set(np.random.default_rng(seed).choice(read, number, replace=False).tolist())
        fit = [shot for i, shot in enumerate(self.shots) if i not in out]
        return self.select(fit), self.select([self.shots[i] for i in sorted(out)])

    def compare(self, model: Array) -> Comparison:
        """What is left of the readings when a model is taken away.

        Args:
            model: m, [shot, turn, monitor, 2], or [shot, monitor, 2] for one turn.

        Raises:
            MeasurementError: another shape.
        """
        model = np.asarray(model, dtype=float)
        if model.ndim == 3:
            model = model[:, None]
        if model.shape != self.readings.shape:
            raise MeasurementError(
                f"a model of the shape {model.shape} cannot be compared with readings of the "
                f"shape {self.readings.shape}"
            )
        residual = self.readings - model
        chi2 = None
        if self.noise is not None:
            pulls = (residual / self.noise) ** 2
            known = np.isfinite(pulls)
            chi2 = float(pulls[known].mean()) if known.any() else None
        return Comparison(
            residual=residual,
            rms=float(_rms(residual, (0, 1, 2, 3))),
            rms_by_plane=_rms(residual, (0, 1, 2)),
            rms_by_monitor=_rms(residual, (0, 1)),
            rms_by_shot=_rms(residual, (1, 2)),
            chi2_per_dof=chi2,
            readings=int(np.isfinite(residual).sum()),
        )


def _rms(residual: Array, axes: tuple[int, ...]) -> Array:
    there = np.isfinite(residual)
    squares = np.where(there, residual, 0.0) ** 2
    number = there.sum(axis=axes)
    mean = squares.sum(axis=axes) / np.maximum(number, 1)
    return np.asarray(np.where(number > 0, np.sqrt(mean), np.nan))


def _five(states: Any, number: int, name: str) -> Array:
    """[shot, 5] of an array that may lack its last column, delta."""
    try:
        array = np.array(states, dtype=float)
    except (TypeError, ValueError):
        raise MeasurementError(f"{name} are numbers: [shot, 4] or [shot, 5]") from None
    if array.ndim != 2 or array.shape[0] != number or array.shape[1] not in (4, 5):
        raise MeasurementError(
            f"{name} have the shape {array.shape}; x, px, y, py and delta of {number} shots "
            f"need [{number}, 4] or [{number}, 5]"
        )
    return array if array.shape[1] == 5 else np.pad(array, ((0, 0), (0, 1)))
