"""Checks of the BPMs' signals without a model: silent, frozen, copied, cut off."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.diagnosis.records import encoded, named
from tmlattice.errors import MeasurementError, first_of
from tmlattice.inference.judgement import DEFAULT
from tmlattice.lattice import Ring
from tmlattice.measurement import AnyMeasurement, Measurement, TuneReading
from tmlattice.measurement.lost_beam import FEWEST, LostBeam
from tmlattice.measurement.monitors import LARGEST_READING
from tmlattice.measurement.recorded import SENSIBLE
from tmlattice.measurement.shots import FEWEST as TURNS
from tmlattice.observe.noise import SAME_PLACE

CUT = FEWEST
"""Silent BPMs at the end of a shot from which on the beam counts as lost."""
HALF = 0.5
"""Share from which on all is wrong: of unknown names, of sections that follow no trajectory, of
constant signals, and of the readings of a signal that repeat the one before."""
STRAY = 0.02
"""Share of a turn's readings below which a turn far behind the others is a wrong number."""


Status = Literal["fine", "note", "wrong"]


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        name: what.
        status: "fine"; "note"; "wrong", with which no diagnosis is possible.
        sentence: the finding, and its correction.
        before, after: chi-square per reading as stated, and with what is assumed; None where there
            is none.
        assume: with which a diagnosis goes on, the first choice first.
    """

    name: str
    status: Status
    sentence: str
    before: float | None = field(default=None, metadata=named("chi2_before"))
    after: float | None = field(default=None, metadata=named("chi2_after"))
    assume: tuple[str, ...] = ()


def fine(name: str, sentence: str) -> Check:
    """A check that passed."""
    return Check(name, "fine", sentence)


def note(name: str, sentence: str, **more: Any) -> Check:
    """A check with a note."""
    return Check(name, "note", sentence, **more)


def wrong(name: str, sentence: str, **more: Any) -> Check:
    """A check that failed."""
    return Check(name, "wrong", sentence, **more)


def noted(name: str, sentence: str, otherwise: str) -> Check:
    """A check with a note; without a sentence it passed."""
    return note(name, sentence) if sentence else fine(name, otherwise)


@dataclass(frozen=True)
class Checkup:
    """All checks of a measurement.

    Attributes:
        kind: of the measurement, as its folder has it.
        checks: in their order.
        provenance: what made it.
    """

    kind: str
    checks: tuple[Check, ...]
    provenance: Mapping[str, Any]

    @property
    def status(self) -> Status:
        """The worst status."""
        found = {check.status for check in self.checks}
        return "wrong" if "wrong" in found else "note" if "note" in found else "fine"

    @property
    def reported(self) -> tuple[Check, ...]:
        """The checks that did not pass, the worst first."""
        order = ("wrong", "note")
        return tuple(c for status in order for c in self.checks if c.status == status)

    def stop(self, where: str = "") -> None:
        """Raise an error if a check failed.

        Args:
            where: the data, named before the sentences.

        Raises:
            MeasurementError: with the sentences.
        """
        bad = [check.sentence for check in self.checks if check.status == "wrong"]
        if bad:
            raise MeasurementError(where + "; ".join(bad))

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-check`, version 1 (see `schemas/`)."""
        return {
            "format": "tmlattice-check",
            "version": 1,
            "kind": self.kind,
            "status": self.status,
            "checks": encoded(self.checks),
            "provenance": dict(self.provenance),
        }


def not_reached(silent: Flags) -> Flags:
    """Which BPMs [monitor] follow a lost beam: the last ones that are silent [reading, monitor] in
    all readings, where a run of the last ones is in most; in beam order."""
    runs = np.cumprod(silent[~silent.all(axis=1), ::-1], axis=1)[:, ::-1].astype(bool)
    lost = len(runs) > 0 and np.median(runs.sum(axis=1)) >= CUT
    return np.asarray(runs.all(axis=0) & lost)


def one_plane(unread: str) -> str:
    """The message about a plane without readings."""
    return (
        f"no BPM reads {unread}: the orbit in {unread} is unknown, and errors that act in {unread} "
        "alone are not determined"
    )


