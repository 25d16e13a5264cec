"""The diagnosis of what a stored beam shows, and of several measurements of one machine together.

>>> diagnose_together(ring, {"kick": turns, "orbit": orbit, "injection": first_turns})

Rows are stacked; causes are shared, nuisances are each measurement's own. Few causes are tried
first; where they leave more than noise, small errors are there too, their sizes are learnt, and the
cause is sought among them. A reference of each kind holds what was there before.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.assessment import Block, combined_p_value, compared_of
from tmlattice.diagnosis.correlations import correlations_of
from tmlattice.diagnosis.findings import (
    findings_of,
    finished,
    sensitivity,
    verdict_of,
    with_consequences,
)
from tmlattice.diagnosis.kinds import How, Measured, Part, kind_of, part_of, stacked
from tmlattice.diagnosis.left_out import spikes, with_silent
from tmlattice.diagnosis.next_kind import next_kind
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.diagnosis.stages import (
    held_out,
    misfit_of,
    pairs_of,
    seen_by,
    stages_of,
    too_large,
    views_of,
)
from tmlattice.diagnosis.strategy import (
    CLEAR,
    DOUBT,
    FEW,
    explained,
    freedom,
    outlier,
    strongest,
)
from tmlattice.diagnosis.suspects import suspects
from tmlattice.diagnosis.views import JointView
from tmlattice.effects import (
    Cause,
    Effect,
    LaunchEffect,
    apply,
    background_rms,
    find,
    modelled,
    rare,
)
from tmlattice.errors import EffectError, MeasurementError, UnstableRingError
from tmlattice.inference.among import MOST, Known, Learnt, small_errors_of
from tmlattice.inference.judgement import DEFAULT, Judgement
from tmlattice.inference.newton import Outcome, fit
from tmlattice.inference.problem import Hypothesis
from tmlattice.inference.search import Explanation, Search, explain
from tmlattice.inference.together import Together
from tmlattice.lattice import Ring
from tmlattice.optics import ring_tunes
from tmlattice.version import __version__

Array = NDArray[np.float64]

MOST_OF_IT = 0.5
"""Share of the gap that one cause has to make to be put aside before sizes are learnt."""

CROWDED = 1.5
"""What half of the monitors leave at least of their noise where a few causes with names were tried,
from which on nothing without a name is: errors are everywhere."""


def diagnose_together(
    ring: Ring,
    measured: Mapping[str, Measured],
    *,
    reference: Mapping[str, Measured] | None = None,
    background: Mapping[str, float | None] | None = None,
    known: Known | None = None,
    holdout: float = 0.33,
    effects: Sequence[str] | None = None,
    max_effects: int = 8,
    false_alarm: float = DEFAULT.false_alarm,
    assume: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Where the gap between a ring and its measurements lies, what causes it, how far it shrinks.

    Args:
        ring: the design.
        measured: by the names that the result calls them.
        reference: of the same machine before the fault, of any kinds: static errors cancel.
        background: small errors, as of `diagnose`.
        known: of the small errors beforehand, from an earlier diagnosis whose ring as found this
            is: see `twin`. Then no background is asked for.
        holdout: share of shots, or of correctors, that judge.
        effects: names of those that may be the cause; else all usual ones.
        max_effects: findings at most.
        false_alarm: share of faultless data sets in which something may be found.
        assume: what was written down wrongly everywhere, see `measurement.assume`.
        seed: of the split and of the threshold's simulation.
        progress: told what is being done.

    Raises:
        MeasurementError: data that cannot be used; the sentence says which.
        EffectError: none of the effects can be looked for.
        UnknownNameError: a monitor or an effect that does not exist.
        UnstableRingError: the design has no stored beam.
    """
    begun = time.perf_counter()
    judgement = Judgement(false_alarm=false_alarm)
    turns = any(kind_of(one) == "turn_by_turn" for one in measured.values())
    chosen = _chosen(ring, effects, turns)
    places = {name: float(max(len(find(name).places(ring)), 1)) for name in chosen}
    how = How(ring, places, judgement, holdout, assume, seed)
    progress("data")
    parts = [with_silent(ring, _named(label, one, how), one) for label, one in measured.items()]
    plain = replace(how, holdout=0.0)
    before = [_named(label, one, plain) for label, one in (reference or {}).items()]
    problem = replace(
        stacked(parts, before, how), rare=rare(ring, chosen),
        fixed=() if known is None else known.causes,
    )  # fmt: skip
    hypotheses = [
        (name, place) for name in chosen for place in find(name).places(ring)
        if any(part.problem.sees((name, place)) for part in parts)
    ]  # fmt: skip
    search = Search(
        problem, hypotheses, max_effects, seed=seed, progress=progress,
        unnamed=all(part.kind != "orbit_response" for part in parts),
    )  # fmt: skip
    rms = None if background is None else background_rms(background)
    everywhere = [
        (name, place) for name in (rms or background_rms({"all": None}))
        for place in find(name).places(ring)
    ]  # fmt: skip
    found, small = _sought(search, everywhere, rms, known)
    progress("report")
    return _told(
        ring, parts, problem, found, small, how,
        {
            "seconds": time.perf_counter() - begun, "seed": seed,
            "options": {
                "reference": reference is not None,
                "background": None if background is None else dict(background),
                "holdout": holdout, "effects": None if effects is None else list(effects),
                "max_effects": max_effects, "false_alarm": false_alarm, "radiation": False,
                **({"assume": list(assume)} if assume else {}),
            },
        },
    )  # fmt: skip


