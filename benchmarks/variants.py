"""Unknown rings from known ones: `TMLATTICE_DATA=... python benchmarks/variants.py [RING ...]`.

A measured ring is changed in a way whose outcome is known: fewer correctors, a monitor dead, the
lattice without names, a unit wrong. Each variant is diagnosed with default options as any other
ring; where the diagnosis stops and names what to assume, it goes on with that. It prints what
stopped it, the seconds, the held-out rms in plane, in the other and of the RF's orbit, micrometres,
over the untouched ring's in brackets, and the messages that the untouched ring has not.
A traceback is an error of the program, and ends in the table as one.

`--variant NAME` (any number of them) takes some of them; `--seed N` another draw and split; a ring
may be a folder that `tmlattice import` wrote.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from real_rings import imported, sources

import tmlattice
from tmlattice import read_measurement
from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.measurement.assume import ASSUMPTIONS

MICRO = 1e6
Rng = np.random.Generator


@dataclass(frozen=True)
class Case:
    """A ring's document (`tmlattice-lattice`), and its response."""

    lattice: dict[str, Any]
    measured: OrbitResponse

    def ring(self) -> Ring:
        """The lattice as any user's: out of a file."""
        with tempfile.TemporaryDirectory() as place:
            path = Path(place) / "lattice.json"
            path.write_text(json.dumps(self.lattice), encoding="utf-8")
            return tmlattice.load_ring(path)

    def changed(self, **values: Any) -> "Case":
        """With another measurement."""
        return replace(self, measured=replace(self.measured, **values))


