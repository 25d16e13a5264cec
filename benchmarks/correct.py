"""Measure, diagnose, correct, measure again: what is left of the optics' errors, AT as the machine.

`python benchmarks/correct.py LATTICE [--cases 10] [--kind response|turns|first_turns] [--out FILE]`

Each case is a machine of its own with all usual errors of the catalogue (`--scale`), quadrupoles
wrong by `--gradient` rms, and its orbit corrected by its correctors up to 5 % of their kicks. Its
quadrupole supplies, or each quadrupole (`--knobs`), can be set within `--limit` of their strength,
in steps of 1e-4 of it; each makes its change with a relative error of 1 %, which the oracle alone
knows (`oracle_made`: its settings with these errors). The machine is measured with AT, diagnosed
with default options and corrected; the settings are put into the machine, and AT gives the true
optics at the BPMs: beta beating, dispersion, tunes, coupling. Compared with

- oracle: the same knobs and targets, all errors known;
- svd: the response matrix of the design's supplies, inverted with the number of singular values
  that leaves least, chosen in hindsight (of an orbit response);
- loco: all gradients, skew gradients, gains and kicks fitted to the response by least squares
  without priors, with the best of three cuts in hindsight, and the fitted ring corrected (of an
  orbit response).

A line a case is written at once, with its study (lattice, kind, knobs); cases that FILE has
already are not measured again.
`--keep FOLDER` keeps measurements and diagnoses (the package's own pickles), for the next run to
start from. `--summary FILE` prints the table of such a file. `--sigmas 0 1.5 2` corrects with each
of these values of `solve.SIGMAS` too, and prints what never being worse costs.
"""

import argparse
import json
import logging
import pickle
import time
import warnings
from dataclasses import replace
from pathlib import Path
from unittest import mock

import at
import numpy as np
from scipy.stats import norm
from tables import against, commit

from tmlattice import diagnose, load_ring
from tmlattice.correction import correct, default_knobs, solve
from tmlattice.correction.estimate import Estimate, estimate_of
from tmlattice.correction.targets import ENERGY, Targets
from tmlattice.effects import Cause, RingEffect, apply, background_rms, find
from tmlattice.errors import TmlatticeError
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.response import simulate_response
from tmlattice.machine.shots import draw_background, stream
from tmlattice.machine.simulate import simulate
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data

OPTICS = ("beta_beating", "phase_advance", "dispersion", "tunes", "coupling")
STEERED = 0.05
"""Relative error of the correctors' kicks that correct the orbit before anything is measured."""
CUTS = (1e-2, 1e-3, 1e-5)
"""Of the singular values of a fit without priors, as a share of the largest."""
LARGEST = 1.0
"""Relative change of a gradient or gain from which on such a fit has diverged."""
MEASURED = {
    "response": lambda *machine, seed: (
        simulate_response(*machine, seed=seed, progress=False).measured
    ),
    "turns": lambda *machine, seed: simulate_turns(*machine, seed=seed).measured,
    "first_turns": lambda *machine, seed: simulate(*machine, shots=20, seed=seed).measurement(),
}
"""The measurement of a machine, by its kind."""
METHODS = ("before", "tmlattice", "oracle", "svd", "loco")


def measured(ring, causes, step):
    """AT's optics of the stored beam at the BPMs: beta, m; tunes; coupling; phase; and dispersion,
    m, by two relative steps of the RF, per the energy that they make in the design."""
    engine = AtEngine(ring, causes)
    start, _ = engine._stored
    lattice = engine.lattice()
    places = [i for i, e in enumerate(lattice) if isinstance(e, at.Monitor)]
    _, data, found = at.get_optics(
        lattice, places, dp=float(start[4]), get_chrom=False, XYStep=3e-6, DPStep=1e-3
    )
    up, down = engine.closed_orbits([{"rf": {"frequency_relative": side * step}}
                                     for side in (1, -1)])  # fmt: skip
    R = found.R
    own = np.stack([R[:, 0, 0, 0], R[:, 1, 2, 2]], axis=-1)
    other = np.stack([R[:, 0, 2, 2], R[:, 1, 0, 0]], axis=-1)
    phase = found.mu / (2 * np.pi)
    return {
        "beta": own,
        "coupling": np.sqrt(np.abs(other) / own),
        "dispersion": (up - down) / (2 * ENERGY),
        "tunes": data.tune[:2],
        "phase": phase,
    }


