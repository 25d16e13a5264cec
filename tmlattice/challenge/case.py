"""A challenge on disk: its public part, and the truth in a separate folder.

DIR/challenge.json                   tier and lattice
DIR/cases/NAME/case.json             options of the diagnosis
DIR/cases/NAME/fit|heldout|reference measurement folders of first turns, or one of each kind, and
                                     before_KIND of the machine before the fault
DIR/cases/NAME/learnt                its orbit response before the fault
DIR/truth/NAME.json, NAME.npz        causes, launches, readings without noise
DIR/truth/made.json                  seed, and rejected draws
DIR/results/NAME.json                the diagnosis
DIR/oracle/NAME.json                 the oracle's answer, and those of simple baselines
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, cast
from zipfile import BadZipFile

import numpy as np

from tmlattice.arrays import Array
from tmlattice.batch import fingerprint
from tmlattice.diagnosis.kinds import KINDS
from tmlattice.diagnosis.records import HIDDEN, OPTIONAL, decoded, record_of
from tmlattice.effects import Cause
from tmlattice.errors import TmlatticeError, plain, unknown_choice
from tmlattice.files import output_file, write_json
from tmlattice.input_files import check_no_code, check_shape, json_of, zip_of
from tmlattice.lattice import Ring, load_ring
from tmlattice.lattice.load import contents
from tmlattice.measurement import (
    AnyMeasurement,
    Measurement,
    OrbitResponse,
    read_measurement,
    write_measurement,
)

SET = "tmlattice-challenge-set"
PUBLIC = "tmlattice-challenge-case"
TRUTH = "tmlattice-challenge-truth"

CAUSES = {
    "A": (1, 1), "B": (1, 1), "C": (2, 3), "D": (0, 1), "E": (0, 0),
    "R": (1, 1), "T": (1, 1), "P": (1, 1), "M": (1, 1),
}  # fmt: skip
"""Fewest and most of a case, by tier."""
TIERS = tuple(CAUSES)

BEFORE = "before_"
"""Prefix of the folder of a kind that was measured before the fault."""
LEARNT = "learnt"
"""Folder of an orbit response of the machine before the fault."""


@dataclass(frozen=True)
class Case:
    """Public part of a case.

    Attributes:
        lattice: argument of `load_ring`.
        parts: measurements by folder, see the module.
        options: of `diagnose`: background, effects.
        kinds: measurements that are diagnosed together; () of first turns.
    """

    name: str
    lattice: str
    parts: Mapping[str, AnyMeasurement]
    options: Mapping[str, Any] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()

    @property
    def fit(self) -> Measurement:
        """First turns."""
        return cast(Measurement, self.parts["fit"])

    @property
    def heldout(self) -> Measurement:
        """Held-out first turns."""
        return cast(Measurement, self.parts["heldout"])

    @property
    def reference(self) -> Measurement | None:
        """First turns before the fault, or None."""
        return cast(Measurement | None, self.parts.get("reference"))

    @property
    def learnt(self) -> OrbitResponse | None:
        """Orbit response of the machine before the fault, or None."""
        return cast(OrbitResponse | None, self.parts.get(LEARNT))

    @property
    def measured(self) -> dict[str, AnyMeasurement]:
        """Measurements by kind."""
        return {kind: self.parts[kind] for kind in self.kinds}

    @property
    def before(self) -> dict[str, AnyMeasurement]:
        """Measurements before the fault by kind; empty without a reference."""
        return {k: self.parts[BEFORE + k] for k in self.kinds if BEFORE + k in self.parts}


@dataclass(frozen=True)
class Truth:
    """Secret part of a case.

    Attributes:
        causes: of the catalogue; () for an unknown and for no effect.
        unknown: a fault that is not in the catalogue: kind, element, s, amount; or None. For an
            effect that was removed from the catalogue the kind is "taken_out" and the effect is in
            `causes`.
        signal_to_noise: of each cause alone, or of the unknown; NaN without a signal.
        total: signal to noise of all together; `alone`: in each kind of several.
        background: rms of distributed errors, by effect.
        amplitude, noise: m; of a case of kinds 0, and in units of each kind's usual noise.
        launches: true ones by part (fit, heldout, reference), [shot, 5].
        clean: readings without noise by part, and "before": those of the fit without the fault,
            [shot, monitor, 2], m. A case of kinds has neither.
    """

    name: str = field(metadata=HIDDEN)
    tier: str
    causes: tuple[Cause, ...]
    unknown: Mapping[str, Any] | None
    signal_to_noise: tuple[float, ...]
    total: float
    background: Mapping[str, float]
    amplitude: float
    noise: float
    seed: int
    launches: Mapping[str, Array] = field(metadata=HIDDEN)
    clean: Mapping[str, Array] = field(metadata=HIDDEN)
    alone: Mapping[str, float] = field(default_factory=dict, metadata=OPTIONAL)


@lru_cache(maxsize=2)
def ring_of(lattice: str) -> Ring:
    """Return the design, loaded once per process."""
    return load_ring(lattice)


def write_case(folder: Path, case: Case, truth: Truth) -> None:
    """Write public and secret part; the public one is complete with its `case.json`."""
    own = folder / "cases" / case.name
    for name, measurement in case.parts.items():
        write_measurement(own / name, measurement, force=True)
    secret = folder / "truth"
    secret.mkdir(parents=True, exist_ok=True)
    arrays = {f"launches_{k}": v for k, v in truth.launches.items()}
    arrays |= {f"clean_{k}": v for k, v in truth.clean.items()}
    with output_file(secret / f"{truth.name}.npz") as path, path.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    with output_file(secret / f"{truth.name}.json") as path:
        write_json(path, {"format": TRUTH, "version": 1, **record_of(truth)})
    document = {
        "format": PUBLIC,
        "version": 1,
        "lattice": case.lattice,
        "reference": bool(case.before) or "reference" in case.parts,
        "options": dict(case.options),
        **({LEARNT: True} if case.learnt is not None else {}),
        **({"kinds": list(case.kinds)} if case.kinds else {}),
    }
    with output_file(own / "case.json") as path:
        write_json(path, document)


def read_set(folder: Path) -> dict[str, Any]:
    """Return the public description of a challenge; TmlatticeError: no challenge in the folder, or
    a damaged description."""
    path = folder / "challenge.json"
    found = _read(path, SET)
    if found["tier"] not in TIERS:
        raise unknown_choice("tier", found["tier"], TIERS)
    return found


def case_names(folder: Path) -> list[str]:
    """Names of all complete cases, in order."""
    return sorted(path.parent.name for path in (folder / "cases").glob("*/case.json"))


def check_lattice(place: Path, lattice: Any, trusted: str | None) -> str:
    """Return a challenge's lattice, if loading it runs only code that the caller trusts;
    TmlatticeError: Python code that is not trusted, or no name."""
    if not isinstance(lattice, str) or not lattice:
        raise TmlatticeError(f"{place}: its lattice is {lattice!r:.40}; it should be a name")
    if lattice != trusted:
        instead = f"give --lattice {plain(lattice, 60)} (in Python: lattice=)"
        check_no_code(place, lattice, TmlatticeError, instead)
    return lattice


CONTENTS = "lattice_contents"
"""Key of the fingerprint of the lattice in the public description."""


def check_contents(folder: Path, described: Mapping[str, Any]) -> None:
    """Raise if the lattice differs from the one of the challenge, where that is recorded;
    TmlatticeError: it differs."""
    known = described.get(CONTENTS)
    if known not in (None, fingerprint(contents(ring_of(described["lattice"])))):
        raise TmlatticeError(
            f"'{folder}' was made with another '{described['lattice']}' than the present one; "
            "restore that, or make the challenge again"
        )


def trusted_case(folder: Path, name: str, trusted: str | None) -> Case:
    """Return a case whose lattice may be loaded, see `check_lattice`."""
    case = read_case(folder, name)
    check_lattice(folder / "cases" / name / "case.json", case.lattice, trusted)
    return case


def made_by(folder: Path, name: str, lattice: str) -> str:
    """Return the fingerprint of a case's inputs: lattice, data, options, version."""
    from tmlattice import __version__

    own = folder / "cases" / name
    files = [own / "case.json", *sorted(own.glob("*/*"))]
    return fingerprint(__version__, contents(ring_of(lattice)), *files)


