"""The diagnosis of first turns, of what a stored beam shows, and of several measurements together.

>>> diagnose(ring, {"kick": turns, "orbit": orbit, "injection": first_turns})

Rows are stacked; causes are shared, nuisances are each measurement's own (see `selection`
for the steps). A reference of each kind has the earlier errors.
"""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.diagnosis.assessment import Block, combined_p_value, compared_of
from tmlattice.diagnosis.findings import (
    findings_of,
    finished,
    sensitivity,
    unexplained,
    verdict_of,
    with_consequences,
)
from tmlattice.diagnosis.kinds import KINDS, kind_of, part_of, stacked
from tmlattice.diagnosis.next_measurement import leading, next_kind, next_measurement
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.prepare import Part, noise_of
from tmlattice.diagnosis.result import MOST, Diagnosis, Finding, NextMeasurement
from tmlattice.diagnosis.selection import freedom, select, select_changes
from tmlattice.diagnosis.stages import (
    Stage,
    held_out,
    misfit_of,
    seen_by,
    stages_of,
    views_of,
)
from tmlattice.diagnosis.support import correlations_of
from tmlattice.diagnosis.suspects import suspects
from tmlattice.diagnosis.views import TrajectoryView
from tmlattice.effects import (
    Cause,
    Effect,
    Hypothesis,
    LaunchEffect,
    apply,
    background_rms,
    find,
    is_energy,
    modelled,
    rare,
)
from tmlattice.errors import EffectError, MeasurementError, TmlatticeError
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.distributed import FittedErrors
from tmlattice.inference.newton import Outcome
from tmlattice.inference.scan import NO_SCAN
from tmlattice.inference.search import Explanation, Search
from tmlattice.inference.validation import Misfit
from tmlattice.lattice import Ring
from tmlattice.measurement import AnyMeasurement
from tmlattice.observe.calibration import offset_of
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.optics import ring_tunes
from tmlattice.speaks import listed, micrometres

log = logging.getLogger(__name__)


def diagnose_together(measured: Mapping[str, AnyMeasurement], given: Options) -> Diagnosis:
    """Locate the gap between a ring and its measurements, identify its causes, and validate them.

    Args:
        measured: by the names that the result calls them.
        given: with a reference by the names that the result calls it.

    Raises:
        MeasurementError: data that cannot be used; the message names them.
        EffectError: none of the effects can be looked for.
        UnknownNameError: a monitor or an effect that does not exist.
        UnstableRingError: the design has no stored beam.
    """
    ring, effects, known, reference = given.ring, given.effects, given.known, given.reference
    given.progress("data")
    kinds = [kind_of(one) for one in measured.values()]
    if kinds == ["trajectory"] and known is None:  # with launches of its own, all can be shared
        (label, one), *_ = measured.items()
        first = next(iter((reference or {}).values()), None)
        options = replace(given, reference=first)
        parts = [part_of(label, one, options)]
        before = [one.reference for one in parts if one.reference is not None]
        hypotheses = list(parts[0].hypotheses or ())
        chosen, of_reference = list(parts[0].problem.places), modelled()
        options = replace(options, places=parts[0].problem.places)
    else:
        chosen, of_reference = (_chosen(ring, own, kinds) for own in (effects, None))
        places = {name: float(max(len(find(name).places(ring)), 1)) for name in chosen}
        options = replace(given, places=places, reference=None, effects=None)
        parts = [
            with_silent(ring, _named(label, one, options), one) for label, one in measured.items()
        ]
        plain = replace(options, holdout=0.0)
        before = [_named(label, one, plain) for label, one in (reference or {}).items()]
        hypotheses = _seen(ring, chosen, parts)
    problem = replace(
        stacked(parts, before, options), rare=rare(ring, chosen),
        fixed=() if known is None else known.causes,
    )  # fmt: skip
    search = Search(
        problem, hypotheses, given.max_effects, seed=given.seed, progress=given.progress,
        unnamed=all(part.kind != "orbit_response" for part in parts),
    )  # fmt: skip
    usual = background_rms("all")
    background = given.background
    if isinstance(background, str):
        background = {background: None}
    sizes = usual if background is None else background_rms(background)
    everywhere = [(name, place) for name in sizes for place in find(name).places(ring)]
    learn = background is None
    noisy = any(part.estimated for part in parts)
    if problem.alone:
        selected = select(search, everywhere, sizes, learn=learn, noisy=noisy, known=known)
    else:
        first = problem.reference
        earlier = replace(search, problem=first, hypotheses=_seen(ring, of_reference, parts))
        selected = select_changes(search, earlier, everywhere, sizes, learn=learn, noisy=noisy)
        problem = problem.with_fixed(selected.common)
    small = selected.distributed
    if noisy and problem.alone and small is not None:  # with the noise that was learnt
        assert isinstance(small.plain, CombinedProblem)
        problem = small.plain
        own = zip(parts, problem.parts, strict=True)
        parts = [replace(part, problem=learnt) for part, learnt in own]
    given.progress("report")
    made = given.provenance(background=None if background is None else dict(background))
    return _report(parts, problem, selected.explanation, small, options, made)


