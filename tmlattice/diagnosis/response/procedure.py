"""Diagnosis of an orbit response by families of errors, validated on held-out readings.

One fifth of the correctors is never fitted. For each of them the kick is estimated from half of
the BPMs, one of each two neighbours, and the prediction is scored on the other half. The RF's orbit
is fitted at half of the BPMs and scored at the other half. Families are selected by the marginal
likelihood of the fitted readings.

>>> result = diagnose(ring, measured)
>>> [(step.effect, step.heldout_rms_in_plane) for step in result.steps]

BPM gains and corrector calibrations are degenerate in scale without the dispersion, and
neighbouring quadrupoles are correlated. Priors resolve both: correctors of one kind, or quadrupoles
of one kind or supply, share an error and scatter about it, and the scatter is learnt.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.arrays import TINY, Array
from tmlattice.diagnosis.data_checks import corrected_data, data_checks
from tmlattice.diagnosis.families.dispersion import (
    dispersion_beside,
    dispersion_by_kicks,
    orbits_in_sextupoles,
)
from tmlattice.diagnosis.families.family import StatedCause
from tmlattice.diagnosis.families.steps import STEPS, Trial
from tmlattice.diagnosis.findings import (
    cause_of,
    least_certain,
    strongest_first,
    swap_of,
    with_consequences,
)
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.response.assumed import assumed_of
from tmlattice.diagnosis.response.common_factors import explain_gradients
from tmlattice.diagnosis.response.detected_faults import detected_faults, given_faults
from tmlattice.diagnosis.response.first_guess import FAR, first_guess, strange
from tmlattice.diagnosis.response.hierarchical import (
    HierarchicalFit,
    fit_chi2,
    fit_families,
    reversed_decisions,
)
from tmlattice.diagnosis.response.inconsistencies import inconsistencies
from tmlattice.diagnosis.response.labels import (
    Label,
    corrected,
    label_messages,
    new,
    rejected_channels,
    reversed_ones,
    swapped_planes,
    swaps,
)
from tmlattice.diagnosis.response.missing_effects import weigh
from tmlattice.diagnosis.response.outlier_readings import outlier_readings, without_gross
from tmlattice.diagnosis.response.sparse import outperforms, sparse_fit
from tmlattice.diagnosis.response.state import State, begin
from tmlattice.diagnosis.response.stated import fitted_causes
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.diagnosis.suspects import outliers
from tmlattice.diagnosis.views import ResponseView
from tmlattice.effects import Cause, apply, find, names
from tmlattice.errors import MeasurementError
from tmlattice.inference.judgement import ENOUGH, SIGNIFICANT
from tmlattice.inference.validation import Gap, Misfit
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.noise import overstated
from tmlattice.observe.response_data import ResponseData, Split, response_data, split_columns
from tmlattice.observe.response_problem import single_causes
from tmlattice.optics import ring_tunes

PATTERNS = 8
"""Number of the strongest patterns of the residual."""


def diagnose_response(measured: OrbitResponse, options: Options) -> Diagnosis:
    """Diagnose an orbit response: all families of errors, sparse solutions and single faults.

    Args:
        measured: with an RF step, if possible, and with its noise, else that is estimated.
        options: `effects` are those whose families are tried.

    Raises:
        MeasurementError: too few correctors, or effects that have no family.
        UnknownNameError: an effect or a BPM that does not exist.
        UnstableRingError: no closed orbit.
    """
    ring, effects, progress = options.ring, options.effects, options.progress
    holdout, judgement = options.holdout, options.judgement
    estimated = measured.noise is None
    measured = corrected_data(ring, measured, options.assume)
    trials, data = trials_of(effects), response_data(ring, measured)
    notes = [*data_checks(ring, measured), *assumed_of(measured, data)]
    measured = replace(data.measured, noise=data.noise) if estimated else measured
    measured, gross = without_gross(measured, data)
    if gross:
        notes, data = notes + gross, response_data(ring, measured)
    split = split_columns(data, holdout, np.random.default_rng(options.seed))
    sparse = sparse_fit(data, split, effects, options)
    if sparse is None or not sparse.noise or overstated(ring, data.measured):
        whole = _families(data, split, trials, options)
        worse = sparse is None or outperforms(whole[0], sparse, judgement)
        sparse = None if worse else sparse
    more: dict[str, Any]
    if sparse is None:
        fit, labels = whole
        fit = reversed_decisions(fit, progress)
        fit, findings = _faults(fit, labels, options)
        notes += [*label_messages(own for own in labels if own not in fit.labels), *fit.messages]
        notes += reversed_ones(fit.state)
        # before the covariance of all causes, which is large
        factors = explain_gradients(fit.state)
        apart = inconsistencies(fit.state, judgement.false_alarm)
        found, supports, degenerate, correlated, covariance = fitted_causes(fit.state)
        verdict = least_certain(findings, _verdict(fit, judgement.false_alarm))
        more = {
            "covariance": covariance,
            "supports": supports,
            "degenerate": degenerate,
            "correlations": correlated,
            "rejected_channels": tuple(
                (own.elements[0], own.plane) for own in labels if "rejected" in own.kind
            ),
            "common_factors": factors,
            "inconsistencies": apart,
        }
    else:
        fit, found, more = sparse.fit, sparse.fitted_causes, {"covariance": sparse.covariance}
        verdict, findings = sparse.verdict, sparse.findings[: options.max_effects]
        notes += sparse.messages
    missing = options.missing
    causes = tuple(cause_of(own) for own in findings if own.effect)
    return as_diagnosis(
        ring, fit, fit.state.at.errors.ring, found,
        noise_estimated=estimated,
        verdict=verdict,
        findings=with_consequences(ring, findings, causes),
        warnings=(*notes, *_warnings(fit)),
        hypotheses=tuple(weigh(fit.state, progress=progress)) if missing else None,
        provenance=options.provenance(background={}, missing=missing),
        **more,
    )  # fmt: skip


def _families(
    data: ResponseData, split: Split, trials: Sequence[Trial], options: Options
) -> tuple[HierarchicalFit, list[Label]]:
    """The hierarchical fit of the corrected measurement, and all labels.

    Swaps are corrected, and rejected channels are removed, by the design, then by the fit, until
    there are no new ones."""
    known: list[Label] = []
    while True:
        found = _wrong(begin(data, split), known, of_design=True)
        if not found:
            fit = fit_families(data, split, trials, options.max_effects, options.progress)
            swapped = [own for own in fit.labels if own.kind == "swapped correctors"]
            found = [*new(swapped, known), *_wrong(fit.state, known)]
            if not found:
                return fit, [*known, *fit.labels]
        known += found
        measured = corrected(replace(data.measured, noise=data.noise), found)
        data = response_data(options.ring, measured)
        split = split_columns(data, options.holdout, np.random.default_rng(options.seed))


def _wrong(state: State, known: Sequence[Label], of_design: bool = False) -> list[Label]:
    """New swaps by a state; if there are none, rejected channels. If the design is far from the
    ring, by the typical column or by a better start, columns match by chance, and the ring is
    fitted before swaps are sought."""
    gone = rejected_channels(state)
    names = [own.elements[0] for own in gone if own.kind == "rejected BPM"]
    good = state.good & ~np.isin(state.data.measured.monitors, names)
    there = replace(state, good=good)
    far = of_design and (strange(there, ENOUGH) > FAR or first_guess(there) is not None)
    return new([*([] if far else swaps(state, gone)), *swapped_planes(state)], known) or gone


def _faults(
    fit: HierarchicalFit, labels: Sequence[Label], options: Options
) -> tuple[HierarchicalFit, tuple[Finding, ...]]:
    """The fit given detected single faults, and the findings."""
    state, effects, judgement = fit.state, options.effects, options.judgement
    ring, most = state.data.ring, options.max_effects
    planes = () if effects is not None and "monitor_swap" not in effects else labels
    found = [swap_of(state, own.elements[0], judgement) for own in planes
             if own.kind == "swapped planes"]  # fmt: skip
    hypotheses = single_causes(state.data, effects)
    if hypotheses:
        apart, alone, messages = detected_faults(state, hypotheses, options)
        fit = given_faults(fit, apart) if apart else fit
        fit = replace(fit, messages=(*fit.messages, *messages))
        found += alone
    of_labels = (own.finding(ring) for own in labels)
    found = [*strongest_first(found)[:most], *(own for own in of_labels if own is not None)]
    return fit, strongest_first(found)


def as_diagnosis(
    ring: Ring,
    fit: HierarchicalFit,
    within: Sequence[Cause],
    found: Sequence[StatedCause],
    **fields: Any,
) -> Diagnosis:
    """Return the diagnosis of a fit of a response.

    Args:
        ring: the design.
        fit: with its steps.
        within: errors of the estimated ring.
        found: causes with their errors.
        fields: further ones of the diagnosis.
    """
    data, good = fit.state.data, fit.state.good
    noise_x, noise_y = np.sqrt(np.mean(data.noise[good] ** 2, axis=0)).tolist()
    causes = tuple(cause for cause, _ in found)
    corrected = apply(ring, within)
    errors = tuple(sigma for _, sigma in found)
    named = [(finding.effect or "", finding.element) for finding in fields["findings"]]
    return Diagnosis(
        kind="orbit_response",
        fit_before=_misfit(fit, fit.design.at.read),
        fit_after=_misfit(fit, fit.state.at.read),
        heldout=_gap(fit),
        heldout_shots=(),
        compared=fit.blocks,
        unexplained={
            "p_value": fit.p_value,
            "places": [],
            "patterns": _patterns(fit),
        },
        tunes={
            "before": ring_tunes(ring, data.energy),
            "after": ring_tunes(corrected, data.energy + fit.state.at.errors.energy),
        },
        next=None,
        sensitivity={},
        noise=(noise_x, noise_y),
        ring=ring,
        corrected=corrected,
        causes=causes,
        errors=errors,
        suspects=outliers(ring, causes, errors, named),
        view=ResponseView(
            data.measured, data.orbits, fit.design.at.read, fit.state.at.read,
            fit.state.split.held, good,
        ),
        measured=("dispersion",) if np.isfinite(data.orbits[-1]).any() else (),
        correctors_held_out=int(fit.state.split.held.sum()),
        steps=fit.steps,
        families=fit.families,
        bad_monitors=tuple(data.measured.monitors[i] for i in np.flatnonzero(~good)),
        priors={
            name: group.rms
            for name, group in fit.state.groups.items()
            if name not in {one.name for one in fit.state.apart}
        },
        dispersion=dispersion_beside(fit.state.values, data),
        **fields,
    )  # fmt: skip


def trials_of(effects: Sequence[str] | None, steps: Sequence[Trial] = STEPS) -> list[Trial]:
    """Return the trials of `steps` with families of these effects; None: all.

    Raises:
        MeasurementError: an orbit response is sensitive to none of the effects.
    """
    if effects is None:
        return list(steps)
    wanted = set(names(effects))
    kept = [tuple(f for f in trial if wanted & set(f.effects)) for trial in steps]
    known = {effect for trial in steps for family in trial for effect in family.effects}
    known |= {name for name in names() if find(name).responds}
    if not known & wanted:
        raise MeasurementError(
            f"an orbit response is not sensitive to {', '.join(sorted(wanted)) or 'no effect'}; "
            f"name some of {', '.join(sorted(known))}"
        )
    return [trial for trial in kept if trial]


def _verdict(fit: HierarchicalFit, false_alarm: float) -> str:
    """`none` if the design's residual is noise, of fitted and held-out readings, in-plane, coupling
    and RF; else `distributed`."""
    blocks = (*fit_chi2(fit.design), *fit.steps[0].compared)
    chances = [own.p_value for own in blocks if own.freedom]
    return "none" if min(chances) > false_alarm / len(chances) else "distributed"


def _warnings(fit: HierarchicalFit) -> tuple[str, ...]:
    """Warnings about the closed orbit's effects and outliers."""
    of_orbit = (orbits_in_sextupoles, dispersion_by_kicks)
    messages = (one for make in of_orbit for one in make(fit.state.values, fit.state.data))
    return (*messages, *outlier_readings(fit.state))


