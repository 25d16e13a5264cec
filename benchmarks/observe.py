"""What measurements of a stored beam cost, and how it grows: `python benchmarks/observe.py`.

Turns of two modes with coupling and noise at all monitors, as many as asked for; for each size the
processor seconds that the spectra take (`observe.spectra.lines`), that the folder takes to be
written and read, and the rms of the amplitudes' deviations over their errors. Least of three runs.

One thread of a busy machine; writing and reading (`--files`) in another run:

    turns monitors shots   spectra   write    read    rms of deviations over errors
     1000      246     4      0.25     2.1     3.9    0.99
     1000      246     1      0.06     0.6     0.9    0.99
     1000       60     4      0.08     0.5     0.9    1.04
      250      246     4      0.07     0.5     0.9    1.00
     4000      246     4      1.04     8.8    16.2    1.00
    10000      246     1      0.75     5.5     9.5    0.99

All grow as turns x monitors x shots. `--scans` asks every hypothesis once on the built-in ring,
with the threshold's simulation: four kicks, and the response of 330 correctors at 246 monitors, of
which kicks are seen by the orbit that they make in the sextupoles. Least of two runs on
a machine with three times as much to do as it has processors:

    scan of        hypotheses  readings   seconds
    turns                8224      7880      0.36
    a response           4461    162360      2.92
    kicks in it          2350    162360      2.14

No signature is written out: turns cost as the modes at the monitors, whatever the shots; of a
response the squares are summed up reading by reading, so that it grows as hypotheses x readings.

`--pulls LATTICE` prints how far amounts from closed orbits are off, in their stated errors.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from tmlattice import diagnose, load_ring
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.challenge.draw import Draw
from tmlattice.challenge.kinds import Ruler, measure, problem_of
from tmlattice.effects import find, modelled
from tmlattice.inference.newton import fit
from tmlattice.inference.scan import scan
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.measurement import OrbitResponse, TurnByTurn, read_measurement, write_measurement
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response, single_causes
from tmlattice.observe.spectra import lines
from tmlattice.observe.turn_by_turn import many_turns

SIZES = (
    # turns, monitors, shots
    (1000, 246, 4),
    (1000, 246, 1),
    (1000, 60, 4),
    (250, 246, 4),
    (4000, 246, 4),
    (10_000, 246, 1),
)
TUNES, NOISE = (0.1237, 0.2746), 2e-5


def turns_of(turns, monitors, shots, rng):
    """Readings and true amplitudes [shot, monitor, plane, mode]."""
    size = np.array([[1e-3, 5e-5], [1e-4, 5e-4]])
    modulus = size * rng.uniform(0.5, 1.5, (shots, monitors, 2, 2))
    amplitude = modulus * np.exp(2j * np.pi * rng.uniform(size=modulus.shape))
    moving = np.exp(2j * np.pi * np.outer(np.arange(turns), TUNES))
    readings = np.einsum("sbpm,tm->stbp", amplitude, moving).real
    readings += NOISE * rng.standard_normal(readings.shape)
    return TurnByTurn(readings, tuple(f"b{i}" for i in range(monitors)), (NOISE, NOISE)), amplitude


def least(function, number=3):
    """Seconds, and what it gives."""
    best = np.inf
    for _ in range(number):
        start = time.process_time()
        made = function()
        best = min(best, time.process_time() - start)
    return best, made


def pulls(found, amplitude):
    """rms over shots, monitors and planes, one complex scale a mode and shot taken out."""
    off = []
    for true, read, error in zip(amplitude, found.amplitude, found.error, strict=True):
        for mode in (0, 1):
            a, b, e = (v[..., mode].ravel() for v in (true, read, error))
            off.append((b - np.vdot(a / e, b / e) / np.vdot(a / e, a / e) * a) / e)
    return float(np.sqrt(np.mean(np.abs(off) ** 2) / 2))


# --- scans ----------------------------------------------------------------------------------------
def turns_problem(ring):
    """Four kicks, 64 turns: what a scan costs does not hang on their number."""
    return many_turns(ring, simulate_turns(ring, [], shots=4, turns=64, seed=1).measured, {})


def response_problem(ring):
    """The response of 330 of its correctors, by the model."""
    model = ResponseModel(ring)
    columns = model.columns(model.correctors[:330])
    names = tuple(monitor.name for monitor in ring.monitors)
    kicks = np.full(len(columns.names), 1e-4)
    measured = OrbitResponse(
        correctors=columns.names, planes=columns.planes, kicks=kicks, monitors=names,
        response=kicks[:, None, None] * model.response(columns.names),
        noise=np.full((len(names), 2), 2e-6),
    )  # fmt: skip
    data = response_data(ring, measured)
    base = Predicted(data, Errors.none(data)).bend()
    return Response(base=base, used=np.isfinite(data.orbits), places={}), single_causes(data)


def scans():
    """Processor seconds of every hypothesis asked once."""
    ring = load_ring("petra3")
    turns = turns_problem(ring)
    response, single = response_problem(ring)
    asked = [(name, p) for name in modelled(None, turns=True) for p in find(name).places(ring)]
    print("scan of        hypotheses  readings   seconds")
    seen = {True: [], False: []}
    for h in single:
        seen[find(h[0]).responds].append(h)
    for what, problem, some in (
        ("turns", turns, [h for h in asked if turns.sees(h)]),
        ("a response", response, seen[True]),
        ("kicks in it", response, seen[False]),
    ):
        start = fit(problem, (), problem.first)
        seconds, _ = least(
            lambda p=problem, h=some, s=start: scan(p.metric(s.point), h, s.residual), 2
        )
        print(
            f"{what:14s} {len(some):10d} {int(problem.valid.sum()):9d} {seconds:9.2f}", flush=True
        )


# --- amounts --------------------------------------------------------------------------------------
KICKS = ("corrector_kick_x", "corrector_kick_y", "dipole_field", "dipole_roll",
         "quadrupole_offset_x", "quadrupole_offset_y")  # fmt: skip


def closed_orbit_pulls(lattice, cases):
    """Of one kick of a signal to noise of 20 to 100 in one closed orbit by AT: how far its amount
    is off, in its stated error."""
    ring, kind, off, held = load_ring(lattice), "closed_orbit", [], 0
    for number in range(cases):
        rng = np.random.default_rng([77, number])
        seed = int(rng.integers(2**31))
        healthy = measure(kind, ring, (), 1.0, 4, seed=seed + 1, machine_seed=seed)
        ruler = Ruler(problem_of(ring, {kind: healthy}, {}, {}))
        true = Draw(rng, (20.0, 100.0)).one(ruler, KICKS, lambda effect: effect.places(ring))
        sick = measure(kind, ring, [true], 1.0, 4, seed=seed, machine_seed=seed)
        for found in diagnose(ring, sick).findings:
            members = [(one.effect, one.element) for one in found.credible_set]
            held += (true.effect, true.element) in members
            if members[0] == (true.effect, true.element):
                off.append((found.amount - true.amount) / found.amount_sigma)
    print(
        f"{cases} closed orbits: the truth in {held} sets, first in {len(off)}; pulls have mean "
        f"{np.mean(off):.2f} and width {np.std(off, ddof=1):.2f}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", action="store_true", help="Write and read folders too.")
    parser.add_argument("--scans", action="store_true", help="Scans on the built-in ring instead.")
    parser.add_argument("--pulls", metavar="LATTICE", help="Amounts from closed orbits instead.")
    parser.add_argument("--cases", type=int, default=100, help="Of --pulls.")
    chosen = parser.parse_args()
    if chosen.scans:
        scans()
        return
    if chosen.pulls:
        closed_orbit_pulls(chosen.pulls, chosen.cases)
        return
    print("turns monitors shots   spectra   write    read    rms of deviations over errors")
    for turns, monitors, shots in SIZES:
        measured, amplitude = turns_of(turns, monitors, shots, np.random.default_rng(1))
        at = np.zeros(monitors)
        seconds, found = least(lambda m=measured, at=at: lines(m, at=at))
        write = read = np.nan
        if chosen.files:
            with tempfile.TemporaryDirectory() as folder:
                place = Path(folder) / "m"
                write, _ = least(lambda m=measured, p=place: write_measurement(p, m), 1)
                read, _ = least(lambda p=place: read_measurement(p), 1)
        print(
            f"{turns:5d} {monitors:8d} {shots:5d} {seconds:9.2f} {write:7.1f} {read:7.1f} "
            f"{pulls(found, amplitude):7.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