def _named(label: str, measured: AnyMeasurement, options: Options) -> Part:
    try:
        return part_of(label, measured, options)
    except MeasurementError as error:
        raise MeasurementError(f"{label}: {error}") from error


def _seen(ring: Ring, effects: Sequence[str], parts: Sequence[Part]) -> list[Hypothesis]:
    """Every effect at every place where any measurement is sensitive to it."""
    return [
        (name, place) for name in effects for place in find(name).places(ring)
        if any(part.problem.sees((name, place)) for part in parts)
    ]  # fmt: skip


def _chosen(ring: Ring, effects: Sequence[str] | None, kinds: Sequence[str]) -> list[str]:
    chosen = modelled(effects, "turn_by_turn" in kinds)
    chosen = [name for name in chosen if find(name).places(ring)]
    chosen = [name for name in chosen if not _of_launches(find(name), "trajectory" in kinds)]
    if not chosen:
        raise EffectError("none of these effects can be looked for here; name another one")
    return chosen


def _of_launches(effect: Effect, launched: bool) -> bool:
    """Whether a hypothesis is of launches; the energy of a launch and that of a stored beam are
    two, and launches have an energy of their own."""
    shared = effect.responds and not (launched and is_energy(effect.name))
    return isinstance(effect, LaunchEffect) and not shared