def _misfit(fit: HierarchicalFit, read: Array) -> Misfit:
    """The misfit of the fitted correctors' readings in their own plane."""
    data, good = fit.state.data, fit.state.good
    rows = np.flatnonzero(~fit.state.split.held[:-1])
    miss = data.pick(data.orbits - read)[rows][:, good]
    pull = miss / data.noise_of(0)[rows][:, good]
    return Misfit(float(np.sqrt(np.nanmean(miss**2))), float(np.nanmean(pull**2)))


def _gap(fit: HierarchicalFit) -> Gap:
    misfits = tuple(Misfit(s.heldout_rms_in_plane, s.heldout_chi2_per_dof) for s in fit.steps)
    # in units of each reading's noise: the planes differ in it
    before, after = (max(m.chi2_per_dof - 1, 0.0) for m in (misfits[0], misfits[-1]))
    seen = fit.steps[0].compared[0]  # a gap below this many sigma of the noise is none
    there = before > 0 and seen.chi2 - seen.freedom > SIGNIFICANT * np.sqrt(2 * seen.freedom)
    explained = 1 - after / before if there and len(misfits) > 1 else None
    return Gap(misfits, np.zeros((0, 0, 0)), explained, None, 0, int(seen.freedom))


def _patterns(fit: HierarchicalFit) -> dict[str, Any]:
    """The residual of the fitted correctors: chi-square per reading, and the share of the strongest
    patterns in each plane."""
    state, data = fit.state, fit.state.data
    shares = []
    total, count = 0.0, 0
    for p in (0, 1):
        rows = np.flatnonzero(~state.split.held[:-1] & (data.plane[:-1] == p))
        miss = state.at.left[rows][:, state.good, p]
        seen = np.isfinite(miss)
        miss = np.where(seen, miss, 0.0)
        size = np.linalg.svd(miss, compute_uv=False) ** 2
        shares.append(float(size[:PATTERNS].sum() / max(size.sum(), TINY)))
        total += float(np.sum((miss / data.noise[state.good, p]) ** 2))
        count += int(seen.sum())
    return {"chi2_per_dof": total / max(count, 1), "low_rank": shares}
