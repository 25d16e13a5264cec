"""What a diagnosis has to answer: `python -m tests.scenarios [NAME ...] [--into FILE]`.

A row is a machine (ring, causes, small errors), what is measured of it, a defect of the data, and
the answer that is right: the verdicts that may be given, the causes that have to be found, each
within four of its errors, and words that the report has to contain. Nothing else may be found. All
goes through public functions, so that a method can be exchanged behind them. The result of each row
is printed as it comes and stored, with its seconds, in FILE; rows in FILE are not run again.
"""

import argparse
import json
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.shared import valid
from tmlattice import Cause, diagnose, load_ring, simulate
from tmlattice.errors import TmlatticeError
from tmlattice.files import write_json
from tmlattice.machine import draw_background
from tmlattice.machine.response import simulate_response
from tmlattice.machine.stored_beam import (
    simulate_dispersion,
    simulate_orbits,
    simulate_tunes,
    simulate_turns,
)
from tmlattice.version import __version__

LATTICE = Path(__file__).parent / "lattices" / "small_ring.py"
USUAL = {"all": None}
FITTED = (
    "quadrupole_gradient", "corrector_calibration", "monitor_gain_x", "monitor_gain_y",
    "family_gradient",
)  # fmt: skip
ERRORS = 4.0
"""Stated errors that an amount may be from the truth."""
PULLS = 2.0
"""Largest rms of the misses of fitted small errors over their stated errors."""
FALLS = 0.6
"""Share of the residual of held-out correctors that small errors which are fitted may leave."""
NOISE = 3.0
"""Chi-square of a reading below which that residual is noise."""
MANY_OF = 8
"""Numbers above which they have an rms."""
ANY = frozenset({"identified", "ambiguous", "localised", "distributed"})
ONE = frozenset({"identified", "ambiguous"})
"""Verdicts on something that the catalogue has."""
MAKE: dict[str, Callable[..., Any]] = {
    "first turns": lambda ring, causes, **o: simulate(ring, causes, **o).measurement(),
    "turns": lambda ring, causes, **o: simulate_turns(ring, causes, **o).measured,
    "orbit": lambda ring, causes, **o: simulate_orbits(ring, causes, **o).measured,
    "dispersion": lambda ring, causes, **o: simulate_dispersion(ring, causes, **o).measured,
    "tunes": lambda ring, causes, **o: simulate_tunes(ring, causes, **o).measured,
    "response": lambda ring, causes, **o: (
        simulate_response(ring, causes, progress=False, **o).measured
    ),
}
Change = Callable[[Any, np.random.Generator], Any]


@dataclass(frozen=True)
class Scenario:
    """A machine, what is read of it, and the right answer."""

    name: str
    causes: tuple[Cause, ...] = ()
    kinds: tuple[str, ...] = ("response",)
    small: Mapping[str, float | None] | None = None
    """Small errors: effect -> rms."""
    ring: str = "small"
    seed: int = 3
    made: Mapping[str, Any] | None = None
    """Options of the virtual machine."""
    damage: Change | None = None
    before: tuple[Cause, ...] | None = None
    """Causes of the reference; None: there is none."""
    before_damage: Change | None = None
    options: Mapping[str, Any] | None = None
    """Of `diagnose`."""
    verdicts: frozenset[str] = ONE
    found: tuple[Cause, ...] | None = None
    """None: the causes. Those of an amount of nan are found with any."""
    says: tuple[str, ...] = ()
    """Each is one text, or several of which one is enough, with `|` between them."""
    others: int = 0
    """Findings that may stand beside those."""
    lasts: bool = False
    """It takes long: the quick run is with `fewer` effects."""
    fewer: tuple[str, ...] | None = FITTED
    """Effects of the quick run, with those of the causes; None: there is none."""


@cache
def ring_of(name: str, edits: tuple[tuple[str, str], ...] = ()) -> Any:
    """The small ring, with correctors of both planes where it is called `both`; or a built-in."""
    if name not in {"small", "both"}:
        return load_ring(name)
    import tempfile

    text = LATTICE.read_text(encoding="utf-8")
    if name == "both":
        edits = (('Vcor(eid=f"v{i}")', '(Hcor if i % 2 else Vcor)(eid=f"v{i}")'), *edits)
    for old, new in edits:
        if old not in text:
            raise ValueError(f"'{old}' is not in the lattice")
        text = text.replace(old, new)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small_ring.py"
        path.write_text(text, encoding="utf-8")
        return load_ring(path)


