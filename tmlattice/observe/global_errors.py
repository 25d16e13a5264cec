"""Global errors: a wrong sign, unit or order of all readings or settings.

>>> search = OfTurns(ring, measurement)
>>> search.verdict()                    # the correction that improves the data far

Each assumption (`measurement.assume`) is corrected in the data, and these are scored again, in
every kind of measurement by the same search. Of first turns the trajectories of all sections are
fitted again. The score is their agreement with themselves, with the next section, and with the
launches. Every term has its own scale, so that the section of a fault costs the logarithm of its
misfit: a strong fault does not look global, and does not hide a global error. What all passes have
in common counts once, and is compared with the orbit of a ring with distributed kicks: a machine
whose orbit is millimetres off is no global error.
"""

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import INVISIBLE, TINY, Array, Flags, Indices, finite, rms
from tmlattice.effects import Cause, Settings
from tmlattice.errors import MeasurementError
from tmlattice.inference import chi2
from tmlattice.inference.judgement import DEFAULT
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.measurement.assume import ASSUMPTIONS, assume, in_beam_order, is_unit
from tmlattice.observe.sections import (
    DIVERGED_SIGMA,
    FARTHEST,
    Passes,
    SectionFits,
    Sections,
    distance,
    log_uncertainty,
    mean_pass,
    scaled,
)

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
LEFT, TOO_WELL = 4.0, 0.1
"""Ratio of what each of two corrections leaves to what both do, at least; and chi-square of
launches below which they are no evidence of a unit: readings next to zero fit any."""
TOGETHER = 10_000
"""BPMs times passes that are fitted at once: their maps fit into a processor's cache."""
ROUNDS = 20
"""Reweighted least squares."""
ALIKE = 0.95
"""Correlation of fitted with stated launches, from which their ratio is a factor of all."""
ERRORS = 4.0
"""Independent numbers by which a fault changes what is read in a section, or at a joint, whatever
the number of shots: a kick and a gradient in each plane."""
KICKS = np.append(0.0, 10.0 ** np.arange(0, 11))
"""Variances of distributed kicks that are tried: of a section's typical reading, over its noise's.
"""


@dataclass(frozen=True)
class Terms:
    """Mismatches between the parts of a measurement.

    Attributes:
        cost: negative log likelihood of each term, with its own scale, at least the noise.
        blur: log uncertainty of launches and joints, which penalises vague readings.
        levels, launch: chi-square per reading of the sections, and of the launches in the worse
            plane (NaN if none is stated): of all that was read, and of its changes from pass to
            pass, [2].
    """

    cost: Array
    blur: float
    levels: Array
    launch: Array


