"""The diagnosis of a measurement: where the gap lies, which effect causes it, how far it shrinks.

>>> diagnosis = diagnose(load_ring("petra3"), read_measurement("day_1"))
>>> diagnosis.verdict, diagnosis.findings[0].effect, diagnosis.findings[0].element
>>> diagnosis.gap["closed"]                     # on shots that the fit never saw
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.diagnosis.assessment import Block, combined_p_value, compared_of
from tmlattice.diagnosis.background import SmallErrors
from tmlattice.diagnosis.common import sought_in
from tmlattice.diagnosis.correlations import correlations_of
from tmlattice.diagnosis.doctor import consulted, mended
from tmlattice.diagnosis.findings import (
    findings_of,
    finished,
    sensitivity,
    unexplained,
    verdict_of,
    with_consequences,
)
from tmlattice.diagnosis.next_kind import leading
from tmlattice.diagnosis.next_measurement import NextMeasurement, next_measurement
from tmlattice.diagnosis.prepare import Prepared, batch, noise_of, same_monitors
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.diagnosis.strategy import freedom
from tmlattice.diagnosis.suspects import suspects
from tmlattice.diagnosis.views import TrajectoryView
from tmlattice.effects import Cause, apply, background_rms
from tmlattice.errors import BeamLostError, TmlatticeError
from tmlattice.inference.judge import Gap, held_out_gap, misfit
from tmlattice.inference.judgement import DEFAULT, Judgement
from tmlattice.inference.newton import Outcome
from tmlattice.inference.scan import FreeScan
from tmlattice.inference.search import Explanation, Search
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns, judged, turns_of
from tmlattice.optics import ring_tunes
from tmlattice.speaks import micrometres
from tmlattice.version import __version__

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


def diagnose(
    ring: Ring,
    measurement: Measurement,
    *,
    reference: Measurement | None = None,
    background: Mapping[str, float | None] | None = None,
    holdout: float = 0.33,
    heldout: Measurement | None = None,
    effects: Sequence[str] | None = None,
    max_effects: int = 8,
    radiation: bool = False,
    false_alarm: float = DEFAULT.false_alarm,
    assume: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Where the gap between a ring and its measurement lies, what causes it, how far it shrinks.

    Args:
        ring: the design.
        measurement: first turns, or a few turns, of one or more shots.
        reference: of the same machine before the fault: static errors cancel.
        background: small errors that the machine has everywhere, rms by effect (None: the
            catalogue's own; "all": every usual one; empty, or "none": there are none). Not given:
            whether there are any, and how large they are, the data say.
        holdout: share of the shots that the fit does not see, for the gap.
        heldout: those shots themselves, instead of a share.
        effects: names of those that may be the cause; else all usual ones of the catalogue.
        max_effects: findings at most.
        radiation: the model radiates as expected.
        false_alarm: share of faultless data sets in which something may be found.
        assume: what was written down wrongly everywhere, see `measurement.assume`; it is undone in
            all shots first.
        seed: of the split, the threshold's simulation and the bootstrap.
        progress: told what is being done.

    Raises:
        MeasurementError: data that cannot be used, that have a wrong sign, unit or order
            everywhere, or that are of another lattice.
        BeamLostError: launches that are lost in the design.
        EffectError: none of the effects can be looked for.
        UnknownNameError: a monitor or an effect that does not exist.
    """
    begun = time.perf_counter()
    options = {
        "reference": reference is not None,
        "background": None if background is None else dict(background),
        "holdout": holdout,
        "effects": None if effects is None else list(effects),
        "max_effects": max_effects,
        "radiation": radiation,
        "false_alarm": false_alarm,
        **({"assume": list(assume)} if assume else {}),
    }
    judgement = Judgement(false_alarm=false_alarm)
    progress("data")
    measurement = mended(ring, measurement, assume)
    reference, heldout = (mended(ring, own, assume) for own in (reference, heldout))
    said = consulted(ring, measurement, radiation, reference)
    measurement = batch(ring, measurement, said)
    reference, heldout = (own and batch(ring, own, said) for own in (reference, heldout))
    if heldout is None:
        measurement, heldout = measurement.split(holdout, seed)
        if heldout is None and holdout > 0:
            said.append("one shot was measured, so none is held out")
    progress("model")
    rms = None if background is None else background_rms(background)
    ready, found = sought_in(
        ring, measurement, reference, radiation, effects, rms, judgement,
        lambda ready: Search(
            ready.problem, ready.hypotheses, max_effects, seed=seed, progress=progress
        ),
    )  # fmt: skip
    small, explanation = found.small, finished(found.explanation)
    progress("report")
    told = _told(ring, ready, small, explanation, judgement)
    gap = _held_out(ring, heldout, ready, told, small, explanation, said)
    repaired = apply(ring, told.causes)
    noise = _noise(ready, small)
    left_out = _left_out(ready.problem, explanation, measurement.shots)
    compared = compared_of(told.fitted, gap)
    p_value = combined_p_value(compared)
    return Diagnosis(
        verdict=told.verdict,
        findings=with_consequences(ring, told.findings, told.causes),
        fit_before=misfit(told.residuals[0], told.problem.data.sigma),
        fit_after=misfit(told.residuals[-1], told.problem.data.sigma),
        heldout=gap,
        heldout_shots=() if heldout is None else heldout.shots,
        unexplained=unexplained(told.problem.model.ring, told.left, p_value, judgement),
        compared=compared,
        correlations=correlations_of(
            [(cause.effect, cause.element) for cause in told.causes],
            explanation.fit.covariance[: len(told.causes), : len(told.causes)],
        ),
        tunes={"before": ring_tunes(ring), "after": ring_tunes(repaired)},
        next=_next(ring, ready, explanation, seed),
        sensitivity=sensitivity(explanation.first, judgement),
        warnings=_said(said, ready, noise, told, left_out),
        suspects=suspects(ring, explanation, judgement) if told.verdict == "distributed" else (),
        left_out=left_out,
        noise=noise,
        noise_estimated=ready.estimated,
        provenance={
            "package": __version__,
            "lattice": ring.name,
            "measurement": measurement.lattice,
            "options": options,
            "seed": seed,
            "seconds": time.perf_counter() - begun,
        },
        ring=ring,
        repaired=repaired,
        causes=told.causes,
        errors=_errors(explanation)[: len(told.causes)],
        priors={} if small is None else small.sizes,
        prior_errors={} if small is None else small.open,
        view=TrajectoryView(explanation, ready.problem.data, told.problem.model),
    )