# --- results ----
def _report(
    parts: Sequence[Part],
    problem: CombinedProblem,
    found: Explanation,
    small: FittedErrors | None,
    options: Options,
    provenance: dict[str, Any],
    refuted: str = "",
) -> Diagnosis:
    """The diagnosis; without its causes if they are refuted, for this reason."""
    given = (parts, problem, found, small, options, provenance)
    ring, judgement = options.ring, options.judgement
    found = finished(found)
    at = {monitor.name: i for i, monitor in enumerate(ring.monitors)}  # by their place in the ring
    aside = {at[ring[problem.monitors[m]].name]: seen for m, seen in found.monitors.items()}
    found = replace(found, monitors=aside)
    result = found.fit
    problem = problem.near(result.causes)
    # what counts turns late reads nothing in the first ones
    late = {c.element for c in result.causes if find(c.effect).of_turns}
    dead = tuple(
        dict.fromkeys(d for p in parts for d in p.dead if ring.monitors[d[0]].name not in late)
    )
    estimated = any(part.estimated for part in parts)
    findings = findings_of(ring, found, dead, judgement)
    fitted = Block("fitted readings", result.chi2, freedom(found.problem, result))
    verdict, findings, messages = verdict_of(
        found, findings, fitted.p_value, estimated, judgement, refuted
    )
    if verdict == "none" and small is not None and small.errors and problem.alone:
        verdict = "distributed"  # the gap is of distributed errors; a reference has them too
    elif verdict != "distributed" and result.outcome is not Outcome.CONVERGED:
        messages = (*messages, f"the fit of the amounts did not converge: {result.outcome.value}")
    causes = () if verdict == "distributed" else result.causes
    left = found.left if causes or (found.kicks and findings) else found.first_kicks
    if result.causes and not causes:  # nothing is explained: the gap stays
        fitted = Block(fitted.name, found.before.chi2, freedom(found.problem, found.before))
    kept = problem.without(found.dropped)
    stages = stages_of(kept, found, small, causes)
    views = views_of(parts, kept, stages)
    since = 0 if small is None else max(len(stages) - 2, 0)
    turns = parts[0] if parts[0].hypotheses is not None and len(parts) == 1 else None
    # what acts on a stored beam: launches have an energy of their own
    stored = [c for c in causes if turns is None or not isinstance(find(c.effect), LaunchEffect)]
    rejected: tuple[dict[str, Any], ...] = ()
    heldout = held_out(parts, kept, found, small, stages, since)
    if turns is None:
        # errors of held-out readings do not include undetermined distributed errors
        compared = compared_of(fitted, heldout if small is None else None)
        stated = tuple(f"{part.label}: {one}" for part in parts for one in part.messages)
        notes = list(outlier_messages(parts, problem, found))
    else:
        compared = compared_of(fitted, heldout)
        stated = turns.messages
        rejected = rejected_readings(turns, problem, found)
        notes = about_rejected(rejected)
        if turns.estimated:
            both = zip(_noise(parts), "xy", strict=True)
            levels = [f"{micrometres(own)} in {plane}" for own, plane in both if np.isfinite(own)]
            notes.append(f"the noise was estimated from the data: {', '.join(levels)}")
        notes += about_launches(turns, findings)
    if causes and stages[-1].share < 1:
        return _report(*given, refuted="no beam is stored with them and the distributed errors")
    # shots alone: parts of other validation sets do not see each cause
    if causes and turns is not None and heldout is not None and heldout.refutes:
        return _report(*given, refuted="with them the gap of the held-out readings stays")
    warnings = [*stated, *notes, *messages]
    if (share := stages[-1].share) < 1:
        warnings.append(
            "no beam is stored with all of the estimated distributed errors: the residuals are for "
            f"{share:.4g} of the last step to them"
        )
    view: Explanation | TrajectoryView = found
    if turns is not None:
        own = kept.parts[0]
        assert isinstance(own, FirstTurns)
        before, after = (stages[i].point.view[0].view.readings for i in (0, -1))
        dropped = found.dropped[: own.valid.size].reshape(own.valid.shape)
        view = TrajectoryView(found, own, before, after, dropped)

    def misfit(stage: Stage) -> Misfit:  # without the reference
        return misfit_of([*zip(kept.parts[: len(parts)], stage.point.view, strict=False)])

    corrected = apply(ring, causes)
    covariance = result.covariance[: len(causes), : len(causes)]
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    kinds = [part.kind for part in parts]
    return Diagnosis(
        kind=kinds[0] if len(kinds) == 1 else "together",
        verdict=verdict,
        findings=tuple(
            replace(one, seen_by=seen_by(parts, kept, stages[-1].point, one))
            if turns is None
            else one
            for one in with_consequences(ring, findings, stored)
        ),
        fit_before=misfit(stages[0 if small is None else 1]),
        fit_after=misfit(stages[-1]),
        heldout=heldout,
        heldout_shots=() if turns is None else turns.shots[1],
        compared=compared,
        covariance=covariance,
        correlations=correlations_of([(c.effect, c.element) for c in causes], covariance),
        unexplained=unexplained(
            ring,
            NO_SCAN if small is not None and verdict == "distributed" else left,
            combined_p_value(compared),
            judgement,
        ),
        tunes={"before": ring_tunes(ring), "after": ring_tunes(corrected, offset_of(stored))},
        next=_next(found, parts, options, problem.fixed),
        sensitivity=sensitivity(found.first, judgement),
        warnings=tuple(dict.fromkeys(warnings)),
        suspects=suspects(ring, found, judgement) if verdict == "distributed" else (),
        outliers=rejected,
        noise=_noise(parts),
        noise_estimated=estimated,
        provenance=provenance,
        ring=ring,
        corrected=corrected,
        causes=causes,
        errors=tuple(errors.tolist()),
        priors={} if small is None else dict(small.sizes),
        prior_errors={} if small is None else dict(small.errors),
        view=view,
        measured=tuple(sorted({own for kind in kinds for own in KINDS[kind].quantities})),
        parts=views if turns is None else (),
    )


def _next(
    found: Explanation, parts: Sequence[Part], options: Options, fixed: tuple[Cause, ...]
) -> NextMeasurement | None:
    """The recommended next measurement: of first turns one more shot, else another kind."""
    ring, one = options.ring, parts[0].problem
    if len(parts) > 1 or not isinstance(one, FirstTurns):
        return next_kind(ring, found, [part.kind for part in parts], options, fixed)
    pair = leading(ring, found, options.judgement.mass)
    if pair is None:
        return None
    try:
        return next_measurement(ring, one.data, *pair, one.model.assembly.known, options.seed)
    except TmlatticeError:
        log.warning("no next measurement could be found", exc_info=True)
    return None


