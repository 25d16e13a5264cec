"""The diagnosis of a measurement: where the gap lies, which effect causes it, how far it shrinks.

>>> diagnosis = diagnose(load_ring("petra3"), read_measurement("day_1"))
>>> diagnosis.verdict, diagnosis.findings[0].effect, diagnosis.findings[0].element
>>> diagnosis.gap["closed"]                     # on shots that the fit never saw
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tmlattice.beam.model import Hypothesis, Model
from tmlattice.diagnosis.background import SmallErrors, small_errors
from tmlattice.diagnosis.gap import held_out_gap, misfit
from tmlattice.diagnosis.next_measurement import NextMeasurement, next_measurement
from tmlattice.diagnosis.result import (
    VERDICTS,
    Diagnosis,
    Finding,
    Member,
    TrajectoryView,
    ring_tunes,
)
from tmlattice.effects import CATALOGUE, Cause, apply, background_rms, find, names
from tmlattice.errors import MeasurementError, TmlatticeError
from tmlattice.inference.newton import Fit, Problem, fit
from tmlattice.inference.scan import FreeScan, look_elsewhere
from tmlattice.inference.search import FALSE_ALARM, Detection, Explanation, Rival, explain
from tmlattice.inference.whitening import Whitening
from tmlattice.lattice import Element, Ring
from tmlattice.measurement import Measurement
from tmlattice.observe.data import Data, joined, of_measurement
from tmlattice.observe.noise import estimate, local_misfit

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

MASS = 0.95
"""Probability that a credible set is to hold."""

SILENT_SHARE = 0.2
"""Where more monitors than this have no signal, they are not there: no finding each."""

ALIEN = 0.35
"""A local misfit above this share of the orbit: the data are of another ring."""
RETAKEN = 2
"""How often small errors are taken again along the orbit of a strong fault, at most."""


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
    false_alarm: float = FALSE_ALARM,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Where the gap between a ring and its measurement lies, what causes it, how far it shrinks.

    Args:
        ring: the design.
        measurement: first turns, or a few turns, of one or more shots.
        reference: of the same machine before the fault: static errors cancel.
        background: small errors that the machine has everywhere, rms by effect (None: the
            catalogue's own; "all": every usual one). With a reference and no background given,
            every usual one.
        holdout: share of the shots that the fit does not see, for the gap.
        heldout: those shots themselves, instead of a share.
        effects: names of those that may be the cause; else the whole catalogue.
        max_effects: findings at most.
        radiation: the model radiates as expected.
        false_alarm: share of faultless data sets in which something may be found.
        seed: of the split, the threshold's simulation and the bootstrap.
        progress: told what is being done.

    Raises:
        MeasurementError: data that cannot be used, or that are of another lattice.
        UnknownNameError: a monitor or an effect that does not exist.
    """
    begun = time.perf_counter()
    options = {
        "reference": reference is not None,
        "background": dict(background or {}),
        "holdout": holdout,
        "effects": None if effects is None else list(effects),
        "max_effects": max_effects,
        "radiation": radiation,
        "false_alarm": false_alarm,
    }
    chosen = [name for name in names(effects) if name != "monitor_dead"]
    warnings: list[str] = []
    if heldout is None:
        measurement, heldout = measurement.split(holdout, seed)
        if heldout is None and holdout > 0:
            warnings.append("one shot: none is held out, so nobody judges the gap")
    known = [Cause(f"radiation_loss_{k}", None, 1.0) for k in ("bends", "wigglers") if radiation]
    known = [cause for cause in known if find(cause.effect).places(ring)]

    data = of_measurement(ring, measurement)
    if reference is not None:
        before_fault = of_measurement(ring, reference, reference=True)
        data = joined(before_fault, data)
        background = {"all": None} if background is None else background
    progress("model")
    model = Model(ring, data.settings, data.turns, known, active=data.active)
    listed = {name.casefold() for name in measurement.monitors}
    dead, data = _dead_monitors(model, data, listed, warnings)
    rough = data.with_sigma(np.array([1e-4, 1e-4]))
    places = {name: max(len(find(name).places(ring)), 1) for name in chosen}
    start = fit(Problem(model, rough, Whitening(rough), places), (), data.launches)
    data, noise, estimated = _with_noise(data, start, warnings)
    _check_lattice(ring, data, start)

    rms = background_rms(background or {})
    nobody = np.zeros(data.valid.shape, dtype=bool)
    before = fit(Problem(model, data, Whitening(data), places), (), start.launches)
    small: SmallErrors | None = None
    fitted = data

    def search(most: int = max_effects, *, names_first: bool = False) -> Explanation:
        def problem_without(dropped: NDArray[np.bool_]) -> Problem:
            if small is not None and not dropped.any():
                return Problem(model, fitted, small.whitening, places)
            kept = fitted.without(dropped)
            spread = None if small is None else small.spread
            return Problem(model, kept, Whitening(kept, spread), places)

        progress("scan")
        hypotheses = model.hypotheses(chosen)
        if (data.launch_sigma[:, 4] > 0).any():  # the energy of every shot is free
            hypotheses = [h for h in hypotheses if h[0] != "energy_offset"]
        return explain(
            problem_without(nobody),
            hypotheses,
            before,
            problem_without,
            most=most,
            rate=false_alarm,
            seed=seed,
            progress=progress,
            names_first=names_first,
        )

    if rms:
        progress("background")
        small = small_errors(ring, data, known, rms, before.launches)
        model, fitted, before = small.model, small.data, small.before
    if small is None:
        explanation = search()
    else:  # two findings say already whether the small errors have to be taken again
        explanation = search(min(2, max_effects), names_first=True)
        for _ in range(RETAKEN):
            if not _misled(explanation):
                break
            progress("background with what was found")
            found = explanation.fit
            errors = small.estimate(found, explanation.problem.whitening)
            clear = [named.detection.statistic for named in explanation.named]
            strongest = found.causes[int(np.argmax(clear))]  # the others may be the background's
            small = small_errors(ring, data, known, rms, found.launches, [strongest], errors)
            model, fitted, before = small.model, small.data, small.before
            explanation = search(min(2, max_effects), names_first=True)
        if explanation.full and max_effects > 1:
            explanation = search()
    progress("report")
    result = explanation.fit
    causes = result.causes
    findings = _findings(ring, model, explanation, dead)
    kept = fitted.without(explanation.dropped)
    freedom = _freedom(kept, result)
    p_value = float(stats.chi2.sf(result.chi2, freedom))
    verdict, standing = _verdict(explanation, findings, p_value, estimated, warnings)
    left = explanation.left
    if verdict == "distributed":  # nothing is explained: what was found stands no longer
        causes, result, left = (), before, explanation.first_kicks
        kept = fitted
        p_value = float(stats.chi2.sf(before.chi2, _freedom(fitted, before)))
    fits = [before, result] if causes or result.kicks else [before]
    estimates: list[list[Cause]] = [[] for _ in fits]
    if small is not None:
        seen_by = (small.whitening, explanation.problem.whitening)
        estimates = [small.estimate(f, w) for f, w in zip(fits, seen_by, strict=False)]
    gap = None
    if heldout is not None:
        other = of_measurement(ring, heldout).with_sigma(np.array(noise))
        other = _same_monitors(other, data, explanation)
        steps = [causes[:i] for i in range(len(causes) + 1)]
        there = [known] * len(steps)
        if small:  # the small errors too, as each explanation leaves them
            steps = [(), causes] if causes else [()]
            there = [[*known, *errors] for errors in estimates[: len(steps)]]
        models = [Model(ring, other.settings, other.turns, k) for k in there]
        gap = held_out_gap(models, other, steps, seed)
    repaired = apply(ring, causes)
    there_now = kept.valid & data.active[:, None, None]
    residuals = []
    for f, errors in zip(fits, estimates, strict=True):
        made = small.made_by(errors) if small else 0.0
        difference = kept.readings - f.paths.readings - made
        residuals.append(np.where(there_now, difference, np.nan))
    _say_about_shots(data, standing, warnings)
    return Diagnosis(
        verdict=verdict,
        findings=standing,
        fit_before=misfit(residuals[0], kept.sigma),
        fit_after=misfit(residuals[-1], kept.sigma),
        heldout=gap,
        heldout_shots=() if heldout is None else heldout.shots,
        unexplained=_unexplained(model, left, p_value),
        tunes={"before": ring_tunes(ring), "after": ring_tunes(repaired)},
        next=_next(ring, data, explanation, known, seed),
        sensitivity=_sensitivity(explanation),
        warnings=tuple(dict.fromkeys(warnings)),
        noise=noise,
        noise_estimated=estimated,
        provenance={
            "package": _version(),
            "lattice": ring.name,
            "measurement": measurement.lattice,
            "options": options,
            "seed": seed,
            "seconds": time.perf_counter() - begun,
        },
        ring=ring,
        repaired=repaired,
        causes=causes,
        errors=tuple(np.sqrt(np.maximum(np.diag(result.covariance)[: len(causes)], 0)).tolist()),
        view=TrajectoryView(explanation, data, model),
    )


