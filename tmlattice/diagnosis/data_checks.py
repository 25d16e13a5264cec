"""The data checks: errors of a measurement as a whole, before any search for faults.

>>> checkup = check_data(load_ring("petra3"), read_measurement("day_1"))
>>> [check.sentence for check in checkup.reported]

Global errors come first, by the same search in every kind of measurement: a wrong sign, unit or
order is reported with its correction and with the assumption that continues without it. Of first
turns launches, noise and single readings follow.

BPMs and correctors of a measurement that are not in the lattice. A control room reads more than its
lattice file has, such as a BPM in a transfer line. Such channels are rejected, with a note. If most
names are unknown, the names or the lattice are wrong: the first one raises an error. So does a
magnet in the place of a BPM.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, rms
from tmlattice.beam.rf import speed_of
from tmlattice.by_name import by_name
from tmlattice.diagnosis import signals
from tmlattice.diagnosis.response.first_guess import BETTER, elsewhere
from tmlattice.diagnosis.signals import HALF, Check, Checkup, fine, note, wrong
from tmlattice.effects import Cause, expected_radiation
from tmlattice.errors import (
    MeasurementError,
    TmlatticeError,
    TooFewTurnsError,
    UnknownNameError,
    first_of,
)
from tmlattice.inference.judgement import FEW, MISSTATED, SIGNIFICANT
from tmlattice.lattice import Ring
from tmlattice.measurement import (
    AnyMeasurement,
    Dispersion,
    Measurement,
    OrbitResponse,
    TuneReading,
    TurnByTurn,
)
from tmlattice.measurement.assume import ASSUMPTIONS, assume, in_beam_order, is_unit, read_of
from tmlattice.measurement.kinds import KINDS, STORED
from tmlattice.measurement.lost_beam import beam_lost, exact
from tmlattice.measurement.monitors import Names
from tmlattice.measurement.recorded import recorded
from tmlattice.observe.compared import (
    ANOTHER,
    Compared,
    OfColumns,
    compared,
    names_of_others,
)
from tmlattice.observe.global_errors import CERTAIN, OfTurns, Search, Verdict
from tmlattice.observe.noise import PASSES, noise_scatter
from tmlattice.observe.response_data import response_data
from tmlattice.observe.sections import Passes, SectionFits
from tmlattice.observe.spoilt import SPOILT, without_spoilt

ENERGY = 0.02
"""Share by which a stated beam energy may differ from the lattice's."""
CIRCUMFERENCE = 1e-3
"""Relative difference between the length by the RF and the lattice's; eight real rings have 4e-5 at
most, and a wrong harmonic number of 1000 makes it."""
ALIEN = 0.85
"""Share of the orbit that no trajectory of a section explains from which on the data belong to
another ring. Noise or readings in no order leave all of it, strong distributed errors 0.7."""
RESOLVED = 0.45
"""The same where signs, units or order were corrected, which another order changes by chance: at
least 0.49 is left then, of the right one 0.37 at most in seven rings."""
STRANGE = 0.4
"""Share of the orbit that a section leaves, from which a BPM may have another's name: where the
phase of a machine runs off its design's, sections leave 0.37 at most."""
CORRECTED = 0.1
"""Misfit of the typical column with wrong signs, units or order corrected, from which on the
lattice may be wrong."""
FAR = 100.0
"""Square of the sigma by which launches may differ from the stated ones, by
benchmarks/data_checks.py."""
FACTOR = 1.2
"""Ratio of all fitted to all stated launches, or its inverse, from which it is stated."""
EXACT = 0.01
"""Share of the launches that gains of the first BPMs change."""
NOTHING_FROM, SURE, NO_BEAM = 2, 4, 0.75
"""Sections at the end that follow no trajectory, from which on the beam may be lost, and is: a few
swapped BPMs spoil less; the share of their readings that is left then, of noise 0.9."""
UNSPOILT = {"shots": "no shot is unlike the others", "outliers": "no reading is an outlier"}
GLOBAL = "signs, units and order"
MOST_ERRORS = 4
"""Global errors of one measurement at most."""


