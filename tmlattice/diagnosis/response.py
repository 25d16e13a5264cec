"""Which errors close how much of a measured orbit response's gap, step by step, on held-out data.

A fifth of the correctors is never fitted. Of each of them only the kick is taken, from a random
half of the monitors, and the other half judges; the RF's orbit is fitted on half of the monitors
and judged on the other half.

Skew gradients act on the tunes to second order: fitted after the gradients and not together with
them, they close the coupling's gap and open the in-plane one again. The steps say so.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response_fit import Fit, fit
from tmlattice.effects import Cause, apply
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.response import ResponseModel, derivatives

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

BAD = 4.0
"""A monitor whose rms residual is so many times the median one's is bad."""
GAIN, CALIBRATION = 0.05, 0.05  # rms of the priors: twice the catalogue's gain, its calibration
CROSS, ROLL = 0.01, 0.01
GRADIENT, SKEW = 5e-3, 1e-3
"""Where the search for the scale of the gradients' priors starts: relative, and 1/m."""
COUPLING_ROUNDS = 3
ROUNDS = 5
"""Of Gauss and Newton, while monitors are dropped and the weights follow the residual."""


@dataclass(frozen=True)
class Step:
    """The gap with what has been allowed so far.

    Attributes:
        effect: what was added last; the first is "design".
        parameters: how many it has.
        heldout_rms_in_plane, heldout_rms_coupling: m, over held-out correctors.
        heldout_chi2_per_dof: in-plane, by the readings' noise.
        dispersion_rms: of the RF's orbit in x on the half of the monitors not fitted, m.
    """

    effect: str
    parameters: int
    heldout_rms_in_plane: float
    heldout_rms_coupling: float
    heldout_chi2_per_dof: float
    dispersion_rms: float


@dataclass(frozen=True)
class ResponseDiagnosis:
    """Ordered steps and what was found.

    Attributes:
        steps: the first is the design's.
        causes: of the ring, its correctors and its monitors, those of the last step.
        errors: posterior rms of each, the same length.
        bad_monitors: names of those left out.
        seed: of the split.
    """

    steps: tuple[Step, ...]
    causes: tuple[Cause, ...]
    errors: tuple[float, ...]
    bad_monitors: tuple[str, ...]
    seed: int


def diagnose_response(
    ring: Ring,
    measured: OrbitResponse,
    *,
    holdout: float = 0.2,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda stage: None,
) -> ResponseDiagnosis:
    """Monitors and correctors, then gradients, then what couples the planes.

    Args:
        ring: the design.
        measured: with an RF step, and the noise of its readings.
        holdout: share of the correctors that is never fitted.
        seed: of the split.
        progress: called with the name of each stage.

    Raises:
        MeasurementError: no RF step, no noise, or too few correctors.
    """
    return _Run(ring, measured, holdout, seed, progress).run()


