"""Sections of a turn, each with its own trajectory, which isolate a fault.

>>> sections = Sections(ring, measurement)
>>> (found,) = sections.fit([passes])
>>> found.misfit                                  # chi-square of each section over its freedom

A single fault spoils its section and the joint behind it; a wrong sign, unit or order spoils all.
Launches are not needed: the first section determines them. Maps are composed from the layers'
second-order ones, and truncated: over a part of a turn the lost third order is far below the noise.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import INVISIBLE, TINY, Array, Flags, Indices, finite
from tmlattice.beam.layers import Layers
from tmlattice.beam.model import Model
from tmlattice.effects import Cause, Settings
from tmlattice.inference import chi2
from tmlattice.inference.newton import ROUNDS, SETTLED
from tmlattice.lattice import Ring
from tmlattice.maps.quadratic import Quadratic
from tmlattice.maps.taylor import second_derivatives

Places = NDArray[np.intp]

KEPT = np.array([0, 1, 2, 3, 5])  # of six coordinates, without tau
WEAK = 1e-8
"""Weight of unmeasured directions of a trajectory, over the strongest direction's."""
TWO = 2
"""Coordinates of a trajectory in a plane, and so readings that determine it."""
DIVERGED_SIGMA = 1e15
"""Residual in sigma of a trajectory that diverges."""
FARTHEST = 1e6
"""Largest coordinate of a trajectory, m or rad: beyond, it diverges."""
ENERGY = 5e-3
"""Relative; prior rms of a pass's energy deviation."""
MOST = 8
"""Monitors of a section; four coordinates leave three quarters of their readings as a test."""


def _five(weights: Sequence[Array]) -> Quadratic:
    """Stacked weights in six coordinates as maps of (x, px, y, py, delta)."""
    W0, W1, W2 = weights
    T = second_derivatives(W2) / 2
    if W0.shape[-1] == W1.shape[-1]:
        W0, W1, T = W0[..., KEPT], W1[..., KEPT, :], T[..., KEPT, :, :]
    return Quadratic(W0, W1[..., KEPT], T[..., KEPT, :][..., KEPT])


@dataclass(frozen=True)
class Passes:
    """Readings by pass: one turn of one shot each.

    Attributes:
        readings: [pass, monitor, 2], m; NaN where missing.
        sigma: noise of a reading, m, [monitor, 2].
        delta: first guess of the relative energy deviation, which is fitted, [pass].
        shot, turn: of each, [pass].
        alone: whether each pass has its own energy; else all share one correction.
    """

    readings: Array
    sigma: Array
    delta: Array
    shot: Places
    turn: Places
    alone: bool = False