@by_name
def check_data(
    ring: Ring,
    data: AnyMeasurement,
    *,
    assumed: Sequence[str] = (),
    radiation: bool = False,
) -> Checkup:
    """Return the checks of a measurement as a whole.

    Args:
        ring: the design.
        data: of any kind.
        assumed: what is recorded wrongly, names of `ASSUMPTIONS`; it is undone first.
        radiation: the model radiates as expected.

    Raises:
        MeasurementError: an assumption without meaning for these data.
        UnknownNameError: an unknown assumption, or names that mostly are not the lattice's.
    """
    from tmlattice import __version__

    begun = time.perf_counter()
    data, absent = in_the_lattice(ring, data)
    names = [monitor.name for monitor in ring.monitors]
    data, cut = recorded(data, names)
    checks = [*(note("names", sentence) for sentence in absent),
              *(note("recording", sentence) for sentence in cut)]  # fmt: skip
    if signals.few(ring, data) is None:
        data = assume(in_beam_order(data, names), assumed, names)
        if isinstance(data, Measurement):
            data, spoilt = without_spoilt(ring, data)
            checks += [note(name, spoilt[name]) if name in spoilt else fine(name, text)
                       for name, text in UNSPOILT.items()]  # fmt: skip
    checks += _whole(ring, data, radiation)
    kind = next(name for name, own in KINDS.items() if isinstance(data, own.record))
    provenance = {
        "package": __version__,
        "lattice": ring.name,
        "measurement": None,
        "options": {"assume": list(assumed), "radiation": radiation and kind not in STORED},
        "seconds": time.perf_counter() - begun,
    }
    return Checkup(kind, tuple(checks), provenance)


def _whole(ring: Ring, data: AnyMeasurement, radiation: bool, problem: Any = None) -> list[Check]:
    """The checks of data without readings that are rejected; `problem` has the lines of turns."""
    checks = [_stated(ring, data), *_period(ring, data)]
    if (few := signals.few(ring, data)) is not None:
        return [*checks, few]
    if isinstance(data, Measurement):
        known = expected_radiation(ring) if radiation else ()
        return [*checks, *_of_first_turns(ring, data, known)]
    data = in_beam_order(data, [monitor.name for monitor in ring.monitors])
    return [*checks, *_of_compared(ring, data, problem)]


_REPORTED = ("energy", "copied BPMs", "lost beam", GLOBAL, "launches")
"""Notes that the diagnosis does not find by itself."""


def data_checks(
    ring: Ring,
    data: AnyMeasurement,
    radiation: bool = False,
    reference: Measurement | OrbitResponse | None = None,
    problem: Any = None,
) -> list[str]:
    """The notes on these data, and on a reference, for a diagnosis: without what is rejected
    before, see `check_data`.

    Args:
        ring: the design.
        data: of any kind.
        radiation: see `check_data`.
        reference: of the same kind.
        problem: of turns, with their spectral lines; None: they are fitted here.

    Raises:
        MeasurementError: a check failed.
    """

    both = [
        Checkup("", tuple(_whole(ring, one, radiation, problem)), {})
        for one in (data, reference) if one is not None
    ]  # fmt: skip
    notes = [[check.sentence for check in one.reported if check.name in _REPORTED] for one in both]
    if reference is None:
        both[0].stop()
        return notes[0]
    wrong, as_wrong = ({c.name for c in one.checks if c.status == "wrong"} for one in both)
    alone = "{} alone (correct its file; --assume applies to both): "
    both[0].stop("" if wrong <= as_wrong else alone.format("the second measurement"))
    both[1].stop(alone.format("the reference"))
    text, reported = notes
    return text + [f"the reference: {sentence}" for sentence in reported if sentence not in text]


Some = TypeVar("Some")


def corrected_data(ring: Ring, data: Some, assumed: Sequence[str]) -> Some:
    """The data with the assumed errors corrected, if there are any."""
    if data is None or not assumed:
        return data
    return assume(data, assumed, [monitor.name for monitor in ring.monitors])


def _stated(ring: Ring, data: AnyMeasurement) -> Check:
    """The check of the stated lattice and energy."""
    if data.energy is None:
        return fine("energy", "the data state no energy")
    if abs(data.energy / ring.energy - 1) > ENERGY:
        return note(
            "energy", f"the data state a beam energy of {data.energy:g} GeV, the lattice "
            f"{ring.energy:g}: name this machine's lattice, or its energy (`energy` in "
            "tmlattice.toml)",
        )  # fmt: skip
    return fine("energy", f"{data.energy:g} GeV, as the lattice has it")


