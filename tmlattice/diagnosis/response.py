"""Which errors close how much of a measured orbit response's gap, step by step, on held-out data.

A fifth of the correctors is never fitted. Of each of them only the kick is taken, from a random
half of the monitors, and the other half judges; the RF's orbit is fitted on half of the monitors
and judged on the other half. Which families of errors are kept is decided on other correctors, held
out from the rest, so that the figures of the steps judge and choose nothing.

>>> result = diagnose_response(ring, measured)
>>> [(step.effect, step.heldout_rms_in_plane) for step in result.steps]

Gain and calibration are degenerate in scale but for the dispersion; neighbouring quadrupoles can
pull against one another. Priors settle both: a family of correctors or quadrupoles (one kind of
magnet, or one supply) shares an error, its members scatter about it, and how much is learnt from
the data. Gradients and skew gradients are fitted together, because skew ones move the tunes.
"""

import logging
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.response_derivatives import derivatives
from tmlattice.diagnosis.response_result import ResponseDiagnosis, Step, pick
from tmlattice.effects import Cause, apply
from tmlattice.errors import MeasurementError
from tmlattice.inference.priors import Group, Normal, Posterior, normal_equations, solve
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

BAD = 5.0
"""A monitor whose rms residual, its gain fitted, is so many times the median one's is bad."""
FEW = 4
"""Correctors that a plane needs for a monitor to be judged by what its gain leaves."""
DELTA = 1e-3
"""Energy deviation of the differences that tell what an energy spread does; its square is also
the unit in which the spread's is fitted."""
STEP = 0.01
"""Trusted change of a gain, a calibration or a gradient (relative) in one round."""
SKEW_STEP = 3e-4  # 1/m: larger steps move the tunes
ROLL_STEP = 0.02
LARGEST_GRADIENT = 0.02
"""Prior rms that one magnet may have at most, relative: a larger error is a broken magnet."""
LARGEST_SKEW = 5e-4  # 1/m: half a millimetre of orbit in a sextupole
HELPS, SPOILS = 0.995, 1.25
"""A step is kept where its judge falls to the first, the rms over both planes falls, and none
(in-plane, coupling, RF) rises above the second; the RF's has some 25 readings, so 14 % of its
own."""
TYPICAL = 10.0
"""The median misfit of all columns counts as so many readings of each one's own."""
INNER = 0.2
"""Share of the fitted correctors, and of the RF's fitted monitors, that choose the steps."""

IN_PLANE = (
    "corrector_calibration", "family_gradient", "monitor_gain", "quadrupole_gradient",
    "energy_spread",
)  # fmt: skip
COUPLING = ("monitor_roll", "corrector_roll", "skew_gradient")
ORDER: tuple[tuple[tuple[str, ...], tuple[int, int]], ...] = (
    (("corrector_calibration", "family_gradient"), (3, 0)),
    (("monitor_gain",), (2, 0)),
    (("quadrupole_gradient",), (4, 0)),
    (("energy_spread",), (2, 0)),
    (("monitor_roll",), (0, 1)),
    (("corrector_roll",), (0, 1)),
    (("skew_gradient",), (2, 2)),
)
"""What is tried, one after another; rounds in-plane, and before them rounds of the other plane.
Skew gradients move the tunes to second order, which the gradients then take back."""
NAMES = {
    "monitor_gain": "monitor_gain_x, monitor_gain_y",
    "monitor_roll": "monitor_roll, monitor_coupling",
}


def diagnose_response(
    ring: Ring,
    measured: OrbitResponse,
    *,
    holdout: float = 0.2,
    missing: bool = False,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda stage: None,
) -> ResponseDiagnosis:
    """Correctors and families, monitors, single gradients, then what couples the planes.

    Args:
        ring: the design.
        measured: with an RF step, and the noise of its readings.
        holdout: share of the correctors that is never fitted.
        missing: weigh too which effect the result still lacks.
        seed: of the split.
        progress: called with the name of each stage.

    Raises:
        MeasurementError: no RF step, no noise, or too few correctors.
        UnstableRingError: no closed orbit.
    """
    run = ResponseRun(ring, measured, holdout, seed, progress)
    result = run.run()
    if not missing:
        return result
    from tmlattice.diagnosis.response_missing import weigh

    rows = tuple(weigh(run, progress=progress))
    return replace(result, hypotheses=rows, seconds=time.perf_counter() - run.begun)