def read_case(folder: Path, name: str) -> Case:
    """Return the public part of a case."""
    own = folder / "cases" / name
    public = _read(own / "case.json", PUBLIC)
    kinds = public.get("kinds", [])
    if strange := [kind for kind in kinds if kind not in RECORDS]:
        raise unknown_choice("kind of measurement", strange[0], RECORDS)
    wanted = {kind: kind for kind in kinds} or {"fit": "trajectory", "heldout": "trajectory"}
    if public["reference"]:
        wanted |= {BEFORE + kind: kind for kind in kinds} or {"reference": "trajectory"}
    if public.get(LEARNT):
        wanted[LEARNT] = "orbit_response"
    parts = {}
    for folder_name, kind in wanted.items():
        parts[folder_name] = read_measurement(own / folder_name)
        if not isinstance(parts[folder_name], RECORDS[kind]):
            raise TmlatticeError(
                f"'{own / folder_name}' is no {kind.replace('_', ' ')}; make the challenge again"
            )
    return Case(name, public["lattice"], parts, public["options"], tuple(kinds))


RECORDS: Mapping[str, type] = {name: kind.record for name, kind in KINDS.items()}


def read_truth(folder: Path, name: str) -> Truth:
    """Return the secret part of a case: for `score` alone.

    Raises:
        TmlatticeError: it is missing or damaged.
    """
    try:
        truth = _truth(folder, name)
        few, many = CAUSES[truth.tier]
        known = truth.unknown is None or truth.tier == "D"
        if not (few <= len(truth.causes) <= many and known):
            raise ValueError(f"{len(truth.causes)} causes are none of tier {truth.tier}")
        return truth
    except (
        OSError, ArithmeticError, LookupError, TypeError, ValueError, MemoryError, BadZipFile
    ) as error:  # fmt: skip
        reason = plain(str(error), 100)
        raise TmlatticeError(
            f"the truth of case {name} in '{folder}' cannot be read ({reason}); make it anew"
        ) from error


def _truth(folder: Path, name: str) -> Truth:
    secret = _read(folder / "truth" / f"{name}.json", TRUTH)
    launches: dict[str, Array] = {}
    clean: dict[str, Array] = {}
    content = zip_of(folder / "truth" / f"{name}.npz", TmlatticeError, "arrays of a truth")
    with np.load(content) as arrays:
        for key in arrays:
            kind, part = key.split("_", 1)
            (launches if kind == "launches" else clean)[part] = arrays[key]
    truth: Truth = decoded(Truth, {**secret, "name": name, "launches": launches, "clean": clean})
    return truth


def _read(path: Path, kind: str) -> dict[str, Any]:
    document = json_of(path, TmlatticeError)
    if not isinstance(document, dict) or document.get("format") != kind:
        raise TmlatticeError(f"{path} is not of the format '{kind}'; make the challenge again")
    check_shape(path, document, kind.removeprefix("tmlattice-"), TmlatticeError)
    return document