# --- what is told ----
def _errors(explanation: Explanation) -> tuple[float, ...]:
    """Standard error of the amount of each cause."""
    return tuple(np.sqrt(np.maximum(np.diag(explanation.fit.covariance), 0.0)).tolist())


@dataclass(frozen=True)
class _Told:
    """What stands of an explanation.

    Attributes:
        verdict, findings, causes: that stand.
        problem: the readings that they are judged on.
        left: the scan of free kicks about what stands.
        fitted: the readings of the fit, compared with what stands.
        estimates: the likeliest small errors before and after, empty without a background.
        residuals: readings less model before and after, NaN where there is none.
        said: what a reader should know.
    """

    verdict: str
    findings: tuple[Finding, ...]
    causes: tuple[Cause, ...]
    problem: FirstTurns
    left: FreeScan
    fitted: Block
    estimates: list[list[Cause]]
    residuals: list[Array]
    said: tuple[str, ...]


def _told(
    ring: Ring,
    ready: Prepared,
    small: SmallErrors | None,
    explanation: Explanation,
    judgement: Judgement,
) -> _Told:
    result, problem, left = explanation.fit, turns_of(explanation), explanation.left
    findings = findings_of(ring, explanation, ready.dead, judgement)
    alone = bool(problem.data.active.all())
    fitted = Block("fitted readings", result.chi2, freedom(problem, result))
    verdict, standing, said = verdict_of(
        explanation, findings, fitted.p_value, ready.estimated, judgement
    )
    learnt = small is not None and small.evidence is not None
    if verdict == "nothing" and learnt and alone:
        verdict = "distributed"  # the gap has a cause: many small ones
    if verdict == "distributed":  # nothing is explained: what was found stands no longer
        result, left = explanation.before, explanation.first_kicks
        problem = ready.problem if small is None else small.problem
        fitted = Block(fitted.name, result.chi2, freedom(problem, result))
    elif result.outcome is not Outcome.CONVERGED:
        said = (*said, f"the amounts are not settled: {result.outcome.value}")
    fits = [explanation.before, result] if result.causes or result.kicks else [explanation.before]
    estimates: list[list[Cause]] = [[] for _ in fits]
    if small is not None:
        seen_by = (small.problem.whitening, turns_of(explanation).whitening)
        estimates = [small.estimate(f, w) for f, w in zip(fits, seen_by, strict=False)]
    there = problem.valid & problem.data.active[:, None, None]
    residuals = []
    for one, errors in zip(fits, estimates, strict=True):
        made = small.made_by(errors) if small else 0.0
        difference = problem.data.readings - one.point.view.readings - made
        residuals.append(np.where(there, difference, np.nan))
    return _Told(
        verdict, standing, result.causes, problem, left, fitted, estimates, residuals, said
    )