def _version() -> str:
    from tmlattice import __version__

    return __version__


# --- before the search ----
def _dead_monitors(
    model: Model, data: Data, listed: set[str], warnings: list[str]
) -> tuple[list[tuple[int, float]], Data]:
    """Monitors without a signal (1) or with a frozen one (2), and the data without the latter."""
    count = len(model.at)
    readings = data.readings.reshape(-1, count, 2)
    valid = data.valid.reshape(-1, count, 2)
    silent, frozen, half = [], [], []
    for m, name in enumerate(model.maps.monitors):
        there = valid[:, m]
        if not there.any():
            if name.casefold() in listed:
                silent.append(m)
        elif not there.any(axis=0).all():
            half.append(name)
        elif there.sum() >= 4:
            values = [readings[there[:, plane], m, plane] for plane in (0, 1)]
            if all(len(v) > 1 and np.ptp(v) == 0 for v in values):
                frozen.append(m)
    absent = sum(1 for name in model.maps.monitors if name.casefold() not in listed)
    if absent:
        warnings.append(f"{absent} of the ring's {count} monitors are not in the measurement")
    if half:
        some = ", ".join(half[:3]) + (", ..." if len(half) > 3 else "")
        warnings.append(f"{len(half)} monitors read one plane only: {some}")
    if len(silent) > SILENT_SHARE * count:
        warnings.append(f"{len(silent)} monitors have no signal; they count as not there")
        silent = []
    dropped = np.zeros(data.valid.shape, dtype=bool)
    for m in frozen:
        dropped[:, m::count] = True
    return [(m, 1.0) for m in silent] + [(m, 2.0) for m in frozen], data.without(dropped)