def _noise(parts: Sequence[Part]) -> tuple[float, float]:
    """rms noise of a reading, m, of the first measurement with BPMs."""
    for part in parts:
        if isinstance(part.problem, FirstTurns):
            return noise_of(part.problem.data)
        own = part.problem.valid & (part.problem.owner() >= 0)
        if own.any():
            rows = part.problem.as_rows(own.astype(float))
            rms = float(np.sqrt(np.mean(rows[rows > 0] ** -2.0)))
            return rms, rms
    return float("nan"), float("nan")


def with_silent(ring: Ring, part: Part, measured: Any) -> Part:
    """The part, with a message about BPMs of its measurement without usable readings; dead ones
    become findings."""
    problem = part.problem
    owners = problem.owner()
    heard = {
        ring[problem.monitors[m]].name for m in np.unique(owners[problem.valid & (owners >= 0)])
    }
    heard |= {ring.monitors[m].name for m, _ in part.dead}
    names = [ring[name].name for name in getattr(measured, "monitors", ())]
    silent = [name for name in names if name not in heard]
    if not silent:
        return part
    messages = f"no usable reading of {', '.join(silent)}: rejected"
    return replace(part, messages=(*part.messages, messages))


def outlier_messages(
    parts: Sequence[Part], problem: CombinedProblem, found: Explanation
) -> Iterator[str]:
    """A message for each measurement with single readings that the search rejected."""
    flat = np.array([np.ravel(reading)[-1] for reading in found.outliers], dtype=np.int64)
    for part, one in zip(parts, problem.parts, strict=False):
        owners = one.owner().ravel()
        own = flat[(flat >= 0) & (flat < owners.size)]
        flat = flat - owners.size
        count = Counter(one.monitors[owner] for owner in owners[own])
        notes = [name if many == 1 else f"{name} ({many})" for name, many in count.items()]
        if notes:
            yield f"{part.label}: outliers, rejected: {', '.join(notes)}"


# --- of first turns -------------------------------------------------------------------------------
def rejected_readings(
    part: Part, problem: CombinedProblem, found: Explanation
) -> tuple[dict[str, Any], ...]:
    """Single readings that the search rejected, {"shot", "turn", "monitor", "plane"}; the shot of a
    reference is None."""
    rows: list[dict[str, Any]] = []
    names, own = part.problem.monitors, problem.parts[0].valid
    for (flat,) in found.outliers:
        of_reference = flat >= own.size
        there, at = (problem.parts[1].valid, flat - own.size) if of_reference else (own, flat)
        shot, reading, plane = np.unravel_index(at, there.shape)
        turn, monitor = divmod(int(reading), len(names))
        rows.append({
            "shot": None if of_reference else part.shots[0][shot], "turn": turn,
            "monitor": names[monitor], "plane": "xy"[plane],
        })  # fmt: skip
    return tuple(rows)


def about_launches(part: Part, findings: Sequence[Finding]) -> list[str]:
    """Messages about what these launches leave undetermined of the findings."""
    assert isinstance(part.problem, FirstTurns)
    notes, data = [], part.problem.data
    if not data.planes.all() and any(finding.effect is None for finding in findings):
        unread, other = ("x", "y") if data.planes[1] else ("y", "x")
        notes.append(
            f"a localised error may begin upstream in {unread}, which sextupoles couple into "
            f"{other}"
        )
    if data.shots == 1 and findings:
        notes.append(
            "one trajectory gives one kick at each place: any single multipole "
            "explains it; two or more launches identify the effect"
        )
    return notes


def about_rejected(outliers: Sequence[Mapping[str, Any]]) -> list[str]:
    """A message about outliers, if there are any."""
    if not outliers:
        return []
    names = [
        f"{row['monitor']} {row['plane']}, "
        + ("the reference" if row["shot"] is None else f"shot {row['shot']}")
        + (f", turn {row['turn']}" if row["turn"] else "")
        for row in outliers
    ]
    some = listed(names, MOST, "; ")
    return [f"{len(outliers)} single readings are outliers and were rejected: {some}"]