def errors(now, goal, tolerance):
    """rms by target, (x, y), and the cost that a correction minimises."""
    beta = goal["beta"]
    advance = np.diff(now["phase"] - goal["phase"], axis=0)
    parts = {
        "beta_beating": now["beta"] / beta - 1,
        "phase_advance": advance - np.round(advance),
        "dispersion": now["dispersion"] - goal["dispersion"],
        "tunes": ((now["tunes"] - goal["tunes"] + 0.5) % 1 - 0.5)[None],
        "coupling": np.sqrt(beta / beta[:, ::-1]) * now["coupling"],
    }
    rms = {name: np.sqrt(np.mean(own**2, axis=0)) for name, own in parts.items()}
    half = {"coupling": 0.5}
    cost = sum(
        np.mean(np.sqrt(1 + half.get(name, 1.0) * (own / tolerance[name]) ** 2) - 1)
        for name, own in rms.items()
    )
    return {**{name: own.tolist() for name, own in rms.items()}, "cost": float(cost)}


def devices(ring, kind, limit):
    knobs = []
    for knob in default_knobs(ring, [kind, "skew_quadrupoles"]):
        size = abs(knob.present) or 0.01
        knobs.append(replace(knob, low=knob.present - limit * size, step=1e-4 * size,
                             high=knob.present + limit * size))  # fmt: skip
    return knobs


def clipped(knobs, amounts):
    """Amounts within the limits."""
    return [
        min(max(a, knob.bounds[0]), knob.bounds[1]) for knob, a in zip(knobs, amounts, strict=True)
    ]


def changes(knobs, amounts):
    return [
        cause for knob, a in zip(knobs, amounts, strict=True) for cause in knob.causes(float(a))
    ]


def of_settings(correction, scale=None):
    """The causes that the settings make; `scale`: made over asked change by knob, else 1."""
    return [c for s in correction.settings
            for c in s.knob.causes(s.amount * (scale[s.knob.name] if scale else 1.0))]  # fmt: skip


def svd_candidates(ring, data, knobs):
    """Amounts of the supplies with 1, 2, ... singular values of the design's response matrix."""
    at_design = Predicted(data, Errors.none(data))
    weight = 1 / data.noise[None] if np.ndim(data.noise) else 1 / data.noise
    pairs = [(c.effect, c.element) for knob in knobs for c in knob.causes(1.0)]
    owner = [k for k, knob in enumerate(knobs) for _ in knob.causes(1.0)]
    matrix = np.zeros((len(knobs), at_design.left.size))
    for k, slope in zip(owner, at_design.signatures(pairs), strict=True):
        matrix[k] += np.nan_to_num(slope * weight).ravel()
    left = np.nan_to_num(at_design.left * weight).ravel()
    u, s, v = np.linalg.svd(matrix.T, full_matrices=False)
    for n in range(1, len(s) + 1):
        yield -(v[:n].T @ ((u[:, :n].T @ left) / s[:n]))


