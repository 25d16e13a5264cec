"""Trajectories as the monitors read them: the first turn, or turn by turn."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmlattice.errors import MeasurementError, first_of, unknown_name
from tmlattice.measurement.arrays import Unit, names_of, readings_of
from tmlattice.measurement.monitors import HIGHEST_ENERGY, Names, noise_table
from tmlattice.measurement.shown import Shown

Array = NDArray[np.float64]
Settings = Mapping[str, Mapping[str, float]]

COORDINATES = ("x", "px", "y", "py", "delta")
"""Of a launch: m, and units of the reference momentum; delta is the relative energy deviation."""

UNKNOWN_LAUNCH = (np.inf, np.inf, np.inf, np.inf, 0.0)
"""The sigma of a launch of which nothing is known, but that the energy is the nominal one."""

SETTINGS = ("kick", "k1_relative", "k2_relative", "frequency_relative")
"""What may be changed on purpose: rad, relative strengths, and the RF's relative frequency."""


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
class Measurement(Shown):
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
        lattice: what the data state about the lattice; a hint.
        energy: what the data state about the beam energy, GeV; a hint.
        devices: names that the control system has for monitors and correctors, by the names here;
            empty: unknown.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, or no reading at all.
    """

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
            unit: of x and y.
            noise, settings, shots: see the attributes.
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
        readings = np.asarray(self.readings, dtype=float)
        monitors = tuple(self.monitors)
        number = len(self.launches)
        if readings.ndim != 4 or readings.shape[::2] != (number, len(monitors)) or (
            readings.shape[3] != 2
        ):  # fmt: skip
            raise MeasurementError(
                f"readings have the shape {readings.shape}; {number} launches and "
                f"{len(monitors)} monitors need [{number}, turns, {len(monitors)}, 2]"
            )
        Names("monitor", monitors)
        launches = _five(self.launches, number, "launches")
        if not np.isfinite(launches).all():
            raise MeasurementError("a launch is not finite; give x, px, y, py of every shot")
        if np.isinf(readings).any():
            raise MeasurementError("a reading is infinite; a missing one is NaN")
        if not np.isfinite(readings).any():
            raise MeasurementError("every reading is missing; nothing can be fitted")
        shots = tuple(int(i) for i in self.shots) or tuple(range(number))
        if len(shots) != number or len(set(shots)) != number:
            raise MeasurementError(f"{number} launches need {number} shot ids, each once")
        if self.launch_sigma is not None:
            sigma = _five(self.launch_sigma, number, "launch_sigma")
            if not (sigma >= 0).all():
                raise MeasurementError("a launch_sigma is negative or NaN; it is an rms, or inf")
            self._keep(launch_sigma=sigma)
        settings = tuple(self.settings)
        if settings and len(settings) != number:
            raise MeasurementError(f"{len(settings)} settings for {number} shots; one a shot")
        if self.energy is not None and not 0 < self.energy < HIGHEST_ENERGY:
            raise MeasurementError(
                f"an energy of {self.energy:g} GeV cannot be; it is above zero, and in GeV"
            )
        for shot, changed in zip(shots, settings, strict=False):
            check_settings(shot, changed)
        self._keep(
            launches=launches,
            readings=readings,
            monitors=monitors,
            noise=noise_table(self.noise, monitors),
            settings=settings if any(settings) else (),
            shots=shots,
        )

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
        states = np.zeros((len(self.launches), 6))
        states[:, :4] = self.launches[:, :4]
        states[:, 5] = self.launches[:, 4]
        return states

    def in_order_of(self, monitors: Sequence[str]) -> "Measurement":
        """The same with other monitors, such as a ring's: NaN where one was not read.

        Raises:
            UnknownNameError: this measurement has a monitor that is not among them.
        """
        names = Names("monitor", monitors)
        place = [names[name] for name in self.monitors]
        readings = np.full((*self.readings.shape[:2], len(names.names), 2), np.nan)
        readings[:, :, place] = self.readings
        noise = None
        if self.noise is not None:
            noise = np.full((len(names.names), 2), np.nan)
            noise[place] = self.noise
        return replace(self, readings=readings, monitors=names.names, noise=noise)

    def select(
        self,
        shots: Sequence[int] | None = None,
        monitors: Sequence[str] | None = None,
        turns: Sequence[int] | None = None,
    ) -> "Measurement":
        """A part of the measurement, shots and monitors in the order asked for; None: all.

        Args:
            shots: ids.
            monitors: names.
            turns: from 0. A turn keeps its place, for turn 0 is the first: turns that are not
                named are NaN, those behind the last named one are cut.

        Raises:
            MeasurementError: a shot or turn that is not there, or no reading left.
            UnknownNameError: a monitor that is not there.
        """
        part = self
        if shots is not None:
            index = {shot: i for i, shot in enumerate(self.shots)}
            missing = [shot for shot in shots if shot not in index]
            if missing:
                known = first_of(self.shots)
                raise MeasurementError(f"no shot {missing[0]}; there are {known}")
            part = part._take([index[shot] for shot in shots])
        if monitors is not None:
            names = Names("monitor", self.monitors)
            place = [names[name] for name in monitors]
            part = replace(
                part,
                readings=part.readings[:, :, place],
                monitors=tuple(self.monitors[i] for i in place),
                noise=None if self.noise is None else self.noise[place],
            )
        if turns is not None:
            there = self.readings.shape[1]
            outside = [turn for turn in turns if not 0 <= turn < there]
            if outside or not len(turns):
                raise MeasurementError(
                    f"no turn {outside[0] if outside else 'named'}; there are 0 to {there - 1}"
                )
            readings = part.readings[:, : max(turns) + 1].copy()
            readings[:, np.setdiff1d(np.arange(max(turns) + 1), turns)] = np.nan
            part = replace(part, readings=readings)
        return part

    def _take(self, places: Sequence[int]) -> "Measurement":
        index = list(places)
        return replace(
            self,
            launches=self.launches[index],
            readings=self.readings[index],
            launch_sigma=None if self.launch_sigma is None else self.launch_sigma[index],
            settings=tuple(self.settings[i] for i in index) if self.settings else (),
            shots=tuple(self.shots[i] for i in index),
        )

    def split(self, holdout: float, seed: int = 0) -> tuple["Measurement", "Measurement | None"]:
        """Shots to fit, and held-out shots for validation; both in their order.

        Args:
            holdout: part of the shots to hold out, in [0, 1), rounded to whole shots: one at
                least where it is not 0, and one at least stays in the fit. Only shots with
                a reading are held out.
            seed: of the draw.

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
        places = range(len(self.shots))
        return self._take([i for i in places if i not in out]), self._take(sorted(out))

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


def check_settings(shot: int, settings: Settings) -> None:
    """Settings of a shot are known, finite, and each element's own.

    Raises:
        MeasurementError: states which is not.
        UnknownNameError: a setting that no element has.
    """
    Names("element", settings)
    for element, changed in settings.items():
        for name, amount in changed.items():
            if name not in SETTINGS:
                raise unknown_name("setting", name, SETTINGS)
            if (name == "frequency_relative") != (element.casefold() == "rf"):
                raise MeasurementError(
                    f"shot {shot} sets '{name}' of '{element}'; frequency_relative belongs to "
                    "the name 'rf', and nothing else does"
                )
            if not abs(amount) < np.inf:
                raise MeasurementError(
                    f"shot {shot} sets '{name}' of '{element}' to {amount}; give a finite number"
                )