# --- the measurement ------------------------------------------------------------------------------
def half_correctors(case: Case, rng: Rng) -> Case:
    names = np.array(case.measured.correctors)
    kept = np.sort(rng.choice(len(names), len(names) // 2, replace=False))
    return replace(case, measured=case.measured.select(correctors=names[kept].tolist()))


def few_correctors(case: Case, rng: Rng) -> Case:
    names = np.array(case.measured.correctors)
    kept = np.sort(rng.choice(len(names), 8, replace=False))
    return replace(case, measured=case.measured.select(correctors=names[kept].tolist()))


def half_monitors(case: Case, rng: Rng) -> Case:
    names = np.array(case.measured.monitors)
    kept = np.sort(rng.choice(len(names), len(names) // 2, replace=False))
    return replace(case, measured=case.measured.select(monitors=names[kept].tolist()))


def one_plane(plane: str) -> Callable[[Case, Rng], Case]:
    def only(case: Case, rng: Rng) -> Case:
        data = case.measured
        names = [n for n, p in zip(data.correctors, data.planes, strict=True) if p == plane]
        case = replace(case, measured=data.select(correctors=names))
        response = case.measured.response.copy()
        response[..., "yx".index(plane)] = np.nan
        return case.changed(response=response)

    return only


def in_plane_alone(case: Case, rng: Rng) -> Case:
    data = case.measured
    response = data.response.copy()
    for c, plane in enumerate(data.planes):
        response[c, :, "yx".index(plane)] = np.nan
    return case.changed(response=response)


def no_rf(case: Case, rng: Rng) -> Case:
    return case.changed(rf=None)


def no_noise(case: Case, rng: Rng) -> Case:
    return case.changed(noise=None)


def noise_times(factor: float) -> Callable[[Case, Rng], Case]:
    def scaled(case: Case, rng: Rng) -> Case:
        assert case.measured.noise is not None
        return case.changed(noise=factor * case.measured.noise)

    return scaled


def noise_zero_of_some(case: Case, rng: Rng) -> Case:
    assert case.measured.noise is not None
    noise = case.measured.noise.copy()
    noise[:3] = 0.0
    return case.changed(noise=noise)


def _read(case: Case, change: Callable[[np.ndarray], np.ndarray]) -> Case:
    rf = case.measured.rf
    if rf is not None and rf.orbit is not None:
        rf = replace(rf, orbit=change(rf.orbit))
    return case.changed(response=change(case.measured.response), rf=rf)


def reversed_plane(case: Case, rng: Rng) -> Case:
    return _read(case, lambda a: a * [1.0, -1.0])


def planes_swapped(case: Case, rng: Rng) -> Case:
    return _read(case, lambda a: a[..., ::-1])


def millimetres(case: Case, rng: Rng) -> Case:
    case = _read(case, lambda a: 1e3 * a)
    noise = case.measured.noise
    return case.changed(noise=None if noise is None else 1e3 * noise)


def kicks_times(factor: float) -> Callable[[Case, Rng], Case]:
    return lambda case, rng: case.changed(kicks=factor * case.measured.kicks)


def kicks_of_a_plane(case: Case, rng: Rng) -> Case:
    y = np.array(case.measured.planes) == "y"
    return case.changed(kicks=np.where(y, -case.measured.kicks, case.measured.kicks))


def rf_reversed(case: Case, rng: Rng) -> Case:
    rf = case.measured.rf
    return case.changed(rf=None if rf is None else replace(rf, step=-rf.step))


def rf_times(factor: float) -> Callable[[Case, Rng], Case]:
    def wrong(case: Case, rng: Rng) -> Case:
        rf = case.measured.rf
        return case.changed(rf=None if rf is None else replace(rf, step=factor * rf.step))

    return wrong


def rf_frequency(case: Case, rng: Rng) -> Case:
    rf = case.measured.rf
    return case.changed(rf=None if rf is None else replace(rf, frequency=1e-6 * rf.frequency))


def _of_monitors(case: Case, rng: Rng, count: int) -> tuple[Case, list[int]]:
    return case, rng.choice(len(case.measured.monitors), count, replace=False).tolist()


def monitors_exchanged(case: Case, rng: Rng) -> Case:
    at = int(rng.integers(len(case.measured.monitors) - 1))
    order = np.arange(len(case.measured.monitors))
    order[[at, at + 1]] = at + 1, at
    return _read(case, lambda a: a[..., order, :])


def monitors_dead(case: Case, rng: Rng) -> Case:
    _, (a, b) = _of_monitors(case, rng, 2)

    def dead(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[..., a, :] = 0.0
        values[..., b, 1] = 0.0
        return values

    return _read(case, dead)


def monitors_noise(case: Case, rng: Rng) -> Case:
    _, (a, b) = _of_monitors(case, rng, 2)
    size = float(np.nanstd(case.measured.response))

    def random(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[..., a, :] = size * rng.normal(size=values[..., a, :].shape)
        values[..., b, 1] = size * rng.normal(size=values[..., b, 1].shape)
        return values

    return _read(case, random)


def monitors_reversed(case: Case, rng: Rng) -> Case:
    _, (a, b) = _of_monitors(case, rng, 2)

    def against(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[..., a, :] *= -1
        values[..., b, 1] *= -1
        return values

    return _read(case, against)


def monitor_planes_swapped(case: Case, rng: Rng) -> Case:
    _, (a,) = _of_monitors(case, rng, 1)

    def swapped(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[..., a, :] = values[..., a, ::-1]
        return values

    return _read(case, swapped)


def spikes(case: Case, rng: Rng) -> Case:
    response = case.measured.response.copy()
    hit = rng.random(response.shape) < 0.003
    response[hit] += 20 * np.nanstd(response) * rng.choice([-1.0, 1.0], hit.sum())
    return case.changed(response=response)


def readings_missing(case: Case, rng: Rng) -> Case:
    response = case.measured.response.copy()
    response[rng.random(response.shape) < 0.1] = np.nan
    return case.changed(response=response)


def corrector_dead(case: Case, rng: Rng) -> Case:
    response = case.measured.response.copy()
    response[rng.integers(len(response))] *= 1e-3
    return case.changed(response=response)


def corrector_silent(case: Case, rng: Rng) -> Case:
    response = case.measured.response.copy()
    response[rng.integers(len(response))] = 0.0
    return case.changed(response=response)


def corrector_reversed(case: Case, rng: Rng) -> Case:
    response = case.measured.response.copy()
    response[rng.integers(len(response))] *= -1
    return case.changed(response=response)


def correctors_exchanged(case: Case, rng: Rng) -> Case:
    data = case.measured
    at = int(rng.choice([i for i in range(len(data.planes) - 1)
                         if data.planes[i] == data.planes[i + 1]]))  # fmt: skip
    response = data.response.copy()
    response[[at, at + 1]] = response[[at + 1, at]]
    return case.changed(response=response)


def correctors_exchanged_far(case: Case, rng: Rng) -> Case:
    data = case.measured
    mine = [i for i, p in enumerate(data.planes) if p == "x"]
    a, b = mine[1], mine[1 + len(mine) // 2]
    response = data.response.copy()
    response[[a, b]] = response[[b, a]]
    return case.changed(response=response)


def corrector_twice(case: Case, rng: Rng) -> Case:
    data = case.measured
    response = data.response.copy()
    response[1] = response[0]
    return case.changed(response=response)


def scrambled(case: Case, rng: Rng) -> Case:
    data = case.measured
    columns, monitors = (rng.permutation(len(n)).tolist() for n in (data.correctors, data.monitors))
    return replace(case, measured=data.select(
        [data.correctors[i] for i in columns], [data.monitors[i] for i in monitors]
    ))  # fmt: skip


def no_response_of_a_plane(case: Case, rng: Rng) -> Case:
    """Vertical correctors, but no vertical reading of horizontal ones, and fewer monitors in y."""
    response = case.measured.response.copy()
    response[:, ::2, 1] = np.nan
    return case.changed(response=response)


# --- the lattice ----------------------------------------------------------------------------------
def _renamed(case: Case, lattice: dict[str, Any], places: Sequence[int]) -> Case:
    """The measurement with the names that its places have in another lattice.

    Args:
        case: as it was.
        lattice: the other one.
        places: of the old sequence's elements, in the new one.
    """
    then = Case(lattice, case.measured)
    old, new = case.ring(), then.ring()

    def name(own: str) -> str:
        return new.elements[places[old.index(own)]].name

    return then.changed(
        correctors=tuple(map(name, case.measured.correctors)),
        monitors=tuple(map(name, case.measured.monitors)),
    )


def started_elsewhere(case: Case, rng: Rng) -> Case:
    sequence = case.lattice["sequence"]
    by = len(sequence) // 3
    turned = {**case.lattice, "sequence": sequence[by:] + sequence[:by]}
    return _renamed(case, turned, [(i - by) % len(sequence) for i in range(len(sequence))])


def _with_names(case: Case, name: Callable[[int, str], str]) -> Case:
    definitions = case.lattice["definitions"]
    made, sequence = {}, []
    for i, own in enumerate(case.lattice["sequence"]):
        called = name(i, definitions[own]["kind"])
        key = f"{called}#{i}"
        made[key] = definitions[own]
        sequence.append(key)
    lattice = {**case.lattice, "definitions": made, "sequence": sequence}
    return _renamed(case, lattice, range(len(sequence)))


def names_alike(case: Case, rng: Rng) -> Case:
    return _with_names(case, lambda i, kind: "q1" if kind != "drift" else "d")


def names_by_kind(case: Case, rng: Rng) -> Case:
    return _with_names(case, lambda i, kind: kind)


def names_unique(case: Case, rng: Rng) -> Case:
    return _with_names(case, lambda i, kind: f"e{i}")


def in_slices(case: Case, rng: Rng) -> Case:
    """Every quadrupole in four pieces."""
    made = dict(case.lattice["definitions"])
    sequence: list[str] = []
    places = []
    for own in case.lattice["sequence"]:
        made_of = case.lattice["definitions"][own]
        places.append(len(sequence))
        if made_of["kind"] == "quadrupole" and made_of["parameters"].get("l"):
            parameters = {**made_of["parameters"], "l": made_of["parameters"]["l"] / 4}
            made[own] = {**made_of, "parameters": parameters}
            sequence += 4 * [own]
        else:
            sequence.append(own)
    return _renamed(case, {**case.lattice, "definitions": made, "sequence": sequence}, places)


def wrong_energy(case: Case, rng: Rng) -> Case:
    return case.changed(energy=1.2 * case.lattice["energy_gev"])


def _strengths(case: Case, change: Callable[[str, float], float]) -> Case:
    made = {}
    for name, own in case.lattice["definitions"].items():
        parameters = dict(own["parameters"])
        if own["kind"] == "quadrupole" and parameters.get("k1"):
            parameters["k1"] = change(name, parameters["k1"])
        made[name] = {**own, "parameters": parameters}
    return replace(case, lattice={**case.lattice, "definitions": made})


def gradients_far(case: Case, rng: Rng) -> Case:
    """All gradients 1 % strong, and 1 % of scatter: a design that was never fitted."""
    return _strengths(case, lambda name, k1: k1 * (1.01 + 0.01 * rng.normal()))


def sextupoles_off(case: Case, rng: Rng) -> Case:
    made = {}
    for name, own in case.lattice["definitions"].items():
        parameters = {k: v for k, v in own["parameters"].items() if k not in ("k2", "k1s")}
        made[name] = {**own, "parameters": parameters}
    return replace(case, lattice={**case.lattice, "definitions": made})


VARIANTS: dict[str, Callable[[Case, Rng], Case]] = {
    "unaltered": lambda case, rng: case,
    "half of the correctors": half_correctors,
    "eight correctors": few_correctors,
    "half of the BPMs": half_monitors,
    "x alone": one_plane("x"),
    "y alone": one_plane("y"),
    "in-plane readings alone": in_plane_alone,
    "every other BPM without y": no_response_of_a_plane,
    "no RF step": no_rf,
    "no noise": no_noise,
    "noise / 3": noise_times(1 / 3),
    "noise x 10": noise_times(10.0),
    "noise 0 of three BPMs": noise_zero_of_some,
    "y reversed": reversed_plane,
    "planes swapped": planes_swapped,
    "mm": millimetres,
    "kicks x 2": kicks_times(2.0),
    "kicks x 0.5": kicks_times(0.5),
    "kicks x 1000": kicks_times(1e3),
    "kicks of y reversed": kicks_of_a_plane,
    "RF step reversed": rf_reversed,
    "RF step x 2": rf_times(2.0),
    "RF frequency in MHz": rf_frequency,
    "BPMs swapped": monitors_exchanged,
    "BPMs dead": monitors_dead,
    "BPMs of noise": monitors_noise,
    "BPMs reversed": monitors_reversed,
    "planes of a BPM swapped": monitor_planes_swapped,
    "outliers": spikes,
    "readings missing": readings_missing,
    "corrector dead": corrector_dead,
    "corrector silent": corrector_silent,
    "corrector reversed": corrector_reversed,
    "correctors swapped": correctors_exchanged,
    "correctors swapped far": correctors_exchanged_far,
    "corrector twice": corrector_twice,
    "scrambled": scrambled,
    "started elsewhere": started_elsewhere,
    "names alike": names_alike,
    "names by kind": names_by_kind,
    "names unique": names_unique,
    "in slices": in_slices,
    "wrong energy": wrong_energy,
    "gradients far": gradients_far,
    "no sextupoles": sextupoles_off,
}


# --- the trial ------------------------------------------------------------------------------------
def offered(said: str) -> tuple[str, ...]:
    """What a diagnosis that stopped asks to assume."""
    first = said.rpartition("go on with ")[2].split("; ")[0]
    return tuple(name for name in ASSUMPTIONS if f"--assume {name}" in first)


def tried(make: Callable[[], Case], seed: int, assumed: tuple[str, ...] = ()) -> dict[str, Any]:
    """What comes of a case; a second time with what the first asks to assume."""
    begun = time.process_time()
    try:
        case = make()
        found = tmlattice.diagnose(case.ring(), case.measured, seed=seed, assume=assumed)
    except TmlatticeError as error:
        said = str(error)
        seconds = time.process_time() - begun
        names = offered(said)
        if names and not assumed:
            return {"stopped": said, **tried(lambda: case, seed, names)}
        return {"error": said, "seconds": seconds, "assumed": assumed}
    except Exception:
        return {"traceback": traceback.format_exc(), "seconds": time.process_time() - begun}
    last = found.steps[-1]
    return {
        "seconds": time.process_time() - begun,
        "assumed": assumed,
        "verdict": found.verdict,
        "identified": [f"{f.effect} {f.element} {f.amount:.3g}" for f in found.findings],
        "heldout": [MICRO * own for own in (
            last.heldout_rms_in_plane, last.heldout_rms_coupling, last.dispersion_rms
        )],
        "steps": [own.effect for own in found.families if own.kept],
        "refused": [own.effect for own in found.families if not own.kept],
        "bad": list(found.bad_monitors),
        "warnings": list(found.warnings),
    }  # fmt: skip


def lines(ring: str, name: str, said: dict[str, Any], base: dict[str, Any]) -> list[str]:
    """Of one trial, the first a row."""
    head = f"{ring} | {name} | {said['seconds']:.0f} s | "
    if "traceback" in said:
        return [head + "TRACEBACK", said["traceback"]]
    if "error" in said:
        return [head + f"no result: {said['error']}"]
    figures = []
    for own, usual in zip(said["heldout"], base.get("heldout", 3 * [np.nan]), strict=True):
        figures.append(f"{own:.2f} ({own / usual:.2f})")
    out = [head + f"{said['verdict']} | {' / '.join(figures)}"]
    if "stopped" in said:
        out.append(f"    stopped: {said['stopped']}")
    out += [f"    named: {one}" for one in said["identified"]]
    out += [f"    bad: {', '.join(said['bad'])}"] if said["bad"] != base.get("bad", []) else []
    gone = [one for one in base.get("steps", []) if one not in said["steps"]]
    out += [f"    refused now: {'; '.join(gone)}"] if gone else []
    known = {one[:24] for one in base.get("warnings", [])}
    out += [f"    {one}" for one in said["warnings"] if one[:24] not in known]
    return out


def cases(data: Path, wanted: Sequence[str], place: Path) -> dict[str, Case]:
    """The rings asked for, imported."""
    found = {}
    for name in wanted:
        folder, lattice = Path(name), "lattice.json"
        if not folder.is_dir():
            files = sources(data)[name]
            folder = place / name
            if not files:
                sys.exit(f"{name} stands in a folder of its own: name an imported one")
            imported(name, files, data, place, "first")
        document = json.loads((folder / lattice).read_text(encoding="utf-8"))
        found[folder.name] = Case(document, read_measurement(folder))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=["lnls_2014-07-11_a"])
    parser.add_argument("--variant", action="append", choices=VARIANTS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    data = Path(os.environ.get("TMLATTICE_DATA", "/nowhere"))
    every: dict[str, dict[str, Any]] = {}
    if options.json and options.json.is_file():
        every = json.loads(options.json.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as place:
        for ring, case in cases(data, options.names, Path(place)).items():
            rows = every.setdefault(ring, {})
            for name in options.variant or VARIANTS:
                make = partial(VARIANTS[name], case, np.random.default_rng(options.seed))
                rows[name] = tried(make, options.seed)
                print(*lines(ring, name, rows[name], rows.get("unaltered", {})), sep="\n",
                      flush=True)  # fmt: skip
                if options.json:
                    options.json.write_text(json.dumps(every, indent=1), encoding="utf-8")
    print("\n| ring | variant | verdict | held out in plane, relative to the measured one |\n"
          "|---|---|---|---|")  # fmt: skip
    for ring, rows in every.items():
        whole = rows.get("unaltered", {}).get("heldout", [np.nan])[0]
        for name, row in rows.items():
            ratio = row.get("heldout", [np.nan])[0] / whole
            print(f"| {ring} | {name} | {row.get('verdict', 'no result')} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