def _period(ring: Ring, data: AnyMeasurement) -> list[Check]:
    """The check of the RF's frequency and harmonic against the lattice's length."""
    steps = data.steps if isinstance(data, Dispersion) else (getattr(data, "rf", None),)
    if (rf := steps[0]) is None:
        return []
    length = rf.harmonic * speed_of(ring) / rf.frequency
    text = f"the RF of {rf.frequency:g} Hz with harmonic {rf.harmonic:g}"
    if abs(length / ring.length - 1) < CIRCUMFERENCE:
        return [fine("RF", f"{text} fits the length of '{ring.name}'")]
    return [wrong(
        "RF", f"{text} belongs to a circumference of {length:.6g} m, and '{ring.name}' has "
        f"{ring.length:.6g} m: correct the frequency, the harmonic or the lattice",
    )]  # fmt: skip


AnySearch = TypeVar("AnySearch", bound=Search)


def _global(searched: AnySearch) -> tuple[list[Check], AnySearch]:
    """One check for each global error, one after another, each with those before it corrected; and
    the search with all of them corrected."""
    checks: list[Check] = []
    while len(checks) < MOST_ERRORS and (own := searched.verdict()) is not None:
        checks.append(_sentence(searched, own))
        searched = searched.corrected(own.names)
    return checks or [fine(GLOBAL, "no global error would improve the agreement")], searched


def _sentence(searched: Search, verdict: Verdict) -> Check:
    words = _words(verdict.names)
    others = "; ".join(f"or {_words(own)}: {_options(own)}" for own in verdict.alike)
    corrections = ", ".join(dict.fromkeys(ASSUMPTIONS[n].correction for n in verdict.names))
    before, after = (searched.shown(own) for own in (verdict.before, verdict.after))
    sure = verdict.worth > CERTAIN or isinstance(searched, Compared)
    text = (
        f"{words if sure else f'possibly {words}'}{f' ({others})' if others else ''}: "
        f"{verdict.of} {before} with the data as given, {after} with that corrected; "
        f"{corrections}, or go on with {_options(verdict.names)}"
    )
    chi2 = (verdict.before, verdict.after) if isinstance(searched, OfTurns) else (None, None)
    make = wrong if sure else note
    return make(GLOBAL, text, before=chi2[0], after=chi2[1], assume=verdict.names)


def _words(names: Iterable[str]) -> str:
    return " and ".join(ASSUMPTIONS[name].words for name in names)


def _options(names: Iterable[str]) -> str:
    return " ".join(f"--assume {name}" for name in names)


# --- first turns ----------------------------------------------------------------------------------
def _of_first_turns(ring: Ring, data: Measurement, known: Sequence[Cause]) -> list[Check]:
    lost = beam_lost(data)
    data = lost.without
    flat = data.readings.reshape(-1, len(data.monitors), 2)
    reached = ~signals.not_reached(np.asarray(np.isnan(flat).all(axis=2)))
    flat = flat[:, reached]
    names = [name for name, there in zip(data.monitors, reached, strict=True) if there]
    again = len(flat) > 1 and np.array_equal(flat, np.broadcast_to(flat[:1], flat.shape), True)
    moved = bool(np.ptp(data.launches, axis=0).any()) or any(data.settings)
    moved |= again and not exact(data)  # noise is another in each reading
    checks = [
        *signals.monitors(ring, names, flat, moved), *signals.first_turns(ring, data, lost)
    ]  # fmt: skip
    if any(check.status == "wrong" for check in checks):
        return checks  # nothing can be fitted to such turns
    errors, checked = _global(OfTurns(ring, data, known))
    passes, found = checked.found(checked.data)
    if lost_too := _no_beam(ring, checked, passes, found):
        return [*checks, *errors, *lost_too]
    corrected = any(check.status != "fine" for check in errors)
    lattice = _lattice(ring, checked, passes, found, RESOLVED if corrected else ALIEN)
    if lattice.status == "wrong":  # no wrong sign, unit or order explains that
        return [*checks, lattice]
    checks += [*errors, lattice]
    if all(check.status != "wrong" for check in checks):
        checks += _order(checked, passes, found)
    if any(check.status == "wrong" for check in checks):
        # noise and launches have no meaning before that is corrected, but the unit of the latter
        units = any(is_unit(name) for check in errors for name in check.assume)
        if units and (size := _launches(checked)).status == "wrong":
            checks.append(size)
        return checks
    return [*checks, _launches(checked), _noise(checked, passes, found)]


