"""The change between two orbit responses of one machine.

>>> change = diagnose(ring, after, reference=before)
>>> [(own.effect, own.element, own.amount, own.amount_sigma) for own in change.findings]

The ring, its BPMs and its correctors are fitted to the first measurement. Its residual cancels in
the difference of both (`observe.orbit_response.response_change`), which is fitted in turn, with the
dispersion and the energy of the first fit. Drifts of BPMs and correctors are nuisances with learnt
scales. Stated errors include the scatter of the magnets of one supply, which is learnt, and the
undetermined errors of the first fit (`undetermined`). Findings are supplies (magnets whose names
begin alike), single magnets, gradients in sextupoles and wigglers (by the orbit there), and
insertion devices, selected by the marginal likelihood, see `inference.common_factors`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.data_checks import corrected_data, data_checks
from tmlattice.diagnosis.families.dispersion import (
    OrbitFamily,
    dispersion_by_kicks,
    fitted_orbit_kicks,
)
from tmlattice.diagnosis.families.family import StatedCause
from tmlattice.diagnosis.families.fields import REPRODUCED, FamilyGradient, QuadrupoleGradient
from tmlattice.diagnosis.families.steps import CHANGES, STEPS, EnergyOffset, Trial
from tmlattice.diagnosis.findings import (
    cause_of,
    finding_of,
    least_certain,
    strongest_first,
    with_consequences,
)
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.response.assumed import assumed_of
from tmlattice.diagnosis.response.changed_supplies import changed_supplies
from tmlattice.diagnosis.response.hierarchical import (
    HierarchicalFit,
    decisions,
    fit_families,
    readable,
    reversed_decisions,
    rough_fit,
    steps_of,
)
from tmlattice.diagnosis.response.labels import label_messages, since, without_swaps
from tmlattice.diagnosis.response.linear import linear, with_undetermined
from tmlattice.diagnosis.response.procedure import as_diagnosis, trials_of
from tmlattice.diagnosis.response.rounds import settle
from tmlattice.diagnosis.response.sparse import SparseFit, outperforms, sparse_fit
from tmlattice.diagnosis.response.state import State, begin, bend, jump
from tmlattice.diagnosis.response.stated import unwidened, with_support
from tmlattice.diagnosis.response.undetermined import Undetermined, and_orbits, undetermined
from tmlattice.diagnosis.response.validation import score
from tmlattice.diagnosis.response.weights import LEAST
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.diagnosis.support import FREE, Support
from tmlattice.effects import CATALOGUE, Cause, RingEffect, find, modelled
from tmlattice.effects.effect import FamilyEffect
from tmlattice.errors import TmlatticeError
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.judgement import SIGNIFICANT, Judgement
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.orbit_response import Errors, Predicted, alike, response_change
from tmlattice.observe.response_data import ResponseData, Split, response_data, split_columns

DRIFT, OUTSTANDING = 0.03, 8.0
"""Least change of a BPM or corrector that is a finding, and its least ratio to the typical one."""
ANY = 6.0
"""rms of the logarithm of a change's scale about its first guess: most families did not change."""
EVERYWHERE = 5e-4
"""Relative scatter of magnets above which it is reported without a single detected change."""