@dataclass(frozen=True)
class Split:
    """Mismatches in two parts: what all passes have in common, as kicks of the ring have, and what
    changes from pass to pass. The common part is a single piece of evidence.

    Attributes:
        common: mean over the passes, times the root of their number, [term, row].
        spread: its covariance by noise, [term, row, row].
        kicked: its change by unit kicks of the ring, [term, row, kick].
        changes: sum of squares of the rest, [term].
        freedom: of both, [2, term].
        errors: degrees of freedom that a fault of the machine changes.
    """

    common: Array
    spread: Array
    kicked: Array
    changes: Array
    freedom: Array
    errors: float

    @classmethod
    def of(
        cls, miss: Array, spread: Array, kicked: Array, there: Flags,
        freedom: Array | Indices, errors: float = ERRORS,
    ) -> "Split":  # fmt: skip
        """Split mismatches.

        Args:
            miss: [pass, term, row].
            spread: their covariance by noise, [pass, term, row, row]; [1, 1, row, row] is that of
                independent readings.
            kicked: their change by unit kicks, [term, row, kick].
            there: what was measured, [pass, term, row].
            freedom: of each, [pass, term].
        """
        mean, count = mean_pass(miss, there), there.sum(axis=0)
        rest = np.where(there, miss - mean, 0.0)
        size = miss.shape[-1]
        each = (rest**2).mean(axis=-1) if len(spread) < len(miss) else distance(rest, spread)
        usual = np.broadcast_to(spread.mean(axis=0), (len(mean), size, size))
        most = freedom.max(axis=0)
        root = np.sqrt(count)
        return cls(
            mean * root, usual, finite(kicked) * root[..., None],
            size * np.where(freedom > 0, each, 0.0).sum(axis=0),
            np.stack([most, freedom.sum(axis=0) - most]), errors,
        )  # fmt: skip

    def cost(self, square: float, kicks: Array) -> Array:
        """Negative log likelihood of all terms of both parts, with their own scales, [kicks, term].

        Args:
            square: variance of the noise, in units of the stated one.
            kicks: variances of the kicks, in units of the noise's variance.
        """
        size, even = scaled(self.spread)
        width, axes = np.linalg.eigh(even)
        back = np.swapaxes(axes / np.sqrt(np.maximum(width, INVISIBLE))[:, None], 1, 2)
        kicked = back @ finite(self.kicked / size[..., None], posinf=0, neginf=0)
        by_kicks, axes = np.linalg.eigh(kicked @ np.swapaxes(kicked, 1, 2))
        limit = DIVERGED_SIGMA
        common = np.clip(finite(self.common / size, nan=limit), -limit, limit)
        along = np.swapaxes(axes, 1, 2) @ (back @ common[..., None])  # the axes of the kicks
        own = along[..., 0] ** 2
        wider = 1 + kicks[:, None, None] * np.maximum(by_kicks, 0.0)
        free, changing = self.freedom
        misfit = (own / wider).sum(axis=2) / np.maximum(free, 1) / square
        changes = self.changes / np.maximum(changing, 1) / square
        common_cost = _robust(misfit, free, self.errors) + np.log(wider).sum(axis=2) / 2
        rest = np.broadcast_to(_robust(changes, changing, self.errors), common_cost.shape)
        return np.concatenate([np.where(free > 0, common_cost, 0.0), rest], axis=1)

    def level(self, worst: bool = False) -> float:
        """Mean square of the changes from pass to pass in the typical term, or in the worst one;
        NaN if there are none."""
        changing = self.freedom[1]
        some = changing > 0
        if not some.any():
            return float("nan")
        each = self.changes[some] / changing[some]
        usual = chi2.median_per_freedom(changing[some])
        return float(each.max() if worst else np.median(each / usual))


@dataclass(frozen=True)
class Launches:
    """Fitted less stated launches.

    Attributes:
        miss: by plane, [shot, plane, 2].
        spread: its covariance, [shot, plane, 2, 2].
        stated: [shot, 4].
        split: the same in two parts.
    """

    miss: Array
    spread: Array
    stated: Array
    split: Split

    def beyond_a_fault(self) -> Array:
        """Mismatches [shot, plane, 2] less their part that is a constant and a linear map of the
        plane's launches, as kicks and gradients make it, by least absolute values."""
        left = self.miss.copy()
        size = np.sqrt(np.einsum("...ii->...i", self.spread))
        number = len(left)
        for plane in (0, 1):
            stated = self.stated[:, 2 * plane : 2 * plane + 2]
            largest = np.maximum(np.abs(stated).max(axis=0), TINY)
            made = np.column_stack([np.ones(number), stated / largest])
            target, weight = left[:, plane] / size[:, plane], np.ones(number)
            for _ in range(ROUNDS):
                root = np.sqrt(weight)[:, None]
                found = np.linalg.lstsq(root * made, root * target, rcond=None)[0]
                rest = target - made @ found
                weight = 1 / np.maximum(np.linalg.norm(rest, axis=1), 1.0)
            left[:, plane] = rest * size[:, plane]
        return np.asarray(left * np.sqrt(number / max(number - made.shape[1], 1)))


