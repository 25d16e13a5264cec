"""A machine with small errors everywhere: the background against which a fault must be seen.

The errors are Gaussian with known rms, the same in all shots, and far too many to be found one by
one; what they do to the readings is a covariance. It is linear only about orbits near the true
ones, which small errors move by millimetres. So the likeliest errors are worked out, put into the
model, and the covariance is taken anew about that model; the data are moved so that the errors'
prior still stands about zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from tmlattice.beam.model import Model, Paths
from tmlattice.effects import Cause, find
from tmlattice.errors import BeamLostError
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Hypothesis
from tmlattice.inference.sizes import Sizes, learn_sizes
from tmlattice.inference.whitening import Whitening
from tmlattice.lattice import Ring
from tmlattice.observe.data import Data
from tmlattice.observe.first_turns import FirstTurns

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

ROUNDS = 2
"""Linearisations: about the design, and about the likeliest errors."""

SHARES = (1.0, 0.5, 0.25, 0.0625)
"""Of a step to the likeliest small errors that are tried, until one makes them likelier."""

ROWS = 1600
"""Readings from which sizes are learnt: 17 sizes to some per cent; the time goes as their cube."""


@dataclass(frozen=True)
class SmallErrors:
    """The background, linear about its likeliest amounts.

    Attributes:
        problem: with those amounts in its model, and in its data what the signatures make of them.
        before: launches alone, in this model.
        plain: without them, with the noise as learnt.
        hypotheses, rms: of every error.
        about: the amounts in its model.
        sizes: rms by effect.
        open: relative error of each size that was learnt; large where the readings hardly see it.
        evidence: log evidence that the sizes learnt have over no small errors; None: they were
            told.
        apart: log evidence that the cause beside which they were taken is none of them, however
            large its family may be; None: nobody asked.
    """

    problem: FirstTurns
    before: Fit
    plain: FirstTurns
    hypotheses: tuple[Hypothesis, ...]
    rms: Array
    about: tuple[Cause, ...]
    sizes: Mapping[str, float]
    open: Mapping[str, float] = field(default_factory=dict)
    evidence: float | None = None
    apart: float | None = None

    def estimate(self, explained: Fit, whitening: Whitening) -> list[Cause]:
        """The likeliest small errors beside an explanation, which was found in this whitening."""
        assert self.problem.spread is not None
        rows = explained.clean.reshape(whitening.shots, -1)[:, :-5]
        weights = whitening.back(rows[None])[0]
        shares = np.einsum("esrp,srp->e", self.problem.spread, weights, optimize=True)
        amounts = (self.rms * shares).tolist()
        own = zip(self.hypotheses, amounts, strict=True)
        return [Cause(*h, find(h[0]).some_left(amount)) for h, amount in own]

    def made_by(self, estimate: Sequence[Cause]) -> Array:
        """What small errors make of the readings, linearly, [shot, reading, 2], m."""
        assert self.problem.spread is not None
        amounts = np.array([cause.amount for cause in estimate]) / self.rms
        return np.asarray(np.einsum("e,esrp->srp", amounts, self.problem.spread, optimize=True))

    def unknown(
        self, explained: Fit, seen: FirstTurns, other: FirstTurns, estimate: Sequence[Cause]
    ) -> Array:
        """Covariance of what is still not known of other shots, once these have been explained.

        Of the small errors what the readings leave open, and of the amounts of the causes: as in
        universal kriging (Matheron 1969), whose drift launches and amounts are.

        Args:
            explained: the fit of these shots.
            seen: its problem, in whose whitening it was found.
            other: of the other shots, with the small errors of this explanation in its model.
            estimate: those.

        Returns:
            [shot * reading * 2] twice, m^2.

        Raises:
            BeamLostError: the beam of the other shots is lost among these small errors.
        """
        assert self.problem.spread is not None
        point = other.at(explained.causes, other.data.launches)
        if point.lost:
            raise BeamLostError(f"{point.lost} among the small errors that were found")
        *_, there = background_signatures(other.model, point.view, point.nuisances, self.sizes)
        there = chained(estimate)[:, None] * there.reshape(len(there), -1)
        here = self.problem.spread.reshape(len(there), -1)
        shared = (there.T @ here).reshape(-1, *seen.valid.shape)
        rows = explained.projection.out(seen.whitening.signature(shared))  # [other reading, row]
        unknown = there.T @ there - rows @ rows.T
        slopes = [explained.slopes.get((c.effect, c.element)) for c in explained.causes]
        for_each = [i for i, slope in enumerate(slopes) if slope is not None]
        if for_each:
            seen_by = np.array([slope.row for slope in slopes if slope is not None])
            drift = np.array([other.metres(other.slope(point, i)) for i in for_each])
            drift -= seen_by @ rows.T
            unknown += drift.T @ explained.covariance[np.ix_(for_each, for_each)] @ drift
        return np.asarray(unknown)


def background_signatures(
    model: Model, paths: Paths, launches: Array, rms: Mapping[str, float]
) -> tuple[list[Hypothesis], Array, Array]:
    """Every small error along these trajectories.

    Args:
        model, paths, launches: the base.
        rms: by effect.

    Returns:
        Which they are; the rms of each, [error]; rms times signature, [error, shot, reading, 2], m.
    """
    hypotheses = model.hypotheses(list(rms))
    scale = np.array([rms[name] for name, _ in hypotheses])
    signatures = np.nan_to_num(model.signatures(paths, hypotheses, launches))
    return hypotheses, scale, scale[:, None, None, None] * signatures


def chained(estimate: Sequence[Cause]) -> Array:
    """By which signatures about a model with these errors are slopes in their amounts, [error]."""
    return np.array([find(cause.effect).chain(cause.amount) for cause in estimate])


def small_errors(
    ring: Ring,
    plain: FirstTurns,
    known: Sequence[Cause],
    rms: Mapping[str, float],
    launches: Array,
    causes: Sequence[Cause] = (),
    estimate: Sequence[Cause] = (),
    *,
    learn: bool = False,
    noisy: bool = False,
    weigh: bool = False,
) -> SmallErrors:
    """The background of a machine as these data show it.

    Args:
        ring: the design.
        plain: all shots, those of a reference too (it is the same machine), without small errors.
        known: causes that are there anyway.
        rms: by effect.
        launches: first guess, [shot, 5].
        causes: what was found already: small errors act along the orbit that it makes.
        estimate: the likeliest small errors beside it.
        learn: the sizes are learnt from the data; `rms` is where that starts.
        noisy: so is the noise, which is a guess.
        weigh: whether the one cause is a small error itself is weighed too.

    Raises:
        BeamLostError: the beam does not come round in what is taken for the machine.
    """
    fixed, data = tuple(causes), plain.data
    evidence, errors, opened, apart = None, dict[str, float](), plain.open, None
    for _ in range(1 if estimate else ROUNDS):
        model = Model(ring, data.settings, data.turns, [*known, *estimate], active=data.active)
        alone = fit(replace(plain, model=model, fixed=fixed), (), launches)
        _on_its_way(alone)
        paths = alone.point.view
        hypotheses, scale, spread = background_signatures(model, paths, alone.nuisances, rms)
        estimate = estimate or [Cause(*h, 0.0) for h in hypotheses]
        spread = chained(estimate)[:, None, None, None] * spread
        amounts = np.array([cause.amount for cause in estimate])
        shifted = _moved(data, amounts / scale, spread)
        if learn:
            found, names = _sizes(shifted, spread, alone, hypotheses, noisy)
            if evidence is None:
                evidence = found.log_evidence
            if weigh:
                both = _as_one_of_them(fixed[0], data, hypotheses, amounts, scale, spread)
                other, _ = _sizes(*both, alone, hypotheses, noisy)
                apart = found.log_marginal - other.log_marginal
            errors = dict(zip(names, found.error.tolist(), strict=True))
            factor = dict(zip(names, found.scale, strict=True))
            each = np.array([factor[name] for name, _ in hypotheses])
            rms = {name: float(size * factor.get(name, 1.0)) for name, size in rms.items()}
            scale, spread = each * scale, each[:, None, None, None] * spread
            if noisy:
                data, shifted = (
                    replace(some, sigma=some.sigma * found.noise) for some in (data, shifted)
                )
            opened = (np.array([names.index(name) for name, _ in hypotheses]), found.covariance)
        problem = replace(
            plain, model=model, data=shifted, fixed=fixed, spread=spread, white=None, open=opened
        )
        explained = fit(problem, (), alone.nuisances)
        _on_its_way(explained)
        launches = explained.nuisances
        problem = replace(problem, fixed=())
        small = SmallErrors(
            problem, explained, replace(plain, data=data, white=None, open=opened),
            tuple(hypotheses), scale, tuple(estimate), rms, errors, evidence, apart,
        )  # fmt: skip
        estimate = small.estimate(explained, problem.whitening)
    if fixed:
        small = replace(small, before=fit(problem, (), launches))
        _on_its_way(small.before)
    return small


def damped(
    ring: Ring,
    small: SmallErrors,
    known: Sequence[Cause],
    likeliest: Sequence[Cause],
    causes: Sequence[Cause],
    launches: Array,
    dropped: Flags,
) -> tuple[list[Cause], Fit]:
    """As much of the way to the likeliest small errors as makes them likelier: Gauss and Newton.

    They are worked out linearly about those in the model, which large ones mislead.

    Args:
        ring: the design.
        small: the background about those in its model.
        known: causes that are there anyway.
        likeliest: small errors by that background.
        causes: what was found; amounts and launches follow.
        launches: first guess.
        dropped: readings that were left out.

    Returns:
        The small errors, and the fit beside them; those in the model where no step helps.
    """
    plain = small.plain.without(dropped)
    data = plain.data

    def tried(share: float) -> tuple[list[Cause], Fit, float]:
        errors = [
            replace(goal, amount=start.amount + share * (goal.amount - start.amount))
            for start, goal in zip(small.about, likeliest, strict=True)
        ]
        model = small.problem.model
        if share:
            model = Model(ring, data.settings, data.turns, [*known, *errors], active=data.active)
        found = fit(replace(plain, model=model), causes, launches)
        prior = sum((error.amount / small.sizes[error.effect]) ** 2 for error in errors)
        return errors, found, found.chi2 + prior

    now, fitted, cost = tried(0.0)
    for share in SHARES:
        errors, found, better = tried(share)
        if better < cost:
            return errors, found
    return now, fitted


def _on_its_way(result: Fit) -> None:
    if result.point.lost:
        raise BeamLostError(f"{result.point.lost} among the small errors that the data ask for")


def _as_one_of_them(
    cause: Cause,
    data: Data,
    hypotheses: Sequence[Hypothesis],
    amounts: Array,
    scale: Array,
    spread: Array,
) -> tuple[Data, Array]:
    """The readings and signatures that small errors have to make where the cause is one of them."""
    own = list(hypotheses).index((cause.effect, cause.element))
    spread = spread.copy()
    spread[own] *= find(cause.effect).chain(cause.amount)
    amounts = amounts.copy()
    amounts[own] += cause.amount
    return _moved(data, amounts / scale, spread), spread


def _moved(data: Data, shares: Array, spread: Array) -> Data:
    """The readings with what these shares of the errors' rms make of them, linearly."""
    moved = np.einsum("e,esrp->srp", shares, spread, optimize=True)
    return replace(data, readings=data.readings + np.where(data.valid, moved, 0.0))


