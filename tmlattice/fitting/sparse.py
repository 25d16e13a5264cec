"""Fine-tuning by few causes: which magnets changed, by how much, and what the tunes then are.

Every powered quadrupole and sextupole is a candidate, one group of weights each. A scan along the
tangent maps ranks them; the leading ones are refined through the full nonlinear model, with
OCELOT's own maps of the changed magnet; evidence (the fit's quality against the room that a cause
has) decides between them and how many there are. Magnets that explain the readings about as well
widen the stated error of the tunes.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from tmlattice.errors import BeamLostError, TmlatticeError, UnstableRingError
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.data import FirstTurn, first_turn, readings_of, tangents
from tmlattice.fitting.strengths import LARGEST, RingStrengths, ring_strengths
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork
from tmlattice.optics import matrix_tunes

Array = NDArray[np.float64]


FAULT = 0.3
"""Prior rms of the relative change of a strength that has changed."""


LARGEST_NUMBER, REFINED = 5, 12
"""Of causes, and of candidates that are refined after each scan."""

RARER = 10.0
"""Each cause beyond the first is so many times less likely than the one before: faults are rare,
and with hundreds of candidates a false second one would else come in one case of a hundred."""


@dataclass(frozen=True)
class Explanation:
    """Some changed strengths, fitted to the readings.

    Attributes:
        causes: indices of strengths.
        amounts: relative changes, [cause].
        launches: as fitted, [shot, n].
        covariance: of the amounts, the launches' errors included, [cause, cause].
        chi2: sum of squares of (measured - modelled) / sigma.
        evidence: logarithm, up to a constant of the data.
    """

    causes: tuple[int, ...]
    amounts: Array
    launches: Array
    covariance: Array
    chi2: float
    evidence: float


class _Search:
    """The nonlinear model with any causes, and the scan for one more."""

    def __init__(
        self,
        network: TaylorNetwork,
        strengths: RingStrengths,
        data: FirstTurn,
        fault: float,
    ) -> None:
        self.design = network
        self.model = network.copy()
        self.model.requires_grad_(False)
        self.strengths = strengths
        self.data = data
        self.fault = fault
        self.layer = strengths.layer
        closing = network.maps.closing.coefficients[1]
        steps = np.concatenate([network.weights()[1], closing[None]])[:, :4, :4]
        self.upto = np.empty((len(steps) + 1, 4, 4))  # from the start to every exit, and the end
        self.upto[0] = np.eye(4)
        for k, step in enumerate(steps):
            self.upto[k + 1] = step @ self.upto[k]
        self.known: dict[tuple[int, ...], Explanation | None] = {}
        self.now: dict[int, float] = {}

    def _put(self, causes: Sequence[int], amounts: ArrayLike) -> None:
        now = dict(zip(causes, map(float, np.asarray(amounts)), strict=True))
        if not now or now == self.now:
            return  # only the launches are moving
        self.now = now
        new = self.strengths.only(list(causes)).weights(amounts)
        with torch.no_grad():
            for parameter, weight in zip(self.model.parameters(), new, strict=True):
                parameter[self.layer[list(causes)]] = torch.from_numpy(weight)

    def _take_back(self, causes: Sequence[int]) -> None:
        self.now.clear()
        with torch.no_grad():
            pairs = zip(self.model.parameters(), self.design.parameters(), strict=True)
            for parameter, design in pairs:
                for cause in causes:
                    parameter[self.layer[cause]] = design[self.layer[cause]]

    def _left(self, causes: Sequence[int], amounts: Array, shift: Array) -> Array:
        self._put(causes, amounts)
        return self.data.left(readings_of(self.model, self.data.launches + shift))

    def fit(self, causes: tuple[int, ...], amounts: Array) -> Explanation | None:
        """Gauss-Newton from given amounts; None where it does not settle on a possible change."""
        if causes in self.known:
            return self.known[causes]
        try:
            found = self._fit(causes, np.array(amounts, dtype=float))
        except (BeamLostError, np.linalg.LinAlgError):
            found = None
        finally:
            self._take_back(causes)
        self.known[causes] = found
        return found

    def _fit(self, causes: tuple[int, ...], amounts: Array) -> Explanation | None:
        data, number = self.data, len(causes)
        moving = np.flatnonzero(np.tile(data.launch_sigma > 0, len(data.launches)))
        launch_scale = np.tile(data.launch_sigma, len(data.launches))[moving]
        scale = np.concatenate([np.full(number, self.fault), launch_scale])
        free = np.concatenate([amounts, np.zeros(len(moving))])
        steps = np.concatenate([np.full(number, 1e-4), np.full(len(moving), 1e-7)])

        def left(values: Array) -> Array:
            shift = np.zeros(data.launches.size)
            shift[moving] = values[number:]
            return self._left(causes, values[:number], shift.reshape(data.launches.shape))

        def cost(residual: Array, values: Array) -> float:
            return float(residual @ residual + np.sum((values / scale) ** 2))

        residual = left(free)
        current = cost(residual, free)
        J = np.zeros((len(residual), 0))
        for _ in range(20):
            J = (
                np.stack(
                    [
                        (left(free - h * e) - left(free + h * e)) / (2 * h)
                        for h, e in zip(steps, np.eye(len(free)), strict=True)
                    ],
                    axis=1,
                )
                if len(free)
                else J
            )
            # Scaled by the prior: the normal matrix is then 1 + (what the readings add).
            Js = J * scale
            step = scale * np.linalg.solve(
                Js.T @ Js + np.eye(len(free)), Js.T @ residual - free / scale
            )
            for _ in range(8):  # halved until it helps
                trial = free + step
                if np.abs(trial[:number]).max(initial=0.0) < LARGEST:
                    attempt = left(trial)
                    better = cost(attempt, trial)
                    if better <= current * (1 + 1e-12) + 1e-12:
                        break
                step = step / 2
            else:
                break
            gain, free, residual, current = current - better, trial, attempt, better
            if gain < 1e-7 * max(1.0, current) and np.abs(step / scale).max(initial=0.0) < 1e-6:
                break
        if np.abs(free[:number]).max(initial=0.0) > 0.98 * LARGEST:
            return None
        Js = J * scale
        normal = Js.T @ Js + np.eye(len(free))
        covariance = np.linalg.inv(normal) * np.outer(scale, scale)
        shift = np.zeros(data.launches.size)
        shift[moving] = free[number:]
        _, volume = np.linalg.slogdet(normal)
        room = number * np.log(len(self.layer)) + max(number - 1, 0) * np.log(RARER)
        evidence = -0.5 * current - 0.5 * float(volume) - room
        return Explanation(
            causes, free[:number], data.launches + shift.reshape(data.launches.shape),
            covariance[:number, :number], float(residual @ residual), evidence,
        )  # fmt: skip

    def scan(self, explanation: Explanation) -> tuple[Array, Array]:
        """Gain in chi-square / 2 and amount of one more cause, to first order, [strength].

        The launches and the causes that are already there are projected out.
        """
        data = self.data
        maps = self.design.maps
        self._put(explanation.causes, explanation.amounts)
        changes = np.zeros(len(self.layer))
        changes[list(explanation.causes)] = explanation.amounts
        d0, d1, d2 = self.strengths.slopes(changes)
        blocks, taken = [], []
        try:
            left = (data.readings - readings_of(self.model, explanation.launches)) / data.sigma
            for shot, x in enumerate(explanation.launches):
                path, M, back = tangents(self.model, x)
                entrance = path[self.layer]
                i, j = np.triu_indices(len(x))
                pairs = entrance[:, i] * entrance[:, j]
                kick = d0 + np.einsum("jab,jb->ja", d1, entrance)
                kick += np.einsum("jam,jm->ja", d2, pairs)
                at_start = np.einsum("jab,jb->ja", back[self.layer + 1], kick)
                rows = maps.R1 @ M[maps.at]  # [monitor, 2, n]
                seen = maps.at[:, None] > self.layer
                block = np.einsum("mpa,ja->mpj", rows, at_start) * seen[:, None, :]
                blocks.append(block / data.sigma[shot][..., None])
                own = np.zeros((*rows.shape[:2], len(data.launches) * len(x)))
                own[..., shot * len(x) : (shot + 1) * len(x)] = rows * data.launch_sigma
                taken.append(own / data.sigma[shot][..., None])
        finally:
            self._take_back(explanation.causes)
        signatures = np.stack(blocks)[data.present]
        residual = left[data.present]
        others = np.concatenate([np.stack(taken), np.stack(blocks)[..., list(explanation.causes)]
                                 * self.fault], axis=-1)[data.present]  # fmt: skip
        others = others[:, others.any(axis=0)]
        if others.shape[1]:
            # What a nuisance of this size can explain counts for nothing.
            inner = np.linalg.solve(
                np.eye(others.shape[1]) + others.T @ others,
                others.T @ np.concatenate([signatures, residual[:, None]], axis=1),
            )
            cleaned = np.concatenate([signatures, residual[:, None]], axis=1) - others @ inner
            signal, power = signatures.T @ cleaned[:, -1], np.sum(signatures * cleaned[:, :-1], 0)
        else:
            signal, power = signatures.T @ residual, np.sum(signatures**2, axis=0)
        amount = signal / (power + self.fault**-2)
        gain = 0.5 * signal * amount - 0.5 * np.log1p(power * self.fault**2)
        gain[list(explanation.causes)] = -np.inf
        gain[np.abs(amount) > LARGEST] = -np.inf
        return gain, amount

    def tunes(self, explanation: Explanation) -> Array:
        """Tunes of the ring with these changes, from the product of its matrices.

        Raises:
            UnstableRingError: it has none.
        """
        turn, last = np.eye(4), 0
        order = np.argsort(self.layer[list(explanation.causes)])
        causes = [explanation.causes[i] for i in order]
        changed = self.strengths.only(causes).weights(explanation.amounts[order])[1]
        for k, matrix in zip(self.layer[causes], changed, strict=True):
            turn = matrix[:4, :4] @ self._between(last, k) @ turn
            last = k + 1
        return matrix_tunes(self._between(last, len(self.upto) - 1) @ turn)

    def _between(self, first: int, last: int) -> Array:
        """The design's matrix from one exit to a later one, [4, 4]."""
        return np.asarray(self.upto[last] @ np.linalg.inv(self.upto[first]))

    def tune_covariance(self, explanation: Explanation, tunes: Array) -> Array:
        """Of the tunes [2, 2], from that of the amounts."""
        rows = []
        for i in range(len(explanation.causes)):
            step = min(1e-5, 0.1 * np.sqrt(explanation.covariance[i, i]))
            moved = [
                self.tunes(_moved(explanation, sign * step * np.eye(len(explanation.causes))[i]))
                for sign in (1, -1)
            ]
            rows.append(_short(moved[0] - moved[1]) / (2 * step))
        if not rows:
            return np.zeros((2, 2))
        slope = np.stack(rows, axis=1)
        return np.asarray(slope @ explanation.covariance @ slope.T)