def _with_noise(
    data: Data, start: Fit, warnings: list[str]
) -> tuple[Data, tuple[float, float], bool]:
    missing = ~np.isfinite(data.sigma) & data.valid
    if (data.sigma[data.valid & ~missing] <= 0).any():
        raise MeasurementError("a monitor's noise is zero or negative; leave it out if unknown")
    estimated = bool(missing.any())
    if estimated:
        found = estimate(data, start.paths)
        if not np.isfinite(found).any():
            raise MeasurementError(
                "the noise is not given and the readings are too few to estimate it; give the "
                "noise of a reading"
            )
        found = np.where(np.isfinite(found), found, np.nanmean(found))
        warnings.append(
            f"the noise was estimated from the data: {1e6 * found[0]:.1f} µm in x, "
            f"{1e6 * found[1]:.1f} µm in y"
        )
        data = data.with_sigma(found)
    data = data.with_sigma(np.ones(2))  # where nothing was read
    planes = [
        float(np.sqrt(np.mean(data.sigma[..., p][data.valid[..., p]] ** 2)))
        if data.valid[..., p].any()
        else float("nan")
        for p in (0, 1)
    ]
    return data, (planes[0], planes[1]), estimated


def _check_lattice(ring: Ring, data: Data, start: Fit) -> None:
    """A few errors leave most monitors in agreement with their neighbours."""
    local = local_misfit(data, start.paths)
    if not np.isfinite(local).sum() > 50:
        return
    size = float(np.median(np.abs(local[np.isfinite(local)])))
    orbit = float(np.median(np.abs(data.readings[data.valid])))
    noise = float(np.median(data.sigma[data.valid]))
    if size > max(ALIEN * orbit, 5 * noise):
        raise MeasurementError(
            f"the readings do not follow from '{ring.name}': even between neighbouring monitors "
            f"the model errs by {1e6 * size:.0f} µm where the orbit is {1e6 * orbit:.0f} µm; name "
            "the lattice of this machine, and check units and the names of the monitors"
        )