def planes(read: Flags) -> Check:
    """Whether both planes were read, [2]."""
    if read.all():
        return fine("planes", "both planes were read")
    return note("planes", one_plane("xy"[int(read.argmin())]))


def monitors(ring: Ring, names: Sequence[str], values: Array, moved: bool = True) -> list[Check]:
    """Check for silent, frozen and copied BPMs.

    Args:
        ring: that they are of.
        names: of the monitors.
        values: readings, [reading, monitor, 2], m; NaN where missing.
        moved: the beam was another in each reading, so that not all of them can be alike.
    """
    there = np.isfinite(values)
    if not np.count_nonzero(values[there]):
        text = "every reading is zero: nothing was read; give the readings of a beam"
        return [wrong("frozen BPMs", text)]
    pairs = values[there.all(axis=2)]
    if len(pairs) > 1 and pairs.any() and (pairs[:, 0] == pairs[:, 1]).all():
        text = "x and y are the same to the last digit: one is a copy; give what was read in both"
        return [wrong("planes", text)]
    if moved and there.any(axis=(0, 1)).all():
        x, y = (float(np.median(np.abs(values[..., p][there[..., p]]))) for p in (0, 1))
        if max(x, y) > LARGEST_READING and min(x, y) < SENSIBLE / 10:
            text = (
                f"x and y are in different units: the typical reading is {x:.2g} m in x and {y:.2g}"
                " m in y; give both in metres"
            )
            return [wrong("planes", text)]
    checks = [planes(np.asarray(there.any(axis=(0, 1))))]
    silent = [
        n for n, own in zip(names, np.asarray(there.any(axis=(0, 2))), strict=True) if not own
    ]
    text = f"no reading of {first_of(silent)}" if silent else ""
    if len(silent) > DEFAULT.silent * len(names):
        text = f"{len(silent)} of {len(names)} BPMs have no reading; they are ignored"
    checks.append(noted("silent BPMs", text, f"each of {len(names)} BPMs has a reading"))
    many = there.sum(axis=0) > 2
    with np.errstate(invalid="ignore"):
        high = np.where(there, values, -np.inf).max(axis=0)
        low = np.where(there, values, np.inf).min(axis=0)
    again = (values[1:] == values[:-1]).sum(axis=0) > HALF * (len(values) - 1)
    stuck = many & ((high == low) | (again & (moved & (len(values) >= TURNS))))
    frozen = [
        n if both else f"{n} in {'x' if x else 'y'}"
        for n, (x, y), both in zip(names, stuck, stuck.all(axis=1), strict=True)
        if x or y
    ]
    if moved and stuck.sum() > HALF * max(int(many.sum()), 1):
        text = (
            f"{len(frozen)} of {len(names)} BPMs read the same in every shot and turn: one "
            "reading was copied over the others; give what was read each time"
        )
        checks.append(wrong("frozen BPMs", text))
    else:
        text = f"the same reading again and again: {first_of(frozen)}; leave the signal out"
        checks.append(noted("frozen BPMs", text if frozen else "", "no BPM is frozen"))
    copies = _copies(ring, names, values, stuck)
    text = f"the same readings, to the last digit, of {first_of(copies)}; one of them is a copy"
    return [*checks, noted("copied BPMs", text if copies else "", "no two BPMs read the same")]


def _copies(ring: Ring, names: Sequence[str], values: Array, stuck: Flags) -> list[str]:
    """Pairs of equal signals [monitor, plane], except of BPMs in one place."""
    seen: dict[bytes, tuple[str, float]] = {}
    found = []
    for m, name in enumerate(names):
        for plane in (0, 1):
            signal = values[:, m, plane]
            if stuck[m, plane] or not np.count_nonzero(np.nan_to_num(signal)):
                continue
            if np.isfinite(signal).sum() < 2:
                continue
            own = f"{name} in {'xy'[plane]}", ring[name].s
            other = seen.setdefault(signal.tobytes(), own)
            if other != own and abs(other[1] - own[1]) > SAME_PLACE:
                found.append(f"{other[0]} and {own[0]}")
    return found