def _robust(misfit: Array, freedom: Array, errors: float) -> Array:
    """Negative log likelihood of mean squares in units of the noise, by their degrees of freedom,
    of which a fault of the machine makes no more than some."""
    own = np.maximum(np.minimum(freedom, errors), 1)
    large = own * np.log1p(freedom / own * np.maximum(misfit - 1, 0.0))
    return np.asarray(np.where(misfit < 1, freedom * (misfit - 1), large) / 2)


@dataclass(frozen=True)
class Verdict:
    """A global error whose correction improves the data far.

    Attributes:
        names: assumptions, together.
        gain: log evidence.
        before, after: misfit as stated and corrected: chi-square per reading of first turns; else
            the difference from the design, as `Compared.misfit`.
        of: what has this misfit.
        alike: other assumptions that explain the data as well.
        left: largest chi-square per reading that any part of first turns leaves.
    """

    names: Names
    gain: float
    before: float
    after: float
    of: str
    alike: tuple[Names, ...] = ()
    left: float = np.inf

    @property
    def worth(self) -> float:
        """Log evidence; each assumption beyond the first must be certain by itself."""
        return self.gain - CERTAIN * (len(self.names) - 1)


@dataclass(frozen=True)
class Search:
    """Search for global errors of one measurement.

    Args:
        ring: the design.
        data: its monitors those of the ring.
    """

    ring: Ring
    data: Any

    @cached_property
    def monitors(self) -> list[str]:
        """Monitors of the ring, in beam order."""
        return [monitor.name for monitor in self.ring.monitors]

    def assumed(self, names: Names) -> Any:
        """Return the data with assumptions corrected."""
        return assume(self.data, names, self.monitors)

    def candidates(self) -> list[Names]:
        """Return the assumptions that these data allow."""
        return [(name,) for name, own in ASSUMPTIONS.items() if isinstance(self.data, own.kinds)]

    @abstractmethod
    def improving(self) -> list[Verdict]:
        """Return the assumptions that improve the data far."""

    @abstractmethod
    def corrected(self, names: Names) -> Self:
        """Return the search with assumptions corrected in the data."""

    def shown(self, misfit: float) -> str:
        """A misfit for a sentence."""
        return f"{misfit:.2f}" if misfit < 100 else f"{misfit:.3g}"

    def verdict(self) -> Verdict | None:
        """Return the best assumption, if any improves the data far."""
        found = [own for own in self.improving() if own.after < own.before]
        if not found:
            return None
        order = list(ASSUMPTIONS)
        best = max(own.worth for own in found)
        alike = [own for own in found if own.worth > best - DEFAULT.behind]
        first = min(alike, key=lambda own: [order.index(name) for name in own.names])
        return replace(first, alike=tuple(own.names for own in alike if own is not first))


def _believed(found: Iterable[Verdict]) -> list[Verdict]:
    """Return those with enough evidence; not units by launches that fit any, see `TOO_WELL`."""
    return [own for own in found if own.worth > GAIN
            and not (own.of.endswith("launches") and own.after < TOO_WELL
                     and any(map(is_unit, own.names)))]  # fmt: skip


def _verdict(stated: Terms, other: Terms, names: Names, gain: float) -> Verdict:
    """An assumption with the chi-square that falls most."""
    pairs = []
    for one, then in ((stated.levels, other.levels), (stated.launch, other.launch)):
        which = int(finite(one / np.maximum(then, 1e-12)).argmax())
        pairs.append((float(one[which]), float(then[which])))
    (local, local_then), (launch, _) = pairs
    # the sections may agree either way: then the launches decide
    of_launch = not local > 2 * local_then and bool(np.isfinite(launch))
    of = "chi-square per reading" + " of the launches" * of_launch
    left = float(np.nanmax([*other.levels, *other.launch]))
    return Verdict(names, gain, *pairs[of_launch], of, left=left)


Parts = tuple[Split, list[Split], list[Array]]