def _misled(explanation: Explanation) -> bool:
    """Whether a fault is so strong that small errors along its orbit look like further faults."""
    if not explanation.fit.causes:
        return False
    freedom = _freedom(explanation.problem.data, explanation.fit)
    return explanation.count > 1 or bool(stats.chi2.sf(explanation.fit.chi2, freedom) < 0.01)


# --- after the search ----
def _freedom(data: Data, result: Fit) -> int:
    """Degrees of freedom: readings and priors, less what was fitted."""
    free = data.launch_sigma > 0
    priors = int((free & np.isfinite(data.launch_sigma)).sum())
    amounts = sum(not find(cause.effect).discrete for cause in result.causes)
    kicks = 2 * int(data.active.sum()) * len(result.kicks)
    return max(int(data.valid.sum()) + priors - int(free.sum()) - amounts - kicks, 1)


def _credible(rivals: Sequence[Rival]) -> tuple[list[Rival], Array]:
    """The likeliest rivals that hold the mass, and the probabilities of all."""
    evidence = np.array([rival.fit.log_evidence for rival in rivals])
    probability = np.exp(evidence - evidence.max())
    probability /= probability.sum()
    size = int(np.searchsorted(np.cumsum(probability), MASS)) + 1
    return list(rivals[:size]), probability


def _middle(ring: Ring, name: str | None) -> float | None:
    return next((e.s for e in ring.elements if e.name == name), None)


def _family_span(ring: Ring, hypothesis: Hypothesis) -> list[float]:
    """Positions of all elements that a hypothesis touches, m."""
    place = _middle(ring, hypothesis[1])
    if place is not None:
        return [place]
    return [e.s for e in ring.elements if hypothesis[1] is not None and e.family == hypothesis[1]]


def _between(ring: Ring, positions: Sequence[float]) -> tuple[tuple[float, float], tuple[str, ...]]:
    """From the last monitor before to the first one behind, m, and their names."""
    s = np.array([monitor.s for monitor in ring.monitors])
    low, high = min(positions), max(positions)
    before = int(np.searchsorted(s, low, side="left")) - 1
    behind = int(np.searchsorted(s, high, side="right"))
    start = float(s[before]) if before >= 0 else 0.0
    end = float(s[behind]) if behind < len(s) else ring.length
    near = [ring.monitors[i].name for i in (before, behind) if 0 <= i < len(s)]
    return (start, end), tuple(near)


def _findings(
    ring: Ring, model: Model, explanation: Explanation, dead: Sequence[tuple[int, float]]
) -> list[Finding]:
    result = explanation.fit
    findings = []
    for k, (cause, named) in enumerate(zip(result.causes, explanation.named, strict=True)):
        members, probability = _credible(named.rivals)
        positions = [s for m in members for s in _family_span(ring, m.hypothesis)]
        where, near = _between(ring, positions) if positions else (None, ())
        findings.append(
            Finding(
                effect=cause.effect,
                element=cause.element,
                s=_middle(ring, cause.element),
                amount=cause.amount,
                amount_sigma=float(np.sqrt(max(result.covariance[k, k], 0.0))),
                unit=find(cause.effect).unit,
                probability=float(probability[0]),
                detection=named.detection,
                where=where,
                near=near,
                credible_set=tuple(
                    Member(*m.hypothesis, _middle(ring, m.hypothesis[1]), float(p), m.cause.amount)
                    for m, p in zip(members, probability, strict=False)
                ),
                mass=float(probability[: len(members)].sum()),
            )
        )
    for layer, detection in explanation.kicks.items():
        magnet = ring.magnets[layer]
        findings.append(_located(ring, magnet, detection))
    for m, detection in explanation.monitors.items():
        findings.append(_located(ring, ring.monitors[m], detection))
    for m, amount in dead:
        monitor = ring.monitors[m]
        where, near = _between(ring, [monitor.s])
        member = Member("monitor_dead", monitor.name, monitor.s, 1.0, amount)
        findings.append(
            Finding(
                "monitor_dead",
                monitor.name,
                monitor.s,
                amount,
                0.0,
                "discrete",
                1.0,
                Detection(float("inf"), float("nan"), 0.0),
                where,
                near,
                (member,),
                1.0,
            )
        )
    findings.sort(key=lambda f: -f.detection.statistic)
    return findings