def first_turns(ring: Ring, data: Measurement, lost: LostBeam[Measurement]) -> list[Check]:
    """Check first turns for invalid turn numbers and lost beams.

    Args:
        ring: the design.
        data: without the readings after a lost beam.
        lost: where these begin.
    """
    there = np.asarray(np.isfinite(data.readings).any(axis=3))  # [shot, turn, monitor]
    read = _turns(there)
    if read.status == "wrong":
        return [read]
    if len(lost.shots):
        return [read, note("lost beam", _no_signal(ring, lost))]
    count, turns = there.shape[2], there.shape[1]
    last = [np.flatnonzero(own.ravel()) for own in there]
    stops = [i for i, own in enumerate(last) if len(own) and own[-1] < turns * count - CUT]
    text = ""
    if stops:
        shot = stops[0]
        others = f"; so have {len(stops) - 1} others" if len(stops) > 1 else ""
        text = (
            f"shot {data.shots[shot]} has no reading behind {_place(ring, data, last[shot][-1])}"
            f"{others}: the beam was lost there, or the BPMs behind did not record; it is "
            "used up to there"
        )
    return [read, noted("lost beam", text, "every shot is read to its end")]


def _no_signal(ring: Ring, lost: LostBeam[Measurement]) -> str:
    """The message where the beam was lost, by constant readings."""
    data, shots = lost.without, lost.shots
    ends = sorted(set(lost.last[shots].tolist()))
    names = [_place(ring, data, end) if end >= 0 else "the start" for end in ends]
    where = f"after {names[0]}" if len(ends) == 1 else f"between {names[0]} and {names[-1]}"
    number = len(data.shots)
    which = "every shot" if len(shots) == number else f"{len(shots)} of {number} shots"
    return (
        f"no signal: beam lost {where}"
        + (f" in {which}" if number > 1 else "")
        + (" (or the other shots are differences from this one)" if ends[0] < 0 else "")
        + "; the BPMs read a constant from there on, and these readings are rejected"
    )


def _place(ring: Ring, data: Measurement, reading: int) -> str:
    """A reading's BPM, with its turn where there are several."""
    turn, monitor = divmod(int(reading), len(data.monitors))
    element = ring[data.monitors[monitor]]
    on = f" on turn {turn}" if data.readings.shape[1] > 1 else ""
    return f"{element.name} (s = {element.s:.2f} m){on}"


def _turns(there: Flags) -> Check:
    """The check for turns far behind the others with few readings."""
    count = there.sum(axis=(0, 2))
    read = np.flatnonzero(count)
    full = count.max()
    gaps = [i for i in range(1, len(read)) if read[i] - read[i - 1] > 1]
    if gaps and count[read[gaps[0] :]].max() < max(STRAY * full, 1.5):
        first, last = read[gaps[0] - 1], read[gaps[0]]
        return wrong(
            "turns",
            f"nothing was read between turn {first} and turn {last}, which has {count[last]} of "
            f"{full} readings: a wrong number in the column 'turn'; correct that row",
        )
    turns = f"turns {read[0]} to {read[-1]} were" if len(read) > 1 else f"turn {read[0]} was"
    return fine("turns", f"{turns} read")


def few(ring: Ring, data: AnyMeasurement) -> Check | None:
    """The check for too few BPMs."""
    if not ring.monitors and not isinstance(data, TuneReading):
        return wrong(
            "monitors", f"'{ring.name}' has no BPM; name those elements of the lattice that "
            "are BPMs",
        )  # fmt: skip
    if isinstance(data, Measurement):
        read = int(np.isfinite(data.readings).any(axis=(0, 1, 3)).sum())
        if read < 2:
            return wrong(
                "monitors", f"{read} BPM was read; a trajectory needs two BPMs at least, and "
                "more for a diagnosis: read more",
            )  # fmt: skip
    return None
