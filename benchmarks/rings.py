"""Ring after ring, the same questions: `python benchmarks/rings.py [NAME ...] [--out FILE]`.

The rings that accelerator-toolbox ships, and those of TMLATTICE_DATA where they are there. Each is
loaded from its file; its optics and its first turn are held against AT's own of the same file; both
engines simulate turns and an orbit response; one weak quadrupole is diagnosed, and its ring's tunes
are predicted by fine-tuning. The table has what differed, and the seconds.

`docs/rings.md` shows such a table; `tests/test_rings.py` asks the same of two small rings.
"""

import argparse
import logging
import os
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import at
import machine_data
import numpy as np

from tmlattice import diagnose, load_ring, tune_fit
from tmlattice.beam.chain import Chain
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.effects import Cause
from tmlattice.errors import TmlatticeError
from tmlattice.lattice.at_file import quiet_at
from tmlattice.machine import simulate
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.ocelot_engine import OcelotEngine
from tmlattice.machine.response import simulate_response
from tmlattice.optics import off_momentum, twiss

AMPLITUDE = 1e-4
"""m; of the first turn that is compared: third orders are below a thousandth there."""


@dataclass(frozen=True)
class Case:
    """One ring: where its file is, and what has to be known about it."""

    name: str
    path: Path
    options: dict = field(default_factory=dict)
    markers: str = ""  # FamName of the file's elements that are read, where they are no Monitor
    amplitude: float = 1e-3
    fault: str | None = None
    full: bool = True  # False: optics and engines alone


def shipped(name: str, **more) -> Case:
    return Case(name.split(".", maxsplit=1)[0], Path(machine_data.__file__).parent / name, **more)


def cases() -> list[Case]:
    known = [
        shipped("dba.mat", options={"monitors": "M,DR_03*", "correctors": "DR_04,SF"},
                markers="M"),
        shipped("thomx.m"),
        shipped("australian_synchrotron.m"),
        shipped("soleil.m", markers="BPM"),
        shipped("esrf.m", options={"correctors": "S4,S6,S13,S19,S20,S22,S24"}),
        # at 1 mm third orders are 13 micrometres rms in this ring: as large as the noise
        shipped("hmba.mat", options={"correctors": "SH*"}, amplitude=3e-4),
        shipped("err.mat", full=False),
    ]  # fmt: skip
    data = Path(os.environ.get("TMLATTICE_DATA", "nowhere"))
    more = [
        Case("petra3_low_beta", data / "petra3_orbit_response" / "p3_low_beta.mat"),
        Case("esrf_ebs", data / "real_rings" / "esrf_ebs" / "betamodel.mat",
             options={"sequence": "betamodel", "correctors": "S[FIJ]2A*"}, amplitude=3e-4),
    ]  # fmt: skip
    return known + [case for case in more if case.path.is_file()]


def fractions(tunes):
    return np.asarray(tunes) % 1.0


def of_the_file(case, launch):
    """AT's own of the same file: tunes, chromaticity, and (x, y) at what is read, first turn."""
    options = {"use": case.options["sequence"]} if "sequence" in case.options else {}
    with quiet_at():
        lattice = at.load_lattice(str(case.path), **options)
        lattice.disable_6d()
        for element in lattice:
            if isinstance(element, at.Multipole):
                element.NumIntSteps = 30
        tunes, chromaticity = at.get_tune(lattice)[:2], at.get_chrom(lattice)[:2]
        where = at.get_refpts(lattice, case.markers or at.Monitor)
        start = np.zeros((6, 1), order="F")
        start[:4, 0] = launch
        tracked = lattice.track(start, nturns=max(1, lattice.periodicity), refpts=where)[0]
    return tunes, chromaticity, tracked[[0, 2], 0].transpose(2, 1, 0).reshape(-1, 2)


def study(case: Case) -> dict:
    """The answers of the ring, and the seconds of each question."""
    row: dict = {"ring": case.name}
    clock = time.perf_counter()

    def lap(what):
        nonlocal clock
        now = time.perf_counter()
        row[f"s_{what}"] = now - clock
        clock = now

    ring = load_ring(case.path, **case.options)
    chain = Chain.from_ring(ring)
    tunes = twiss(chain).total_tunes
    chromaticity = off_momentum(Chain.from_ring(ring, 6), ring.length).chromaticity
    row |= {"length": ring.length, "energy": ring.energy}
    row |= {"magnets": len(ring.magnets), "monitors": len(ring.monitors)}
    row |= {"tunes": tunes, "chromaticity": chromaticity}
    row["correctors"] = sum(e.kind in ("hcorrector", "vcorrector") for e in ring.elements)
    lap("info")
    launch = np.array([AMPLITUDE, 0.0, AMPLITUDE, 0.0])
    at_tunes, at_chromaticity, at_turn = of_the_file(case, launch)
    row["tunes_at"] = np.abs(fractions(tunes) - fractions(at_tunes)).max()
    row["chromaticity_at"] = np.abs(chromaticity - at_chromaticity).max()
    read = {k: v for k, v in case.options.items() if k == "sequence"}
    same = load_ring(case.path, **read, **({"monitors": case.markers} if case.markers else {}))
    launches = np.zeros((1, 6))
    launches[0, :4] = launch
    engines = [engine(same) for engine in (AtEngine, OcelotEngine)]
    first = [engine.track(launches)[0, 0] for engine in engines]
    size = float(np.sqrt(np.mean(at_turn**2)))
    row["turn_file"] = np.abs(first[0] - at_turn).max() / size
    row["turn_engines"] = np.abs(first[0] - first[1]).max() / size
    some = [engine.track(launches, 5)[0] for engine in engines]
    row["turns_engines"] = np.abs(some[0] - some[1]).max() / size
    lap("track")
    if case.full:
        follow(case, ring, row, lap)
    row["green"] = green(row)
    return row