def _located(ring: Ring, element: Element, detection: Detection) -> Finding:
    where, near = _between(ring, [element.s])
    return Finding(
        effect=None,
        element=None,
        s=element.s,
        amount=None,
        amount_sigma=None,
        unit=None,
        probability=1.0,
        detection=detection,
        where=where,
        near=tuple(dict.fromkeys((*near[:1], element.name, *near[1:]))),
        credible_set=(),
        mass=0.0,
    )


def _verdict(
    explanation: Explanation,
    findings: Sequence[Finding],
    p_value: float,
    estimated: bool,
    warnings: list[str],
) -> tuple[str, tuple[Finding, ...]]:
    """The least certain of the findings', and the findings that stand."""
    found = explanation.scan
    left = float(found.statistic.max()) if len(found.statistic) else 0.0
    significant = found.p_value(left) < FALSE_ALARM
    if explanation.full and significant:
        warnings.append(
            f"as many as {len(findings)} causes do not explain the data: small errors everywhere; "
            "state their rms as a background, or give a reference from before the fault"
        )
        return "distributed", ()
    if not findings:
        if p_value < 1e-6 and not estimated:
            return "distributed", ()
        return "nothing", ()
    worst = max(findings, key=lambda f: VERDICTS.index(f.verdict)).verdict
    if p_value < 1e-4 and not estimated:
        warnings.append("what is left is more than the noise: see 'unexplained'")
    return worst, tuple(findings)


def _same_monitors(other: Data, data: Data, explanation: Explanation) -> Data:
    """Held-out readings of the monitors that the fit kept."""
    lost = explanation.dropped[data.active].all(axis=0)
    never: NDArray[np.bool_] = np.logical_or(lost, ~data.valid[data.active].any(axis=0))
    readings = min(len(never), other.valid.shape[1])
    dropped = np.zeros(other.valid.shape, dtype=bool)
    dropped[:, :readings] = never[None, :readings]
    return other.without(dropped)


def _unexplained(model: Model, left: FreeScan, p_value: float) -> dict[str, Any]:
    """Whether what is left is noise, and where it sits if not."""
    places: list[dict[str, float]] = []
    s = [model.ring.magnets[int(k)].s for k in left.places]
    taken: list[float] = []
    for i in np.argsort(-left.gain)[:200]:
        statistic, freedom = float(left.statistic[i]), max(int(left.freedom[i]), 1)
        if len(places) == 3 or look_elsewhere(statistic, freedom, len(s)) > FALSE_ALARM:
            break
        (start, end), _ = _between(model.ring, [s[i]])
        if start not in taken:
            taken.append(start)
            places.append({"s_from": start, "s_to": end, "statistic": statistic})
    return {"p_value": p_value, "places": places}


def _next(
    ring: Ring, data: Data, explanation: Explanation, known: Sequence[Cause], seed: int
) -> NextMeasurement | None:
    for named in explanation.named:
        members, _ = _credible(named.rivals)
        if len(members) > 1:
            try:
                return next_measurement(ring, data, members[0], members[1], known, seed)
            except TmlatticeError:
                log.warning("no next measurement could be found", exc_info=True)
    return None


def _sensitivity(explanation: Explanation) -> dict[str, float]:
    """By effect, the amount that reaches the threshold at half of the places where it is seen."""
    found = explanation.scan
    threshold = found.threshold(FALSE_ALARM)
    amounts: dict[str, list[float]] = {}
    for (name, _), information in zip(found.hypotheses, found.information, strict=True):
        if information > 0 and not CATALOGUE[name].discrete:
            least = np.sqrt(threshold / information) ** (1 / CATALOGUE[name].power)
            amounts.setdefault(name, []).append(float(least))
    return {name: float(np.median(values)) for name, values in amounts.items()}


def _say_about_shots(data: Data, findings: Sequence[Finding], warnings: list[str]) -> None:
    shots = int(data.active.sum())
    if shots == 1 and findings:
        warnings.append(
            "one trajectory gives one kick at each place: it locates, but any single multipole "
            "explains it; two or more launches name the effect"
        )