def measured(own: Scenario, causes: Sequence[Cause], seed: int, damage: Change | None) -> Any:
    """What is read: one measurement, or several by name."""
    options = {"background": own.small or {}, "machine_seed": own.seed, **(own.made or {})}
    ring = ring_of(own.ring)
    data = {kind: MAKE[kind](ring, causes, seed=seed, **options) for kind in own.kinds}
    rng = np.random.default_rng(own.seed)
    if damage is not None:
        data = {kind: damage(one, rng) for kind, one in data.items()}
    return data if len(data) > 1 else data[own.kinds[0]]


def run(own: Scenario) -> dict[str, Any]:
    """The answer to a scenario, and what is wrong with it, `faults`: empty where it is right."""
    start = time.process_time()
    data = measured(own, own.causes, own.seed, own.damage)
    options = dict(own.options or {})
    if own.before is not None:
        options["reference"] = measured(own, own.before, own.seed + 1, own.before_damage)
    made = time.process_time()
    answer: dict[str, Any] = {"name": own.name}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = diagnose(ring_of(own.ring), data, seed=own.seed, **options)
    except TmlatticeError as error:
        answer |= {"verdict": "refused", "found": [], "faults": _unsaid(own, str(error))}
        if "refused" not in own.verdicts:
            answer["faults"].insert(0, f"refused: {error}")
        return answer
    answer["verdict"] = result.verdict
    answer["found"] = [
        [one.effect, one.element, _number(one.amount), _number(one.amount_sigma)]
        if one.effect else [one.words, None, None, None]
        for one in result.findings
    ]  # fmt: skip
    faults = [] if result.verdict in own.verdicts else [f"verdict {result.verdict}"]
    wanted = list(own.causes if own.found is None else own.found)
    answer["pulls"] = pulls = []
    for cause in wanted:
        one = next((f for f in result.findings if _holds(f, cause)), None)
        if one is None:
            faults.append(f"not found: {cause.effect} {cause.element}")
        elif one.effect == cause.effect and one.amount_sigma and np.isfinite(cause.amount):
            amount = _amounts(one).get(_key(cause), one.amount)
            sigma = one.amount_sigma * abs(amount / one.amount)  # an alternative's: alike
            pulls.append(_number((amount - cause.amount) / sigma))
            if abs(pulls[-1]) > ERRORS:
                faults.append(f"{cause.effect} {cause.element}: {pulls[-1]:.1f} errors from it")
    if len(result.findings) > len(wanted) + own.others:
        faults.append(f"{len(result.findings)} findings, not {len(wanted)}")
    if own.small and own.before is None and set(own.small) <= set(FITTED):
        faults += _of_small_errors(own, result)
    text = result.report()
    if "nan" in re.split(r"[^a-z]+", text):
        faults.append("a number of the report is nan")
    valid(result.as_json(), "diagnosis")
    answer["faults"] = faults + _unsaid(own, " ".join([text, *result.warnings]))
    answer["seconds"] = [round(made - start, 1), round(time.process_time() - made, 1)]
    return answer


def _unsaid(own: Scenario, text: str) -> list[str]:
    plain = " ".join(text.split())
    return [
        f"does not say: {words}"
        for words in own.says
        if not any(either in plain for either in words.split("|"))
    ]


def _holds(finding: Any, cause: Cause) -> bool:
    if cause.effect.startswith("exchanged"):
        return set(finding.elements) == set((cause.element or "").split(","))
    return _key(cause) in _amounts(finding)


def _key(cause: Any) -> tuple[str, str]:
    return cause.effect, (cause.element or "").casefold()  # a family has no case


def _amounts(finding: Any) -> dict[tuple[str, str], float]:
    """The finding's amount, and those of its alternatives: that of the opposite side of a symmetric
    ring may have the other sign."""
    return {_key(one): one.amount for one in (finding, *finding.credible_set)}