def diagnose_change(before: OrbitResponse, after: OrbitResponse, options: Options) -> Diagnosis:
    """Diagnose the change from one response to the other.

    Args:
        before, after: of the same machine; correctors and BPMs of only one of them are excluded.
        options: correctors that are held out validate the gap; amounts are fitted to all of them.

    Returns:
        Its ring is the one fitted to the first measurement; its steps are those of the change.

    Raises:
        MeasurementError: data that cannot be used, or that are not of one machine.
        UnknownNameError: an effect, a BPM or a corrector that does not exist.
        UnstableRingError: no closed orbit.
    """
    ring, effects, progress = options.ring, options.effects, options.progress
    holdout, judgement, most = options.holdout, options.judgement, options.max_effects
    trials = trials_of(effects, CHANGES)
    before, after = (corrected_data(ring, one, options.assume) for one in (before, after))
    messages = data_checks(ring, after, reference=before)
    messages += _lost(before, after)
    before, after = alike(ring, before, after)
    first, second = response_data(ring, before), response_data(ring, after)
    messages += assumed_of(after, second)
    same = _same(first, second)
    if same:
        trials = []
        messages.append("the two measurements are the same, to the last digit")
    before, first, swaps_before = without_swaps(partial(response_data, ring), before, holdout)
    progress("the reference")
    rng = np.random.default_rng(options.seed)
    # a changed gradient would move a closed orbit of the reference's ring, which operators correct
    still = [trial for trial in STEPS if not any(isinstance(f, OrbitFamily) for f in trial)]
    steps = () if same else trials_of(effects, still)
    fitted, more = _reference(first, split_columns(first, holdout, rng), steps, progress)
    orbit_kicks = fitted_orbit_kicks(fitted.at)
    messages += [f"of the reference: {own}" for own in (*more, *_of_the_ring(fitted))]
    first, second, errors = _by_good_monitors(ring, fitted, before, after, messages)

    def change(measured: OrbitResponse) -> ResponseData:
        return response_change(first, errors, response_data(ring, measured), orbit_kicks)

    _, data, swaps_after = without_swaps(change, second.measured, holdout)
    there = data.ring
    swapped, on_both = since(swaps_before, swaps_after)
    messages += [f"on both days {own}" for own in label_messages(on_both)]
    of_labels = (label.finding(there, other="did") for label in swapped)
    pairs = [own for own in of_labels if own is not None]
    split = split_columns(data, holdout, rng)
    open_ = undetermined(fitted)
    fit = _sparse_or_all(data, split, trials, options, open_)
    if isinstance(fit, SparseFit):
        causes = tuple(cause for cause, _ in fit.fitted_causes)
        sought = [own for own in fit.findings if not is_drift(cause_of(own))]
        found = strongest_first([*sought[:most], *pairs])
        return as_diagnosis(
            there, fit.fit, fit.fit.state.at.errors.ring, fit.fitted_causes,
            verdict=least_certain(found, fit.verdict),
            findings=with_consequences(there, found, causes),
            warnings=(*messages, *fit.messages),
            covariance=fit.covariance,
            noise_estimated=False,
            provenance=options.provenance(background={}),
        )  # fmt: skip
    progress("changes")
    whole = settle(_all_columns(fit.state))
    changed, scatter, whole = changed_supplies(whole, judgement, open_)
    drifted = drifts(whole)
    changed += outstanding(there, [row for row, _ in drifted], judgement)
    wanted = changed if effects is None else [own for own in changed if own.effect in effects]
    named = strongest_first(wanted)[:most]
    causes = tuple(cause_of(own) for own in named)
    known = [own.amount_sigma or 0.0 for own in named]
    reported: list[StatedCause] = list(zip(causes, known, strict=True))
    found = strongest_first([*named, *pairs])
    have = {(cause.effect, cause.element) for cause in causes}
    supports = [FREE] * len(reported)
    for row, support in drifted:
        if (row[0].effect, row[0].element) not in have:
            reported.append(row)
            supports.append(support)
    return as_diagnosis(
        there, fit, [c for c in causes if isinstance(find(c.effect), RingEffect)], reported,
        verdict=least_certain(found, _verdict(whole)),
        findings=with_consequences(there, found, causes),
        warnings=(*messages, *_messages(data, fit, whole, scatter)),
        supports=tuple(supports),
        noise_estimated=True,
        provenance=options.provenance(background={}),
    )  # fmt: skip


def changes() -> list[str]:
    """Return the effects that may change between two measurements: usual ones, and all supplies."""
    families = [name for name, effect in CATALOGUE.items() if isinstance(effect, FamilyEffect)]
    return list(dict.fromkeys([*modelled(), *families]))


def _lost(before: OrbitResponse, after: OrbitResponse) -> list[str]:
    messages = []
    for what, a, b in (
        ("correctors", before.correctors, after.correctors),
        ("BPMs", before.monitors, after.monitors),
    ):
        alone = sorted({n.casefold() for n in a} ^ {n.casefold() for n in b})
        if alone:
            messages.append(f"{what} in only one of the measurements, excluded: {', '.join(alone)}")
    return messages