def _named(label: str, measured: Measured, how: How) -> Part:
    try:
        return part_of(label, measured, how)
    except MeasurementError as error:
        raise MeasurementError(f"{label}: {error}") from error


def _chosen(ring: Ring, effects: Sequence[str] | None, turns: bool) -> list[str]:
    chosen = [name for name in modelled(effects, turns) if find(name).places(ring)]
    chosen = [name for name in chosen if not _of_launches(find(name))]
    if not chosen:
        raise EffectError("none of these effects can be looked for here; name another one")
    return chosen


def _of_launches(effect: Effect) -> bool:
    """Whether it is the launches' alone; what shifts all of them is not the stored beam's, nor seen
    where each shot has a launch of its own."""
    return isinstance(effect, LaunchEffect) and (effect.shifts is not None or not effect.responds)


# --- the search ----
def _sought(
    search: Search,
    everywhere: Sequence[Hypothesis],
    told: Mapping[str, float] | None,
    known: Known | None,
) -> tuple[Explanation, Learnt | None]:
    """Few causes alone, or a few among small errors everywhere: what the data speak for."""
    problem = search.problem
    seen = [h for h in everywhere if problem.sees(h)]
    search.progress("scan")
    start = fit(problem, (), problem.first)
    if start.point.lost:
        raise MeasurementError(f"{start.point.lost} in the design: is it this machine's lattice?")
    few = None
    learn = told is None and known is None
    if not told and known is None:
        narrow = replace(search, most=min(FEW, search.most))
        few = explain(replace(narrow, unnamed=False), start)
        if search.unnamed and not explained(few) and not _crowded(few):
            few = explain(narrow, start)
        if told is not None or explained(few) or len(start.residual) * len(seen) > MOST:
            if few.full and not explained(few) and search.most > FEW:
                few = explain(search, start)
            return few, None
    search.progress("small errors")
    usual = background_rms({"all": None}) if told is None else told
    start_from = Known.usual(seen, usual) if known is None else known

    def learnt(causes: Sequence[Cause], nuisances: Array) -> Learnt:
        return small_errors_of(problem, start_from, nuisances, causes, learn=learn)

    # two findings say already whether the sizes have to be learnt again beside them
    narrow = replace(search, unnamed=False, most=min(2, search.most))
    tried: list[tuple[Explanation, Learnt]] = []
    for aside in dict.fromkeys(((), _outstanding(few))):
        try:
            small = learnt(aside, start.nuisances)
        except UnstableRingError:  # a fault among them makes them too large
            continue
        found = explain(replace(narrow, problem=small.problem), small.before)
        tried.append((found, small))
    if not tried:  # the readings are none of small errors
        return (few if few is not None else explain(search, start)), None
    found, small = max(tried, key=lambda one: _density(*one))
    if learn and small.log_evidence < CLEAR:
        assert few is not None
        return (explain(search, start) if few.full else few), None
    for _ in range(problem.judgement.retaken):
        if not found.named:
            hidden = _hidden(narrow, found, small, learnt, learn)
            if hidden is None:
                break
            found, small, narrow = hidden
            continue
        try:
            about = learnt((*found.fit.causes, *_doubted(found)), found.fit.nuisances)
        except UnstableRingError:  # a cause that is no cause
            break
        again = explain(replace(narrow, problem=about.problem), about.before)
        same = again.names == found.names
        small, found = about, again
        if same:
            break
    if found.full and search.most > narrow.most:
        whole = replace(narrow, most=search.most, problem=small.problem)
        found = explain(whole, small.before)
    return found, small