def loco(ring, data, cut):
    """The ring of a least squares fit without priors: gradients, skew gradients, gains, kicks; its
    singular values below a share `cut` of the largest are left out."""
    names = (
        "quadrupole_gradient",
        "skew_gradient",
        "monitor_gain_x",
        "monitor_gain_y",
        "monitor_roll",
        "monitor_coupling",
        "corrector_calibration",
        "corrector_roll",
    )
    quads = {e.name for e in ring.elements if e.kind == "quadrupole" and e.k1}
    used = {*data.measured.correctors, *data.measured.monitors, *quads}
    hypotheses = [(n, p) for n in names for p in find(n).places(ring) if p in used]
    amounts = np.zeros(len(hypotheses))
    weight = 1 / data.noise[None] if np.ndim(data.noise) else 1 / data.noise
    best = None
    for _ in range(4):
        causes = [Cause(*h, float(a)) for h, a in zip(hypotheses, amounts, strict=True)]
        now = Predicted(data, Errors.none(data)).with_causes(causes)
        left = np.nan_to_num(now.left * weight).ravel()
        chi2 = float(left @ left)
        if best is None or chi2 < best[0]:
            best = (chi2, causes)
        matrix = np.array([np.nan_to_num(s * weight).ravel() for s in now.signatures(hypotheses)])
        scale = np.linalg.norm(matrix, axis=1)
        scale[scale == 0] = 1.0
        found = np.linalg.lstsq((matrix / scale[:, None]).T, left, rcond=cut)[0] / scale
        if not np.isfinite(found).all() or np.abs(found).max() > LARGEST:
            break
        amounts = amounts + found
    inside = [c for c in best[1] if isinstance(find(c.effect), RingEffect)
              and not find(c.effect).acts_on_settings]  # fmt: skip
    return apply(ring, inside)


def safely(run):
    """What it returns; None where there is no beam or no solution."""
    try:
        return run()
    except (TmlatticeError, at.AtError, np.linalg.LinAlgError, ValueError):
        return None


def diagnosed(ring, causes, seed, kind):
    """The measurement of a machine, its diagnosis, and the seconds of processor that it took."""
    data = MEASURED[kind](ring, causes, seed=seed)
    begun = time.process_time()
    return data, diagnose(ring, data), time.process_time() - begun


def machine(ring, seed, options):
    """Its causes, knobs, made over asked change by knob, the errors that settings leave, and those
    that the oracle's leave, with exact changes and with the made ones."""
    rms = background_rms({"all": options.scale})
    causes = [c for c in draw_background(ring, rms, seed) if c.effect != "quadrupole_gradient"]
    places = find("quadrupole_gradient").places(ring)
    drawn = options.gradient * stream(seed, "gradients").standard_normal(len(places))
    causes += [
        Cause("quadrupole_gradient", p, float(a)) for p, a in zip(places, drawn, strict=True)
    ]
    on_ring = [c for c in causes if isinstance(find(c.effect), RingEffect)]
    steered = correct(
        apply(ring, on_ring),
        goal=ring,
        targets=["closed_orbit"],
        knobs=[replace(k, error=STEERED) for k in default_knobs(ring, ["correctors"])],
    )
    miss = 1 + STEERED * stream(seed, "steering").standard_normal(len(steered.settings))
    kicks = [replace(c, amount=float(m) * c.amount)
             for m, s in zip(miss, steered.settings, strict=True)
             for c in s.knob.causes(s.amount)]  # fmt: skip
    causes, on_ring = [*causes, *kicks], [*on_ring, *kicks]
    knobs = devices(ring, options.knobs, options.limit)
    drawn = stream(seed, "knobs").standard_normal(len(knobs))
    made = {k.name: 1 + k.error * float(d) for k, d in zip(knobs, drawn, strict=True)}
    targets = Targets(ring, OPTICS)
    goal = measured(ring, [], targets.step)

    def left(settings):
        try:
            return errors(
                measured(ring, [*on_ring, *settings], targets.step), goal, targets.tolerance
            )
        except (at.AtError, TmlatticeError, np.linalg.LinAlgError):
            return None

    truth = Estimate(apply(ring, on_ring), ring)
    best = correct(truth, knobs=[replace(k, error=0.0) for k in knobs], targets=OPTICS)
    oracle = {"oracle": left(of_settings(best)), "oracle_made": left(of_settings(best, made))}
    return causes, knobs, made, left, oracle