@dataclass(frozen=True)
class SectionFits:
    """Trajectories of all sections of all passes.

    Attributes:
        left: readings less the trajectory, in units of the noise, [pass, section, reading]; 0 where
            missing.
        owner: the monitor of each, [section, reading]; -1 for none.
        there: whether it was measured, [pass, section, reading].
        free: share of its noise that the trajectory does not absorb, [pass, section, reading].
        freedom: [pass, section].
        misfit: chi-square over the freedom, [pass, section].
        delta: relative energy deviation, [pass].
        start: trajectories at the sections' starts, [pass, section, 4].
        covariance: of these, [pass, section, 4, 4], at a known energy.
        energy: their change by the standard error of the energy, [pass, section, 4].
        end, carried: trajectories and covariances at the sections' ends.
        kicked: change of `left` by unit kicks of the ring behind each monitor, of the pass with the
            most readings, [section, reading, kick].
        start_kicked, end_kicked: change of `start`, and of `end` less the trajectory's, by these
            kicks, [section, 4, kick].
    """

    left: Array
    owner: Indices
    there: Flags
    free: Array
    freedom: Indices
    misfit: Array
    delta: Array
    start: Array
    covariance: Array
    energy: Array
    end: Array
    carried: Array
    kicked: Array
    start_kicked: Array
    end_kicked: Array

    @property
    def level(self) -> float:
        """Typical mean square of the noise in units of the stated one; NaN if undetermined."""
        there = self.freedom > 0
        if not there.any():
            return float("nan")
        usual = chi2.median_per_freedom(self.freedom[there])
        return float(np.median(self.misfit[there] / usual))

    def share(self, passes: Passes) -> float:
        """Share of the readings' rms that the typical trajectory leaves: 1 if it explains none."""
        enough = self.freedom > 3
        if enough.sum() < 3:
            return float("nan")
        part, whole = self._squares(passes)
        shares = np.sqrt(part / np.maximum(whole, TINY))[:, enough]
        return float(np.median(shares, axis=1).min())

    def shares(self, passes: Passes) -> Array:
        """The same of each section, of all passes together and of each alone,
        [1 + pass, section]; NaN if undetermined."""
        enough = self.freedom > 3
        part, whole = (np.where(enough, own, 0.0) for own in self._squares(passes))
        together = (part.sum(axis=1) / np.maximum(whole.sum(axis=1), TINY)).min(axis=0)
        each = part.min(axis=0) / np.maximum(whole[0], TINY)
        own = np.sqrt(np.vstack([together, each]))
        return np.where(np.vstack([enough.any(axis=0), enough]), own, np.nan)

    def _squares(self, passes: Passes) -> tuple[Array, Array]:
        """Mean squares of the residuals and of the readings [2, pass, section], m^2: as read; and
        of several passes less what is the same in all, as it is of kicks."""
        owner, plane = np.maximum(self.owner, 0), np.arange(self.owner.shape[1]) % 2
        read = np.where(self.there, passes.readings[:, owner, plane], 0.0)
        left = np.where(self.there, self.left * passes.sigma[owner, plane], 0.0)
        count, free = np.maximum(self.there.sum(axis=2), 1), np.maximum(self.freedom, 1)
        found = []
        for common in (0.0, 1.0)[: len(read)]:
            whole, part = (
                (np.where(self.there, own - common * mean_pass(own, self.there), 0.0) ** 2).sum(2)
                for own in (read, left)
            )
            found.append((part / free, whole / count))
        parts, wholes = zip(*found, strict=True)
        return np.stack(parts), np.stack(wholes)


def mean_pass(values: Array, there: Flags) -> Array:
    """Mean over the passes that were read, [...], of values [pass, ...]."""
    total = np.where(there, values, 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(there.sum(axis=0), 1))


def scaled(covariance: Array) -> tuple[Array, Array]:
    """Standard deviations [..., n], and the correlations of covariances [..., n, n]."""
    size = np.sqrt(np.maximum(finite(np.einsum("...ii->...i", covariance)), TINY))
    even = covariance / size[..., None] / size[..., None, :]
    return size, finite(even, posinf=0, neginf=0)


def distance(miss: Array, covariance: Array) -> Array:
    """Mean square of a mismatch in units of its covariance, [...]."""
    size, even = scaled(covariance)
    miss = np.clip(finite(miss / size, nan=DIVERGED_SIGMA), -DIVERGED_SIGMA, DIVERGED_SIGMA)
    solved = np.linalg.solve(even + INVISIBLE * np.eye(miss.shape[-1]), miss[..., None])[..., 0]
    return np.asarray(np.einsum("...i,...i->...", miss, solved) / miss.shape[-1])


def log_uncertainty(covariance: Array) -> float:
    """Sum of the log root determinants of covariances [..., n, n]."""
    limit = DIVERGED_SIGMA**2
    covariance = finite(covariance, nan=limit, posinf=limit, neginf=-limit)
    sign, log = np.linalg.slogdet(covariance)
    diagonal = np.log(np.maximum(np.einsum("...ii->...i", covariance), TINY)).sum(axis=-1)
    return float(np.where(sign > 0, log, diagonal).sum()) / 2  # singular: use the diagonal


