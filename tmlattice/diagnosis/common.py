"""What is wrong with a machine before its fault: large causes that a reference shows by itself.

With a reference a cause is sought that is in the measurement and not in the reference. What is in
both and large is no small error: it has to be in the model, or its every change from launch to
launch passes for a fault. So the reference is diagnosed by itself first. What it shows too weakly
for that is found in the measurement; it is in both where the reference is the likelier for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.diagnosis.prepare import Prepared, prepare
from tmlattice.diagnosis.strategy import Found, sought
from tmlattice.effects import Cause, LaunchEffect, find
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import fit
from tmlattice.inference.search import Explanation, Search
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.observe.first_turns import turns_of
from tmlattice.observe.noise import scatter

Array = NDArray[np.float64]

MOST = 8
"""Causes of a reference at most."""
ROUNDS = 3
"""How often something that is found in the measurement may turn out to be in both."""


def sought_in(
    ring: Ring,
    measurement: Measurement,
    reference: Measurement | None,
    radiation: bool,
    effects: Sequence[str] | None,
    background: Mapping[str, float] | None,
    judgement: Judgement,
    search_of: Callable[[Prepared], Search],
) -> tuple[Prepared, Found]:
    """What explains a measurement, beside its reference where there is one.

    Args:
        ring: the design.
        measurement: of the machine.
        reference: of the same machine before its fault, or None.
        radiation: the model radiates.
        effects: names of those that may be the cause; None: all usual ones.
        background: rms of small errors by effect; None: the data say.
        judgement: thresholds.
        search_of: the search in a measurement that is ready.

    Raises:
        Those of `prepare`.
    """
    common: tuple[Cause, ...] = ()
    before: Found | None = None
    estimated = False
    if reference is not None:
        both = prepare(ring, measurement, reference, radiation, effects, judgement)
        progress = search_of(both).progress
        if both.estimated:  # once, from both: of the same electronics
            noise = scatter(both.problem.data, both.before.point.view)
            if estimated := bool(np.isfinite(noise).all()):
                measurement, reference = (_with(own, noise) for own in (measurement, reference))
        progress("reference")
        alone = prepare(ring, reference, None, radiation, None, judgement)
        first = Search(alone.problem, alone.hypotheses, MOST, progress=progress)
        before = sought(ring, alone, first, background)
        common = _named(before.explanation.fit.causes)
    for _ in range(ROUNDS):
        ready = prepare(ring, measurement, reference, radiation, effects, judgement, common)
        found = sought(ring, ready, search_of(ready), background, before)
        more = _named(_in_both(found.explanation))
        if not more:
            break
        common = (*common, *more)
    return replace(ready, estimated=ready.estimated or estimated), found


def _with(measured: Measurement, noise: Array) -> Measurement:
    """The measurement with this noise, m, [2], where it states none."""
    stated = np.full((len(measured.monitors), 2), np.nan)
    stated = stated if measured.noise is None else np.asarray(measured.noise)
    return replace(measured, noise=np.where(np.isfinite(stated), stated, noise))


def _named(causes: tuple[Cause, ...]) -> tuple[Cause, ...]:
    """Without the launches' own, which are fitted in each measurement anyway."""
    return tuple(c for c in causes if not isinstance(find(c.effect), LaunchEffect))


def _in_both(explanation: Explanation) -> tuple[Cause, ...]:
    """Of what was found in the measurement, what the reference rather has than lacks."""
    problem, result = turns_of(explanation), explanation.fit
    if problem.data.active.all():
        return ()
    model, data = problem.model, problem.data
    shared = []
    for i, cause in enumerate(result.causes):
        known = [*model.assembly.known, cause]
        everywhere = Model(model.design, data.settings, data.turns, known, active=data.active)
        others = (*result.causes[:i], *result.causes[i + 1 :])
        there = fit(replace(problem, model=everywhere), others, result.nuisances)
        if there.good and there.chi2 < result.chi2:
            shared.append(cause)
    return tuple(shared)
