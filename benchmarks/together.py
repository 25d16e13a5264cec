"""Faults seen by each kind of measurement alone, and by all of them together.

`python benchmarks/together.py LATTICE [--cases 100] [--seed 0] [--small SCALE] [--kinds turns ...]
[--faultless]`

AT is the machine. Each case is a machine of its own with one fault (none with --faultless), among
the catalogue's usual small errors times SCALE; default options, nothing told. Told are, by signal
to noise of the fault in the measurement at hand: found (a finding with its element, or one between
the same monitors), the fault in the credible set, further findings, pulls of the amount, seconds.
"""

import argparse
import time
from collections import Counter, defaultdict

import numpy as np
from tqdm.auto import tqdm

from tmlattice.diagnosis import diagnose
from tmlattice.effects import Cause, find
from tmlattice.errors import TmlatticeError
from tmlattice.lattice import load_ring
from tmlattice.machine import simulate
from tmlattice.machine.stored_beam import (
    simulate_dispersion,
    simulate_orbits,
    simulate_tunes,
    simulate_turns,
)

FAULTS = (
    "quadrupole_gradient", "skew_gradient", "quadrupole_offset_x", "quadrupole_offset_y",
    "dipole_field", "sextupole_offset_x", "insertion_device_focusing", "corrector_kick_x",
    "corrector_kick_y", "monitor_gain_x", "monitor_gain_y", "monitor_roll", "monitor_swap",
)  # fmt: skip
"""Drawn evenly; amounts are even in their logarithm over two decades."""

BANDS = (5.0, 10.0, 20.0, np.inf)
"""Signal to noise."""

MAKE = {
    "turns": lambda ring, causes, own: simulate_turns(ring, causes, shots=3, **own).measured,
    "orbit": lambda ring, causes, own: simulate_orbits(ring, causes, **own).measured,
    "dispersion": lambda ring, causes, own: simulate_dispersion(ring, causes, **own).measured,
    "tunes": lambda ring, causes, own: simulate_tunes(ring, causes, **own).measured,
    "first": lambda ring, causes, own: simulate(ring, causes, shots=4, **own).measurement(),
}


def drawn(ring, seed):
    """A fault."""
    rng = np.random.default_rng([seed, 77])
    effect = find(str(rng.choice([n for n in FAULTS if find(n).places(ring)])))
    place = str(rng.choice(effect.places(ring)))
    if effect.discrete:
        return Cause(effect.name, place, 1.0)
    size = effect.largest * 10 ** rng.uniform(-2.3, -0.3)
    return Cause(effect.name, place, float(rng.choice([-1, 1]) * size))


def measured(ring, causes, kinds, scale, seed):
    """The machine's measurements."""
    own = {"seed": seed, "machine_seed": seed}
    if scale:
        own["background"] = {"all": scale}
    return {kind: MAKE[kind](ring, causes, own) for kind in kinds}


def judged(ring, fault, found):
    """Signal to noise, whether it is found, in the set, beside how many others; its pull."""
    scan = found.explanation.first
    truth = (fault.effect, fault.element)
    where = scan.hypotheses.index(truth) if truth in scan.hypotheses else None
    ratio = 0.0 if where is None else abs(fault.amount) * np.sqrt(scan.information[where])
    s = ring[fault.element].s
    near = [f for f in found.findings if f.where and f.where[0] - 0.01 <= s <= f.where[1] + 0.01]
    inside = any((m.effect, m.element) == truth for f in near for m in f.credible_set)
    pull = np.nan
    for cause, error in zip(found.causes, found.errors, strict=True):
        if (cause.effect, cause.element) == truth and error > 0:
            pull = (cause.amount - fault.amount) / error
    return ratio, bool(near), inside, len(found.findings) - len(near[:1]), pull


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("lattice")
    arguments.add_argument("--cases", type=int, default=100)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--small", type=float, default=0.0)
    arguments.add_argument("--kinds", nargs="+", default=["turns"], choices=MAKE)
    arguments.add_argument("--alone", action="store_true", help="each kind alone too")
    arguments.add_argument("--faultless", action="store_true")
    given = arguments.parse_args()
    ring = load_ring(given.lattice)
    sets = [tuple(given.kinds)]
    if given.alone and len(given.kinds) > 1:
        sets = [*((kind,) for kind in given.kinds), *sets]
    rows, seconds, verdicts = defaultdict(list), defaultdict(list), defaultdict(Counter)
    alarms = Counter()
    for case in tqdm(range(given.cases), disable=None):
        seed = 10_000 * (given.seed + 1) + case
        fault = drawn(ring, seed)
        causes = [] if given.faultless else [fault]
        try:
            data = measured(ring, causes, given.kinds, given.small, seed)
        except TmlatticeError as error:  # a fault that no beam survives
            verdicts["not simulated"][type(error).__name__] += 1
            continue
        for some in sets:
            begun = time.process_time()
            found = diagnose(ring, {kind: data[kind] for kind in some})
            seconds[some].append(time.process_time() - begun)
            verdicts[some][found.verdict] += 1
            alarms[some] += bool(found.findings) and given.faultless
            if not given.faultless:
                rows[some].append(judged(ring, fault, found))
    for some in sets:
        name = " + ".join(some)
        print(f"{name}: {dict(verdicts[some])}, {np.median(seconds[some]):.2f} s in the median, "
              f"{np.max(seconds[some]):.1f} at most")  # fmt: skip
        if given.faultless:
            print(f"  false alarms {alarms[some]} of {given.cases}")
            continue
        table = np.array(rows[some], dtype=float)
        for low, high in zip((0.0, *BANDS[:-1]), BANDS, strict=True):
            own = table[(table[:, 0] >= low) & (table[:, 0] < high)]
            if not len(own):
                continue
            pulls = own[np.isfinite(own[:, 4]), 4]
            spread = f", pulls {np.std(pulls):.2f} ({len(pulls)})" if len(pulls) > 2 else ""
            print(f"  signal to noise {low:g} to {high:g}: {len(own)} cases, place "
                  f"{100 * own[:, 1].mean():.1f} %, in the set {100 * own[:, 2].mean():.1f} %, "
                  f"further findings {int(own[:, 3].clip(0).sum())}{spread}")  # fmt: skip
    if verdicts["not simulated"]:
        print(f"not simulated: {dict(verdicts['not simulated'])}")


if __name__ == "__main__":
    main()