def _lattice(
    ring: Ring, checked: OfTurns, passes: Passes, found: SectionFits, most: float
) -> Check:
    """The check whether the readings follow trajectories of this ring."""
    share = found.share(passes)
    if not np.isfinite(share):
        return fine("lattice", "too few BPMs to decide whether this is the machine's lattice")
    stated = checked.data.noise is not None
    if share > most and not (stated and found.level < 4):
        return wrong(
            "lattice",
            f"the readings follow no trajectory of '{ring.name}': {100 * share:.0f} % of the orbit "
            "is unexplained even between neighbouring BPMs; name the lattice of this machine, and "
            "check the names and the order of the BPMs",
            before=found.level if stated else None,
        )
    return fine("lattice", f"the readings follow trajectories of '{ring.name}'")


def _order(checked: OfTurns, passes: Passes, found: SectionFits) -> list[Check]:
    """The check for BPMs with the names of others, whose sections follow no trajectory."""
    read, made = checked.predicted()
    if len(read) < FEW:
        return []
    names = checked.data.monitors
    text, moved = names_of_others("BPM", names, *(np.moveaxis(v, 1, 0) for v in (read, made)))
    strange = found.shares(passes)[0] > STRANGE
    there = text and np.isin(found.owner[strange], moved).any()
    return [wrong("order", text)] if there else []


def _no_beam(ring: Ring, checked: OfTurns, passes: Passes, found: SectionFits) -> list[Check]:
    """The check for readings behind a lost beam: the last sections of all shots, or of some, follow
    nothing."""
    if passes.turn.any():
        return []
    together, *each = (_follows_nothing(own) for own in found.shares(passes))
    # noise alone leaves less than a half of one section by chance, of two hardly
    lost = [own for own in each if len(own) and own[0] >= NOTHING_FROM]
    which = f"at least {len(lost)} of {len(each)} shots"
    if len(each) > 1 and len(together) and not any(own[0] < together[0] for own in lost):
        lost, which = [together] * len(each), "any shot"
    if not lost:
        return []
    sections, behind = sum(len(own) for own in lost), np.sort([own[0] for own in lost])
    ends = [ring[checked.data.monitors[found.owner[section, 0]]] for section in behind[[0, -1]]]
    where = " and ".join(f"{end.name} (s = {end.s:.2f} m)" for end in dict.fromkeys(ends))
    make = wrong if sections >= SURE else note
    return [make(
        "lost beam",
        f"from {'a place between ' if len(set(ends)) > 1 else ''}{where} on the readings follow no "
        f"trajectory in {which}, and before they do: the beam was lost, or these BPMs have other "
        "names; leave their readings out, or correct the names",
    )]  # fmt: skip


def _follows_nothing(shares: Array) -> NDArray[np.intp]:
    """The last sections that follow no trajectory, by their shares [section]; none, if those before
    do not either."""
    read = np.flatnonzero(np.isfinite(shares))
    if not len(read):
        return read
    strange = np.cumsum(np.log(np.maximum(shares[read], 1e-9) / HALF)[::-1])[::-1]
    behind = read[strange.argmax() :]
    left = rms(shares[behind])
    lost = NOTHING_FROM <= len(behind) < len(read) and left > NO_BEAM
    return behind if lost else read[:0]