# --- the fits -------------------------------------------------------------------------------------
def _not_validated(split: Split) -> Split:
    """A split in which all correctors, and all of the RF's orbit, are fitted."""
    none, half = np.zeros_like(split.held), split.half.copy()
    half[-1] = True
    return Split(none, half)


def _same(first: ResponseData, second: ResponseData) -> bool:
    return bool(
        np.array_equal(first.orbits, second.orbits, equal_nan=True)
        and np.array_equal(first.kicks, second.kicks)
    )


def _reference(
    data: ResponseData, split: Split, steps: Sequence[Trial], progress: Callable[[str], Any]
) -> tuple[State, list[str]]:
    """The state fitted to the first measurement, and messages; the design if the fit diverges."""
    nothing = begin(data, _not_validated(split))
    if not steps:
        return nothing, []
    try:
        fit = fit_families(data, split, steps, len(steps), progress)
        return settle(bend(jump(_all_columns(fit.state), beyond=1.0))), list(fit.messages)
    except (TmlatticeError, np.linalg.LinAlgError):
        return nothing, ["its fit diverged; the change is relative to the design"]


def _of_the_ring(fitted: State) -> Iterator[str]:
    """Messages about the ring of the reference that are in no list of causes."""
    energy, where = fitted.at.errors.energy, EnergyOffset.variable
    if energy:
        there = linear(fitted, EnergyOffset.block)
        sigma = there.posterior.sigma[there.where[where]]
        if abs(energy) > SIGNIFICANT * sigma[0]:
            yield (
                f"its beam differs from the nominal energy by {energy:.2e} ± {sigma[0]:.0e} "
                "(relative), "
                "and the tunes are those there"
            )
    yield from dispersion_by_kicks(fitted.values, fitted.data)


def _by_good_monitors(
    ring: Ring, fitted: State, before: OrbitResponse, after: OrbitResponse, messages: list[str]
) -> tuple[ResponseData, ResponseData, Errors]:
    """Both measurements, and the errors of the first, without BPMs that are bad in the first."""
    errors = replace(fitted.at.errors, monitors=fitted.at.errors.monitors[fitted.good])
    if not fitted.good.all():
        names = np.array(fitted.data.measured.monitors)
        messages.append(
            f"BPMs that are bad in the reference, excluded: {', '.join(names[~fitted.good])}"
        )
        kept = names[fitted.good].tolist()
        before, after = (one.select(monitors=kept) for one in (before, after))
    first, second = (response_data(ring, one) for one in (before, after))
    return replace(first, orbits=fitted.data.orbits[:, fitted.good]), second, errors


def _fit_change(
    data: ResponseData, split: Split, trials: Sequence[Trial], progress: Callable[[str], Any]
) -> HierarchicalFit:
    """The fit of all possible changes, with the estimated noise of the difference."""
    design = replace(begin(data, split), guessed=ANY)
    trials = readable(design, trials)
    state = settle(bend(jump(rough_fit(design, trials, progress))))
    state = settle(_learnt_noise(state))
    design = _with_noise(design, state.data.noise)
    steps = steps_of(score(design, "reference"), state, trials)
    return HierarchicalFit(design, state, steps, decisions(data, trials, trials, {}))


def _learnt_noise(state: State) -> State:
    """The state with less noise where two measurements agree better than stated; if they agree
    less, the model discrepancy of each column grows."""
    scales = []
    data = state.data
    for block in (0, 1):
        left = (data.pick(state.at.left, block) / data.noise_of(block))[:-1]
        left = left[state.fitted[:-1]][:, state.good]
        left = left[np.isfinite(left)]
        scales.append(float(chi2.typical(left)) if len(left) else 1.0)
    lower = float(np.clip(max(scales), LEAST, 1.0))
    return _with_noise(state, lower * data.noise)