def _parts(passes: Passes, found: SectionFits) -> Parts:
    """Mismatches of the sections, and of their joints, those between turns too; and the joints'
    covariances."""
    left = np.eye(found.left.shape[2])[None, None]
    sections = Split.of(found.left, left, found.kicked, found.there, found.freedom)
    pairs = [(found.start[:, 1:] - found.end[:, :-1],
              found.covariance[:, 1:] + found.carried[:, :-1],
              (found.start_kicked[1:], found.end_kicked[:-1]))]  # fmt: skip
    follows = np.flatnonzero((np.diff(passes.shot) == 0) & (np.diff(passes.turn) == 1))
    if len(follows):
        pairs.append((found.start[follows + 1, :1] - found.end[follows, -1:],
                      found.covariance[follows + 1, :1] + found.carried[follows, -1:],
                      (found.start_kicked[:1], found.end_kicked[-1:])))  # fmt: skip
    joints = []
    for miss, spread, (behind, before) in pairs:
        kicked = np.concatenate([behind, -before], axis=2)
        free = np.full(miss.shape[:2], 4)
        joints.append(Split.of(miss, spread, kicked, np.ones(miss.shape, dtype=bool), free))
    return sections, joints, [spread for _, spread, _ in pairs]


def _scattered(readings: Array) -> float:
    """Negative log likelihood of where there are readings, by the number of places along the ring
    where they begin or end: one, where the beam is lost; many, if BPMs have others' names."""
    read = np.asarray(np.isfinite(readings).any(axis=(0, 2)))
    ends = int(np.count_nonzero(np.diff(read)))
    return math.lgamma(len(read) + 1) - math.lgamma(ends + 1) - math.lgamma(len(read) - ends + 1)


Key = tuple[int, float, bytes]
"""What a fit of first turns depends on: readings, factor of the kicks, energies of the launches."""