def case(ring, seed, options):
    """One machine: rms errors by method, and what was predicted."""
    causes, knobs, made, left, oracle = machine(ring, seed, options)
    found = {"seed": seed, "before": left([]), **oracle}
    kept = options.keep and options.keep / f"{options.kind}-{seed}.pickle"
    if kept and kept.is_file():
        data, diagnosis, seconds = pickle.loads(kept.read_bytes())
    else:
        data, diagnosis, seconds = diagnosed(ring, causes, seed, options.kind)
        if kept:
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(pickle.dumps((data, diagnosis, seconds)))
    begun = time.process_time()
    estimate = estimate_of(diagnosis)
    then = time.process_time()
    own = correct(estimate, knobs=knobs, targets=OPTICS)
    found |= {"seconds_diagnosis": seconds, "seconds_posterior": then - begun,
              "seconds_correction": time.process_time() - then}  # fmt: skip
    found |= {"tmlattice": left(of_settings(own, made)), "refused": own.refused,
              "devices": len(own.settings), "now": own.before, "expected": own.after,
              "at_limit": sum(s.at_limit for s in own.settings)}  # fmt: skip
    if options.sigmas:
        found["prices"] = {
            f"{n:g}": price(estimate, knobs, n, lambda c: left(of_settings(c, made))["cost"])
            for n in options.sigmas
        }
    if options.kind == "response" and not options.alone:
        readings = response_data(ring, data)
        ratio = np.array([made[knob.name] for knob in knobs])
        tried = [left(changes(knobs, ratio * clipped(knobs, a)))
                 for a in svd_candidates(ring, readings, knobs)]  # fmt: skip
        tried = [one for one in tried if one is not None]
        found["svd"] = min(tried, key=lambda one: one["cost"], default=None)
        fits = [
            safely(lambda cut=cut: left(of_settings(correct(
                loco(ring, readings, cut), goal=ring, knobs=knobs, targets=OPTICS), made)))
            for cut in CUTS
        ]  # fmt: skip
        found["loco"] = min((f for f in fits if f), key=lambda one: one["cost"], default=None)
        found["loco_cuts"] = [f and f["cost"] for f in fits]
    return found


def price(estimate, knobs, sigmas, cost):
    """The cost, whether nothing is set, and the chance to be worse, of a correction whose gain is
    this many standard deviations above zero."""
    with mock.patch.object(solve, "SIGMAS", sigmas):
        found = correct(estimate, knobs=knobs, targets=OPTICS)
    chance = 0.0 if found.refused else norm.sf(found.gain / found.gain_error)
    return [cost(found), bool(found.refused), float(chance)]


def prices(rows):
    """Print the table of `price` as Markdown."""
    print("| standard deviations | median after | nothing set | worse than before "
          "| expected by the posterior |\n" + "|---" * 5 + "|")  # fmt: skip
    before = np.array([row["before"]["cost"] for row in rows])
    for sigmas in rows[0]["prices"]:
        after, refused, chance = np.array([row["prices"][sigmas] for row in rows]).T
        print(f"| {sigmas} | {np.median(after):.3g} | {refused.sum():.0f} "
              f"| {np.sum(after > before)} | {chance.sum():.2g} |")  # fmt: skip


def beat(one):
    return float("inf") if one is None else float(np.sqrt(np.mean(np.square(one["beta_beating"]))))


def rms(one, name):
    return float("inf") if one is None else float(np.sqrt(np.mean(np.square(one[name]))))