def _number(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")


def _few(own: Scenario) -> list[str]:
    return list(dict.fromkeys([*(own.fewer or ()), *(cause.effect for cause in own.causes)]))


def _of_small_errors(own: Scenario, result: Any) -> list[str]:
    """What is wrong with fitted small errors, all of which are fitted, against those drawn."""
    ring = ring_of(own.ring)
    true = {(c.effect, c.element): c.amount for c in own.causes}
    for c in draw_background(ring, own.small or {}, own.seed):
        true[c.effect, c.element] = true.get((c.effect, c.element), 0.0) + c.amount
    missed: dict[str, list[tuple[float, float, float]]] = {}
    for cause, sigma in zip(result.causes, result.errors, strict=True):
        amount = true.get((cause.effect, cause.element))
        if amount is not None and sigma:
            missed.setdefault(cause.effect, []).append((cause.amount - amount, sigma, amount))
    first, last = result.steps[0], result.steps[-1]
    explained = last.heldout_rms_in_plane < FALLS * first.heldout_rms_in_plane
    noise = last.heldout_chi2_per_dof < NOISE
    faults = [] if explained or noise else ["held-out readings are not explained"]
    for effect, rows in missed.items():
        off, sigma, amount = np.transpose(rows)
        if effect in FITTED and len(rows) > MANY_OF and np.std(off / sigma) > PULLS:
            faults.append(f"{effect}: pulls {np.std(off / sigma):.1f}")
        if effect == "quadrupole_gradient" and len(rows) > MANY_OF and np.std(off) > np.std(amount):
            faults.append(f"{effect}: further from the truth than the design")
    return faults


# --- defects of the data ------------------------------------------------------------------------


def changed(name: str, change: Callable[[np.ndarray, Any, np.random.Generator], None]) -> Change:
    """A change, in place, of a copy of an array of the record."""

    def made(data: Any, rng: np.random.Generator) -> Any:
        values = getattr(data, name).copy()
        change(values, data, rng)
        return replace(data, **{name: values})

    return made


readings = partial(changed, "response")
"""Of a response, [corrector, monitor, plane]."""
in_turn = partial(changed, "readings")
"""Of first turns or turns, [shot, turn, monitor, plane]."""


def own_plane(data: Any) -> np.ndarray:
    return np.array([int(plane == "y") for plane in data.planes])


def noise_of(data: Any) -> float:
    return float(np.nanmedian(data.noise))


def single(number: int, times: float) -> Change:
    """Single readings that stick out, in the plane of their corrector."""

    def change(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
        for place in rng.permutation(read[:, :, 0].size)[:number]:
            c, m = divmod(int(place), read.shape[1])
            read[c, m, own_plane(data)[c]] += times * noise_of(data) * rng.choice([-1, 1])

    return readings(change)


def lagging(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    """At two steps half of the monitors still average over the time before."""
    for c in (2, 9):
        read[c, ::2, own_plane(data)[c]] *= 0.85


def other_kick(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    """A second kick in two steps, in the plane of the step and across."""
    x = data.planes.index("x")
    read[data.correctors.index("v2"), :, 0] += 0.05 * read[x, :, 0]
    read[data.correctors.index("v4")] += 0.1 * read[data.correctors.index("v8")]


def larger_steps(data: Any, rng: np.random.Generator) -> Any:
    """Two correctors that were stepped 20 times as far."""
    response, kicks = data.response.copy(), np.array(data.kicks)
    for c in (2, 9):
        response[c] *= 20
        kicks[c] *= 20
    return replace(data, response=response, kicks=kicks)


def random_monitor(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[:, 6] = rng.permutation(read[:, 6])


def noisy_monitor(times: float) -> Change:
    def change(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
        read[:, 6] += times * noise_of(data) * rng.standard_normal(read[:, 6].shape)

    return readings(change)


def noisy_across(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    """One monitor, in x, of correctors that kick in y."""
    across = own_plane(data) == 1
    read[across, 6, 0] += 40 * noise_of(data) * rng.standard_normal(across.sum())


def random_corrector(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[5] = rng.permutation(read[5])


def silent(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[:, 6] = 0.0


def moved(plane: int, times: float) -> Change:
    """A closed orbit in every step and the RF's, each time another amount."""

    def change(data: Any, rng: np.random.Generator) -> Any:
        first = next(c for c, own in enumerate(own_plane(data)) if own == plane)
        orbit = data.response[first, :, plane]
        orbit = orbit * times * noise_of(data) / np.sqrt(np.mean(orbit**2))
        amounts = rng.standard_normal(len(data.correctors) + 1)
        response, rf = data.response.copy(), data.rf.orbit.copy()
        response[:, :, plane] += amounts[:-1, None] * orbit
        rf[:, plane] += amounts[-1] * orbit
        return replace(data, response=response, rf=replace(data.rf, orbit=rf))

    return change


def drifting(data: Any, rng: np.random.Generator) -> Any:
    """The beam's energy drifts within the steps, by a hundredth of what the RF's step makes."""
    amounts = 0.01 * rng.standard_normal(len(data.correctors))
    return replace(data, response=data.response + amounts[:, None, None] * data.rf.orbit)


def swapped_correctors(first: str, second: str) -> Change:
    def change(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
        pair = [data.correctors.index(first), data.correctors.index(second)]
        read[pair] = read[pair[::-1]]

    return readings(change)


def swapped_monitors(first: str, second: str) -> Change:
    def change(data: Any, rng: np.random.Generator) -> Any:
        pair = [data.monitors.index(first), data.monitors.index(second)]
        response, orbit = data.response.copy(), data.rf.orbit.copy()
        response[:, pair] = response[:, pair[::-1]]
        orbit[pair] = orbit[pair[::-1]]
        return replace(data, response=response, rf=replace(data.rf, orbit=orbit))

    return change


def noise_times(factor: Any) -> Change:
    return lambda data, rng: replace(data, noise=data.noise * np.asarray(factor))


def rf_zeros(data: Any, rng: np.random.Generator) -> Any:
    orbit = data.rf.orbit.copy()
    orbit[[5, 15, 25]] = 0.0
    return replace(data, rf=replace(data.rf, orbit=orbit))


def rf_outliers(data: Any, rng: np.random.Generator) -> Any:
    orbit = data.rf.orbit.copy()
    orbit[[5, 15, 25]] += 1e-3 * rng.standard_normal((3, 2))
    return replace(data, rf=replace(data.rf, orbit=orbit))


def rf_copied(data: Any, rng: np.random.Generator) -> Any:
    """The design's dispersion, cell by cell the same."""
    orbit = data.rf.orbit.copy()
    orbit[:, 0] = 1e-4 * np.array([1.0, np.pi, np.sqrt(2)])[np.arange(len(orbit)) % 3]
    return replace(data, rf=replace(data.rf, orbit=orbit))


def no_rf(data: Any, rng: np.random.Generator) -> Any:
    return replace(data, rf=None)


def no_noise(data: Any, rng: np.random.Generator) -> Any:
    return replace(data, noise=None)


def zeros_across(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    for c, plane in enumerate(own_plane(data)):
        read[c, :, 1 - plane] = 0.0


def no_x(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[..., 0] = np.nan


def no_y(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[..., 1] = np.nan


def lost(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[:, :, 20:] = 0.0


def frozen(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[:, :, 9] = 1.234e-4


def dead(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[:, :, 9] = 0.0


def wild(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[2, 0, 11, 0] += 5e-3


def reversed_x(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read[..., 0] *= -1


def millimetres(read: np.ndarray, data: Any, rng: np.random.Generator) -> None:
    read *= 1e-3


# --- rows ---------------------------------------------------------------------------------------

WEAK = Cause("quadrupole_gradient", "QF::2", -0.02)
GRADIENTS = {"quadrupole_gradient": 3e-3}
NOTHING = frozenset({"none"})
MANY = frozenset({"distributed"})
SOUND = NOTHING | MANY
"""Verdicts on a machine without a single fault among its small errors."""
LOCATED = frozenset({"localised"})
BENDS = [f"bend::{k}" for k in range(32)]


SLOW: dict[str, Any] = {"lasts": True, "fewer": None}
"""Of rows that are run with `-m slow` alone: others of their kind are run always."""


def row(name: str, *causes: Cause, **more: Any) -> Scenario:
    """What stands in the name before the colon: kinds of measurement, usual errors, a reference."""
    parts = name.split(":", maxsplit=1)[0].split(", ")
    own = {"small": USUAL} if {"usual errors", "since"} & {*parts} else {}
    own |= {"before": ()} if "since" in parts else {}
    return Scenario(name, causes, tuple(p for p in parts if p in MAKE), **own | more)


def one(
    effect: str, element: str | None, amount: float, head: str = "response", **more: Any
) -> Scenario:
    """A single cause."""
    return row(f"{head}: {effect} {element} {amount:g}", Cause(effect, element, amount), **more)


usual = partial(one, head="response, usual errors", lasts=True)
turned = partial(one, head="first turns")


def defect(name: str, damage: Change, *says: str, **more: Any) -> Scenario:
    """A defect of a response's data, among small errors of gradients, calibrations and gains."""
    small = GRADIENTS | {"corrector_calibration": 0.02}
    small |= {"monitor_gain_x": 0.01, "monitor_gain_y": 0.01}
    options = {"ring": "both", "small": small, "found": (), "verdicts": SOUND, "says": says}
    return row(f"response, data: {name}", damage=damage, **options | {"lasts": True} | more)


RESPONSES = (
    row("response: nothing", verdicts=NOTHING, lasts=True),
    one("quadrupole_gradient", "QF::2", -0.05),
    one("quadrupole_roll", "QD::4", 0.01),
    one("sextupole_offset_y", "sf::2", -3e-3),
    one("dipole_roll", "bend::10", 1e-3),
    one("quadrupole_offset_x", "QD::9", 1e-4),
    one("corrector_kick_x", "v4", 2e-5),
    one("corrector_calibration", "v5", 0.5),
    one("corrector_calibration", "v2", -1.0),
    one("corrector_roll", "v5", 0.05),
    one("monitor_gain_x", "end_1", -2.0),
    one("monitor_swap", "bpm::4", 1.0),
    one("monitor_roll", "bpm::4", 0.01),
    one("energy_spread", None, 1e-3),
    one("family_gradient", "QD", -0.01),
    row(
        "response: two causes",
        Cause("quadrupole_roll", "QF::2", 0.02),
        Cause("corrector_calibration", "v7", 0.2),
    ),
    row(
        "response: five causes",
        Cause("quadrupole_gradient", "QD::5", 0.01),
        Cause("quadrupole_gradient", "QF::9", -0.008),
        Cause("quadrupole_gradient", "QF::3", 0.006),
        Cause("quadrupole_gradient", "QD::12", 0.005),
        Cause("corrector_calibration", "v2", 0.1),
        made={"kick": 1e-5, "noise": 2e-8, "engine": "ocelot", "rf_step": -3000.0},
        lasts=True,
        fewer=None,
    ),
    row("response: gradients", small={"quadrupole_gradient": 2e-3}, verdicts=MANY, **SLOW),
    *(
        row(f"response, usual errors: none, {k}", seed=k, verdicts=SOUND, **SLOW)
        for k in (5, 8, 11)
    ),
    usual("quadrupole_gradient", "QF::2", 0.03, fewer=None),
    usual("quadrupole_roll", "QD::4", 0.02),
    usual("corrector_calibration", "v3", -2.0, fewer=None),
    usual("corrector_calibration", "v2", -1.0, fewer=(*FITTED, "corrector_roll")),
    usual("corrector_roll", "v5", np.pi / 2, fewer=None),
    usual("monitor_gain_y", "bpm::6", -2.0, fewer=None),
    usual("monitor_gain_x", "end_1", -1.33, fewer=None),
    usual("monitor_swap", "end_6", 1.0),
    usual("family_gradient", "QD", -0.0235),
    usual("sextupole_offset_y", "sf::2", -3e-3, fewer=None),
    *(  # a member of a family, one with the scatter of its usual errors, one beside the orbit
        usual(*fault, seed=1, made={"machine_seed": 5}, fewer=fewer)
        for *fault, fewer in (
            ("quadrupole_gradient", "QD::1", 0.02, FITTED),
            ("sextupole_offset_y", "sd::2", 2.5e-3, FITTED),
            ("gradient_absolute", "sf::2", 0.02, None),
        )
    ),
    row(
        "response: edges of all bends",
        *tuple(Cause("vertical_focusing", name, 2e-3) for name in BENDS),
        small=GRADIENTS,
        found=(),
        verdicts=MANY,
        says=("vertical_focusing|vertical focusing",),
        lasts=True,
    ),
    row(
        "response: an insertion device in a straight",
        Cause("vertical_focusing", "d::95", 0.01),
        small=GRADIENTS,
        found=(),
        verdicts=MANY | ONE,
        others=1,
        says=("d::95",),
        **SLOW,
    ),
    row(
        "response: kicks in the dispersion",
        small={"quadrupole_offset_x": 1e-4, **GRADIENTS},
        verdicts=SOUND,
        lasts=True,
    ),
    row(
        "response: small errors and the beam's energy",
        Cause("energy_offset", None, 2e-3),
        small=USUAL,
        found=(),
        verdicts=MANY | ONE,
        others=1,
        says=("energy_offset|energy deviation",),
        lasts=True,
        fewer=None,
    ),
)

DEFECTS = (
    defect("single readings stick out", single(24, 10), fewer=None),
    defect("single readings are gross", single(12, 250)),
    defect("two steps read too early", readings(lagging), "contradict"),
    defect("another kick in two steps", readings(other_kick), "v2", "v4"),
    defect("two steps are larger", larger_steps),
    defect("a monitor resembles nothing", readings(random_monitor), "end_2", fewer=None),
    defect("a monitor is noisy", noisy_monitor(40), "end_2"),
    defect("a monitor is noisy across", readings(noisy_across), "end_2", fewer=None),
    defect("a monitor is silent", readings(silent), "end_2"),
    defect(
        "a corrector resembles nothing", readings(random_corrector), "v5", others=1, verdicts=ANY
    ),
    defect("the beam moves in y", moved(1, 20), "beam jitter between", fewer=None),
    defect("the beam moves little in x", moved(0, 5), "beam jitter between", fewer=None),
    defect(
        "the energy drifts",
        drifting,
        "changes of the beam's energy",
        fewer=(*FITTED, "monitor_roll", "corrector_roll"),
    ),
    *(
        defect(
            f"exchanged correctors {a}, {b}",
            swapped_correctors(a, b),
            verdicts=LOCATED | MANY,
            says=(f"{a} and {b}|{b} and {a}",),
            others=1,
            fewer=fewer,
        )
        for a, b, fewer in (
            ("v5", "v7", None),
            ("v4", "v10", None),
            ("v4", "v5", None),
            ("v0", "v14", None),
        )
    ),
    defect(
        "exchanged monitors",
        swapped_monitors("end_1", "end_14"),
        verdicts=LOCATED | MANY,
        says=("end_1 and end_14|end_14 and end_1",),
        others=1,
        fewer=None,
    ),
    *(
        row(
            f"response, data: exchanged correctors {a}, {b} alone",
            damage=swapped_correctors(a, b),
            verdicts=LOCATED,
            found=(Cause("exchanged", f"{a},{b}", np.nan),),
            lasts=True,
            fewer=fewer,
        )
        for a, b, fewer in (("v5", "v9", None), ("generated_a", "v5", FITTED))
    ),
    defect(
        "the noise is stated five times too small",
        noise_times([0.2, 1.0]),
        "the noise in x",
        fewer=None,
    ),
    defect("the noise is stated ten times too large", noise_times(10.0), "noise is too large"),
    defect("no noise is stated", no_noise, "noise of the readings is not stated"),
    defect("no step of the RF", no_rf, "there is no RF step"),
    defect("three zeros in the RF's orbit", rf_zeros, "0 m, which no beam reads"),
    defect("three outliers in the RF's orbit", rf_outliers, "RF's orbit"),
    defect("the RF's orbit is a copy", rf_copied, "simulated, not measured"),
    defect("zeros across", readings(zeros_across), "no corrector is read in the other plane"),
    defect("one-sided steps", lambda data, rng: data, made={"one_sided": True}),
    defect(
        "half of the correctors",
        lambda data, rng: data,
        made={"correctors": [f"v{k}" for k in range(0, 16, 2)]},
        fewer=None,
    ),
)


def since(name: str, *causes: Cause, **more: Any) -> Scenario:
    """What changed between two responses of a machine with usual errors."""
    return row(f"response, since: {name}", *causes, **SLOW | more)


CHANGES = (
    since("none", verdicts=NOTHING),
    since("a magnet", Cause("quadrupole_gradient", "QD::5", -0.008)),
    since("a supply", Cause("family_gradient", "QF", 0.003)),
    since(
        "a supply and a magnet",
        Cause("family_gradient", "QF", 0.003),
        Cause("quadrupole_gradient", "QD::5", -0.008),
    ),
    since(
        "two supplies, 5 and -3 %",
        Cause("family_gradient", "QF", 0.05),
        Cause("family_gradient", "QD", -0.03),
    ),
    since("a corrector is reversed", Cause("corrector_calibration", "v3", -2.0)),
    since("a monitor's gain", Cause("monitor_gain_x", "bpm::6", 0.1)),
    since(
        "correctors exchanged",
        damage=swapped_correctors("v5", "v9"),
        verdicts=LOCATED,
        found=(Cause("exchanged", "v5,v9", np.nan),),
    ),
    since(
        "correctors exchanged on both days",
        damage=swapped_correctors("v5", "v9"),
        before_damage=swapped_correctors("v5", "v9"),
        verdicts=NOTHING,
    ),
    since(
        "correctors exchanged in the reference",
        before_damage=swapped_correctors("v5", "v9"),
        verdicts=NOTHING | LOCATED | MANY,
        others=1,
        says=("v5 and v9|v9 and v5",),
    ),
    since(
        "supplies, and every magnet by 1 %",
        Cause("family_gradient", "QF", -0.01),
        Cause("family_gradient", "QD", -0.016),
        verdicts=ANY,
        damage=None,
    ),
    row("first turns, since: a magnet", Cause("quadrupole_gradient", "QD::5", -0.02), **SLOW),
    row("first turns, since: nothing", verdicts=NOTHING, **SLOW),
    row(
        "orbit, since: a kick",
        Cause("corrector_kick_x", "v6", 3e-5),
        lasts=True,
        fewer=("corrector_kick_y", "quadrupole_offset_x", "dipole_field", "monitor_gain_x"),
    ),
    row("orbit, since: another energy", Cause("energy_offset", None, 1e-3)),
    row(
        "orbit, since: another energy, as before, and a kick",
        Cause("energy_offset", None, 2e-3),
        Cause("corrector_kick_x", "v6", 3e-5),
        before=(Cause("energy_offset", None, 2e-3),),
        found=(Cause("corrector_kick_x", "v6", 3e-5),),
    ),
)

TURNS = (
    row("first turns: nothing", verdicts=NOTHING),
    row("first turns, usual errors: none", verdicts=SOUND),
    turned("quadrupole_gradient", "QD::5", -0.05),
    turned("quadrupole_roll", "QF::7", 0.05),
    turned("sextupole_strength", "sf::3", -1.0, made={"amplitude": 3e-3}),
    turned("dipole_roll", "bend::10", 2e-3),
    turned("quadrupole_offset_x", "QF::4", 5e-4),
    turned("corrector_kick_x", "v4", 2e-4),
    turned("monitor_gain_y", "bpm::6", -2.0),
    turned("monitor_swap", "end_6", 1.0),
    turned("monitor_offset_x", "end_6", 5e-4),
    turned("sextupole_offset_x", "sf::3", 2e-3),
    turned("skew_gradient", "QF::7", 0.02),
    turned("insertion_device_focusing", "wig_1", 0.03),
    turned("energy_offset", None, 1e-3),
    row(
        "first turns: two magnets",
        Cause("quadrupole_gradient", "QD::5", -0.05),
        Cause("quadrupole_gradient", "QF::12", 0.05),
    ),
    row(
        "first turns, data: one frozen",
        damage=in_turn(frozen),
        found=(Cause("monitor_dead", "bpm::4", np.nan),),
        verdicts=ANY,
        says=("frozen",),
    ),
    row(
        "first turns, data: one silent",
        damage=in_turn(dead),
        found=(Cause("monitor_dead", "bpm::4", np.nan),),
        verdicts=ANY,
    ),
    row("first turns, data: a wild reading", WEAK, damage=in_turn(wild), **SLOW),
    row("first turns, data: lost", WEAK, damage=in_turn(lost), says=("lost",), **SLOW),
    row(
        "first turns, data: x reversed",
        damage=in_turn(reversed_x),
        verdicts=frozenset({"refused"}),
        says=("x",),
        **SLOW,
    ),
    row(
        "first turns, data: millimetres",
        damage=in_turn(millimetres),
        verdicts=frozenset({"refused"}),
        **SLOW,
    ),
    row("first turns, x alone: nothing", damage=in_turn(no_y), verdicts=NOTHING),
    row(
        "first turns, x alone: a magnet",
        Cause("quadrupole_gradient", "QD::5", -0.05),
        damage=in_turn(no_y),
    ),
    row(
        "first turns, y alone: a magnet",
        Cause("quadrupole_gradient", "QD::5", -0.05),
        damage=in_turn(no_x),
    ),
    row("turns: nothing", verdicts=NOTHING, **SLOW),
    row("turns: a magnet", Cause("quadrupole_gradient", "QD::5", -0.01)),
    row("turns: a roll", Cause("quadrupole_roll", "QF::7", 0.02), **SLOW),
    row("turns: exchanged planes", Cause("monitor_swap", "end_1", 1.0)),
    row("turns, usual errors: none", verdicts=SOUND, **SLOW),
    row(
        "turns, y alone: a magnet",
        Cause("quadrupole_gradient", "QD::5", -0.01),
        damage=in_turn(no_x),
    ),
    row("orbit: a kick", Cause("corrector_kick_x", "v6", 3e-5)),
    row("orbit: nothing", verdicts=NOTHING),
    row("orbit: another energy", Cause("energy_offset", None, 1e-3)),
    row("orbit, usual errors: another energy", Cause("energy_offset", None, 2e-3)),
    row("turns: another energy", Cause("energy_offset", None, 2e-3)),
    row("orbit, dispersion, tunes: another energy", Cause("energy_offset", None, -1e-3)),
    row("dispersion: a magnet", Cause("quadrupole_gradient", "QD::3", -0.01)),
    row("orbit, dispersion, tunes: nothing", verdicts=NOTHING),
    row(
        "orbit, dispersion, tunes: a kick and a magnet",
        Cause("corrector_kick_x", "v6", 3e-5),
        Cause("quadrupole_gradient", "QD::3", -0.01),
    ),
    row(
        "turns, dispersion, usual errors: a magnet",
        Cause("quadrupole_gradient", "QD::3", -0.05),
        **SLOW,
    ),
    row("response, dispersion: a magnet", WEAK, lasts=True),
    row(
        "response, first turns, usual errors: a magnet",
        Cause("quadrupole_gradient", "QF::2", 0.03),
        lasts=True,
        fewer=None,
    ),
)

SCENARIOS = (*RESPONSES, *DEFECTS, *CHANGES, *TURNS)
QUICK = tuple(
    own if not own.lasts else replace(own, options={**(own.options or {}), "effects": _few(own)})
    for own in SCENARIOS
    if not own.lasts or own.fewer is not None
)
"""Those that last are run with few effects."""


def main() -> None:
    """The table, or the rows whose names contain one of the words."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("words", nargs="*")
    parser.add_argument("--into", type=Path)
    given = parser.parse_args()
    known = json.loads(given.into.read_text())["rows"] if given.into and given.into.exists() else []
    rows = {row["name"]: row for row in known}
    for own in SCENARIOS:
        if own.name in rows or (given.words and not any(word in own.name for word in given.words)):
            continue
        row = run(own)
        rows[own.name] = row
        print("wrong" if row["faults"] else "right", own.name, row.get("seconds"), row["verdict"],
              *row["faults"], sep="; ", flush=True)  # fmt: skip
        if given.into:
            made_by = {"command": "python -m tests.scenarios --into FILE", "package": __version__}
            write_json(given.into, {**made_by, "rows": list(rows.values())})
    wrong = sum(bool(row["faults"]) for row in rows.values())
    print(f"{len(rows) - wrong} of {len(rows)} right")


if __name__ == "__main__":
    main()