def _with_noise(state: State, noise: Array) -> State:
    data = replace(state.data, noise=noise)
    at = Predicted(data, state.at.errors, state.at.bent)
    return replace(state, data=data, at=at)


def _all_columns(state: State) -> State:
    """The fit with held-out correctors included."""
    return replace(state, split=_not_validated(state.split))


# --- drifts of BPMs and correctors, whose outliers are findings ----
def drifts(state: State) -> list[tuple[StatedCause, Support]]:
    """Return the changes of BPMs and correctors since the reference, with errors and support."""
    found: list[tuple[StatedCause, Support]] = []
    for block in (0, 1):
        own = {f.variable: f for f in state.of_block(block) if f.per != "ring"}
        if not own:
            continue
        there = with_undetermined(state, block)
        posterior = there.posterior
        values = {name: posterior.values[there.where[name]] for name in own}
        given = replace(state, values={**state.values, **values})
        found += with_support(given, own.values(), there, unwidened(posterior))
    return found


def outstanding(ring: Ring, changes: Sequence[StatedCause], judgement: Judgement) -> list[Finding]:
    """Return the findings: BPMs and correctors whose change is an outlier of the usual drift."""
    found = []
    for effect in dict.fromkeys(cause.effect for cause, _ in changes):
        rows = [row for row in changes if row[0].effect == effect]
        usual = float(chi2.typical([cause.amount for cause, _ in rows]))
        for cause, sigma in rows:
            size = abs(cause.amount)
            if size > max(DRIFT, OUTSTANDING * usual) and size > SIGNIFICANT * sigma:
                square = (size / max(sigma, 1e-12)) ** 2
                seen = Detection.among(square, len(rows))
                found.append(finding_of(ring, [cause], np.ones(1), sigma, seen, judgement.mass))
    return found


def is_drift(cause: Cause) -> bool:
    """Return whether a change of a BPM or a corrector is within the usual drift from day to day."""
    of_each = {name for trial in CHANGES for family in trial if family.per != "ring"
               for name in family.effects}  # fmt: skip
    return cause.effect in of_each and abs(cause.amount) <= DRIFT


# --- messages ---------------------------------------------------------------------------------
def _sparse_or_all(
    data: ResponseData,
    split: Split,
    trials: Sequence[Trial],
    options: Options,
    open_: Undetermined,
) -> SparseFit | HierarchicalFit:
    """The sparse solution of a change, or the fit of all possible changes."""
    asked = changes() if options.effects is None else options.effects
    sparse = sparse_fit(data, split, asked, options, and_orbits(data.ring, open_))
    if sparse is not None and all(is_drift(cause) for cause, _ in sparse.fitted_causes):
        sparse = None
    if sparse is not None and sparse.noise:
        return sparse
    fit = _fit_change(data, split, trials, options.progress)
    if sparse is None or outperforms(fit, sparse, options.judgement):
        return reversed_decisions(fit, options.progress)
    return sparse


def _verdict(state: State) -> str:
    group = state.groups.get(QuadrupoleGradient.name)
    return "distributed" if group is not None and group.rms > EVERYWHERE else "none"


def _messages(
    data: ResponseData, fit: HierarchicalFit, state: State, scatter: Mapping[str, float]
) -> list[str]:
    """Messages on the agreement of two measurements, and the scatter of magnets and supplies."""
    left = data.pick(state.at.left)[:-1][:, state.good]
    agree = 1e6 * float(chi2.typical(left))
    stated = 1e6 * float(np.median(data.noise))
    messages = [
        f"given the changes, the two measurements agree to {agree:.2g} µm (by their stated noise "
        f"{stated:.2g} µm are expected)"
    ]
    if scatter:
        size = scatter[QuadrupoleGradient.name]
        messages.append(
            f"magnets of one supply differ in their change by {size:.1g} (rms, relative), which is "
            f"in the errors; changes below {REPRODUCED:g} are ignored"
        )
    if size := scatter.get(FamilyGradient.name, 0.0):
        messages.append(
            f"other supplies changed, too, by {size:.1g} (rms, relative), which is in the errors: "
            "the readings do not determine which ones, nor by how much each"
        )
    return messages