def summary(rows):
    """The table of cases."""
    cost = {m: np.array([np.inf if r.get(m) is None else r[m]["cost"] for r in rows])
              for m in METHODS}  # fmt: skip
    beta = {m: np.array([beat(r.get(m)) for r in rows]) for m in METHODS}
    print(f"{len(rows)} machines; {sum(bool(r['refused']) for r in rows)} refused")
    methods = [m for m in METHODS if all(m in row for row in rows)]
    print(f"{'median':14s}" + "".join(f"{m:>12s}" for m in methods))
    for name in OPTICS:
        own = [np.median([rms(r.get(m), name) for r in rows]) for m in methods]
        print(f"{name:14s}" + "".join(f"{v:12.4g}" for v in own))
    print(f"{'cost':14s}" + "".join(f"{np.median(cost[m]):12.4g}" for m in methods))
    ratio = beta["tmlattice"] / beta["oracle"]
    print(f"beta beating over the oracle's: median {np.median(ratio):.3f}, worst {ratio.max():.3f}")
    more = cost["tmlattice"] - cost["oracle"]
    print(f"tolerances beyond the oracle's: median {np.median(more):.3f}, worst {more.max():.3f}")
    for other in ("svd", "loco", "before"):
        if all(other in row for row in rows):
            better = np.sum(cost["tmlattice"] <= cost[other])
            print(f"better than {other}, or equal: {better} of {len(rows)} (beta beating "
                  f"{np.sum(beta['tmlattice'] <= beta[other])})")  # fmt: skip
            if other != "before":
                print("better, equal within the effect of the changes' errors, worse: "
                      f"{against(rows, other)}")  # fmt: skip
    for when, true in (("now", "before"), ("expected", "tmlattice")):
        held = {}
        for name in OPTICS:
            pairs = [p for r in rows for p in zip(r[when][name], r[true][name], strict=True)]
            held[name] = np.mean([low <= own <= high for (_, low, high), own in pairs])
        shares = ", ".join(f"{name} {share:.2f}" for name, share in held.items())
        print(f"68 % intervals that hold, {when}: {shares}; all {np.mean([*held.values()]):.2f}")
    for what in ("diagnosis", "posterior", "correction"):
        print(f"seconds of the {what}: {np.median([r[f'seconds_{what}'] for r in rows]):.1f}")


def main() -> None:
    """Measure, and print the table."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("lattice", nargs="?")
    arguments.add_argument("--cases", type=int, default=10)
    arguments.add_argument("--kind", choices=tuple(MEASURED), default="response")
    arguments.add_argument("--scale", type=float, default=1.0)
    arguments.add_argument("--gradient", type=float, default=3e-3)
    arguments.add_argument("--limit", type=float, default=0.03)
    arguments.add_argument("--knobs", default="supplies")
    arguments.add_argument("--correctors", default=None, help="patterns, as `load_ring` takes them")
    arguments.add_argument("--monitors", default=None)
    arguments.add_argument("--sigmas", type=float, nargs="+", default=())
    arguments.add_argument("--out", type=Path)
    arguments.add_argument("--keep", type=Path, help="folder of diagnoses, for another correction")
    arguments.add_argument("--alone", action="store_true", help="without SVD and LOCO")
    arguments.add_argument("--summary", type=Path)
    options = arguments.parse_args()
    if options.summary:
        rows = [json.loads(line) for line in options.summary.read_text().splitlines()]
        for study in sorted({tuple(row["study"]) for row in rows}):
            print("\n" + ", ".join(study))
            summary([row for row in rows if tuple(row["study"]) == study])
        return
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    marks = {
        k: v for k, v in (("correctors", options.correctors), ("monitors", options.monitors)) if v
    }
    ring = load_ring(options.lattice, **marks)
    rows = []
    if options.out and options.out.is_file():
        rows = [json.loads(line) for line in options.out.read_text().splitlines()]
    study = [Path(options.lattice).stem, options.kind, options.knobs]
    if study[0] == "lattice":  # of `tmlattice import`
        study[0] = Path(options.lattice).absolute().parent.name
    rows = [row for row in rows if row["study"] == study]
    done = {row["seed"] for row in rows}
    for seed in range(options.cases):
        if seed in done:
            continue
        try:
            row = {"study": study, "commit": commit(), **case(ring, seed, options)}
        except (TmlatticeError, ValueError) as error:
            print(f"seed {seed}: {type(error).__name__}: {error}", flush=True)
            continue
        rows.append(row)
        print(f"seed {seed}: beta beating " + ", ".join(
            f"{m} {100 * beat(row.get(m)):.2f} %" for m in METHODS), flush=True)  # fmt: skip
        if options.out:
            with options.out.open("a") as file:
                short = json.loads(json.dumps(row), parse_float=lambda n: float(f"{float(n):.4g}"))
                file.write(json.dumps(short) + "\n")
    summary(rows)
    if options.sigmas and rows:
        prices(rows)


if __name__ == "__main__":
    main()
