"""Cases with a withheld cause: AT is the real machine, every case has its own random numbers."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from tmlattice.arrays import Array, Flags
from tmlattice.batch import fingerprint
from tmlattice.challenge.case import (
    CONTENTS,
    LEARNT,
    RECORDS,
    SET,
    TIERS,
    Case,
    Truth,
    case_names,
    read_set,
    ring_of,
    write_case,
)
from tmlattice.challenge.draw import Draw
from tmlattice.challenge.kinds import (
    TIER_KINDS,
    CaseSettings,
    Ruler,
    kinds_case,
    measure,
    quiet_problem,
)
from tmlattice.challenge.unknown import DISCRETE, LARGEST, Unknown, clean_readings
from tmlattice.effects import Cause, Settings, background_rms, find, modelled, monitors_with, names
from tmlattice.errors import TmlatticeError, UnstableRingError, unknown_choice
from tmlattice.files import output_file, write_json
from tmlattice.input_files import json_of
from tmlattice.lattice import Ring
from tmlattice.lattice.load import contents
from tmlattice.machine import Machine, Shots, draw_background, draw_shots
from tmlattice.machine.shots import stream
from tmlattice.machine.simulate import measured
from tmlattice.measurement import AnyMeasurement, Measurement

SIGNAL = (5.0, 100.0)
"""Signal to noise, log-uniform."""

AMPLITUDE = (1e-3, 3e-3)
NOISE = (5e-6, 5e-5)

SET_CORRECTORS = 4
"""Random correctors that are set in every case, independently of the fault, so that wrong kicks and
rolls are visible."""

SET_KICK = (2e-5, 5e-5)

HELD_OUT = 2


def make(
    tier: str,
    cases: int,
    seed: int,
    folder: Path,
    *,
    lattice: str = "petra3",
    reference: bool = False,
    learnt: bool = False,
    correctors: int | None = None,
    shots: int = 4,
    effects: Sequence[str] | None = None,
    amount: float | None = None,
    signal: tuple[float, float] = SIGNAL,
    background: str | Mapping[str, float | None] | None = None,
    known_rms: bool = False,
    kinds: Sequence[str] = (),
    progress: bool = True,
) -> dict[str, int]:
    """Make a challenge; existing cases are kept.

    Args:
        tier: A one effect; B one effect among distributed errors; C two or three; D one that the
            catalogue does not contain; E none. Those are in first turns; R is one effect in an
            orbit response, T in turns of a stored beam, M in two or three kinds together, P a
            change between two measurements of one machine.
        reference: tier B, with a measurement from before the fault.
        learnt: tier B, with an orbit response from before the fault, whose diagnosis is the prior
            of the case's. A machine that stores no beam has none, and is diagnosed without.
        correctors: number of correctors of that response, evenly along the ring; None: all.
        shots: of first turns and kicks of a stored beam; of the fit, two more are held out.
        effects: draw from these alone.
        amount: of the effect, of random sign, instead of a random signal to noise.
        background: tiers of kinds and tier B, rms of the distributed errors by effect (None: the
            catalogue's); default in tiers B and P: every usual one.
        known_rms: the diagnosis is given these rms; else it estimates them.
        kinds: of measurement, for tiers E, M and P; of M two or three are drawn.

    Returns:
        How often each effect was drawn without reaching the smallest signal to noise.

    Raises:
        TmlatticeError: another tier, or a folder of another challenge.
    """
    if tier not in TIERS:
        raise unknown_choice("tier", tier, TIERS)
    kinds = _kinds(tier, kinds)
    if reference and tier != "B":
        raise TmlatticeError("a reference is for tier B; leave --reference out")
    if learnt and (tier != "B" or reference or known_rms):
        raise TmlatticeError(
            "--learnt is for tier B, without --reference or known rms; leave --learnt out"
        )
    if background and tier != "B" and not kinds:
        raise TmlatticeError(
            "distributed errors are for tier B and for those of kinds; leave --background out"
        )
    if known_rms and "orbit_response" in kinds:
        raise TmlatticeError(
            "an orbit response determines those rms by itself; leave known_rms out"
        )
    if correctors is not None and not learnt:
        raise TmlatticeError("correctors are those of a learnt response; give --learnt too")
    everywhere = background or ({"all": None} if tier in ("B", "P") else {})
    rms = background_rms(everywhere) if everywhere else {}
    chosen = names(effects)
    ring = ring_of(lattice)
    public = {
        "format": SET,
        "version": 1,
        "tier": tier,
        "lattice": lattice,
        CONTENTS: fingerprint(contents(ring)),
        "reference": reference,
        "shots": shots,
        "effects": None if effects is None else chosen,
        "amount": amount,
        "signal": list(signal),
        "background": rms,
    }
    if tier == "B" or kinds:
        public["known_rms"] = known_rms
    if learnt:
        public[LEARNT] = True
    if correctors is not None:
        public["correctors"] = correctors
    if kinds:
        public["kinds"] = list(kinds)
    _begin(folder, public, seed)
    asked = CaseSettings(
        tier, lattice, ring, seed, kinds, tuple(chosen) if effects else None, shots, signal, amount,
        rms, known_rms,
    )  # fmt: skip
    unreachable: Counter[str] = Counter()
    there = set(case_names(folder))
    for number in tqdm(range(cases), unit="case", disable=None if progress else True):
        name = f"{number:04d}"
        if name in there:
            continue
        if kinds:
            case, truth, lost = kinds_case(asked, number, name)
        else:
            drawn = CaseDraw(asked, number, reference)
            case, truth = drawn.make(name)
            if learnt:
                case = _learnt_before(case, drawn, correctors)
            lost = drawn.draw
        write_case(folder, case, truth)
        unreachable.update(effect for effect, _, _ in lost.unreachable)
    made = {"seed": seed, "cases": cases, "unreachable": dict(unreachable)}
    with output_file(folder / "truth" / "made.json") as path:
        write_json(path, {"format": "tmlattice-challenge-made", "version": 1, **made})
    return dict(unreachable)


def _learnt_before(case: Case, drawn: "CaseDraw", correctors: int | None) -> Case:
    """Add the orbit response of the case's machine without the fault, in usual noise; nothing if
    that machine stores no beam."""
    own: dict[str, Any] = {"machine_seed": drawn.seed, "seed": drawn.seed + 2}
    own["background"] = drawn.background
    if correctors is not None:
        own["correctors"] = evenly(drawn.ring, correctors)
    try:
        response = measure("orbit_response", drawn.ring, (), 1.0, drawn.asked.shots, **own)
    except UnstableRingError:
        return case
    return replace(case, parts={**case.parts, LEARNT: response})


def evenly(ring: Ring, count: int) -> list[str]:
    """Return correctors of a ring, evenly along it in each plane, half of each if possible;
    TmlatticeError: the ring has fewer."""
    planes = [[e.name for e in ring.elements if e.kind == kind]
              for kind in ("hcorrector", "vcorrector")]  # fmt: skip
    first, second = (len(own) for own in planes)
    if count > first + second:
        raise TmlatticeError(f"'{ring.name}' has {first + second} correctors, no {count}")
    share = min(max(count - count // 2, count - second), first)
    chosen = {
        own[i * len(own) // some]
        for own, some in zip(planes, (share, count - share), strict=True) for i in range(some)
    }  # fmt: skip
    return [e.name for e in ring.elements if e.name in chosen]


def _kinds(tier: str, asked: Sequence[str]) -> tuple[str, ...]:
    """Measurements of a tier; () of first turns."""
    if not asked:
        return TIER_KINDS.get(tier, ())
    if tier not in "EMP":
        raise TmlatticeError("kinds are chosen for tiers E, M and P; leave --kind out")
    for kind in asked:
        if kind not in RECORDS:
            raise unknown_choice("kind", kind, RECORDS)
    if tier == "M" and len(set(asked)) < 2:
        raise TmlatticeError("tier M is of kinds together; name at least two of them")
    return tuple(dict.fromkeys(asked))


def _begin(folder: Path, public: Mapping[str, Any], seed: int) -> None:
    """Make the folder of a new challenge, or check that of the same one."""
    if (folder / "challenge.json").exists():
        described = read_set(folder)
        if {CONTENTS: public[CONTENTS], **described} != public or _seed(folder) not in (None, seed):
            raise TmlatticeError(f"'{folder}' contains another challenge; name another folder")
        return
    folder.mkdir(parents=True, exist_ok=True)
    with output_file(folder / "challenge.json") as path:
        write_json(path, public)


def _seed(folder: Path) -> int | None:
    """Seed of a challenge, if recorded."""
    try:
        made = json_of(folder / "truth" / "made.json", TmlatticeError)
        return int(made["seed"])
    except (TmlatticeError, ValueError, LookupError, TypeError):
        return None


class CaseDraw:
    """One case, drawn from its own random numbers."""

    def __init__(self, asked: CaseSettings, number: int, reference: bool = False) -> None:
        self.asked, self.ring, self.number = asked, asked.ring, number
        self.effects = names(asked.effects)
        self.random = random = stream(asked.seed, "challenge", asked.tier, number)
        self.seed = int(random.integers(2**31))
        self.amplitude = float(random.uniform(*AMPLITUDE))
        self.noise = float(np.exp(random.uniform(*np.log(NOISE))))
        correctors = [e.name for e in self.ring.elements if e.is_corrector]
        size = min(SET_CORRECTORS, len(correctors))
        self.set = [str(c) for c in random.choice(correctors, size, replace=False)]
        self.shots = self._draw_shots(asked.shots + HELD_OUT, self.seed)
        before = self._draw_shots(asked.shots, self.seed + 1)
        self.before = before if reference else None
        self.background = dict(asked.background)
        self.small = draw_background(self.ring, self.background, self.seed)
        self.draw = Draw(random, asked.signal, asked.amount)

    def _draw_shots(self, count: int, seed: int) -> Shots:
        settings: list[Settings] = []
        for _ in range(count):
            size = self.random.uniform(*SET_KICK, len(self.set))
            kicks = size * self.random.choice([-1.0, 1.0], len(self.set))
            settings.append({c: {"kick": float(k)} for c, k in zip(self.set, kicks, strict=True)})
        return draw_shots(self.ring, count, self.amplitude, settings=settings, seed=seed)

    def make(self, name: str) -> tuple[Case, Truth]:
        """Return its public and its secret part."""
        healthy = clean_readings(Machine(self.ring, self.small), self.shots)
        fit = slice(0, self.asked.shots)
        launches = _five(self.shots)[fit]
        settings = self.shots.settings[fit]
        before = 0
        if self.before is not None:
            launches = np.concatenate([_five(self.before), launches])
            settings = (*self.before.settings, *settings)
            before = len(self.before)
        options: dict[str, Any] = {}
        if self.background and self.asked.known_rms:
            options["background"] = self.background
        causes: list[Cause] = []
        unknown: dict[str, Any] | None = None
        clean, sizes, total = healthy, [], 0.0
        if self.asked.tier != "E":
            ruler = Ruler(
                quiet_problem(self.ring, launches, settings, self.noise, self.background, before)
            )
            kind = self._unknown_kind() if self.asked.tier == "D" else None
            if kind in LARGEST:
                clean, unknown = self._unknown(str(kind), healthy, ruler)
            else:
                if kind is not None:
                    unknown = {"kind": "taken_out"}
                    options["effects"] = [n for n in names() if n != kind]
                count = 1 if self.asked.tier != "C" else int(self.random.integers(2, 4))
                while len(causes) < count:
                    cause = self._cause(ruler, self.effects if kind is None else [kind])
                    if all((c.effect, c.element) != (cause.effect, cause.element) for c in causes):
                        causes.append(cause)
                clean = self._readings(causes)
                sizes = [self._size(ruler, self._readings([c]) - healthy, [c]) for c in causes]
            total = self._size(ruler, clean - healthy, causes)
            sizes = sizes or [total]
        frozen = monitors_with(self.ring, causes).frozen
        case = self._case(name, clean, frozen, options)
        clean = np.where(frozen[:, None], case.fit.readings[0, 0], clean)
        parts = {"fit": clean[fit], "heldout": clean[self.asked.shots :], "before": healthy[fit]}
        true = {"fit": _five(self.shots)[fit], "heldout": _five(self.shots)[self.asked.shots :]}
        if self.before is not None:
            true["reference"] = _five(self.before)
        truth = Truth(
            name, self.asked.tier, tuple(causes), unknown, tuple(sizes), total, self.background,
            self.amplitude, self.noise, self.seed, true, parts,
        )  # fmt: skip
        return case, truth

    # --- what is wrong --------------------------------------------------------------------------
    def _cause(self, ruler: Ruler, effects: Sequence[str]) -> Cause:
        """Draw a cause; one that acts on settings at a corrector that is set."""
        return self.draw.one(
            ruler, effects, lambda e: self.set if e.acts_on_settings else e.places(self.ring)
        )

    def _unknown_kind(self) -> str:
        """Draw unknowns and removed effects for half of the cases each, every kind in turn."""
        taken = [name for name in modelled() if find(name).places(self.ring)]
        kinds = list(LARGEST)
        which = self.number // 2
        pool = kinds if self.number % 2 == 0 else taken
        turn = stream(self.asked.seed, "kinds", which // len(pool)).permutation(len(pool))
        return pool[int(turn[which % len(pool)])]

    def _unknown(self, kind: str, healthy: Array, ruler: Ruler) -> tuple[Array, dict[str, Any]]:
        fit = slice(0, self.asked.shots)
        for _ in range(100):
            fault = Unknown(self.ring, kind, self.shots, healthy, self.random)
            amount = LARGEST[kind]
            if kind not in DISCRETE:
                target = self.draw.target()
                amount *= 0.1
                for _ in range(3):
                    change = fault.readings(amount) - healthy
                    size = ruler.size(change[fit])
                    amount = min(amount * target / max(size, 1e-9), LARGEST[kind])
            clean = fault.readings(amount)
            size = ruler.size((clean - healthy)[fit])
            if np.isfinite(clean).all() and size >= self.draw.signal[0]:
                place = fault.element
                known = {"kind": kind, "element": place.name, "s": place.s, "amount": amount}
                return clean, known
            self.draw.unreachable.append((kind, fault.element.name, size))
        raise TmlatticeError(f"no {kind} reaches the smallest signal to noise; take larger shots")

    def _readings(self, causes: Sequence[Cause]) -> Array:
        return clean_readings(Machine(self.ring, [*self.small, *causes]), self.shots)

    def _size(self, ruler: Ruler, change: Array, causes: Sequence[Cause]) -> float:
        if not all(find(cause.effect).modelled for cause in causes):
            return float("nan")
        return ruler.size(change[: self.asked.shots])

    # --- what is written ------------------------------------------------------------------------
    def _case(self, name: str, clean: Array, frozen: Flags, options: dict[str, Any]) -> Case:
        noise = stream(self.seed, "reading noise").standard_normal(clean.shape)
        readings = clean + self.noise * noise
        readings[:, frozen] = readings[0, frozen]
        first = self._measurement(self.shots, readings)
        shots = list(range(len(self.shots)))
        parts: dict[str, AnyMeasurement] = {
            "fit": first.select(shots[: self.asked.shots]),
            "heldout": first.select(shots[self.asked.shots :]),
        }
        if self.before is not None:
            quiet = clean_readings(Machine(self.ring, self.small), self.before)
            noise = stream(self.seed, "reference noise").standard_normal(quiet.shape)
            parts["reference"] = self._measurement(self.before, quiet + self.noise * noise)
        return Case(name, self.asked.lattice, parts, options)

    def _measurement(self, shots: Shots, readings: Array) -> Measurement:
        return measured(self.ring, shots, readings[:, None], np.full(2, self.noise))


def _five(shots: Shots) -> Array:
    return shots.launches[:, [0, 1, 2, 3, 5]]
