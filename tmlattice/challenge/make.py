"""Cases with a withheld cause: AT is the real machine, every case has random numbers of its own."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from tmlattice.batch import fingerprint
from tmlattice.challenge.case import (
    CONTENTS,
    SET,
    TIERS,
    Case,
    Truth,
    case_names,
    read_set,
    ring_of,
    write_case,
)
from tmlattice.challenge.ruler import Ruler
from tmlattice.challenge.unknown import DISCRETE, LARGEST, Unknown, clean_readings
from tmlattice.effects import (
    Cause,
    Settings,
    background_rms,
    find,
    modelled,
    monitors_with,
    names,
)
from tmlattice.errors import TmlatticeError
from tmlattice.files import output_file, write_json
from tmlattice.lattice import Ring
from tmlattice.lattice.load import contents
from tmlattice.machine import Machine, Shots, draw_background, draw_shots
from tmlattice.machine.shots import stream
from tmlattice.measurement import Measurement

Array = NDArray[np.float64]

SIGNAL = (5.0, 100.0)
"""Signal to noise, log-uniform."""

AMPLITUDE = (1e-3, 3e-3)
NOISE = (5e-6, 5e-5)

SET_CORRECTORS = 4
"""So many random correctors are set in every case, whatever is wrong: the settings betray nothing,
and correctors that kick wrongly or stand askew can be seen."""

SET_KICK = (2e-5, 5e-5)

HELD_OUT = 2

Drawn = tuple[str, str | None, float]
"""What was asked for and could not be reached: effect, place, signal to noise at the cap."""


def make(
    tier: str,
    cases: int,
    seed: int,
    folder: Path,
    *,
    lattice: str = "petra3",
    reference: bool = False,
    shots: int = 4,
    effects: Sequence[str] | None = None,
    amount: float | None = None,
    signal: tuple[float, float] = SIGNAL,
    background: Mapping[str, float | None] | None = None,
    told: bool = False,
    progress: bool = True,
) -> dict[str, int]:
    """Make a challenge; cases that are there already are kept.

    Args:
        tier: A one effect; B one effect among small errors everywhere; C two or three; D one that
            the catalogue does not hold; E none.
        cases: how many.
        seed: of everything.
        folder: for the challenge.
        lattice: what `load_ring` takes.
        reference: tier B, with a measurement from before the fault.
        shots: of the fit; two more are held out.
        effects: draw from these alone.
        amount: of the effect, of random sign, instead of a signal to noise that is drawn.
        signal: smallest and largest signal to noise.
        background: tier B, rms of the small errors by effect (None: the catalogue's own); every
            usual one if not given.
        told: the diagnosis is told those sizes; else it has to learn them.
        progress: show a bar where there is a terminal.

    Returns:
        How often each effect was drawn and could not reach the smallest signal to noise.

    Raises:
        TmlatticeError: another tier, or a folder of another challenge.
    """
    if tier not in TIERS:
        raise TmlatticeError(f"no tier '{tier}'; there are {', '.join(TIERS)}")
    if reference and tier != "B":
        raise TmlatticeError("a reference is for tier B; leave --reference out")
    if background and tier != "B":
        raise TmlatticeError("small errors everywhere are for tier B; leave --background out")
    rms = background_rms(background or {"all": None}) if tier == "B" else {}
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
    if tier == "B":
        public["told"] = told
    if (folder / "challenge.json").exists():
        described = read_set(folder)
        if {CONTENTS: public[CONTENTS], **described} != public or _seed(folder) not in (None, seed):
            raise TmlatticeError(f"'{folder}' holds another challenge; name another folder")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        with output_file(folder / "challenge.json") as path:
            write_json(path, public)
    unreachable: Counter[str] = Counter()
    there = set(case_names(folder))
    for number in tqdm(range(cases), unit="case", disable=None if progress else True):
        name = f"{number:04d}"
        if name in there:
            continue
        draw = CaseDraw(
            ring,
            lattice,
            tier,
            seed,
            number,
            reference,
            shots,
            chosen,
            amount,
            signal,
            rms,
            told,
        )
        case, truth = draw.make(name)
        write_case(folder, case, truth)
        unreachable.update(effect for effect, _, _ in draw.unreachable)
    made = {"seed": seed, "cases": cases, "unreachable": dict(unreachable)}
    with output_file(folder / "truth" / "made.json") as path:
        write_json(path, {"format": "tmlattice-challenge-made", "version": 1, **made})
    return dict(unreachable)


def _seed(folder: Path) -> int | None:
    """The seed that a challenge was made with, where that is known."""
    try:
        made = json.loads((folder / "truth" / "made.json").read_text(encoding="utf-8"))
        return int(made["seed"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None


class CaseDraw:
    """Everything about one case, drawn from its own random numbers."""

    def __init__(
        self,
        ring: Ring,
        lattice: str,
        tier: str,
        seed: int,
        number: int,
        reference: bool = False,
        shots: int = 4,
        effects: Sequence[str] | None = None,
        amount: float | None = None,
        signal: tuple[float, float] = SIGNAL,
        background: Mapping[str, float] | None = None,
        told: bool = False,
    ) -> None:
        self.ring, self.lattice, self.tier = ring, lattice, tier
        self.effects = names(effects)
        self.amount, self.signal = amount, signal
        self.fit_shots = shots
        self.number, self.set_seed = number, seed
        random = stream(seed, "challenge", tier, number)
        self.seed = int(random.integers(2**31))
        self.random = random
        self.amplitude = float(random.uniform(*AMPLITUDE))
        self.noise = float(np.exp(random.uniform(*np.log(NOISE))))
        correctors = [e.name for e in ring.elements if e.kind in ("hcorrector", "vcorrector")]
        size = min(SET_CORRECTORS, len(correctors))
        self.set = [str(c) for c in random.choice(correctors, size, replace=False)]
        self.shots = self._draw_shots(shots + HELD_OUT, self.seed)
        before = self._draw_shots(shots, self.seed + 1)
        self.before = before if reference else None
        self.background = dict(background or {})
        self.told = told
        self.small = draw_background(ring, self.background, self.seed)
        self.unreachable: list[Drawn] = []

    def _draw_shots(self, count: int, seed: int) -> Shots:
        settings: list[Settings] = []
        for _ in range(count):
            size = self.random.uniform(*SET_KICK, len(self.set))
            kicks = size * self.random.choice([-1.0, 1.0], len(self.set))
            settings.append({c: {"kick": float(k)} for c, k in zip(self.set, kicks, strict=True)})
        return draw_shots(self.ring, count, self.amplitude, settings=settings, seed=seed)

    def make(self, name: str) -> tuple[Case, Truth]:
        """Its public and its secret part."""
        healthy = clean_readings(Machine(self.ring, self.small), self.shots)
        fit = slice(0, self.fit_shots)
        launches = _five(self.shots)[fit]
        settings = self.shots.settings[fit]
        before = 0
        if self.before is not None:
            launches = np.concatenate([_five(self.before), launches])
            settings = (*self.before.settings, *settings)
            before = len(self.before)
        options: dict[str, Any] = {}
        if self.background and self.told:
            options["background"] = self.background
        causes: list[Cause] = []
        unknown: dict[str, Any] | None = None
        clean, sizes = healthy, []
        if self.tier != "E":
            ruler = Ruler(self.ring, launches, settings, self.noise, self.background, before)
            kind = self._unknown_kind() if self.tier == "D" else None
            if kind in LARGEST:
                clean, unknown = self._unknown(str(kind), healthy, ruler)
            else:
                if kind is not None:
                    unknown = {"kind": "taken_out"}
                    options["effects"] = [n for n in names() if n != kind]
                count = 1 if self.tier != "C" else int(self.random.integers(2, 4))
                while len(causes) < count:
                    cause = self._cause(ruler, self.effects if kind is None else [kind])
                    if all((c.effect, c.element) != (cause.effect, cause.element) for c in causes):
                        causes.append(cause)
                clean = self._readings(causes)
                sizes = [self._size(ruler, self._readings([c]) - healthy, [c]) for c in causes]
            total = self._size(ruler, clean - healthy, causes)
            sizes = sizes or [total]
        else:
            total = 0.0
        case = self._case(name, clean, causes, options)
        clean = self._frozen(clean, case, causes)
        parts = {"fit": clean[fit], "heldout": clean[self.fit_shots :], "before": healthy[fit]}
        true = {"fit": _five(self.shots)[fit], "heldout": _five(self.shots)[self.fit_shots :]}
        if self.before is not None:
            true["reference"] = _five(self.before)
        truth = Truth(
            name, self.tier, tuple(causes), unknown, tuple(sizes), total, self.background,
            self.amplitude, self.noise, self.seed, true, parts,
        )  # fmt: skip
        return case, truth

    # --- what is wrong --------------------------------------------------------------------------
    def _target(self) -> float:
        return float(np.exp(self.random.uniform(*np.log(self.signal))))

    def _cause(self, ruler: Ruler, effects: Sequence[str]) -> Cause:
        """Effect, then place, uniformly; the amount for a signal to noise, up to its cap."""
        for _ in range(1000):
            name = effects[int(self.random.integers(len(effects)))]
            effect = find(name)
            places = self.set if effect.acts_on_settings else effect.places(self.ring)
            if not places:
                continue
            place = places[int(self.random.integers(len(places)))]
            sign = float(self.random.choice([-1.0, 1.0]))
            target = self._target()
            if effect.discrete:
                forms = int(effect.largest)
                return Cause(name, place, float(self.random.integers(1, forms + 1)))
            if effect.one_sign:
                sign = 1.0
            if self.amount is not None:
                return Cause(name, place, sign * self.amount)
            cap = Cause(name, place, sign * effect.largest)
            most = ruler.of([cap])
            if not most >= self.signal[0]:
                self.unreachable.append((name, place, most))
                continue
            if target >= most:
                return cap
            return Cause(name, place, _solved(ruler, cap, most, target, effect.power))
        raise TmlatticeError("no effect reaches the smallest signal to noise; take larger shots")

    def _unknown_kind(self) -> str:
        """Unknowns and effects taken out share the cases half and half, each in turn."""
        taken = [name for name in modelled() if find(name).places(self.ring)]
        kinds = list(LARGEST)
        which = self.number // 2
        pool = kinds if self.number % 2 == 0 else taken
        turn = stream(self.set_seed, "kinds", which // len(pool)).permutation(len(pool))
        return pool[int(turn[which % len(pool)])]

    def _unknown(self, kind: str, healthy: Array, ruler: Ruler) -> tuple[Array, dict[str, Any]]:
        fit = slice(0, self.fit_shots)
        for _ in range(100):
            fault = Unknown(self.ring, kind, self.shots, healthy, self.random)
            amount = LARGEST[kind]
            if kind not in DISCRETE:
                target = self._target()
                amount *= 0.1
                for _ in range(3):
                    change = fault.readings(amount) - healthy
                    size = ruler.size(change[fit])
                    amount = min(amount * target / max(size, 1e-9), LARGEST[kind])
            clean = fault.readings(amount)
            size = ruler.size((clean - healthy)[fit])
            if np.isfinite(clean).all() and size >= self.signal[0]:
                place = fault.element
                known = {"kind": kind, "element": place.name, "s": place.s, "amount": amount}
                return clean, known
            self.unreachable.append((kind, fault.element.name, size))
        raise TmlatticeError(f"no {kind} reaches the smallest signal to noise; take larger shots")

    def _readings(self, causes: Sequence[Cause]) -> Array:
        return clean_readings(Machine(self.ring, [*self.small, *causes]), self.shots)

    def _size(self, ruler: Ruler, change: Array, causes: Sequence[Cause]) -> float:
        if not all(find(cause.effect).modelled for cause in causes):
            return float("nan")
        return ruler.size(change[: self.fit_shots])

    # --- what is written ------------------------------------------------------------------------
    def _case(
        self, name: str, clean: Array, causes: Sequence[Cause], options: dict[str, Any]
    ) -> Case:
        noise = stream(self.seed, "reading noise").standard_normal(clean.shape)
        readings = clean + self.noise * noise
        for at in self._frozen_monitors(causes):
            readings[:, at] = readings[0, at]
        first = self._measurement(self.shots, readings)
        shots = list(range(len(self.shots)))
        reference = None
        if self.before is not None:
            quiet = clean_readings(Machine(self.ring, self.small), self.before)
            noise = stream(self.seed, "reference noise").standard_normal(quiet.shape)
            reference = self._measurement(self.before, quiet + self.noise * noise)
        return Case(
            name,
            self.lattice,
            first.select(shots[: self.fit_shots]),
            first.select(shots[self.fit_shots :]),
            reference,
            options,
        )

    def _measurement(self, shots: Shots, readings: Array) -> Measurement:
        monitors = tuple(monitor.name for monitor in self.ring.monitors)
        return Measurement(
            launches=shots.nominal,
            readings=readings[:, None],
            monitors=monitors,
            noise=np.full((len(monitors), 2), self.noise),
            launch_sigma=np.tile(shots.sigma, (len(shots), 1)),
            settings=shots.settings,
            lattice=self.ring.name,
            energy=self.ring.energy,
        )

    def _frozen_monitors(self, causes: Sequence[Cause]) -> list[int]:
        return [int(at) for at in np.flatnonzero(monitors_with(self.ring, causes).frozen)]

    def _frozen(self, clean: Array, case: Case, causes: Sequence[Cause]) -> Array:
        clean = clean.copy()
        for at in self._frozen_monitors(causes):
            clean[:, at] = case.fit.readings[0, 0, at]
        return clean


def _solved(ruler: Ruler, cap: Cause, most: float, target: float, power: int) -> float:
    """The amount whose signal to noise is the target: readings change nearly as amount^power."""
    amount, size = cap.amount, most
    for _ in range(6):
        amount *= (target / max(size, 1e-12)) ** (1 / power)
        amount = float(np.clip(amount, -abs(cap.amount), abs(cap.amount)))
        size = ruler.of([Cause(cap.effect, cap.element, amount)])
        if abs(size / target - 1) < 1e-3:
            break
    return amount


def _five(shots: Shots) -> Array:
    return shots.launches[:, [0, 1, 2, 3, 5]]