@dataclass(frozen=True)
class OfTurns(Search):
    """Search for global errors of first turns, of which some shots and turns are used.

    Args:
        known: causes in the model.
    """

    data: Measurement
    known: Sequence[Cause] = ()
    _sections: dict[float, Sections] = field(default_factory=dict, repr=False)
    _found: dict[Key, tuple[Measurement, Passes, SectionFits]] = field(
        default_factory=dict, repr=False
    )
    _made: dict[Names, Measurement] = field(default_factory=dict, repr=False)
    _split: dict[Key, Parts] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", _part(in_beam_order(self.data, self.monitors)))

    @cached_property
    def scale(self) -> float:
        """rms of the readings, m."""
        return _size(self.data)

    @cached_property
    def kicks(self) -> Array:
        """All kicks that were set, rad."""
        return _kicks(self.data.settings)

    def assumed(self, names: Names) -> Measurement:
        """Return the data with assumptions corrected."""
        if names not in self._made:
            self._made[names] = super().assumed(names)
        return self._made[names]

    # --- one assumption -------------------------------------------------------------------------
    def found(self, data: Measurement) -> tuple[Passes, SectionFits]:
        """Return the trajectories of the sections of a measurement."""
        self._fit([data])
        return self._found[self._key(data)][1:]

    def _mismatches(self, data: Measurement) -> Parts:
        """The mismatches of a measurement, see `_parts`."""
        key = self._key(data)
        if key not in self._split:
            self._split[key] = _parts(*self.found(data))
        return self._split[key]

    def _key(self, data: Measurement) -> Key:
        return id(data.readings), self._times(data), data.launches[:, 4].tobytes()

    def _times(self, data: Measurement) -> float:
        """Common factor of the shots' kicks."""
        if data.settings is self.data.settings or not self.kicks.any():
            return 1.0
        return float(_kicks(data.settings) @ self.kicks / (self.kicks @ self.kicks))

    def _fit(self, several: Iterable[Measurement]) -> None:
        """Find the trajectories of several measurements, those of equally many passes at once."""
        new = {self._key(data): (data, self._passes(data)) for data in several
               if self._key(data) not in self._found}  # fmt: skip
        alike: dict[tuple[float, int], list[Key]] = {}
        for key, (_, passes) in new.items():
            alike.setdefault((key[1], len(passes.shot)), []).append(key)
        for (times, count), keys in alike.items():
            most = max(TOGETHER // max(count * len(self.data.monitors), 1), 1)
            for some in (keys[i : i + most] for i in range(0, len(keys), most)):
                fits = self._section(times).fit([new[key][1] for key in some])
                # with the data, whose id is in the key
                self._found.update((k, (*new[k], fit)) for k, fit in zip(some, fits, strict=True))

    def _passes(self, data: Measurement) -> Passes:
        shots, turns = data.readings.shape[:2]
        readings = data.readings.reshape(shots * turns, -1, 2)
        read = np.isfinite(readings).any(axis=(1, 2))
        shot, turn = (own[read] for own in np.divmod(np.arange(len(readings)), turns))
        noise = np.full((len(data.monitors), 2), UNSTATED_NOISE)
        if self.data.noise is not None:
            own = self._noise(data)
            noise = np.where(np.isfinite(own), own, np.nanmedian(own))
        factor = _size(data) / self.scale if self.scale > 0 else 1.0
        sigma = self.data.launch_sigma
        alone = sigma is not None and bool(sigma[:, 4].any())
        return Passes(readings[read], factor * noise, data.launches[shot, 4], shot, turn, alone)

    def _section(self, times: float) -> Sections:
        """Sections with the shots' kicks multiplied."""
        if 1.0 not in self._sections:
            at = {name.casefold(): i for i, name in enumerate(self.monitors)}
            data = self.data
            places = np.array([at[self.ring[name].name.casefold()] for name in data.monitors])
            settings = data.settings or tuple({} for _ in data.launches)
            self._sections[1.0] = Sections(self.ring, settings, places, self.known)
        if times not in self._sections:
            self._sections[times] = self._sections[1.0].with_kicks(times)
        return self._sections[times]

    def _noise(self, data: Measurement) -> Array:
        """Stated noise, in the present order of the monitors."""
        assert self.data.noise is not None
        if data.noise is None or data.noise.shape != self.data.noise.shape:
            return self.data.noise
        ratio = np.nanmedian(data.noise) / np.nanmedian(self.data.noise)
        return np.asarray(data.noise / ratio)

    def terms(self, names: Names, square: float) -> Terms:
        """Return the mismatches that an assumption leaves.

        Args:
            names: assumptions, together; () for the data as stated.
            square: variance of the readings, in units of the stated one.
        """
        data = self.assumed(names)
        passes, found = self.found(data)
        sections, joints, spreads = self._mismatches(data)
        backwards = "beam-backwards" in names
        launch, blur = self._launch(data, passes, found, square, backwards)
        times = _size(data) / self.scale
        blur += sum(log_uncertainty(own / times**2) / len(own) for own in spreads)
        ratio = 1.0
        if data.noise is not None:
            ratio = float(np.nanmedian(passes.sigma) / np.nanmedian(data.noise))
        noise = np.log(ratio * np.sqrt(square)) / NOISE_WIDTH if data.noise is not None else 0.0
        orbit = np.log(max(_size(data), TINY) / ORBIT) / ORBIT_WIDTH
        moved = (sections.kicked**2).sum(axis=2)  # none where nothing was read
        kicks = KICKS / np.median(moved[moved > 0]) if moved.any() else KICKS[:1]
        parts = [own.cost(square, kicks) for own in (sections, *joints)]
        of_launch = np.full(2, np.nan)
        if launch is not None:  # in m and rad; the information of launches differs
            parts.append(np.maximum(launch.split.cost(1.0, square * kicks), 0.0))
            each = np.median(distance(launch.miss, launch.spread), axis=0)
            of_launch = np.array([each.max(), launch.split.level(True)])
        costs = np.concatenate(parts, axis=1)
        best = costs[costs.sum(axis=1).argmin()]
        unit = 1 / square if data.noise is None else ratio**2
        return Terms(
            np.concatenate([best, [noise**2 / 2, orbit**2 / 2, _scattered(passes.readings)]]),
            blur,
            unit * np.array([found.level, sections.level()]),
            of_launch,
        )

    def predicted(self) -> tuple[Array, Array]:
        """Readings of first turns, and the design's with the launches of their first section, less
        their mean over the shots, [shot, monitor, 2]."""
        passes, found = self.found(self.data)
        first = np.flatnonzero((passes.turn == 0) & np.isfinite(found.start[:, 0]).all(axis=1))
        launches = np.concatenate([found.start[first, 0], found.delta[first, None]], axis=1)
        made = self._section(1.0).predicted(launches, passes.shot[first])
        read = passes.readings[first]
        there = np.isfinite(read)
        return np.where(there, read - mean_pass(read, there), np.nan), made - made.mean(axis=0)

    def launches(self, square: float, tolerance: float) -> tuple[Array, Array, Array, Array]:
        """Mean squares of fitted less stated launches by plane, [shot, 2]; the same less their
        median, and less what a fault before the first monitors makes, [2, shot, 2]; the misfit of
        the sections that determine them, [shot]; and the ratio of the changes of the fitted from
        shot to shot to those of the stated ones, [2], NaN where they are not proportional."""
        passes, found = self.found(self.data)
        first = np.flatnonzero(np.append(True, np.diff(passes.shot) != 0))
        launch, _ = self._launch(self.data, passes, found, square, False, tolerance)
        assert launch is not None
        fitted, stated = found.start[first, 0], self.data.launches[passes.shot[first], :4]
        miss = launch.miss
        several = miss, miss - np.median(miss, axis=0), launch.beyond_a_fault()
        each, *changes = (distance(own, launch.spread) for own in several)
        size = np.maximum(np.ptp(stated, axis=0), TINY)
        a, b = ((own - np.mean(own, axis=0)) / size for own in (fitted, stated))
        a, b = (finite(own).reshape(-1, 2, 2) for own in (a, b))
        inner, square_a, square_b = ((u * v).sum(axis=(0, 2)) for u, v in ((a, b), (a, a), (b, b)))
        alike = (inner**2 > ALIKE**2 * square_a * square_b) & (inner != 0)
        ratio = np.where(alike, inner, np.nan) / np.maximum(square_b, TINY)
        return each, np.stack(changes), found.misfit[first, 0], ratio

    def _launch(
        self,
        data: Measurement,
        passes: Passes,
        found: SectionFits,
        square: float,
        backwards: bool,
        tolerance: float = LAUNCH_TOLERANCE,
    ) -> tuple[Launches | None, float]:
        """Fitted against stated launches, None if no launch is stated; and the log of their
        uncertainty."""
        if backwards:  # the end of the last turn, against the stated launches
            last = np.flatnonzero(np.append(np.diff(passes.shot) != 0, True))
            shot, fitted = passes.shot[last], found.end[last, -1] * _TURNED
            covariance = found.carried[last, -1] * np.outer(_TURNED, _TURNED)
            stated, J = self.data.launches[shot], np.tile(np.eye(4), (len(last), 1, 1))
            sigma = self.data.launch_sigma
            kicked = found.end_kicked[-1] * _TURNED[:, None]
        else:
            first = np.flatnonzero(np.append(True, np.diff(passes.shot) != 0))
            shot, fitted = passes.shot[first], found.start[first, 0]
            covariance = found.covariance[first, 0]
            energy = found.energy[first, 0]
            covariance = covariance + energy[:, :, None] * energy[:, None]
            stated, sigma = data.launches[shot], data.launch_sigma
            J = np.tile(np.eye(4), (len(first), 1, 1))
            kicked = found.start_kicked[0]
            if passes.turn[first].any():
                stated, J = self._carried(data, passes, first)
        if sigma is None or np.isinf(sigma[shot, :4]).all():
            return None, 0.0
        own = np.minimum(sigma[shot, :4], 1e3)
        width = tolerance * np.sqrt(np.mean(fitted**2, axis=0))
        spread = square * covariance + (J * own[:, None] ** 2) @ np.swapaxes(J, 1, 2)
        spread = spread + np.diag(np.maximum(width, 1e-12) ** 2)
        times = _size(data) / self.scale
        open_ = square * covariance / (own**2 + np.maximum(width, 1e-12) ** 2)[:, None] / times**2
        blur = log_uncertainty(np.eye(4) + open_)
        miss = np.clip(finite(fitted - stated[:, :4], nan=FARTHEST), -FARTHEST, FARTHEST)
        planes = miss.reshape(-1, 2, 2)
        spreads = np.stack([spread[:, p, p] for p in (slice(0, 2), slice(2, 4))], axis=1)
        free = np.full(planes.shape[:2], 2)
        every = np.ones(planes.shape, dtype=bool)
        split = Split.of(planes, spreads, kicked.reshape(2, 2, -1), every, free, np.inf)
        return Launches(planes, spreads, stated[:, :4], split), blur

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
        data = self.data
        without = list(_LAST)
        if data.launch_sigma is None or np.isinf(data.launch_sigma[:, :4]).all():
            without += ["launches", "slopes", "positions", "beam"]
            without += ["readings-in-km"]  # distinguished by curvature alone
        if not data.launches[:, 4].any():
            without += ["energies"]
        if not any("kick" in own for shot in data.settings for own in shot.values()):
            without += ["settings"]
        if len(data.monitors) < 4:
            without += ["monitors"]
        found = [
            own for own in super().candidates() if not {own[0], own[0].split("-")[0]} & set(without)
        ]
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
        found = []
        for names in several:
            data = self.assumed(names)
            found += [self.found(data)[1].level, self._mismatches(data)[0].level()]
        return max(float(np.nanmin(found)), 1e-12) if np.isfinite(found).any() else 1.0

    def improving(self) -> list[Verdict]:
        """Return the assumptions that improve the data far; and the best of them with others, if it
        leaves more than noise."""
        several = self.candidates()
        self._fit(map(self.assumed, [(), *several]))
        square = self.square([(), *several])
        stated = self.terms((), square)

        def gains(some: Iterable[Names]) -> list[Verdict]:
            found, some = [], list(filter(self._possible, some))
            self._fit(map(self.assumed, some))
            for names in some:
                other = self.terms(names, square)
                gain = float(stated.cost.sum() - other.cost.sum())
                gain -= max(other.blur - stated.blur, 0.0)
                found.append(_verdict(stated, other, names, gain))
            return found

        found = sorted(gains(several), key=lambda own: own.gain, reverse=True)
        if not found or found[0].gain < GAIN:
            return []
        believed = _believed(found)
        if believed and believed[0].left < LEFT and self.data.noise is not None:
            return believed  # no two leave so much less
        order = list(ASSUMPTIONS).index
        alone = {own.names: own.left for own in found}
        both = gains(sorted({
            tuple(sorted({*one.names, *two}, key=order))
            for one in found[:BEAM] for two in several if not _same_part(one.names[0], two[0])
        } - set(several)))  # fmt: skip
        found += [
            own
            for own in both  # two have to leave less than each of them
            if LEFT * own.left < min(alone.get((name,), np.inf) for name in own.names)
        ]
        return _believed(found)

    def corrected(self, names: Names) -> Self:
        """Return the search with assumptions corrected in the data."""
        data = self.assumed(names)
        sections = {1.0: self._section(self._times(data))}
        return replace(self, data=data, _sections=sections, _found={}, _made={}, _split={})


def _same_part(one: str, other: str) -> bool:
    """Whether two assumptions exclude each other: both about the order of the monitors, about the
    settings, or about the unit of one quantity."""
    (a, *_), (b, *_) = one.split("-"), other.split("-")
    units = is_unit(one) and is_unit(other)
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
    return rms(data.readings[np.isfinite(data.readings)])