def _moved(explanation: Explanation, step: Array) -> Explanation:
    e = explanation
    return Explanation(e.causes, e.amounts + step, e.launches, e.covariance, e.chi2, e.evidence)


def _short(difference: Array) -> Array:
    """The short way round the circle of tunes."""
    return np.asarray((difference + 0.5) % 1.0 - 0.5)


def fit_sparse(
    network: TaylorNetwork,
    measurement: Measurement,
    *,
    ring: Ring | None = None,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    noise: float | None = None,
    launch_sigma: ArrayLike | None = None,
    fault: float = FAULT,
    largest_number: int = LARGEST_NUMBER,
    refined: int = REFINED,
    candidates: Sequence[str] | None = None,
    progress: bool = True,
) -> FitResult:
    """Fit a measurement's first turn by as few changed magnets as the evidence asks for.

    Args:
        network: the design.
        measurement: at least one shot.
        ring: that the network was made from; else the network's own `ring`.
        kinds: of magnets whose strength may have changed.
        noise: rms of one reading, m; else the measurement's.
        launch_sigma: standard error of the launch coordinates, one number or [n]; None: known.
        fault: prior rms of a relative change.
        largest_number: of causes.
        refined: candidates that are refined after each scan.
        candidates: names of the only magnets that may have changed; None: all of the kinds.
        progress: there is nothing to show; every method takes it.

    Returns:
        The network of the refined ring, its tunes from its own matrix, and their standard error:
        that of the changes, and the spread over other magnets that explain the readings nearly as
        well, weighted by their evidence. No error is stated where no cause was found: what a
        fault too small to be seen does to the tunes is not known from these readings.

    Raises:
        MeasurementError: no reading, or no noise stated.
        TmlatticeError: no ring to change, or no powered magnet of these kinds.
        UnstableRingError: the ring that explains the readings has no tune.
    """
    begun = time.perf_counter()
    ring = network.ring if ring is None else ring
    if ring is None:
        raise TmlatticeError("method 'sparse' changes the ring's magnets: give ring=")
    data = first_turn(network, measurement, noise, launch_sigma)
    known = ring_strengths(ring, kinds, network.dimension)
    if candidates is not None:
        wanted = {ring[name].name for name in candidates}
        places = [i for i, s in enumerate(known.strengths) if s.name in wanted]
        if not places:
            raise TmlatticeError(
                f"none of {sorted(wanted)} is a powered {' or '.join(kinds)}; name some that are"
            )
        known = known.only(places)
    strengths = known.strengths
    search = _Search(network, known, data, fault)
    best, chi2 = _grown(search, largest_number, refined)
    changed = ring
    for cause, amount in zip(best.causes, best.amounts, strict=True):
        strength = strengths[cause]
        changed = changed.with_changed(
            strength.name, **{strength.attribute: strength.value * (1 + float(amount))}
        )
    tunes = search.tunes(best)
    covariance = _spread(search, best)
    errors = np.sqrt(np.diag(best.covariance))
    return FitResult(
        network=TaylorNetwork.from_ring(changed, network.dimension),
        loss=[float(c) * float(np.mean(data.sigma**2)) / len(data.launches) for c in chi2],
        penalty=[0.0] * len(chi2),
        best_epoch=len(chi2) - 1,
        stopped_early=False,
        seconds=time.perf_counter() - begun,
        options={
            "method": "sparse",
            "kinds": list(kinds),
            "noise": noise,
            "launch_sigma": None if launch_sigma is None else data.launch_sigma.tolist(),
            "fault": fault,
            "largest_number": largest_number,
            "refined": refined,
            "candidates": None if candidates is None else list(candidates),
        },
        tunes=tunes,
        tune_sigma=np.sqrt(np.diag(covariance)) if best.causes else None,
        changes={
            strengths[c].name: (float(a), float(e))
            for c, a, e in zip(best.causes, best.amounts, errors, strict=True)
        },
    )