def follow(case: Case, ring, row: dict, lap) -> None:
    """Orbit response, diagnosis and fine-tuning."""
    planes = {kind: [e.name for e in ring.elements if e.kind == kind] for kind in
              ("hcorrector", "vcorrector")}  # fmt: skip
    chosen = [name for names in planes.values() for name in names[:: max(1, len(names) // 4)][:4]]
    both = [
        simulate_response(ring, correctors=chosen, kick=2e-5, noise=0.0, engine=engine,
                          progress=False).measured for engine in ("at", "ocelot")
    ]  # fmt: skip
    orbits = [np.concatenate([m.response, m.rf.orbit[None]]) for m in both]
    sizes = np.sqrt(np.mean(orbits[0] ** 2, axis=(1, 2), keepdims=True))
    row["response"] = float((np.abs(orbits[0] - orbits[1]) / sizes).max())
    lap("response")
    powered = [e for e in ring.elements if e.kind == "quadrupole" and e.k1 and e.length > 0.05]
    fault = case.fault or powered[len(powered) // 3].name
    data = simulate(ring, [Cause("quadrupole_gradient", fault, -0.05)], shots=6, noise=2e-5,
                    amplitude=case.amplitude, seed=1).measurement()  # fmt: skip
    lap("simulate")
    row["check"] = check_data(ring, data).status
    lap("check")
    found = diagnose(ring, data, seed=1)
    row["fault"], row["verdict"] = fault, found.verdict
    row["found"] = [f.element for f in found.findings]
    row["place"] = any(place_is(ring, fault, name) for name in row["found"][:1])
    lap("diagnose")
    try:
        fit = tune_fit(ring, fault, change=-0.05, launch=(1e-3, 0, 1e-3, 0), epochs=300,
                       progress=False)  # fmt: skip
        row["tune_fit"] = fit.problem
        if fit.network_tunes is not None:
            row["tune_fit"] = float(np.abs(fit.network_tunes - fit.true_tunes).max())
            row["tune_shift"] = float(np.abs(fit.design_tunes - fit.true_tunes).max())
    except TmlatticeError as error:
        row["tune_fit"] = str(error)
    lap("tune_fit")


def place_is(ring, fault: str, name: str | None) -> bool:
    """The magnet itself, or another piece of it."""
    return name is not None and name in ring.pieces(fault)


LIMITS = {"tunes_at": 1e-3, "turn_file": 2e-2, "turn_engines": 2e-3, "turns_engines": 2e-2,
          "response": 2e-2}  # fmt: skip
"""Of the size of the orbit, or of a tune: AT's bends have edges and gradients of first order."""


def green(row: dict) -> bool:
    good = all(row[key] < limit for key, limit in LIMITS.items() if key in row)
    good = good and row.get("place", True) and row.get("check") != "wrong"
    return good and not isinstance(row.get("tune_fit"), str)


AGREEMENT = (
    ("ring", "ring", "{}"), ("length", "m", "{:.1f}"), ("energy", "GeV", "{:.3g}"),
    ("magnets", "magnets", "{}"), ("monitors", "BPMs", "{}"),
    ("correctors", "correctors", "{}"),
    ("tunes", "tunes", "{0[0]:.4f} / {0[1]:.4f}"), ("tunes_at", "tunes, from AT's", "{:.0e}"),
    ("chromaticity", "chromaticity", "{0[0]:+.2f} / {0[1]:+.2f}"),
    ("turn_file", "first turn, from AT's", "{:.0e}"), ("turn_engines", "engines, 1 turn", "{:.0e}"),
    ("turns_engines", "5 turns", "{:.0e}"), ("response", "response", "{:.0e}"),
)  # fmt: skip
WORK = (
    ("ring", "ring", "{}"), ("fault", "fault", "{}"), ("check", "check", "{}"),
    ("verdict", "verdict", "{}"),
    ("place", "place", "{}"), ("tune_shift", "its dQ", "{:.0e}"),
    ("tune_fit", "after tune-fit", "{:.0e}"), ("s_info", "info", "{:.1f}"),
    ("s_track", "turns", "{:.1f}"), ("s_response", "2 responses", "{:.1f}"),
    ("s_simulate", "simulate", "{:.1f}"),
    ("s_check", "check", "{:.1f}"), ("s_diagnose", "diagnose", "{:.1f}"),
    ("s_tune_fit", "tune-fit", "{:.1f}"), ("green", "all", "{}"),
)  # fmt: skip


def cell(value, form: str) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "right" if value else "**wrong**"
    return value if isinstance(value, str) else form.format(value)


def table(rows: list[dict], columns) -> str:
    lines = [[title for _, title, _ in columns], ["---" for _ in columns]]
    lines += [[cell(row.get(key), form) for key, _, form in columns] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    rows = []
    for case in cases():
        if chosen.names and case.name not in chosen.names:
            continue
        try:
            rows.append(study(case))
        except TmlatticeError as error:
            rows.append({"ring": case.name, "verdict": str(error), "green": False})
        print(table(rows[-1:], WORK).splitlines()[-1], flush=True)
    text = table(rows, AGREEMENT) + "\n" + table(rows, WORK)
    print(f"\n{text}")
    if chosen.out:
        chosen.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