class _Run:
    def __init__(
        self,
        ring: Ring,
        measured: OrbitResponse,
        holdout: float,
        seed: int,
        progress: Callable[[str], Any],
    ) -> None:
        names = [monitor.name for monitor in ring.monitors]
        measured = measured.select(
            monitors=[n for n in names if n in {ring[m].name for m in measured.monitors}]
        )
        if measured.rf is None or measured.rf.orbit is None:
            raise MeasurementError("an orbit response without an RF step: dispersion is not known")
        if measured.noise is None or np.isnan(measured.noise).any():
            raise MeasurementError("the noise of the readings is not known; add it")
        self.ring, self.m, self.seed, self.progress = ring, measured, seed, progress
        self.at = np.array([names.index(n) for n in measured.monitors])
        self.data = np.concatenate([measured.response, measured.rf.orbit[None]])
        self.kicks = np.append(measured.kicks, measured.rf.step / measured.rf.frequency)
        self.plane = np.append([int(p == "y") for p in measured.planes], 0)
        self.noise = measured.noise
        columns, monitors = self.data.shape[:2]
        rng = np.random.default_rng(seed)
        self.held = np.zeros(columns, dtype=bool)
        count = round(holdout * (columns - 1))
        if not 0 < count < columns - 1:
            raise MeasurementError(f"{columns - 1} correctors cannot be split; measure more")
        self.held[rng.choice(columns - 1, count, replace=False)] = True
        self.half = np.zeros((columns, monitors), dtype=bool)  # that give kicks, or the RF's fit
        for c in [*np.flatnonzero(self.held), columns - 1]:
            self.half[c, rng.choice(monitors, monitors // 2, replace=False)] = True
        self.good = np.ones(monitors, dtype=bool)
        self.gain = np.zeros((monitors, 2))
        self.calibration = np.zeros(columns)
        self.quadrupoles = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1 != 0]
        self.skew: list[Cause] = []
        self.gradients = np.zeros(len(self.quadrupoles))
        self.extra = 5e-6
        """What the model still lacks, m: it lessens the weight of readings, as noise does."""

    def run(self) -> ResponseDiagnosis:
        """The steps in their order."""
        self._set(self.ring)
        scores: list[tuple[str, int, tuple[Any, ...]]] = [("design", 0, self._state())]
        columns, monitors = self.data.shape[:2]
        self.progress("monitors and correctors")
        for _ in range(2):
            found = self._in_plane(False, None)
        scores.append(
            ("monitor_gain, corrector_calibration", 2 * monitors + columns - 1, self._state())
        )
        gradients = np.zeros(len(self.quadrupoles))
        for _ in range(ROUNDS):
            self.progress("gradients")
            found, gradients = self._gauss_newton(gradients)
        scores.append(("quadrupole_gradient", len(gradients), self._state()))
        self.progress("coupling")
        self.gradients = gradients
        for name, skew in (("monitor_roll, monitor_coupling, corrector_roll", False),
                           ("skew_gradient", True)):  # fmt: skip
            own, state = self._coupling(skew)
            count = len(own.ring) if skew else 2 * monitors + columns - 1
            scores.append((name, count, state))
        causes, errors = self._causes(found, self.gradients)
        more, more_errors = self._coupling_causes(own)
        steps = [Step(name, count, *self._score(*state)) for name, count, state in scores]
        bad = tuple(self.m.monitors[i] for i in np.flatnonzero(~self.good))
        return ResponseDiagnosis(
            tuple(steps), (*causes, *more), (*errors, *more_errors), bad, self.seed
        )

    def _set(self, ring: Ring) -> None:
        self.model = ResponseModel(ring)
        response = self.model.response(self.m.correctors)
        whole = np.concatenate([response, self.model.rf_response()[None]])[:, self.at]
        self.beam = whole * self.kicks[:, None, None]

    def _pick(self, values: Array, plane: Indices) -> Array:
        """One plane of [column, monitor, 2] for each column."""
        return np.asarray(np.take_along_axis(values, plane[:, None, None], 2)[..., 0])

    def _weight(self, plane: Indices, fitted_rf: bool = True) -> Array:
        data = self._pick(self.data, plane)
        use = np.isfinite(data) & self.good & ~self.held[:, None]
        use[-1] &= self.half[-1] & fitted_rf
        variance = self.noise[:, plane].T ** 2 + self.extra**2
        return np.where(use, 1 / variance, 0.0)

    def _errors(self, effect: str, plane: Indices) -> Array:
        """What the readings in `plane` do for each gradient, [error, column, monitor]."""
        places = [(effect, q) for q in self.quadrupoles]
        scale = ((1 + self.calibration) * self.kicks)[:, None]
        gain = 1 + self.gain[:, plane].T
        index = plane[:, None, None]
        out = np.empty((len(places), *gain.shape))
        for i, slope in enumerate(derivatives(self.model, places, self.m.correctors)):
            out[i] = np.take_along_axis(slope[:, self.at], index, 2)[..., 0] * scale * gain
        return out

    def _in_plane(self, with_gradients: bool, gradients: Array | None) -> Fit:
        plane = self.plane
        beam = self._pick(self.beam, plane)
        scale, gain = 1 + self.calibration[:, None], 1 + self.gain[:, plane].T
        read = scale * gain * beam
        by_column = gain * beam
        by_column[-1] = 0  # the RF's step is known
        known = [self.gain.ravel(), self.calibration]
        slopes: Array | Sequence[Array] = []
        if with_gradients:
            assert gradients is not None
            slopes = self._errors("quadrupole_gradient", plane)
            known.append(gradients)
        weight = self._weight(plane)
        found = fit(
            self._pick(self.data, plane) - read, weight, plane, scale * beam, by_column, slopes,
            GAIN, CALIBRATION, GRADIENT, start=np.concatenate(known),
        )  # fmt: skip
        if not with_gradients:
            self.gain, self.calibration = found.monitor, found.column
            self._look()
        return found

    def _look(self, drop: bool = False) -> None:
        """The residual as it is now: what the model lacks, and the monitors that are bad."""
        weight = self._weight(self.plane)
        left = np.where(weight > 0, self._residual(), np.nan)[:-1]
        used = self.good & np.isfinite(left).any(axis=0)
        rms = np.zeros(len(used))
        rms[used] = np.sqrt(np.nanmean(left[:, used] ** 2, axis=0))
        if drop:  # before, the optics' errors are far larger than a bad monitor's
            self.good = used & (rms <= BAD * np.median(rms[used]))
        self.extra = max(1e-7, float(np.nanmedian(np.abs(left[:, self.good]))) / 0.6745)

    def _residual(self) -> Array:
        scale, gain = 1 + self.calibration[:, None], 1 + self.gain[:, self.plane].T
        read = scale * gain * self._pick(self.beam, self.plane)
        return np.asarray(self._pick(self.data, self.plane) - read)

    def _gauss_newton(self, gradients: Array) -> tuple[Fit, Array]:
        """One step, shortened until what it minimises falls."""
        weight = self._weight(self.plane)
        before = np.concatenate([self.gain.ravel(), self.calibration, gradients])
        m, c = self.gain.size, len(self.plane)
        found = self._in_plane(True, gradients)
        goal = np.concatenate([found.monitor.ravel(), found.column, found.ring])
        prior = np.repeat([GAIN, CALIBRATION, found.scale], [m, c, len(gradients)])

        def cost(values: Array) -> float:
            chi2 = float((weight * np.nan_to_num(self._residual()) ** 2).sum())
            return chi2 + float(((values / prior) ** 2).sum())

        old = cost(before)
        share = 1.0
        while True:
            values = before + share * (goal - before)
            self.gain, self.calibration = values[:m].reshape(-1, 2), values[m : m + c]
            gradients = values[m + c :]
            self._set(apply(self.ring, [*self._gradient_causes(gradients), *self.skew]))
            if cost(values) <= old or share < 0.1:
                break
            share /= 2
        self._look(drop=True)
        log.info("share %.3g of a step, scale %.2e, lacking %.2e m", share, found.scale, self.extra)
        return found, gradients

    def _gradient_causes(self, gradients: Array) -> list[Cause]:
        return [
            Cause("quadrupole_gradient", q, float(a))
            for q, a in zip(self.quadrupoles, gradients, strict=True)
        ]

    def _coupling(self, skew: bool) -> tuple[Fit, tuple[Any, ...]]:
        """Fit of the readings in the other plane, and what the score needs of it."""
        own, other = self.plane, 1 - self.plane
        scale, gain = 1 + self.calibration[:, None], 1 + self.gain[:, other].T
        m, c = self.gain.size, len(own)
        known = np.zeros(m + c + (len(self.quadrupoles) if skew else 0))
        gradients = self.gradients
        for _ in range(COUPLING_ROUNDS if skew else 1):
            cross, roll = known[:m].reshape(-1, 2), known[m : m + c]
            straight = scale * gain * self._pick(self.beam, own)
            by_column = np.zeros_like(straight)
            for i, name in enumerate(self.m.correctors):
                slope = next(derivatives(self.model, [("corrector_roll", name)], [name]))
                by_column[i] = slope[0, self.at, other[i]] * self.kicks[i]
            by_column *= scale * gain
            slopes: Array | Sequence[Array]
            slopes = self._errors("skew_gradient", other) if skew else []
            read = scale * gain * self._pick(self.beam, other)
            read = read + cross[:, other].T * straight + roll[:, None] * by_column
            residual = self._pick(self.data, other) - read
            weight = self._weight(other)
            self.extra = float(np.nanmedian(np.abs(residual[weight > 0]))) / 0.6745
            weight = self._weight(other)
            found = fit(
                residual, weight, other, straight, by_column, slopes, CROSS, ROLL, SKEW, start=known
            )
            known = np.concatenate([found.monitor.ravel(), found.column, found.ring])
            if skew:
                self.skew = [
                    Cause("skew_gradient", q, float(a))
                    for q, a in zip(self.quadrupoles, found.ring, strict=True)
                ]
                self._set(apply(self.ring, [*self._gradient_causes(gradients), *self.skew]))
        return found, (self.beam, self.gain, found.monitor)

    def _state(self) -> tuple[Any, ...]:
        return self.beam, self.gain, None

    def _score(
        self, beam: Array, gain: Array, cross: Array | None
    ) -> tuple[float, float, float, float]:
        """In-plane and coupling rms, chi2 per reading, dispersion rms: over the good monitors."""
        own, other = self.plane, 1 - self.plane
        read = (1 + gain) * beam
        straight, across = self._pick(read, own), self._pick(read, other)
        data, data_across = self._pick(self.data, own), self._pick(self.data, other)
        if cross is not None:
            across = across + cross[:, other].T * (1 + gain[:, other].T) * self._pick(beam, own)
        variance = self.noise[:, own].T ** 2
        inside, outside, chi2 = [], [], []
        for c in np.flatnonzero(self.held):
            seen = np.isfinite(data[c]) & self.good
            near, far = seen & self.half[c], seen & ~self.half[c]
            u = straight[c, near]  # all alike: what the model lacks is not the readings' noise
            kick = (u * data[c, near]).sum() / (u * u).sum()
            miss = data[c, far] - kick * straight[c, far]
            inside.append(miss)
            chi2.append(miss**2 / variance[c, far])
            outside.append((data_across[c] - kick * across[c])[far & np.isfinite(data_across[c])])
        judge = self.good & ~self.half[-1] & np.isfinite(data[-1])
        rf = (data[-1] - straight[-1])[judge]

        def rms(parts: Any) -> float:
            return float(np.sqrt(np.mean(np.square(parts))))

        return (
            rms(np.concatenate(inside)),
            rms(np.concatenate(outside)),
            float(np.mean(np.concatenate(chi2))),
            rms(rf),
        )

    def _causes(self, found: Fit, gradients: Array) -> tuple[list[Cause], list[float]]:
        causes, sigma = [], found.sigma
        monitors, columns = len(self.m.monitors), len(self.plane)
        for i, name in enumerate(self.m.monitors):
            causes += [
                Cause(f"monitor_gain_{p}", name, float(self.gain[i, j])) for j, p in enumerate("xy")
            ]
        causes += [
            Cause("corrector_calibration", name, float(a))
            for name, a in zip(self.m.correctors, self.calibration[:-1], strict=True)
        ]
        causes += self._gradient_causes(gradients)
        kept = np.delete(sigma, 2 * monitors + columns - 1)  # the RF has no calibration
        return causes, kept.tolist()

    def _coupling_causes(self, found: Fit) -> tuple[list[Cause], list[float]]:
        """x reads (coupling + roll) y, y reads (coupling - roll) x."""
        causes: list[Cause] = []
        errors: list[float] = []
        monitors, columns = len(self.m.monitors), len(self.plane)
        both = found.sigma[: 2 * monitors].reshape(monitors, 2)
        spread = np.sqrt((both**2).sum(axis=1)) / 2
        for i, name in enumerate(self.m.monitors):
            x, y = found.monitor[i]
            causes += [
                Cause("monitor_roll", name, float(x - y) / 2),
                Cause("monitor_coupling", name, float(x + y) / 2),
            ]
            errors += [float(spread[i])] * 2
        rest = found.sigma[2 * monitors :]
        for i, name in enumerate(self.m.correctors):
            causes.append(Cause("corrector_roll", name, float(found.column[i])))
            errors.append(float(rest[i]))
        for i, name in enumerate(self.quadrupoles):
            causes.append(Cause("skew_gradient", name, float(found.ring[i])))
            errors.append(float(rest[columns + i]))
        return causes, errors