def few_causes(
    network: TaylorNetwork, strengths: RingStrengths, data: FirstTurn
) -> Explanation | None:
    """The changed strengths that the evidence asks for; the one of greatest evidence where it asks
    for none."""
    search = _Search(network, strengths, data, FAULT)
    best = _grown(search, LARGEST_NUMBER, REFINED)[0]
    return best if best.causes else _best_of(search, best, REFINED)


def _grown(search: _Search, largest_number: int, refined: int) -> tuple[Explanation, list[float]]:
    """One cause after another while the evidence grows, and chi-square on the way."""
    best = search.fit((), np.zeros(0))
    if best is None:
        raise BeamLostError("the launch is lost in the design ring; launch closer to the axis")
    chi2 = [best.chi2]
    for _ in range(min(largest_number, len(search.layer))):
        grown = _best_of(search, best, refined)
        if grown is None or grown.evidence <= best.evidence:
            break
        best = _exchanged(search, grown, refined)
        chi2.append(best.chi2)
    return best, chi2


def _best_of(search: _Search, start: Explanation, number: int) -> Explanation | None:
    """`start` with the one more cause that has the best evidence, of `number` refined."""
    gain, amount = search.scan(start)
    best = None
    for cause in np.argsort(-gain)[:number]:
        if gain[cause] == -np.inf:
            break
        found = search.fit(
            (*start.causes, int(cause)), np.append(start.amounts, np.clip(amount[cause], -1, 1))
        )
        if found is not None and (best is None or found.evidence > best.evidence):
            best = found
    return best