def _noise(ready: Prepared, small: SmallErrors | None) -> tuple[float, float]:
    """Of a reading: where nobody states it, neighbours take small errors between them for noise."""
    return ready.noise if small is None else noise_of(small.problem.data)


def _held_out(
    ring: Ring,
    heldout: Measurement | None,
    ready: Prepared,
    told: _Told,
    small: SmallErrors | None,
    explanation: Explanation,
    said: list[str],
) -> Gap | None:
    """The gap on shots that the fit did not see: the design's; with the small errors in it, as the
    fit without causes leaves them; with the findings, one by one where there are no small errors.
    """
    if heldout is None:
        return None
    other = of_measurement(ring, heldout).with_sigma(np.array(_noise(ready, small)))
    dropped = ready.problem.valid & ~told.problem.valid
    other = same_monitors(other, ready.problem.data, dropped)

    def problem(known: Sequence[Cause], causes: tuple[Cause, ...]) -> FirstTurns:
        model = Model(ring, other.settings, other.turns, [*ready.known, *known])
        return FirstTurns(model=model, data=other, places={}, fixed=causes)

    if small is None:
        steps = [told.causes[:i] for i in range(len(told.causes) + 1)]
        return held_out_gap([judged(problem((), step)) for step in steps])
    scored = [judged(problem((), ()))]
    seen_by = (small.problem, turns_of(explanation))
    fits = (explanation.before, explanation.fit)[: len(told.estimates)]
    for one, seen, errors in zip(fits, seen_by, told.estimates, strict=False):
        try:
            unknown = small.unknown(one, seen, problem(errors, ()), errors)
        except BeamLostError as error:
            said.append(f"{error}: the held-out shots do not validate the result")
            return None
        scored.append(judged(problem(errors, one.causes), unknown))
    return held_out_gap(scored, since=max(len(scored) - 2, 0))


def _left_out(
    problem: FirstTurns, explanation: Explanation, shots: Sequence[int]
) -> tuple[dict[str, Any], ...]:
    """Single readings that the search left out as spikes, {"shot", "turn", "monitor", "plane"}."""
    count = len(problem.monitors)
    first = int((~problem.data.active).sum())  # of a reference, which come first
    rows: list[dict[str, Any]] = []
    for shot, reading, plane in explanation.spikes:
        turn, monitor = divmod(reading, count)
        of = shots[shot - first] if shot >= first else None
        rows.append(
            {"shot": of, "turn": turn, "monitor": problem.monitors[monitor], "plane": "xy"[plane]}
        )
    return tuple(rows)


def _next(
    ring: Ring, ready: Prepared, explanation: Explanation, seed: int
) -> NextMeasurement | None:
    pair = leading(ring, explanation, ready.problem.judgement.mass)
    if pair is None:
        return None
    try:
        return next_measurement(ring, ready.problem.data, *pair, ready.known, seed)
    except TmlatticeError:
        log.warning("no next measurement could be found", exc_info=True)
    return None


def _said(
    said: Sequence[str],
    ready: Prepared,
    noise: tuple[float, float],
    told: _Told,
    left_out: Sequence[Mapping[str, Any]],
) -> tuple[str, ...]:
    """What a reader should know, each once."""
    found = [*said, *ready.said, *told.said]
    if ready.estimated:
        both = zip(noise, "xy", strict=True)
        levels = [f"{micrometres(own)} in {plane}" for own, plane in both if np.isfinite(own)]
        found.append(f"the noise was estimated from the data: {', '.join(levels)}")
    read = ready.problem.data.planes
    if not read.all() and any(finding.effect is None for finding in told.findings):
        unread, other = ("x", "y") if read[1] else ("y", "x")
        found.append(
            f"what is located may begin upstream in {unread}, which sextupoles pass on to {other}"
        )
    if ready.problem.data.active.sum() == 1 and told.findings:
        found.append(
            "one trajectory gives one kick at each place: it locates, but any single multipole "
            "explains it; two or more launches name the effect"
        )
    return tuple(dict.fromkeys([*found, *_about_spikes(left_out)]))


SHOWN = 4
"""Readings left out that a warning names."""


def _about_spikes(left_out: Sequence[Mapping[str, Any]]) -> list[str]:
    if not left_out:
        return []
    some = "; ".join(
        f"{row['monitor']} {row['plane']}, "
        + ("the reference" if row["shot"] is None else f"shot {row['shot']}")
        + (f", turn {row['turn']}" if row["turn"] else "")
        for row in left_out[:SHOWN]
    )
    more = f"; and {len(left_out) - SHOWN} more" if len(left_out) > SHOWN else ""
    return [f"{len(left_out)} single readings are wrong for once and were left out: {some}{more}"]