def _hidden(
    search: Search,
    found: Explanation,
    small: Learnt,
    learnt: Callable[[Sequence[Cause], Array], Learnt],
    learn: bool,
) -> tuple[Explanation, Learnt, Search] | None:
    """A fault among small errors that hides it: with sizes learnt beside it the readings are
    likelier than without. One that outweighs its family needs no statistic of its own; it made the
    family as large as itself."""
    amounts = small.problem.estimate(found.fit.clean).tolist()
    errors = zip(small.problem.known.hypotheses, amounts, strict=True)
    estimate = [Cause(*h, a) for h, a in errors]
    far = outlier(estimate, small.sizes) if learn else None
    for beside in dict.fromkeys(((far,) if far is not None else (), _doubted(found))):
        if not beside:
            continue
        try:
            about = learnt(beside, found.fit.nuisances)
        except UnstableRingError:  # a cause that is no cause
            continue
        granted = frozenset((c.effect, c.element) for c in beside if c is far)
        own = replace(search, granted=granted)
        again = explain(replace(own, problem=about.problem), about.before)
        if again.named and _density(again, about) > _density(found, small):
            return again, about, own
    return None


def _density(found: Explanation, small: Learnt) -> float:
    """Log density of the readings by an explanation among small errors."""
    return small.problem.log_scale + found.fit.log_evidence


def _outstanding(few: Explanation | None) -> tuple[Cause, ...]:
    """A cause that alone makes most of the gap: it would make all small errors too large."""
    if few is None or not few.named:
        return ()
    clear = max(named.detection.statistic for named in few.named)
    gap = few.before.chi2 - few.problem.freedom
    return (strongest(few),) if clear > MOST_OF_IT * gap else ()


def _crowded(found: Explanation) -> bool:
    """Whether most monitors still read something else."""
    problem = found.problem
    left, _ = problem.left(found.fit.point)
    owner = problem.owner()[problem.valid]
    own, squares = owner[owner >= 0], left[problem.valid][owner >= 0] ** 2
    if not len(own):
        return False
    count = np.bincount(own, minlength=len(problem.monitors))
    mean = np.bincount(own, squares, len(problem.monitors)) / np.maximum(count, 1)
    return float(np.median(np.sqrt(mean[count > 0]))) > CROWDED


def _doubted(found: Explanation) -> tuple[Cause, ...]:
    """The likeliest cause that was not taken: sizes that were learnt with a fault among them are
    too large, and it passes for a small error; it has to be weighed with sizes learnt without."""
    top = int(np.argmax(found.scan.statistic)) if len(found.scan.statistic) else -1
    if top < 0 or found.scan.statistic[top] < DOUBT:
        return ()
    name, place = found.scan.hypotheses[top]
    if find(name).discrete:
        return ()
    amount, effect = found.scan.amount[top], find(name)
    root = min(abs(amount) ** (1 / effect.power), effect.largest)
    return (Cause(name, place, float(np.copysign(root, amount))),)