def _launches(checked: OfTurns) -> Check:
    """The check of the stated launches against fitted ones."""
    square = max(checked.square([()]), 1.0)
    data = checked.data
    if data.launch_sigma is None or np.isinf(data.launch_sigma[:, :4]).all():
        return fine("launches", "no launch is stated; they are fitted")
    own, changes, misfit, ratio = checked.launches(square, EXACT)
    sections = checked.found(data)[1].misfit
    if sections.shape[1] < FEW:
        return fine("launches", "too few BPMs to check the launches")
    free = "or go on with --assume launches-unknown"
    # else a fault of the first magnets biases the fit
    good = misfit < SPOILT * max(square, float(np.median(sections)))
    unlike, beyond = changes[:, good].max(axis=2)
    usual, most = float(np.median(unlike)) if good.any() else 0.0, SIGNIFICANT**2
    scaled = (usual > most) & (np.maximum(ratio, 1 / ratio) > FACTOR)
    alone = unlike > max(most, MISSTATED**2 * usual)
    contradict = (beyond > most).any() and (usual > most or alone.any())
    if good.sum() > FEW and (contradict or scaled.any()):
        which, size = "of every shot", usual
        if usual < most:
            ids = ", ".join(str(data.shots[i]) for i in np.flatnonzero(good)[alone])
            which, size = f"of shot {ids}", float(unlike[alone].min())
        times = " and ".join(f"{ratio[p]:.2g} times these in {'xy'[p]}"
                             for p in np.flatnonzero(scaled))  # fmt: skip
        if times:
            times = f", being {times} (is that the unit or size of the readings?)"
        return wrong(
            "launches",
            f"the fitted launches {which} differ from the stated ones by {np.sqrt(size):.0f} of "
            "their launch_sigma, "
            f"each in another way{times}: correct these launches (are they of these shots?) or "
            f"their rms, {free}",
            before=usual, assume=("launches-unknown",),
        )  # fmt: skip
    good = misfit < SPOILT * square
    if not good.any():
        return fine("launches", "too few good BPMs near the start to check the launches")
    worst = float(np.median(own[good], axis=0).max())
    if worst > FAR:
        return note(
            "launches",
            f"the fitted launches differ from the stated ones by {np.sqrt(worst):.0f} of their "
            "launch_sigma, unless there is a fault before the first BPMs: correct the launches "
            f"or their rms, {free}",
            before=worst, assume=("launches-unknown",),
        )  # fmt: skip
    return fine("launches", "the fitted launches are the stated ones")


def _noise(checked: OfTurns, passes: Passes, found: SectionFits) -> Check:
    """The check of the stated noise against the residuals between neighbouring BPMs."""
    level = float(np.sqrt(found.level))
    if not np.isfinite(level):
        return fine("noise", "too few BPMs to check the noise")
    typical = float(np.median(passes.sigma))
    if checked.data.noise is None:
        return fine("noise", f"none is stated; the residuals are {_micro(level * typical)}")
    small = level < 1 / MISSTATED
    random = None if small else noise_scatter(passes, found)
    if small or (random is not None and random > MISSTATED):
        text = (
            f"the stated noise of {_micro(typical)} is {1 / level:.1f} times the residuals "
            f"between neighbouring BPMs ({_micro(level * typical)}; chi-square per reading "
            f"{level**2:.2g})"
        )
        if random is not None:
            text = (
                f"the stated noise of {_micro(typical)} is too small: from shot to shot the "
                f"readings scatter by {_micro(random * typical)} about the trajectories that their "
                f"neighbours follow (chi-square per reading {level**2:.3g})"
            )
        return wrong(
            "noise", f"{text}: state the noise of one reading, or go on with --assume "
            "noise-from-data", before=level**2, after=1.0, assume=("noise-from-data",),
        )  # fmt: skip
    text = f"{_micro(typical)} is stated, neighbouring BPMs show {_micro(level * typical)}"
    if level <= MISSTATED:
        return fine("noise", text)
    if random is None:
        return note(
            "noise", f"{text}: the noise is larger than stated, or distributed errors are as "
            f"large; {len(checked.data.shots)} shots do not show which: take {PASSES} or more",
        )  # fmt: skip
    return fine(
        "noise", f"{_micro(typical)} is stated, and the scatter from shot to shot is no larger; "
        f"neighbouring BPMs show {_micro(level * typical)}, the same or in proportion in all "
        "shots: errors of the machine",
    )  # fmt: skip


def _micro(metres: float) -> str:
    return f"{1e6 * metres:.3g} µm"


