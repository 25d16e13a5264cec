"""Global errors of first turns: a wrong sign, unit or order of all readings or settings.

>>> search = GlobalErrors(ring, measurement)
>>> search.verdict()                    # the correction that improves the data far

Each assumption is corrected in the data, and the trajectories of all sections are fitted again. The
score is their agreement with themselves, with the next section, and with the launches. Every term
has its own scale, so that the section of a fault costs the logarithm of its misfit: a strong fault
does not look global, and does not hide a global error.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, Settings
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.measurement.assume import ASSUMPTIONS, assume, in_beam_order
from tmlattice.observe.sections import Passes, SectionFits, Sections, distance, log_uncertainty

Array = NDArray[np.float64]

SHOTS, TURNS = 8, 3
"""Shots and turns that are used: a global error is in each."""
UNSTATED_NOISE = 1e-5
"""m; noise of a measurement that states none."""
LAUNCH_TOLERANCE = 0.03
"""Relative tolerance of fitted launches, for small errors of magnets and monitors in the first
section."""
NOISE_WIDTH = np.log(3.0)
"""Uncertainty of a stated noise: a factor of three, one standard deviation."""
ORBIT, ORBIT_WIDTH = 1e-3, np.log(10.0)
"""m; usual orbit of first turns, to a factor of ten, one standard deviation."""
ALIKE = 3.0
"""Log evidence below which two assumptions are equivalent."""
_LAST = ("noise-from-data", "launches-unknown", "readings-doubled", "readings-halved")
"""Not tried: other assumptions include the first two, and distributed errors mimic a factor of two.
"""
BEAM = 4
"""Best assumptions that are combined with every other."""
_TURNED = np.array([1.0, -1.0, 1.0, -1.0])


Names = tuple[str, ...]

GAIN, CERTAIN = 12.0, 15.0
"""Log evidence above which a global error is reported, and above which it is certain: no healthy
measurement of `benchmarks/data_checks.py` gains as much."""
SHARE = 0.65
"""Share of all changed terms that an assumption must improve: the section of a fault may gain much
by chance, but then many others lose."""
CLEAR, CLEAR_UNIT, AGAINST = 3.0, 30.0, 10.0
"""Factors by which chi-square must fall: of sections or launches, at least; with a unit corrected;
and of sections where launches contradict. Units are powers of a thousand."""
RIGHT = 5.0
"""Chi-square of correct launches."""
FINE, FINE_GAIN = 0.1, 30.0
"""Share of the orbit below which sections agree in any case, and log evidence that curvature, or a
few corrector settings, must then gain."""


@dataclass(frozen=True)
class Terms:
    """Mismatches between the parts of a measurement, and their degrees of freedom.

    Attributes:
        local, joints: mean squares in units of the noise, within sections and where they meet;
            those between turns are joints too.
        freedom: of the sections' terms.
        launch: mean squares of launches by plane, in units of noise and stated rms, by the scale of
            the noise: see `GlobalErrors`.
        stated: log of the stated noise over the estimated one, 0 if none is stated; log of the
            orbit over a usual one; each in standard deviations.
        blur: log uncertainty of launches and joints, which penalises vague readings.
        level, share: of the sections: see `SectionFits`.
        unit: chi-square per reading of a mean square of 1: of the stated noise, or of the best
            assumption's.
    """

    local: Array
    joints: Array
    freedom: NDArray[np.int64]
    launch: Array
    stated: Array
    blur: float
    level: float
    share: float
    unit: float

    def cost(self, square: float) -> Array:
        """Negative log likelihood of each term, with its own scale, at least the noise."""
        return np.concatenate([
            self.freedom / 2 * _robust(self.local / square),
            2 * _robust(self.joints / square),
            np.log(np.maximum(self.launch, 1.0)),  # their information differs
            self.stated**2 / 2,
        ])  # fmt: skip


def _robust(misfit: Array) -> Array:
    return np.where(misfit < 1, misfit - 1, np.log(np.maximum(misfit, 1.0)))


@dataclass(frozen=True)
class Verdict:
    """A global error whose correction improves the data far.

    Attributes:
        names: assumptions, together.
        gain: log evidence.
        before, after: chi-square per reading of the sections, and of the launches (NaN if none is
            stated), [2].
        alike: other assumptions that explain the data as well.
    """

    names: Names
    gain: float
    before: tuple[float, float]
    after: tuple[float, float]
    alike: tuple[Names, ...] = ()


def certain(verdict: Verdict) -> bool:
    """Whether the evidence is decisive."""
    return worth(verdict) > CERTAIN


def worth(verdict: Verdict) -> float:
    """Log evidence; each assumption beyond the first must be certain by itself."""
    return verdict.gain - CERTAIN * (len(verdict.names) - 1)


def widely(stated: Terms, other: Terms, square: float) -> bool:
    """Whether an assumption improves nearly all terms that it changes."""
    a, b = stated.cost(square), other.cost(square)
    if len(a) != len(b):
        return True
    better, worse = np.maximum(a - b, 0).sum(), np.maximum(b - a, 0).sum()
    return bool(better > SHARE * (better + worse))


def believable(verdict: Verdict, share: float) -> bool:
    """Whether the corrected terms are right, not only less wrong.

    Args:
        verdict: the global error.
        share: of the orbit that the sections leave as stated.
    """
    (local, launch), (local_then, launch_then) = verdict.before, verdict.after
    local_clears, launch_clears = local / max(local_then, 1e-12), launch / max(launch_then, 1e-12)
    if launch_then > RIGHT and local_clears < AGAINST:  # false if no launch is stated
        return False
    unit = any("-in-" in name for name in verdict.names)
    clear = CLEAR_UNIT if unit else CLEAR
    if local_clears > clear or launch_clears > clear:
        return True
    return share < FINE and not unit and verdict.gain > FINE_GAIN


def levels(terms: Terms) -> tuple[float, float]:
    """Chi-square per reading of the sections, and of the launches in the worse plane."""
    launch = terms.launch.reshape(-1, 2)
    worse = float(np.median(launch, axis=0).max()) if len(launch) else float("nan")
    return terms.unit * terms.level, worse


@dataclass
class GlobalErrors:
    """Search for global errors of one measurement.

    Args:
        ring: the design.
        measurement: first turns, its monitors those of the ring.
        known: causes in the model.
    """

    ring: Ring
    measurement: Measurement
    known: Sequence[Cause] = ()
    _sections: dict[float, Sections] = field(default_factory=dict, repr=False)
    _found: dict[object, tuple[object, Passes, SectionFits]] = field(
        default_factory=dict, repr=False
    )
    _made: dict[Names, Measurement] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self.monitors = [monitor.name for monitor in self.ring.monitors]
        self.measurement = _part(in_beam_order(self.measurement, self.monitors))
        self.scale = _size(self.measurement)
        self.kicks = _kicks(self.measurement.settings)

    def assumed(self, names: Names) -> Measurement:
        """Return the data with assumptions corrected."""
        if names not in self._made:
            self._made[names] = assume(self.measurement, names, self.monitors)
        return self._made[names]

    # --- one assumption -------------------------------------------------------------------------
    def found(self, data: Measurement) -> tuple[Passes, SectionFits]:
        """Return the trajectories of the sections of a measurement."""
        factor = self._times(data)
        key = (id(data.readings), factor)
        if key not in self._found:
            self._found[key] = (data, *self._fit(data, factor))  # keeps the data, and so their id
        return self._found[key][1:]

    def _times(self, data: Measurement) -> float:
        """Common factor of the shots' kicks."""
        if data.settings is self.measurement.settings or not self.kicks.any():
            return 1.0
        return float(_kicks(data.settings) @ self.kicks / (self.kicks @ self.kicks))

    def _fit(self, data: Measurement, times: float) -> tuple[Passes, SectionFits]:
        shots, turns = data.readings.shape[:2]
        readings = data.readings.reshape(shots * turns, -1, 2)
        read = np.isfinite(readings).any(axis=(1, 2))
        shot, turn = (own[read] for own in np.divmod(np.arange(len(readings)), turns))
        noise = np.full((len(data.monitors), 2), UNSTATED_NOISE)
        if self.measurement.noise is not None:
            own = self._noise(data)
            noise = np.where(np.isfinite(own), own, np.nanmedian(own))
        factor = _size(data) / self.scale if self.scale > 0 else 1.0
        sigma = data.launch_sigma
        alone = sigma is not None and bool(sigma[:, 4].any())
        passes = Passes(readings[read], factor * noise, data.launches[shot, 4], shot, turn, alone)
        return passes, self._section(times).fit(passes)

    def _section(self, times: float) -> Sections:
        """Sections with the shots' kicks multiplied."""
        if 1.0 not in self._sections:
            at = {name.casefold(): i for i, name in enumerate(self.monitors)}
            data = self.measurement
            places = np.array([at[self.ring[name].name.casefold()] for name in data.monitors])
            settings = data.settings or tuple({} for _ in data.launches)
            self._sections[1.0] = Sections(self.ring, settings, places, self.known)
        if times not in self._sections:
            self._sections[times] = self._sections[1.0].with_kicks(times)
        return self._sections[times]

    def _noise(self, data: Measurement) -> Array:
        """Stated noise, in the present order of the monitors."""
        assert self.measurement.noise is not None
        if data.noise is None or data.noise.shape != self.measurement.noise.shape:
            return self.measurement.noise
        ratio = np.nanmedian(data.noise) / np.nanmedian(self.measurement.noise)
        return np.asarray(data.noise / ratio)

    def terms(self, names: Names, square: float) -> Terms:
        """Return the mismatches that an assumption leaves.

        Args:
            names: assumptions, together; () for the data as stated.
            square: variance of the readings, in units of the stated one.
        """
        data = self.assumed(names)
        passes, found = self.found(data)
        spreads = [found.covariance[:, 1:] + found.carried[:, :-1]]
        joints = [distance(found.start[:, 1:] - found.end[:, :-1], spreads[0]).ravel()]
        follows = np.flatnonzero((np.diff(passes.shot) == 0) & (np.diff(passes.turn) == 1))
        if len(follows):
            miss = found.start[follows + 1, 0] - found.end[follows, -1]
            spreads.append(found.covariance[follows + 1, 0] + found.carried[follows, -1])
            joints.append(distance(miss, spreads[1]))
        noise, unit = 0.0, 1 / square
        orbit = np.log(max(_size(data), 1e-30) / ORBIT) / ORBIT_WIDTH
        if data.noise is not None:
            ratio = float(np.nanmedian(passes.sigma) / np.nanmedian(data.noise))
            noise, unit = float(np.log(ratio * np.sqrt(square))) / NOISE_WIDTH, ratio**2
        backwards = "beam-backwards" in names
        launch, blur = self._launch(data, passes, found, square, backwards)
        times = _size(data) / self.scale
        blur += sum(log_uncertainty(own / times**2) for own in spreads)
        return Terms(
            found.misfit.ravel(),
            np.concatenate(joints),
            found.freedom.ravel(),
            launch,
            np.array([noise, orbit]),
            blur,
            found.level,
            found.share(passes),
            unit,
        )

    def launches(self, square: float, tolerance: float) -> tuple[Array, Array]:
        """Mean squares of fitted less stated launches by plane, [shot, 2], and the misfit of the
        sections that determine them, [shot]."""
        passes, found = self.found(self.measurement)
        first = np.flatnonzero(np.append(True, np.diff(passes.shot) != 0))
        own, _ = self._launch(self.measurement, passes, found, square, False, tolerance)
        return own.reshape(-1, 2), found.misfit[first, 0]

    def _launch(
        self,
        data: Measurement,
        passes: Passes,
        found: SectionFits,
        square: float,
        backwards: bool,
        tolerance: float = LAUNCH_TOLERANCE,
    ) -> tuple[Array, float]:
        """Mean squares of fitted less stated launches by plane, [shot * 2], and the log of their
        uncertainty."""
        if backwards:  # the end of the last turn, against the stated launches
            last = np.flatnonzero(np.append(np.diff(passes.shot) != 0, True))
            shot, fitted = passes.shot[last], found.end[last, -1] * _TURNED
            covariance = found.carried[last, -1] * np.outer(_TURNED, _TURNED)
            stated, J = self.measurement.launches[shot], np.tile(np.eye(4), (len(last), 1, 1))
            sigma = self.measurement.launch_sigma
        else:
            first = np.flatnonzero(np.append(True, np.diff(passes.shot) != 0))
            shot, fitted = passes.shot[first], found.start[first, 0]
            covariance = found.covariance[first, 0]
            energy = found.energy[first, 0]
            covariance = covariance + energy[:, :, None] * energy[:, None]
            stated, sigma = data.launches[shot], data.launch_sigma
            J = np.tile(np.eye(4), (len(first), 1, 1))
            if passes.turn[first].any():
                stated, J = self._carried(data, passes, first)
        if sigma is None or np.isinf(sigma[shot, :4]).all():
            return np.zeros(0), 0.0
        own = np.minimum(sigma[shot, :4], 1e3)
        width = tolerance * np.sqrt(np.mean(fitted**2, axis=0))
        spread = square * covariance + (J * own[:, None] ** 2) @ np.swapaxes(J, 1, 2)
        spread = spread + np.diag(np.maximum(width, 1e-12) ** 2)
        times = _size(data) / self.scale
        open_ = square * covariance / (own**2 + np.maximum(width, 1e-12) ** 2)[:, None] / times**2
        blur = log_uncertainty(np.eye(4) + open_)
        miss = np.clip(np.nan_to_num(fitted - stated[:, :4], nan=1e6), -1e6, 1e6)
        planes = [distance(miss[:, p], spread[:, p, p]) for p in (slice(0, 2), slice(2, 4))]
        return np.stack(planes, axis=1).ravel(), blur

    def _carried(
        self, data: Measurement, passes: Passes, first: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Launches carried to the first measured turn."""
        sections = self._section(self._times(data))
        stated, slopes = np.zeros((len(first), 5)), np.zeros((len(first), 4, 4))
        for i, one in enumerate(first):
            shot = passes.shot[one : one + 1]
            turns = int(passes.turn[one])
            x, J = sections.carried(data.launches[shot], shot, turns)
            stated[i], slopes[i] = x[0], J[0]
        return stated, slopes

    # --- all of them ----------------------------------------------------------------------------
    def candidates(self) -> list[Names]:
        """Return the assumptions that these data allow."""
        data = self.measurement
        names = [n for n, a in ASSUMPTIONS.items() if a.trajectory and n not in _LAST]
        without = []
        if data.launch_sigma is None or np.isinf(data.launch_sigma[:, :4]).all():
            without += ["launches", "slopes", "positions", "beam"]
            without += ["readings-in-km"]  # distinguished by curvature alone
        if not data.launches[:, 4].any():
            without += ["energies"]
        if not any("kick" in own for shot in data.settings for own in shot.values()):
            without += ["settings"]
        if len(data.monitors) < 4:
            without += ["monitors"]
        found: list[Names] = [(n,) for n in names if not {n, n.split("-")[0]} & set(without)]
        return [own for own in found if self._possible(own)]

    def _possible(self, names: Names) -> bool:
        try:
            self.assumed(names)
        except MeasurementError:
            return False
        return True

    def square(self, several: Iterable[Names]) -> float:
        """Variance of the readings in units of the stated one, from the best of several
        assumptions."""
        found = [self.found(self.assumed(names))[1].level for names in several]
        return max(float(np.nanmin(found)), 1e-12) if np.isfinite(found).any() else 1.0

    def verdict(self) -> Verdict | None:
        """Return the assumption that improves the data far, if any; two together if that is far
        better still."""
        several = self.candidates()
        square = self.square([(), *several])
        stated = self.terms((), square)
        found = [own for names in several if (own := self._judged(names, stated, square))]
        found.sort(key=worth, reverse=True)
        if not found or found[0].gain < GAIN:
            return None
        pairs = {
            tuple(sorted({*first.names, *second}, key=list(ASSUMPTIONS).index))
            for first in found[:BEAM]
            for second in several
            if not _same_part(first.names[0], second[0])
        } - set(several)
        found += [
            own for names in sorted(pairs)
            if self._possible(names) and (own := self._judged(names, stated, square))
        ]  # fmt: skip
        found = [own for own in found if worth(own) > GAIN and believable(own, stated.share)]
        if not found:
            return None
        best = max(map(worth, found))
        alike = [own for own in found if worth(own) > best - ALIKE]
        first = min(alike, key=lambda own: [list(ASSUMPTIONS).index(n) for n in own.names])
        return replace(first, alike=tuple(own.names for own in alike if own is not first))

    def _judged(self, names: Names, stated: Terms, square: float) -> Verdict | None:
        """Return the gain of an assumption that improves nearly all terms that it changes."""
        other = self.terms(names, square)
        if not widely(stated, other, square):
            return None
        gain = float(stated.cost(square).sum() - other.cost(square).sum())
        gain -= max(other.blur - stated.blur, 0.0)
        return Verdict(names, gain, levels(stated), levels(other))

    def corrected(self, names: Names) -> "GlobalErrors":
        """Return the search with assumptions corrected in the data."""
        data = self.assumed(names)
        sections = {1.0: self._section(self._times(data))}
        return GlobalErrors(self.ring, data, self.known, sections)


def _same_part(one: str, other: str) -> bool:
    """Whether two assumptions exclude each other: both about the order of the monitors, about the
    settings, or about the unit of one quantity."""
    (a, *_), (b, *_) = one.split("-"), other.split("-")
    units = "-in-" in one and "-in-" in other
    return one == other or (a == b and (units or a in ("monitors", "settings")))


def _kicks(settings: Sequence[Settings]) -> Array:
    """All set kicks, in order."""
    return np.array([
        own["kick"] for shot in settings for own in shot.values() if "kick" in own
    ])  # fmt: skip


def _part(data: Measurement) -> Measurement:
    """A few shots and turns, those with the most readings."""
    count = np.isfinite(data.readings).sum(axis=(2, 3))  # [shot, turn]
    shots = np.sort(np.argsort(-count.sum(axis=1), kind="stable")[:SHOTS])
    read = np.flatnonzero(count[shots].any(axis=0))
    turns = range(int(read[min(TURNS, len(read)) - 1]) + 1)
    return data.select(shots=[data.shots[i] for i in shots], turns=list(turns))


def _size(data: Measurement) -> float:
    there = data.readings[np.isfinite(data.readings)]
    return float(np.sqrt(np.mean(there**2)))
