"""One displaced sextupole among the usual errors, by first turns: oracle and diagnosis.

SOLEIL's lattice as accelerator-toolbox ships it; six shots of 1 mm, noise 20 micrometres, every
usual error of the catalogue, and one sextupole, drawn by the seed, that is displaced. The oracle is
a dense Gaussian model of the readings with the true scales, linear about the true errors and
launches; what the leading displacements do is taken to second order from AT. It integrates the
amount over four decades, as the diagnosis does, and has all six shots.

The oracle detects where the largest fall of chi-square is above the threshold of the whole scan
(0.3 %). `diagnose` is run three times: with default options (four shots in the fit), with all six
shots in the fit, and with these and the scales stated.

    python benchmarks/displaced_sextupole.py --amount 1e-3 --plane x --seeds 1 2 3
"""

import argparse
import logging
import warnings
from pathlib import Path

import machine_data
import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp
from scipy.stats import chi2

from tmlattice import Cause, diagnose, load_ring, simulate
from tmlattice.beam.model import Model
from tmlattice.effects import background_rms, find
from tmlattice.machine import Machine, draw_background

NOISE = 2e-5
STEP = 1e-3  # m; of a displacement, for its slope and curvature
FINITE = 30  # displacements whose curvature is taken
RATE = 0.003  # of false alarms
DRAWS = 64


def oracle(ring, simulation, fault, amount) -> dict:
    """Signal to noise of the fault, its statistic and the largest, threshold, probabilities."""
    rms = background_rms({"all": None})
    shots = simulation.shots
    launches = shots.launches[:, [0, 1, 2, 3, 5]]
    small = draw_background(ring, rms, simulation.machine_seed)

    def read(more=()):
        machine = Machine(ring, [*small, *more], noise=NOISE)
        return machine.monitors.read(machine.beam(shots.launches))[:, 0]

    base = read()
    monitors = [c for c in small if c.effect.startswith("monitor")]
    known = [c for c in small if c not in monitors and not find(c.effect).acts_on_settings]
    model = Model(ring, [{}] * len(launches), known=known)
    paths = model.paths(launches, monitors)

    def slopes(hypotheses):
        return np.nan_to_num(model.signatures(paths, hypotheses, launches)).reshape(
            len(hypotheses), -1
        )

    errors = model.hypotheses(list(rms))
    scale = np.array([rms[name] for name, _ in errors])
    drawn = {(c.effect, c.element): c.amount for c in small}
    spread = scale[:, None] * slopes(errors)
    covariance = NOISE**2 * np.eye(base.size) + spread.T @ spread
    expected = (np.array([drawn[h] for h in errors]) / scale) @ spread
    per_shot = base[0].size
    for i, off in enumerate(launches - shots.nominal):
        own = slice(i * per_shot, (i + 1) * per_shot)
        launch = np.asarray(paths.launch[i]).reshape(per_shot, 5)
        covariance[own, own] += (launch * shots.sigma**2) @ launch.T
        expected[own] += launch @ off
    root = np.linalg.cholesky(covariance)

    def white(rows):
        return solve_triangular(root, np.atleast_2d(rows).T, lower=True).T

    rows = white((simulation.measurement().readings[:, 0] - base).ravel() + expected)[0]
    hypotheses = [h for h in model.hypotheses() if find(h[0]).modelled]
    first = white(slopes(hypotheses))
    second = np.zeros_like(first)
    norm = np.maximum((first**2).sum(axis=1), 1e-12)
    seen = (first @ rows) ** 2 / norm
    draws = (np.random.default_rng(0).standard_normal((DRAWS, rows.size)) @ first.T) ** 2 / norm
    count = DRAWS / -np.log1p(-chi2.sf(draws.max(axis=1), 1)).sum()
    moved = [i for i, h in enumerate(hypotheses) if h[0].startswith("sextupole_offset")]
    true = hypotheses.index(fault)
    for i in {*sorted(moved, key=lambda i: -seen[i])[:FINITE], true}:
        up, down = (read([Cause(*hypotheses[i], side * STEP)]) - base for side in (1, -1))
        first[i] = white((up - down).ravel() / (2 * STEP))[0]
        second[i] = white((up + down).ravel() / (2 * STEP**2))[0]
    share = np.logspace(-4, 0, 161)
    share = np.concatenate([-share, share])
    statistic, evidence = np.zeros((2, len(hypotheses)))
    effects = {name: sum(h[0] == name for h in hypotheses) for name, _ in hypotheses}
    for i, (name, _) in enumerate(hypotheses):
        effect = find(name)
        a = share * effect.largest
        a = np.sign(a) * np.abs(a) ** effect.power
        if effect.discrete:
            a = np.ones(1)
        one, two = first[i], second[i]
        gain = a * (one @ rows) + a**2 * (two @ rows)
        gain -= 0.5 * (a**2 * (one @ one) + 2 * a**3 * (one @ two) + a**4 * (two @ two))
        statistic[i] = 2 * gain.max()
        evidence[i] = logsumexp(gain) - np.log(len(a) * len(effects) * effects[name])
    probability = np.exp(evidence - logsumexp(evidence))
    own = [i for i, h in enumerate(hypotheses) if h[1] == fault[1]]
    return {
        "signal_to_noise": np.linalg.norm(first[true] * amount + second[true] * amount**2),
        "statistic": statistic[true],
        "largest": statistic.max(),
        "threshold": chi2.isf(-np.expm1(np.log1p(-RATE) / count), 1),
        "effect_and_place": probability[true],
        "place": probability[own].sum(),
    }


def main() -> None:
    """Print a line a seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--amount", type=float, default=1e-3)
    parser.add_argument("--plane", choices="xy", default="x")
    parser.add_argument("--seeds", nargs="*", type=int, default=list(range(1, 11)))
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    ring = load_ring(Path(machine_data.__file__).parent / "soleil.m")
    powered = [e.name for e in ring.elements if e.kind == "sextupole" and e.k2]
    told = {"background": {"all": None}}
    for seed in chosen.seeds:
        place = powered[int(np.random.default_rng(seed).integers(len(powered)))]
        fault = (f"sextupole_offset_{chosen.plane}", place)
        made = simulate(ring, [Cause(*fault, chosen.amount)], shots=6, seed=seed, **told)
        best = oracle(ring, made, fault, chosen.amount)
        line = [f"{seed} {place}:", *(f"{key} {value:.3g}" for key, value in best.items())]
        for name, options in (
            ("default", {}), ("six shots", {"holdout": 0.0}), ("scales", {"holdout": 0.0, **told}),
        ):  # fmt: skip
            found = diagnose(ring, made.measurement(), **options)
            sets = [[(m.effect, m.element) for m in f.credible_set] for f in found.findings]
            line.append(f"{name}: {found.verdict}" + " with it" * any(fault in s for s in sets))
        print("; ".join(line), flush=True)


if __name__ == "__main__":
    main()