@dataclass(frozen=True)
class _Fitted:
    """What the trajectories of some measurements are fitted to.

    Attributes:
        maps: to the monitors of each section, [measurement, pass, section, monitor].
        data, sigma, there: readings and their noise, m, and whether they were measured,
            [measurement, pass, section, monitor, 2].
        prior: precision of each coordinate, [measurement, pass, section, 4].
        freedom: [measurement, pass, section].
        delta, group: expected energy, and index of the settings, [measurement, pass].
        alone: see `Passes`, [measurement].
    """

    maps: Quadratic
    data: Array
    sigma: Array
    there: Flags
    prior: Array
    freedom: Indices
    delta: Array
    alone: Flags
    group: Places

    def __getitem__(self, which: Flags) -> "_Fitted":
        """Some of the measurements."""
        return _Fitted(*(getattr(self, own.name)[which] for own in fields(self)))

    def linearised(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Residuals of trajectories x [measurement, pass, section, 5], in units of the noise, their
        slopes by these and by the energy, [..., reading (, 4)], and the normal equations."""
        image, slope = self.maps(x[..., None, :])
        left = np.where(self.there, (self.data - image) / self.sigma, 0.0)
        left = left.reshape(*x.shape[:-1], -1)
        A = (slope[..., :4] / self.sigma[..., None]).reshape(*left.shape, 4)
        curvature = np.swapaxes(A, -1, -2) @ A + self.prior[..., None] * np.eye(4)
        own = (slope[..., 4] / self.sigma).reshape(left.shape)
        return left, A, own, _regularised(curvature)


class Sections:
    """Sections of a turn of a ring, with the settings of some shots.

    Args:
        ring: the design.
        settings: of each shot.
        monitors: indices among the ring's of those with readings, rising.
        known: causes in the model.

    Attributes:
        monitors: as given.
        group: index of each shot's settings, [shot].
    """

    def __init__(
        self,
        ring: Ring,
        settings: Sequence[Settings],
        monitors: Places,
        known: Sequence[Cause] = (),
    ) -> None:
        model = Model(ring, settings, 1, known)
        self.monitors = monitors
        self.group = np.zeros(len(settings), dtype=np.intp)
        for group in model.groups:
            self.group[group.shots] = group.number
        layers = [group.layers for group in model.groups]
        self._steps = [np.stack(own) for own in zip(*(own.W for own in layers), strict=True)]
        reads = [np.stack(own) for own in zip(*(own.R for own in layers), strict=True)]
        self._reads = _five(reads)[:, monitors]
        self._design = Layers.of(model.maps).W
        exits = layers[0].at[monitors]
        size = int(np.clip(len(monitors) // 12, 4, MOST))
        count = max(len(monitors) // size, 1)
        self._members = np.array_split(np.arange(len(monitors)), count)
        starts = [0, *(int(exits[own[0]]) for own in self._members[1:])]
        self._bounds = list(zip(starts, [*starts[1:], layers[0].steps], strict=True))
        self._exits = exits

    def with_kicks(self, factor: float) -> "Sections":
        """Return the sections with the settings' changes multiplied: maps are linear in kicks."""
        made = copy(self)
        made.__dict__.pop("_made", None)
        made._steps = [
            design + factor * (own - design)
            for design, own in zip(self._design, self._steps, strict=True)
        ]
        return made

    @cached_property
    def _made(self) -> tuple[Quadratic, Quadratic, Array]:
        """Maps from the start of each section to its monitors [group, monitor], and to its end
        [group, section], all sections at once, step by step; and unit kicks at the monitors,
        carried back to the start, [monitor, 4, plane]."""
        steps, reads = _five(self._steps), self._reads
        groups, count = len(steps.B), len(self._bounds)
        first = np.array([start for start, _ in self._bounds])
        length = np.array([end - start for start, end in self._bounds])
        way = Quadratic(
            np.zeros((groups, count, 5)),
            np.tile(np.eye(5), (groups, count, 1, 1)),
            np.zeros((groups, count, 5, 5, 5)),
        )
        section = np.concatenate([np.full(len(own), w) for w, own in enumerate(self._members)])
        at = self._exits - first[section]  # steps within the section
        seen = Quadratic(*(np.zeros_like(getattr(reads, name)) for name in "BRT"))
        before = np.tile(np.eye(4), (len(at), 1, 1))
        for step in range(int(length.max()) + 1):
            here = np.flatnonzero(at == step)
            if len(here):
                now = reads[:, here].after(way[:, section[here]])
                for name in "BRT":
                    getattr(seen, name)[:, here] = getattr(now, name)
                before[here] = way.R[0, section[here], :4, :4]
            go = np.flatnonzero(step < length)
            if len(go):
                moved = steps[:, first[go] + step].after(way[:, go])
                for name in "BRT":
                    getattr(way, name)[:, go] = getattr(moved, name)
        return seen, way, np.asarray(np.linalg.inv(before)[..., 1::2], dtype=float)

    def fit(self, several: Sequence[Passes]) -> list[SectionFits]:
        """Fit the trajectory of each section to its own readings, of each of several measurements
        of equally many passes; together, which takes less time."""
        seen, way, kicks = self._made
        width = max(len(own) for own in self._members)
        owner = np.full((len(self._members), width), -1, dtype=np.int64)
        for w, members in enumerate(self._members):
            owner[w, : len(members)] = members
        padded = owner >= 0
        read, delta, shot = (
            np.stack([getattr(own, name) for own in several])
            for name in ("readings", "delta", "shot")
        )
        noise = np.stack([own.sigma for own in several])[:, None]
        group = self.group[shot]
        shape = *group.shape, (W := len(owner))  # [measurement, pass, section]
        maps = seen[group[..., None, None], np.where(padded, owner, 0)]
        data = read[:, :, owner]
        there = np.isfinite(data) & padded[..., None]
        sigma = np.where(there, noise[:, :, owner], np.inf)
        count = np.asarray(there.sum(axis=-2), dtype=np.int64)  # [..., plane]
        freedom = np.maximum(count - TWO, 0).sum(axis=-1)
        prior = _prior_precision(read, maps.R, padded, count)
        x = np.zeros((*shape, 5))
        x[..., 4] = delta[..., None]
        by_energy = np.zeros((*shape, 4))
        alone = np.array([own.alone for own in several])
        section = np.arange(W)
        every = _Fitted(maps, data, sigma, there, prior, freedom, delta, alone, group)
        rest, on = every, np.arange(len(several))  # those that go on
        with np.errstate(all="ignore"):
            for _ in range(ROUNDS - 1):
                here = x[on]
                left, A, own, curvature = rest.linearised(here)
                back: Array = np.linalg.solve(curvature, np.swapaxes(A, -1, -2)).astype(float)
                pull = np.linalg.solve(curvature, (rest.prior * here[..., :4])[..., None])
                step_4 = (back @ left[..., None] - pull)[..., 0]
                fitted = (A @ step_4[..., None])[..., 0]
                drift = -(back @ own[..., None])[..., 0]  # of the trajectories, by the energy
                unfitted = left - fitted
                off_energy = own + (A @ drift[..., None])[..., 0]
                inner = _energy_terms(unfitted, off_energy, rest.freedom)
                ends = way[rest.group[..., None], section](here)
                outer = _joints(here[..., :4], ends, step_4, drift, _inverse(curvature))
                expected = rest.delta - here[..., 0, 4]
                change, known = _common_energy(inner, outer, expected, rest.alone)
                error = np.sqrt(known)
                by_energy[on] = drift / error[..., None, None]
                moved = np.maximum(_median(np.abs(fitted)), np.nanmax(np.abs(change) * error, 1))
                moved /= np.maximum(1.0, _median(np.abs(unfitted)))
                step_4 = step_4 + drift * change[..., None, None]
                x[on, ..., :4] = np.clip(here[..., :4] + finite(step_4), -FARTHEST, FARTHEST)
                x[on, ..., 4] += change[..., None]
                going = moved > SETTLED
                if not going.any():
                    break
                if not going.all():
                    on, rest = on[going], rest[going]
            left, A, _, curvature = every.linearised(x)
        whole: Array = finite(
            (left**2).sum(axis=-1), nan=DIVERGED_SIGMA**2, posinf=DIVERGED_SIGMA**2
        )
        covariance = _inverse(curvature)
        end, slope = way[group[..., None], section](x)
        J = slope[..., :4, :4]
        fullest = there.sum(axis=(-2, -1)).argmax(axis=1)  # the pass of each section
        most = np.arange(len(several))[:, None], fullest, section
        own = np.where(padded[:, :, None, None], kicks[np.where(padded, owner, 0)], 0.0)
        behind = np.tril(np.ones((width, width)), -1)[:, None, :, None]  # reading, kick
        kicked = np.einsum("swkpi,wmiq->swkpmq", maps.R[most][..., :4], own) * behind
        kicked = kicked.reshape(len(several), W, 2 * width, -1)
        kicked /= sigma[most].reshape(len(several), W, -1, 1)
        moved_start = covariance[most] @ np.swapaxes(A[most], -1, -2) @ kicked
        carried_back = np.moveaxis(own, 1, 2).reshape(W, 4, -1)
        fits = {
            "left": left,
            "there": there.reshape(*shape, -1),
            "free": 1 - np.einsum("...ri,...ij,...rj->...r", A, covariance, A),
            "freedom": freedom,
            "misfit": whole / np.maximum(freedom, 1),
            "delta": x[..., 0, 4],
            "start": x[..., :4],
            "covariance": covariance,
            "energy": finite(by_energy),
            "end": end[..., :4],
            "carried": J @ covariance @ np.swapaxes(J, -1, -2),
            "kicked": kicked - A[most] @ moved_start,
            "start_kicked": moved_start,
            "end_kicked": J[most] @ (moved_start - carried_back),
        }
        of_reading = np.repeat(owner, 2, axis=1)
        return [
            SectionFits(owner=of_reading, **{name: own[i] for name, own in fits.items()})
            for i in range(len(several))
        ]

    def predicted(self, launches: Array, shot: Places) -> Array:
        """Readings of one turn [pass, monitor, 2] by launches [pass, 5] of shots, m."""
        seen, way, _ = self._made
        x, group = launches, self.group[shot]
        read = np.zeros((len(launches), len(self.monitors), 2))
        for w, members in enumerate(self._members):
            read[:, members] = seen[group[:, None], members](x[:, None])[0]
            ends = np.clip(way[group, w](x)[0][:, :4], -FARTHEST, FARTHEST)
            x = np.concatenate([finite(ends), x[:, 4:]], axis=1)
        return np.clip(finite(read), -FARTHEST, FARTHEST)

    def carried(self, launches: Array, shot: Places, turns: int) -> tuple[Array, Array]:
        """Launches [pass, 5] of shots after whole turns, and the slopes [pass, 4, 4]."""
        _, way, _ = self._made
        x, J = launches.copy(), np.tile(np.eye(4), (len(launches), 1, 1))
        for _ in range(turns):
            for w in range(len(self._bounds)):
                image, slope = way[self.group[shot], w](x)
                x = np.concatenate([image[:, :4], x[:, 4:]], axis=1)
                J = slope[:, :4, :4] @ J
        return x, J


def _median(values: Array) -> Array:
    """Median of the numbers of each measurement, [measurement]; 0 if there are none."""
    flat = values.reshape(len(values), -1)
    if not flat.size:
        return np.zeros(len(flat))
    count = np.count_nonzero(~np.isnan(flat), axis=1)
    ordered = np.sort(flat, axis=1)  # NaN last; `numpy.nanmedian` takes ten times longer
    which = np.arange(len(flat))
    middle = (ordered[which, (count - 1) // 2] + ordered[which, count // 2]) / 2
    return np.where(count > 0, middle, 0.0)


EnergyTerms = tuple[Array, Array, Array]
"""Terms [measurement, pass, term] of the energy's equation: misfit, right side and left side."""


def _energy_terms(left: Array, slope: Array, freedom: Indices) -> EnergyTerms:
    """Terms of readings, projected off the trajectories of their sections."""
    misfit = np.where(freedom > 0, (left**2).sum(axis=-1) / np.maximum(freedom, 1), np.inf)
    return misfit, (left * slope).sum(axis=-1), (slope**2).sum(axis=-1)


def _joints(
    start: Array, ends: tuple[Array, Array], step: Array, drift: Array, covariance: Array
) -> EnergyTerms:
    """Terms of the joints between sections, after the next step of the trajectories."""
    J = ends[1][..., :4, :4]
    end = ends[0][..., :4] + (J @ step[..., None])[..., 0]
    pushed = (J @ drift[..., None])[..., 0] + ends[1][..., :4, 4]
    miss = finite((start + step)[..., 1:, :] - end[..., :-1, :])
    slope = finite(drift[..., 1:, :] - pushed[..., :-1, :])
    carried = J @ covariance @ np.swapaxes(J, -1, -2)
    spread = finite(covariance[..., 1:, :, :] + carried[..., :-1, :, :])
    size, even = scaled(spread)
    right = np.stack([miss / size, slope / size], axis=-1)
    both = np.linalg.solve(even + INVISIBLE * np.eye(4), right)
    misfit = (both[..., 0] * miss / size).sum(axis=-1) / 4
    return (
        misfit,
        -(both[..., 0] * slope / size).sum(axis=-1),
        (both[..., 1] * slope / size).sum(-1),
    )


def _common_energy(
    inner: EnergyTerms, outer: EnergyTerms, prior: Array, alone: Flags
) -> tuple[Array, Array]:
    """Common energy of the sections and joints of a pass, or of all passes, [measurement, pass],
    and its inverse variance; terms spoilt by a fault have little weight.

    Args:
        inner, outer: of sections, of joints.
        prior: expected energy, [measurement, pass].
        alone: see `Passes`, [measurement].
    """
    asked, known = prior / ENERGY**2, np.full(prior.shape, 1 / ENERGY**2)
    for misfit, right, left in (inner, outer):
        there = np.isfinite(misfit)
        level = np.maximum(_median(np.where(there, misfit, np.nan)), 1.0)
        weight = np.where(there, 1 / np.maximum(misfit, level[:, None, None]), 0.0)
        asked = asked + finite(weight * right).sum(axis=-1)
        known = known + finite(weight * left).sum(axis=-1)
    asked, known = (
        np.where(alone[:, None], own, own.sum(axis=1, keepdims=True)) for own in (asked, known)
    )
    return asked / known, known


def _prior_precision(readings: Array, slopes: Array, members: Flags, count: Indices) -> Array:
    """Prior precision of each coordinate, [..., section, 4]; 0 in a plane with readings.

    With fewer than two readings in a plane the prior is as large as the turn's readings. Without it
    sextupoles would let the trajectory diverge to fit the other plane.

    Args:
        readings: [..., monitor, 2], m.
        slopes: d readings / d coordinate of the design, [..., section, monitor, 2, 5].
        members: which monitors exist, [section, monitor].
        count: of the readings, [..., section, 2].
    """
    size = np.sqrt(np.nanmean(readings**2, axis=(-2, -1)))[..., None, None, None]
    own = np.stack([slopes[..., 0, 0:2], slopes[..., 1, 2:4]], axis=-2)  # [..., plane, coordinate]
    square = np.where(members[..., None, None], own**2, 0.0).sum(axis=-3)
    square = square / members.sum(axis=1)[:, None, None]
    precision = square / np.maximum(size, TINY) ** 2
    return np.where((count < TWO)[..., None], precision, 0.0).reshape(*count.shape[:-1], 4)


def _inverse(curvature: Array) -> Array:
    return np.asarray(np.linalg.inv(curvature), dtype=float)


def _regularised(curvature: Array) -> Array:
    """Normal equations [..., 4, 4] regularised in every direction."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", curvature), 0.0))
    scale = np.where(np.isfinite(scale), scale, 0.0)
    largest = np.maximum(scale.max(axis=-1, keepdims=True), TINY)
    scale = np.maximum(scale, 1e-2 * largest)
    held = finite(curvature, posinf=0.0, neginf=0.0)
    return np.asarray(held + WEAK * scale[..., None] ** 2 * np.eye(4))