# --- what is compared with the design's -----------------------------------------------------------
def _of_compared(ring: Ring, data: AnyMeasurement, problem: Any = None) -> list[Check]:
    checks: list[Check] = []
    if isinstance(data, TurnByTurn):
        data = beam_lost(data).without
    if not isinstance(data, TuneReading):
        values = read_of(data).reshape(-1, len(data.monitors), 2)
        moved = isinstance(data, OrbitResponse | TurnByTurn)
        checks = signals.monitors(ring, data.monitors, values, moved)
    if any(check.status == "wrong" for check in checks):
        return checks
    try:
        search = compared(ring, data, problem)
        checks += [note("lines", sentence) for sentence in search.warnings]
        checks += [fine("tunes", sentence) for sentence in search.tunes]
        errors, checked = _global(search)
        left = checked.misfit()
    except (MeasurementError, TooFewTurnsError) as error:
        return [*checks, wrong("data", str(error))]
    if not np.isfinite(left).any():
        text = "one orbit is the sum of all errors: it shows neither signs nor the order of BPMs"
        return [*checks, fine(GLOBAL, text)]
    typical = float(np.nanmedian(left))
    sizes = checked.sizes() if isinstance(checked, OfColumns) else []
    more = [wrong("size", sentence) for sentence in sizes]
    found = [check for check in errors if check.status == "wrong"]
    if not found:
        order = [wrong("order", sentence) for sentence in checked.other_order()]
        if order:
            return [*checks, *more, *order]
    if isinstance(data, OrbitResponse) and typical > (CORRECTED if found else ANOTHER):
        guess = None
        with suppress(TmlatticeError):  # reported elsewhere
            guess = elsewhere(response_data(ring, data))
        if guess is not None and guess.left < BETTER * typical:
            far = note(
                "lattice",
                f"the lattice of '{ring.name}' is far from the ring that was measured, which it "
                f"resembles with all focusing quadrupoles changed by {100 * guess.focusing:+.0f} % "
                f"and all defocusing ones by {100 * guess.defocusing:+.0f} %; signs and the order "
                "of the data are not checked",
            )
            # a wrong unit shows with any lattice
            units = [own for own in found if all(map(is_unit, own.assume))]
            return [*checks, *units, *more, far]
    text = f"{search.of} {search.shown(typical)}"
    if typical > ANOTHER and not more:  # no wrong sign, unit or order explains that
        return [*checks, wrong(
            "lattice",
            f"the data are not those of '{ring.name}': {text}; name the lattice of this machine, "
            "and check the names and the order of BPMs and correctors",
        )]  # fmt: skip
    return [*checks, *errors, *more, fine("lattice", text)]


MEANT = "did you mean"
"""Phrase in the message about a misspelt name."""


def in_the_lattice(ring: Ring, measured: Some) -> tuple[Some, list[str]]:
    """The measurement without BPMs and correctors that are not in the lattice, and a sentence for
    each kind left out.

    Args:
        ring: the design.
        measured: of any kind.

    Raises:
        UnknownNameError: more than half of the monitors, or of the correctors, are not there.
    """
    own: Any = measured
    messages: list[str] = []
    if not ring.monitors:
        return measured, messages  # nothing can be read there; reported elsewhere
    monitors = Names("BPM", (monitor.name for monitor in ring.monitors))
    for what, kept, find in (
        ("BPMs", "monitors", monitors.__getitem__), ("correctors", "correctors", ring.index),
    ):  # fmt: skip
        names = getattr(own, kept, ())
        unknown = [n for n in names if monitors.find(n) is None and _hint(ring.index, n)]
        if not unknown:
            continue
        fix = _hint(find, unknown[0])
        if len(unknown) > HALF * len(names):
            raise UnknownNameError(
                f"{len(unknown)} of {len(names)} {what} are not in the lattice: {fix}"
            )
        own = own.select(**{kept: [name for name in names if name not in unknown]})
        typed = MEANT in fix and len(unknown) == 1
        messages.append(
            f"not in the lattice, and left out: {len(unknown)} of {len(names)} {what} "
            f"({first_of(unknown)})" + (f"; {fix.partition('; ')[2]}" if typed else "")
        )
    return own, messages


def _hint(find: Callable[[str], object], name: str) -> str:
    """The message about an unknown name; empty of a known one."""
    try:
        find(name)
    except UnknownNameError as error:
        return str(error)
    return ""
