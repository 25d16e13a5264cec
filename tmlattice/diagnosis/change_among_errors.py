"""What changed between two orbit responses of one machine, among the small errors that both have.

The first measurement leaves the small errors of ring, monitors and correctors known with a
covariance, and from there the second one is searched: what the first does not know of the optics is
in every amount's error and in every comparison of hypotheses. Where small errors of the usual kinds
and a few changes do not explain both to their noise, this says nothing: the model lacks something
that the difference of the two is free of, or monitors and correctors drift.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.diagnosis.few import MOST, Few, few_told, used
from tmlattice.diagnosis.joint import among_errors
from tmlattice.diagnosis.state import State, begin
from tmlattice.diagnosis.strategy import POOR
from tmlattice.effects import CATALOGUE, Cause, background_rms, find, modelled, rare
from tmlattice.effects.effect import FamilyEffect
from tmlattice.errors import UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.among import Known, Learnt, small_errors_of
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.levels import CLEAR
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.search import Search
from tmlattice.lattice import Ring
from tmlattice.observe.orbit_response import Errors, Predicted, ResponseData, Split, response_data
from tmlattice.observe.response_change import response_change
from tmlattice.observe.response_problem import Response, single_causes

ROWS = 6000
"""Readings of one measurement that small errors are learnt from at most: the time goes as their
cube, and is half a minute here."""
NEARLY = 3.0
"""Times the noise that the families' fit to the first measurement typically leaves, above which it
is not asked whether small errors explain that: they are the families' and some more."""
OWN = 0.8
"""Share of a column's, or a monitor's, change that its own scale makes where that drifts."""
SURE = 1 - 1e-8
"""Share of a direction of small errors that the first measurement may know: what is linear about
the likeliest errors is in both measurements alike, and takes nothing from their difference."""


def change_among_errors(
    before: ResponseData,
    after: ResponseData,
    fitted: State,
    split: Split,
    effects: Sequence[str] | None,
    most: int,
    judgement: Judgement,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda stage: None,
) -> tuple[Ring, Few, ResponseData] | None:
    """The few changes from one response to the other, or None where they do not explain it.

    Args:
        before, after: with the same correctors and monitors.
        fitted: families of errors fitted to the first one.
        split: held-out correctors give half of their monitors to the search.
        effects: names of those that may have changed; None: all usual ones, and families.
        most: findings at most.
        judgement: thresholds.
        seed: of the threshold's simulation.
        progress: told what is being done.

    Returns:
        The ring with the small errors of the first measurement, what is told of the second one, and
        the difference on top of the first.
    """
    if before.orbits.size > ROWS or _typical(fitted) > NEARLY or _drift(before, after):
        return None
    progress("small errors of the reference")
    learnt = _learnt(before, judgement)
    if learnt is None:
        return None
    known = learnt.problem.learnt(learnt.before, SURE)
    ring = before.ring
    hypotheses = changes(after, effects)
    if not hypotheses:
        return None
    places = {name: sum(h[0] == name for h in hypotheses) for name, _ in hypotheses}
    problem = replace(
        _problem(after, judgement), used=used(after, split), places=places,
        rare=rare(ring, list(places)),
    )  # fmt: skip
    search = Search(
        problem, hypotheses, min(most, MOST), unnamed=False, seed=seed, progress=progress
    )
    start = fit(problem, (), problem.first)
    found, _ = among_errors(search, start, known, learn=False)
    count = len(found.fit.residual)
    if not _noise(found.fit, count - len(found.fit.causes)):
        return None
    there, change = response_change(before, _errors(before, known), after)
    data = response_data(there, change)
    base = begin(data, split).at.bend()
    return there, few_told(data, split, found, base, count, judgement), data


def changes(data: ResponseData, effects: Sequence[str] | None) -> list[tuple[str, str | None]]:
    """What may have changed: single causes, and the supplies of families."""
    families = [name for name, effect in CATALOGUE.items() if isinstance(effect, FamilyEffect)]
    usual = list(dict.fromkeys([*modelled(), *families]))
    return single_causes(data, usual if effects is None else effects)


def _problem(data: ResponseData, judgement: Judgement) -> Response:
    base = Predicted(data, Errors.none(data)).bend()
    return Response(base=base, used=np.isfinite(data.orbits), places={}, judgement=judgement)


def _usual(problem: Response, ring: Ring) -> Known:
    """Every small error that machines have, of its usual size."""
    usual = background_rms({"all": None})
    everywhere = [
        (name, place) for name in usual for place in find(name).places(ring)
        if problem.sees((name, place))
    ]  # fmt: skip
    return Known.usual(everywhere, usual)


def _learnt(data: ResponseData, judgement: Judgement) -> Learnt | None:
    """Small errors as the first measurement shows them; None: they are not all that is wrong."""
    problem = _problem(data, judgement)
    try:
        learnt = small_errors_of(problem, _usual(problem, data.ring), problem.first)
    except (UnstableRingError, np.linalg.LinAlgError):  # too large to be small errors
        return None
    return learnt if _noise(learnt.before, len(learnt.before.residual)) else None


def _drift(before: ResponseData, after: ResponseData) -> bool:
    """Whether more correctors, or monitors, changed their scale than there are few causes."""
    scale = (before.kicks / after.kicks)[:, None, None]
    change = np.nan_to_num((after.orbits * scale - before.orbits) / before.noise)
    own = np.nan_to_num(before.orbits / before.noise)
    for axes in ((1, 2), (0, 2)):
        whole = (change**2).sum(axis=axes) / 2
        size = np.maximum((own**2).sum(axis=axes), 1e-300)
        taken = (change * own).sum(axis=axes) ** 2 / size / 2
        if ((taken > CLEAR) & (taken > OWN * whole)).sum() > MOST:
            return True
    return False


def _typical(fitted: State) -> float:
    """What half of the readings leave at most, in units of the noise (1 for noise alone)."""
    left = fitted.data.pick(fitted.at.left) / fitted.data.noise_of(0)
    return float(np.nanmedian(np.abs(left[:, fitted.good]))) / 0.6745


def _noise(fit: Fit, freedom: int) -> bool:
    """Whether what is left may be noise."""
    return bool(fit.good and chi2.sf(fit.chi2, freedom) > POOR)


def _errors(data: ResponseData, known: Known) -> Errors:
    own = zip(known.hypotheses, known.amounts.tolist(), strict=True)
    return Errors.none(data).with_causes(data, [Cause(*h, amount) for h, amount in own if amount])