def stem(name: str) -> str:
    """What a family's names begin with: up to the first underscore, dot or `::`."""
    return re.split(r"_|\.|::", name, maxsplit=1)[0].casefold()


def families(names: Sequence[str]) -> tuple[list[str], Array]:
    """Stems that more than one has, and who belongs to them, [name, family] of 0 and 1."""
    stems = [stem(name) for name in names]
    kinds = [kind for kind in dict.fromkeys(stems) if stems.count(kind) > 1]
    return kinds, np.array([[float(own == kind) for kind in kinds] for own in stems]).reshape(
        len(names), len(kinds)
    )


@dataclass
class _State:
    """Everything that is fitted: monitors' matrices, correctors, the ring's errors."""

    monitors: Array  # [monitor, 2, 2]
    calibration: Array  # [column]
    roll: Array
    gradients: Array
    skew: Array
    spread: Array  # [1], (energy spread / DELTA)^2

    def copy(self) -> "_State":
        return replace(self, **{name: value.copy() for name, value in vars(self).items()})


class ResponseRun:
    """The fit of one measured response; `run` is the whole of it."""

    def __init__(
        self,
        ring: Ring,
        measured: OrbitResponse,
        holdout: float = 0.2,
        seed: int = 0,
        progress: Callable[[str], Any] = lambda stage: None,
    ) -> None:
        names = [monitor.name for monitor in ring.monitors]
        known = {ring[name].name: name for name in measured.monitors}
        measured = measured.select(monitors=[known[name] for name in names if name in known])
        if measured.rf is None or measured.rf.orbit is None:
            raise MeasurementError("an orbit response without an RF step: dispersion is not known")
        if measured.noise is None or np.isnan(measured.noise).any():
            raise MeasurementError("the noise of the readings is not known; add it")
        self.ring, self.m, self.seed, self.progress = ring, measured, seed, progress
        self.begun = time.perf_counter()
        order = {name: i for i, name in enumerate(names)}
        self.at = np.array([order[ring[name].name] for name in measured.monitors])
        self.data = np.concatenate([measured.response, measured.rf.orbit[None]])
        self.kicks = np.append(measured.kicks, measured.rf.step / measured.rf.frequency)
        self.plane = np.append([int(p == "y") for p in measured.planes], 0)
        self.noise = measured.noise
        columns, monitors = self.data.shape[:2]
        self._split(holdout, np.random.default_rng(seed))
        self.good = np.ones(monitors, dtype=bool)
        self.quadrupoles = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1 != 0]
        self.skews = [e.name for e in ring.elements if e.kind == "quadrupole"]
        self.state = _State(
            np.tile(np.eye(2), (monitors, 1, 1)), np.zeros(columns), np.zeros(columns),
            np.zeros(len(self.quadrupoles)), np.zeros(len(self.skews)), np.zeros(1),
        )  # fmt: skip
        self.lacking = np.full((2, columns), 1e-4)
        """What the model lacks in-plane and across in each column, m: it lessens weights as noise
        does, so that one corrector whose field is not where the model has it spoils no magnet."""
        self.exploring = True
        self.bent = np.zeros_like(self.data)
        """What the steps' finite size adds to their linear orbit changes, m."""
        self.allowed: list[str] = []
        self.groups: dict[str, Group] = {}
        self.design = self._set()
        gap = pick(self.data - self.design, self.plane)[~self.held]
        self.lacking[:] = float(np.nanmedian(np.abs(gap))) / 0.6745

    def _split(self, holdout: float, rng: np.random.Generator) -> None:
        columns, monitors = self.data.shape[:2]
        count = round(holdout * (columns - 1))
        inner = round(INNER * (columns - 1 - count))
        if not (count > 0 and inner > 0 and count + inner < columns - 2):
            raise MeasurementError(f"{columns - 1} correctors cannot be split; measure more")
        self.held, self.inner = np.zeros((2, columns), dtype=bool)
        drawn = rng.permutation(columns - 1)
        self.held[drawn[:count]] = True
        self.inner[drawn[count : count + inner]] = True
        self.half = np.zeros((columns, monitors), dtype=bool)  # gives kicks, or the RF's fit
        for c in [*np.flatnonzero(self.held | self.inner), columns - 1]:
            self.half[c, rng.choice(monitors, monitors // 2, replace=False)] = True
        near = np.flatnonzero(self.half[-1])
        self.inner_rf = np.zeros(monitors, dtype=bool)
        self.inner_rf[rng.choice(near, max(1, round(INNER * len(near))), replace=False)] = True

    # --- the steps --------------------------------------------------------------------------------
    def run(self) -> ResponseDiagnosis:
        """Explore which families help, then fit those to all correctors but the held-out ones."""
        steps = [Step("design", 0, *self.score(self.held, self.half))]
        refused = []
        inner = self._inner()
        for names, rounds in ORDER:
            self.progress(", ".join(NAMES.get(name, name) for name in names))
            before, allowed = (self.state.copy(), self.lacking.copy(), self.good), self.allowed
            self.allowed = [*allowed, *names]
            own, across = rounds
            if own:
                self._bend()
            for block in [1] * across + [0] * own:
                self.round(block)
            now = self._inner()
            step = Step(
                ", ".join(NAMES.get(name, name) for name in names),
                sum(self._count(name) for name in names), *self.score(self.held, self.half),
            )  # fmt: skip
            judge = 0 if names[0] in IN_PLANE else 1
            good = bool(
                now[judge] < HELPS * inner[judge]
                and np.hypot(*now[:2]) < np.hypot(*inner[:2])
                and (now < SPOILS * inner).all()
            )
            log.info("%s: inner %s -> %s, kept %s", names, inner, now, good)
            if good:
                steps.append(step)
                inner = now
            else:
                refused.append(replace(step, kept=False))
                (self.state, self.lacking, self.good), self.allowed = before, allowed
                for name in names:
                    self._forget(name)
                self._set()
        self.progress("result")
        self.exploring = False
        self._bend()
        for block in (1, 0, 0):
            self.round(block)
        last = self.score(self.held, self.half)
        steps[-1] = Step(steps[-1].effect, steps[-1].parameters, *last)
        causes, errors, degenerate = self._found()
        return ResponseDiagnosis(
            self.ring, self.m, tuple(steps), tuple(refused), causes, errors,
            tuple(self.m.monitors[i] for i in np.flatnonzero(~self.good)),
            {name: g.rms for name, g in self.groups.items()}, degenerate, self.held, self.good,
            self.design, self.read(), self.data, self.seed, time.perf_counter() - self.begun,
        )  # fmt: skip

    def _inner(self) -> Array:
        """What chooses: in-plane, coupling and dispersion rms of correctors held out for it."""
        figures = self.score(self.inner, self.half, self.inner_rf)
        return np.array([figures[0], figures[1], figures[3]])

    def _count(self, name: str) -> int:
        columns, monitors = self.data.shape[:2]
        count: int = {
            "family_gradient": len(families(self.quadrupoles)[0]),
            "quadrupole_gradient": len(self.quadrupoles),
            "skew_gradient": len(self.skews),
            "energy_spread": 1,
        }.get(name, 2 * monitors if name.startswith("monitor") else columns - 1)
        return count

    def _forget(self, name: str) -> None:
        for key in [key for key in self.groups if key.startswith(name)]:
            del self.groups[key]

    # --- the model --------------------------------------------------------------------------------
    def ring_causes(self) -> list[Cause]:
        """Of gradients and skew gradients, as fitted so far."""
        pairs = (
            ("quadrupole_gradient", self.quadrupoles, self.state.gradients),
            ("skew_gradient", self.skews, self.state.skew),
        )
        return [
            Cause(effect, place, float(a))
            for effect, places, amounts in pairs
            for place, a in zip(places, amounts, strict=True)
            if a != 0
        ]

    def _set(self) -> Array:
        """Model and readings with the errors as they are."""
        ring = apply(self.ring, self.ring_causes())
        self.model = ResponseModel(ring)
        response = self.model.response(self.m.correctors)
        self.beam = self.orbits(self.model)
        self.curved = np.zeros_like(self.beam)
        if "energy_spread" in self.allowed:
            # a monitor reads the centroid of particles whose orbits answer each as its energy has
            # it: half the second derivative by the energy, times the mean square
            step = DELTA / self.model.rf_start[5]
            up, down = (self.orbits(self.model.at_frequency(f)) for f in (step, -step))
            self.curved = (up + down) / 2 - self.beam
            self.beam = self.beam + self.state.spread[0] * self.curved
        self.across = np.zeros_like(self.beam)  # of a kick in the other plane
        if "corrector_roll" in self.allowed:
            turned = [Cause("corrector_roll", name, _TURN) for name in self.m.correctors]
            model = ResponseModel(apply(ring, turned)).response(self.m.correctors)[:, self.at]
            slope = (model - response[:, self.at] * np.cos(_TURN)) / np.sin(_TURN)
            self.across[:-1] = slope * self.kicks[:-1, None, None]
        return self.read()

    def orbits(self, model: ResponseModel) -> Array:
        """Orbit changes of the steps, the RF's last, m, [column, monitor, 2].

        The RF's is as large as the dispersion: a step of half a per cent in energy has a third
        order that is several times the readings' noise.
        """
        steps = model.response(self.m.correctors) * self.kicks[:-1, None, None]
        whole = np.concatenate([steps, model.rf_change(self.kicks[-1])[None]])[:, self.at]
        return np.asarray(whole + self.bent)

    def _bend(self) -> None:
        """The third order of the correctors' two-sided steps, where the fit stands.

        It is a micrometre where the orbit is a millimetre, and the closed orbits of all correctors
        take seconds: it is taken once a step.
        """
        kicks = self.kicks[:-1] * (1 + self.state.calibration[:-1])
        up, down = (
            self.model.closed_orbits(self.m.correctors, side * kicks / 2) for side in (1, -1)
        )
        linear = self.model.response(self.m.correctors) * kicks[:, None, None]
        self.bent[:-1] = (up - down - linear)[:, self.at]
        self._set()

    def read(self) -> Array:
        """What monitors read of it, m, [column, monitor, 2]."""
        return np.asarray(np.einsum("mij,cmj->cmi", self.state.monitors, self.kicked()))

    def kicked(self) -> Array:
        """The beam's orbit changes with the correctors as they are, m, [column, monitor, 2]."""
        state = self.state
        beam = (1 + state.calibration)[:, None, None] * self.beam
        return np.asarray(beam + state.roll[:, None, None] * self.across)

    def slopes_of(self, effect: str, places: Sequence[str], plane: Indices) -> Array:
        """What the readings in `plane` do for each error, [error, column, monitor]."""
        scale = ((1 + self.state.calibration) * self.kicks)[:, None]
        gain = np.diagonal(self.state.monitors, axis1=1, axis2=2)[:, plane].T
        index = plane[:, None, None]
        pairs = [(effect, place) for place in places]
        out = np.empty((len(places), *gain.shape))
        for i, slope in enumerate(derivatives(self.model, pairs, self.m.correctors)):
            out[i] = np.take_along_axis(slope[:, self.at], index, 2)[..., 0] * scale * gain
        return out

    # --- a round of Gauss and Newton --------------------------------------------------------------
    def weight(self, block: int) -> Array:
        """1 / variance of the readings in the own plane (0) or the other (1), [column, monitor]."""
        plane = self.plane if block == 0 else 1 - self.plane
        use = np.isfinite(pick(self.data, plane)) & self.good & ~self.held[:, None]
        use[-1] &= self.half[-1]
        if self.exploring:
            use &= ~self.inner[:, None]
            use[-1] &= ~self.inner_rf
        variance = self.noise[:, plane].T ** 2 + self.lacking[block][:, None] ** 2
        return np.where(use, 1 / variance, 0.0)

    def _has(self, block: int) -> bool:
        return any(name in self.allowed for name in (IN_PLANE, COUPLING)[block])

    def round(self, block: int) -> None:
        """Linearise the readings of one block, solve, move, and look at what is left."""
        if not self._has(block):
            return
        normal, start, trust = self.linear(block)
        self._put(block, solve(normal, self.priors(block), start, trust).values)
        self._set()
        for seen in (0, 1):
            if self._has(seen):
                self._look(seen)
        log.info(
            "lacking %s m, %s",
            np.median(self.lacking, axis=1),
            {name: f"{group.rms:.1e}" for name, group in self.groups.items()},
        )

    def linear(self, block: int) -> tuple[Normal, Array, Array]:
        """Normal equations where the fit stands, the parameters there, and the trusted change."""
        state, own = self.state, self.plane
        plane = own if block == 0 else 1 - own
        beam = self.kicked()
        gain = np.diagonal(state.monitors, axis1=1, axis2=2)[:, plane].T
        if block == 0:
            by_monitor, by_column = pick(beam, own), gain * pick(self.beam, own)
            effect, places, ring = "quadrupole_gradient", self.quadrupoles, state.gradients
            monitors = np.diagonal(state.monitors, axis1=1, axis2=2) - 1
            column, steps = state.calibration, (STEP, STEP, STEP)
        else:
            by_monitor, by_column = pick(beam, own), gain * pick(self.across, plane)
            effect, places, ring = "skew_gradient", self.skews, state.skew
            monitors = np.stack([state.monitors[:, 0, 1], state.monitors[:, 1, 0]], axis=1)
            column, steps = state.roll, (ROLL_STEP, ROLL_STEP, SKEW_STEP)
        by_column[-1] = 0  # the RF's step is known
        wanted = effect in self.allowed or (block == 0 and "family_gradient" in self.allowed)
        slopes: Array | list[Array] = self.slopes_of(effect, places, plane) if wanted else []
        if block == 0 and wanted:  # relative to the design's strength, not to the one found
            slopes = np.asarray(slopes) / (1 + ring)[:, None, None]
        if not wanted:
            ring = ring[:0]
        trusted = [steps[2]] * len(ring)
        if block == 0 and "energy_spread" in self.allowed:
            curve = gain * pick(self.curved * (1 + state.calibration)[:, None, None], own)
            slopes = np.concatenate([np.asarray(slopes).reshape(-1, *curve.shape), curve[None]])
            ring, trusted = np.append(ring, state.spread), [*trusted, 10.0]
        residual = pick(self.data - self.read(), plane)
        self.slopes = slopes
        normal = normal_equations(
            residual, self.weight(block), plane, by_monitor, by_column, slopes
        )
        start = np.concatenate([monitors.ravel(), column, ring])
        trust = np.repeat(steps[:2], [monitors.size, len(column)])
        return normal, start, np.append(trust, trusted)

    def _put(self, block: int, values: Array) -> None:
        state = self.state
        m, c = 2 * len(self.at), len(self.plane)
        monitors, column, ring = values[:m].reshape(-1, 2), values[m : m + c], values[m + c :]
        if block == 0:
            state.monitors[:, [0, 1], [0, 1]] = 1 + monitors
            state.calibration = column
            if "energy_spread" in self.allowed:
                state.spread, ring = np.maximum(ring[-1:], 0.0), ring[:-1]
            state.gradients = ring if len(ring) else state.gradients
        else:
            state.monitors[:, [0, 1], [1, 0]] = monitors
            state.roll = column
            state.skew = ring if len(ring) else state.skew

    def priors(self, block: int) -> list[Group]:
        """The groups of what is allowed."""
        columns, monitors = self.data.shape[:2]
        ring = (self.quadrupoles, self.skews)[block]
        wanted = {"quadrupole_gradient", "family_gradient", "skew_gradient"} & set(self.allowed)
        sizes = [2 * monitors, columns]
        if ("skew_gradient" in wanted) if block else wanted - {"skew_gradient"}:
            sizes.append(len(ring))
        if block == 0 and "energy_spread" in self.allowed:
            sizes.append(1)
        edge = np.concatenate([[0], np.cumsum(sizes)])

        def group(name: str, part: int, basis: Array, rms: float, **options: Any) -> Group:
            if name not in self.groups or len(self.groups[name].basis) != edge[-1]:
                whole = np.zeros((edge[-1], basis.shape[1]))
                whole[edge[part] : edge[part + 1]] = basis
                old = self.groups.get(name)
                rms, each = (rms, None) if old is None else (old.rms, old.each)
                self.groups[name] = Group(name, whole, rms, each=each, **options)
            return self.groups[name]

        alike = np.zeros((2 * monitors, 2))
        alike[0::2, 0] = alike[1::2, 1] = 1
        makers: dict[str, Callable[[], list[Group]]] = {
            "corrector_calibration": lambda: [
                group("corrector_calibration", 1, np.eye(columns), 0.02, heavy=True),
                group(
                    "corrector_calibration of families", 1,
                    families([*self.m.correctors, "\0"])[1], 0.05,
                ),
            ],
            "monitor_gain": lambda: [
                group("monitor_gain", 0, np.eye(2 * monitors), 0.01, heavy=True),
                group("monitor_gain of a plane", 0, alike, 0.03, fixed=True),
            ],
            "family_gradient": lambda: [
                group("quadrupole_gradient of families", 2, families(ring)[1], 0.01)
            ],
            "quadrupole_gradient": lambda: [
                group(
                    "quadrupole_gradient", 2, np.eye(len(ring)), 3e-3, heavy=True,
                    most=LARGEST_GRADIENT,
                )
            ],
            "energy_spread": lambda: [
                group("energy_spread", len(sizes) - 1, np.eye(1), 10.0, fixed=True)
            ],
            "monitor_roll": lambda: [
                group("monitor_roll", 0, np.eye(2 * monitors), 0.01, heavy=True)
            ],
            "corrector_roll": lambda: [
                group("corrector_roll", 1, np.eye(columns), 0.01, heavy=True)
            ],
            "skew_gradient": lambda: [
                group(
                    "skew_gradient", 2, np.eye(len(ring)), 3e-4, heavy=True, most=LARGEST_SKEW
                )
            ],
        }  # fmt: skip
        mine = COUPLING if block else IN_PLANE
        return [g for name in mine if name in self.allowed for g in makers[name]()]

    def _look(self, block: int) -> None:
        """What the model lacks now; and the monitors that are bad, their own gains apart."""
        plane = self.plane if block == 0 else 1 - self.plane
        read = self.read()
        weight = self.weight(block)
        left = np.where(weight > 0, pick(self.data - read, plane), np.nan)[:-1]
        typical = float(np.nanmedian(np.abs(left[:, self.good]))) / 0.6745
        noise = float(np.median(self.noise))
        squares = np.full(len(self.plane), typical**2)  # the RF's readings are few
        count = (weight[:-1] > 0).sum(axis=1)
        shared = TYPICAL * typical**2 + np.nansum(left**2, axis=1)
        squares[:-1] = shared / (TYPICAL + count)
        self.lacking[block] = np.sqrt(np.maximum(squares - noise**2, (noise / 5) ** 2))
        if block == 0:
            self._find_bad(pick(read, plane))

    def _find_bad(self, read: Array) -> None:
        use = ~self.held & ~(self.inner if self.exploring else np.zeros_like(self.held))
        use[-1] = False
        data = pick(self.data, self.plane)
        ratio = np.zeros(len(self.good))
        for p in (0, 1):
            rows = use & (self.plane == p)
            if rows.sum() < FEW:
                continue
            u, d = read[rows], data[rows]
            seen = np.isfinite(d)
            d = np.where(seen, d, 0)
            u = np.where(seen, u, 0)
            gain = (u * d).sum(axis=0) / np.maximum((u * u).sum(axis=0), 1e-30)
            count = np.maximum(seen.sum(axis=0), 1)
            rms = np.sqrt(((d - gain * u) ** 2).sum(axis=0) / count)
            rms[(seen.sum(axis=0) == 0) | (abs(gain) < 0.2)] = np.inf
            ratio = np.maximum(ratio, rms / np.median(rms))
        self.good = ratio <= BAD

    # --- the judges -------------------------------------------------------------------------------
    def score(
        self, judges: Flags, half: Flags, rf: Flags | None = None
    ) -> tuple[float, float, float, float, float, float]:
        """In-plane and coupling rms, chi2, dispersion rms, in-plane with jumps, coupling with roll.

        Args:
            judges: the correctors that judge, [column].
            half: monitors that give each of them its kick, [column, monitor].
            rf: monitors that judge the RF's response; None: those that did not fit it.
        """
        own, other = self.plane, 1 - self.plane
        gains = self.state.monitors
        read = np.einsum("mij,cmj->cmi", gains, self.beam)
        straight, across = pick(read, own), pick(read, other)
        data, data_across = pick(self.data, own), pick(self.data, other)
        jumps = pick(np.einsum("mij,cmj->cmi", gains, self.jumps()), own)
        rolls = pick(np.einsum("mij,cmj->cmi", gains, self.across), other)
        variance = self.noise[:, own].T ** 2
        inside, jumped, outside, rolled, squares = [], [], [], [], []
        for c in np.flatnonzero(judges):
            seen = np.isfinite(data[c]) & self.good
            near, far = seen & half[c], seen & ~half[c]
            # all alike: what the model lacks is not the readings' noise
            kick, miss = _fitted(straight[c][:, None], data[c], near, far)
            inside.append(miss)
            squares.append(miss**2 / variance[c, far])
            jumped.append(_fitted(np.stack([straight[c], jumps[c]], 1), data[c], near, far)[1])
            left = data_across[c] - kick[0] * across[c]
            there = np.isfinite(left)
            outside.append(left[far & there])
            if rolls[c].any():
                rolled.append(_fitted(rolls[c][:, None], left, near & there, far & there)[1])
        judge = self.good & np.isfinite(data[-1]) & (~half[-1] if rf is None else rf)
        left = (data[-1] - straight[-1])[judge]
        return (
            rms_of(inside),
            rms_of(outside),
            float(np.mean(np.concatenate(squares))),
            rms_of([left]),
            rms_of(jumped),
            rms_of(rolled) if rolled else float("nan"),
        )

    def jumps(self) -> Array:
        """Beam orbit for a position jump of a metre at each corrector, [column, monitor, 2]."""
        model = self.model
        columns = model.columns(self.m.correctors)
        jump = np.zeros((len(columns.names), model.dimension))
        jump[np.arange(len(jump)), 2 * self.plane[:-1]] = 1
        pulled = np.einsum("cij,cj->ci", model.inverse[columns.layer + 1], jump)
        before = np.einsum("mai,ci->cma", model.reading_slopes, pulled @ model.closing.T)
        behind = np.einsum("mai,ci->cma", model.reading_slopes, pulled)
        whole = before + model.downstream(columns)[:, :, None] * behind
        return np.concatenate([whole[:, self.at], np.zeros((1, len(self.at), 2))])

    # --- what was found ---------------------------------------------------------------------------
    def _found(self) -> tuple[tuple[Cause, ...], tuple[float, ...], tuple[str, ...]]:
        posterior = {}
        for block in (0, 1):
            groups = self.priors(block)
            if groups:
                normal, start, _ = self.linear(block)
                posterior[block] = solve(normal, groups, start, rounds=0)
        found: list[tuple[str, str | None, float, float]] = []
        state, monitors = self.state, self.m.monitors
        m = 2 * len(monitors)
        gain = np.diagonal(state.monitors, axis1=1, axis2=2)
        sigma = {block: p.sigma for block, p in posterior.items()}
        if 0 in posterior:
            for j, p in enumerate("xy"):
                for i, name in enumerate(monitors):
                    found.append((f"monitor_gain_{p}", name, gain[i, j] - 1, sigma[0][2 * i + j]))
            for i, name in enumerate(self.m.correctors):
                amount = state.calibration[i]
                found.append(("corrector_calibration", name, amount, sigma[0][m + i]))
            if state.spread[0] > 0:
                amount = DELTA * float(np.sqrt(state.spread[0]))
                error = DELTA**2 * sigma[0][-1] / (2 * amount)
                found.append(("energy_spread", None, amount, error))
            if not {"family_gradient", "quadrupole_gradient"}.isdisjoint(self.allowed):
                errors = sigma[0][m + len(self.plane) :]
                for i, name in enumerate(self.quadrupoles):
                    found.append(("quadrupole_gradient", name, state.gradients[i], errors[i]))
        if 1 in posterior:
            both = sigma[1][:m].reshape(-1, 2)
            # x reads (coupling + roll) y, y reads (coupling - roll) x
            x, y = state.monitors[:, 0, 1] / gain[:, 0], state.monitors[:, 1, 0] / gain[:, 1]
            spread = np.hypot(*both.T) / 2
            for i, name in enumerate(monitors):
                found.append(("monitor_roll", name, (x[i] - y[i]) / 2, spread[i]))
                found.append(("monitor_coupling", name, (x[i] + y[i]) / 2, spread[i]))
            for i, name in enumerate(self.m.correctors):
                roll = state.roll[i] / (1 + state.calibration[i])
                found.append(("corrector_roll", name, roll, sigma[1][m + i]))
            for i, name in enumerate(self.skews):
                at = m + len(self.plane) + i
                if at < len(sigma[1]):
                    found.append(("skew_gradient", name, state.skew[i], sigma[1][at]))
        found = [row for row in found if row[2] != 0 or row[3] != 0]
        return (
            tuple(Cause(effect, name, float(a)) for effect, name, a, _ in found),
            tuple(float(s) for *_, s in found),
            self._degenerate(posterior[0]) if 0 in posterior else (),
        )

    def _degenerate(self, posterior: Posterior) -> tuple[str, ...]:
        """Directions that the prior holds and not the data."""
        said = []
        m, c = 2 * len(self.at), len(self.plane)
        sigma = posterior.sigma
        spread = posterior.spread
        factor = np.linalg.cholesky(posterior.covariance + 1e-12 * np.eye(len(spread.T)))
        draws = spread @ factor
        scale = draws[:m].mean(axis=0)
        kick = draws[m : m + c - 1].mean(axis=0)
        if scale.any() and kick.any():  # both are fitted
            both = float(scale @ kick / np.sqrt((scale @ scale) * (kick @ kick)))
            said.append(
                f"mean monitor gain against mean corrector scale: known to "
                f"{100 * np.sqrt(scale @ scale):.2f} % by the RF step and the priors, correlation "
                f"{both:+.2f}"
            )
        if "quadrupole_gradient" in self.groups and len(sigma) > m + c:
            group = self.groups["quadrupole_gradient"]
            prior = group.rms if group.each is None else group.each
            loose = np.flatnonzero(sigma[m + c : m + c + len(self.quadrupoles)] > 0.5 * prior)
            names = [self.quadrupoles[i] for i in loose]
            if names:
                said.append(
                    f"{len(names)} gradients that the prior holds more than the data: "
                    + ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
                )  # fmt: skip
        return tuple(said)


_TURN = 0.1
"""Roll that shows a corrector's kick in the other plane, rad."""


def rms_of(parts: Iterable[Array]) -> float:
    """Over all of them."""
    return float(np.sqrt(np.mean(np.square(np.concatenate(list(parts))))))


def _fitted(patterns: Array, data: Array, near: Flags, far: Flags) -> tuple[Array, Array]:
    """Amplitudes of patterns [monitor, pattern] from near readings, and what far ones miss."""
    size = np.abs(patterns[near]).max(axis=0)
    size[size == 0] = 1
    amounts = np.linalg.lstsq(patterns[near] / size, data[near], rcond=None)[0] / size
    return amounts, data[far] - patterns[far] @ amounts