def _without(search: _Search, explanation: Explanation, place: int) -> Explanation | None:
    keep = [i for i in range(len(explanation.causes)) if i != place]
    causes = tuple(explanation.causes[i] for i in keep)
    return search.fit(causes, explanation.amounts[keep])


def _exchanged(search: _Search, best: Explanation, refined: int) -> Explanation:
    """Take causes out, or exchange them for others, as long as the evidence grows."""
    improved = len(best.causes) > 1
    while improved:
        improved = False
        for place in range(len(best.causes)):
            fewer = _without(search, best, place)
            if fewer is None:
                continue
            other = _best_of(search, fewer, refined)
            for found in (fewer, other):
                if found is not None and found.evidence > best.evidence + 1e-6:
                    best, improved = found, True
            if improved:
                break
    return best


def _spread(search: _Search, best: Explanation) -> Array:
    """Covariance of the tunes about those of `best`, over all explanations that were refined."""
    total, weight_sum = np.zeros((2, 2)), 0.0
    try:
        centre = search.tunes(best)
    except UnstableRingError:
        return np.full((2, 2), np.nan)
    for explanation in [e for e in search.known.values() if e is not None]:
        weight = float(np.exp(explanation.evidence - best.evidence))
        if weight < 1e-6:
            continue
        try:
            tunes = search.tunes(explanation)
            own = search.tune_covariance(explanation, tunes)
        except UnstableRingError:
            continue  # the ring stores a beam, or nobody would ask for its tunes
        away = _short(tunes - centre)
        total += weight * (own + np.outer(away, away))
        weight_sum += weight
    return total / weight_sum if weight_sum else np.full((2, 2), np.nan)