# --- what is told ----
def _told(
    ring: Ring,
    parts: Sequence[Part],
    problem: Together,
    found: Explanation,
    small: Learnt | None,
    how: How,
    made: Mapping[str, Any],
) -> Diagnosis:
    judgement = how.judgement
    found = finished(_by_ring(ring, problem, found))
    result = found.fit
    # what counts turns late reads nothing in the first ones
    late = {c.element for c in result.causes if find(c.effect).of_turns}
    dead = tuple(
        dict.fromkeys(d for p in parts for d in p.dead if ring.monitors[d[0]].name not in late)
    )
    estimated = any(part.estimated for part in parts)
    findings = findings_of(ring, found, dead, judgement)
    fitted = Block("fitted readings", result.chi2, freedom(found.problem, result))
    verdict, findings, said = verdict_of(found, findings, fitted.p_value, estimated, judgement)
    if verdict == "nothing" and small is not None and small.errors and all(problem.active):
        verdict = "distributed"  # the gap has a cause: many small ones; a reference has them too
    elif verdict != "distributed" and result.outcome is not Outcome.CONVERGED:
        said = (*said, f"the amounts are not settled: {result.outcome.value}")
    causes = () if verdict == "distributed" else result.causes
    if result.causes and not causes:  # nothing is explained: what is left is what was there
        fitted = Block(fitted.name, found.before.chi2, freedom(found.problem, found.before))
    kept = problem.without(found.dropped)
    stages = stages_of(kept, found, small, causes)
    views = views_of(parts, kept, stages)
    aside = {ring.monitors[m].name for m in found.monitors}
    since = 0 if small is None else max(len(stages) - 2, 0)
    heldout = held_out(parts, problem.fixed, stages, aside, since)
    # what small errors leave undetermined is not in the errors of held-out readings
    compared = compared_of(fitted, heldout if small is None else None)
    told = (f"{part.label}: {one}" for part in parts for one in part.said)
    warnings = [*told, *spikes(parts, problem, found), *said, *too_large(stages)]
    repaired = apply(ring, causes)
    errors = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))[: len(causes)]
    return Diagnosis(
        verdict=verdict,
        findings=tuple(
            replace(one, seen_by=seen_by(parts, kept, stages[-1].point, one))
            for one in with_consequences(ring, findings, causes)
        ),
        fit_before=misfit_of(pairs_of(parts, kept, stages[0])),
        fit_after=misfit_of(pairs_of(parts, kept, stages[-1])),
        heldout=heldout,
        heldout_shots=(),
        compared=compared,
        correlations=correlations_of(
            [(cause.effect, cause.element) for cause in causes],
            found.fit.covariance[: len(causes), : len(causes)],
        ),
        unexplained={"p_value": combined_p_value(compared), "places": []},
        tunes={"before": ring_tunes(ring), "after": ring_tunes(repaired)},
        next=next_kind(ring, found, [part.kind for part in parts], how, problem.fixed),
        sensitivity=sensitivity(found.first, judgement),
        warnings=tuple(dict.fromkeys(warnings)),
        suspects=suspects(ring, found, judgement) if verdict == "distributed" else (),
        noise=_noise(parts),
        noise_estimated=estimated,
        provenance={"package": __version__, "lattice": ring.name, "measurement": None, **made},
        ring=ring,
        repaired=repaired,
        causes=causes,
        errors=tuple(errors.tolist()),
        priors={} if small is None else dict(small.sizes),
        prior_errors={} if small is None else dict(small.errors),
        view=JointView(found, views),
    )


def _by_ring(ring: Ring, problem: Together, found: Explanation) -> Explanation:
    """Monitors that were set aside, by their place in the ring."""
    at = {monitor.name: i for i, monitor in enumerate(ring.monitors)}
    aside = {at[ring[problem.monitors[m]].name]: seen for m, seen in found.monitors.items()}
    return replace(found, monitors=aside)


def _noise(parts: Sequence[Part]) -> tuple[float, float]:
    """rms noise of a reading, m, of the first measurement that has monitors."""
    for part in parts:
        own = part.problem.valid & (part.problem.owner() >= 0)
        if own.any():
            rows = part.problem.as_rows(own.astype(float))
            rms = float(np.sqrt(np.mean(rows[rows > 0] ** -2.0)))
            return rms, rms
    return float("nan"), float("nan")
