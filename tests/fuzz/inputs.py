"""One file of every format that is read, on a ring of ten magnets."""

import contextlib
import math
import shutil
from pathlib import Path

MADX = """
beam, particle=electron, energy=3.0;
l0 = 0.4; k0 := 0.9;
qf: quadrupole, l:=l0, k1:=k0; qd: quadrupole, l=0.4, k1=-0.95;
b: sbend, l=1.2, angle=pi/2, e1=pi/4, e2=pi/4; sf: sextupole, l=0.2, k2=6.0;
ch: hkicker, l=0.1; cv: vkicker, l=0.1; m1: monitor; m2: monitor; d: drift, l=0.5;
cell: line=(m1, qf, d, b, d, m2);
ring: line=(m1, qf, d, sf, ch, d, b, m2, cv, qd, d, b, m1, qf, d, b, m2, qd, d, b, d);
"""
ELEGANT = """QF: KQUAD, L=0.4, K1=0.9
QD: KQUAD, L=0.4, K1=-0.95
B: CSBEND, L=1.2, ANGLE=1.5707963267948966, E1=0.78, E2=0.78
M: MONI
C: KICKER
D: DRIF, L="0.25 2 *"
CELL: LINE=(M, QF, D, C, B, M, QD, D, B)
RING: LINE=(CELL, CELL)
"""


def ring():
    """Ten magnets, six monitors."""
    from tmlattice.lattice.ocelot import elements as o
    from tmlattice.lattice.places import place_elements
    from tmlattice.lattice.ring import Ring

    qf, qd = o.Quadrupole(l=0.4, k1=0.9, eid="qf"), o.Quadrupole(l=0.4, k1=-0.9, eid="qd")
    bend = o.SBend(l=1.2, angle=math.pi / 8, e1=math.pi / 16, e2=math.pi / 16, eid="b")
    monitor, drift = o.Monitor(eid="m"), o.Drift(l=0.5, eid="d")
    coils = o.Hcor(l=0.1, eid="ch"), o.Vcor(l=0.1, eid="cv")
    cell = [monitor, qf, *coils, drift, bend, monitor, drift, qd, drift]
    sources = [*cell, *cell, *cell, o.Sextupole(l=0.2, k2=3.0, eid="s")]
    return Ring("ten", place_elements([s.id for s in sources], sources), 3.0)


def challenge(folder):
    """A challenge of two cases, diagnosed."""
    from tmlattice.challenge import make, run

    with contextlib.chdir(folder):
        make("A", 2, 1, Path("set"), lattice="ring.json", shots=2, progress=False)
        run(Path("set"), jobs=1, progress=False)


def write_all(folder, challenges=True, more=True):
    """Write the files; {format: (command, file that is damaged)}."""
    import at
    from at_ring import at_lattice
    from measured import unsealed, write_measured

    from tmlattice.lattice import save_ring
    from tmlattice.machine import simulate
    from tmlattice.machine.response import simulate_response
    from tmlattice.measurement import write_measurement

    ten = ring()
    save_ring(ten, folder / "ring.json")
    save_ring(ten, folder / "own.json")
    lattice = at.Lattice([*at_lattice(ten)], energy=3e9, periodicity=1, name="ring")
    for name in ("at.json", "at.mat", "at.m", "at.repr"):
        at.save_lattice(lattice, folder / name)
    (folder / "ring.seq").write_text(MADX)
    (folder / "ring.lte").write_text(ELEGANT)
    (folder / "lte.toml").write_text('[lattice]\nfile = "ring.lte"\nenergy = 3\n')
    shots = {"shots": 3, "engine": "ocelot", "seed": 1, "amplitude": 5e-4}
    write_measurement(folder / "turns", simulate(ten, [], **shots).measurement())
    measured = simulate_response(ten, [], seed=1, progress=False, engine="ocelot").measured
    write_measurement(folder / "response", measured)
    for kind in ("turns", "response"):
        unsealed(folder / kind)
    xsuite = Path(__file__).parent.parent / "lattices" / "xtrack_line.json"
    shutil.copy(xsuite, folder / "xsuite.json")
    score = ["dev", "challenge", "score", "set", "--no-oracle", "--jobs", "1"]
    run = ["dev", "challenge", "run", "set", "--jobs", "1", "-q"]
    info = lambda name, *more: (["info", name, *more], name)  # noqa: E731
    found = {
        "own JSON": info("own.json"),
        "AT .json": info("at.json"),
        "AT .mat": info("at.mat"),
        "AT .m": info("at.m"),
        "AT .repr": info("at.repr"),
        "MAD-X": info("ring.seq"),
        "elegant": info("ring.lte", "--machine", "lte.toml"),
        "machine file": (["info", "--machine", "lte.toml"], "lte.toml"),
        "Xsuite": info("xsuite.json"),
        "turns, JSON": (["diagnose", "ring.json", "turns"], "turns/measurement.json"),
        "turns, table": (["diagnose", "ring.json", "turns"], "turns/readings.csv"),
        "response, JSON": (["diagnose", "ring.json", "response"], "response/measurement.json"),
        "response, table": (["diagnose", "ring.json", "response"], "response/response.csv"),
        "check": (["check", "ring.json", "turns"], "turns/measurement.json"),
    }
    if more:
        found |= write_measured(ten, folder)
    if challenges:
        challenge(folder)
        found |= {
            "result": (score, "set/results/0000.json"),
            "truth": (score, "set/truth/0000.json"),
            "truth, arrays": (score, "set/truth/0000.npz"),
            "challenge": (score, "set/challenge.json"),
            "case": (run, "set/cases/0000/case.json"),
            "case, data": (run, "set/cases/0000/fit/readings.csv"),
        }
    return found