def _sizes(
    data: Data, spread: Array, alone: Fit, hypotheses: Sequence[Hypothesis], noisy: bool
) -> tuple[Sizes, list[str]]:
    """Sizes from as many shots as it takes, and the effects that they are of, in their order.

    A fault is no small error: shots of a reference come first.
    """
    per_shot = data.valid[0].size
    shots = np.argsort(data.active, kind="stable")[: max(ROWS // per_shot, 1)]
    some = data.of_shots(shots)
    keep = np.zeros(some.valid.shape, dtype=bool)  # of many turns not all
    keep[:, :: -(-len(shots) * per_shot // ROWS)] = True
    some = some.without(~keep)
    plain = Whitening(some)
    paths = alone.point.view
    left = np.where(some.valid, some.readings - paths.readings[shots], 0.0)
    rows = plain.residual(left, alone.nuisances[shots])
    launch = np.linalg.qr(block_diag(*plain.launch(paths.launch[shots])))[0]
    signatures = plain.signature(spread[:, shots])
    there = (plain.signature(some.valid.astype(float)) > 0) | launch.any(axis=1)
    names = list(dict.fromkeys(name for name, _ in hypotheses))
    belongs = np.array([names.index(name) for name, _ in hypotheses])
    planes = np.zeros((2, *some.valid.shape))
    planes[0, ..., 0], planes[1, ..., 1] = 1.0, 1.0
    noise = [(plain.signature(plane) > 0)[there] for plane in planes] if noisy else []
    families = [signatures[belongs == k][:, there] for k in range(len(names))]
    return learn_sizes(rows[there], launch[there], families, noise), names
