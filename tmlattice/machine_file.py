"""The machine file, `tmlattice.toml`: what commands need to know of one machine, stated once.

>>> machine = load_machine_file("tmlattice.toml")
>>> ring = machine.ring()
>>> diagnosis = diagnose(ring, machine.read("orbits.csv", ring))
>>> correction = correct(diagnosis, knobs=machine.knobs(ring))
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from tmlattice.correction.knobs import Knob, knobs_of, read_knobs
from tmlattice.errors import MachineFileError, plain
from tmlattice.importers import Options, Stated, bring_in
from tmlattice.importers.imported import Imported
from tmlattice.input_files import check_no_code, check_shape, toml_of
from tmlattice.lattice import Ring, builtin_lattices, load_ring
from tmlattice.measurement import AnyMeasurement, read_measurement
from tmlattice.measurement.arrays import METRES

NAME = "tmlattice.toml"
"""Of the file that commands look for in the working directory."""


@dataclass(frozen=True)
class MachineFile:
    """What a machine file states.

    Attributes:
        path: of the file.
        lattice: a built-in name, or a path that is relative to the working directory as `path` is;
            None: the file names none.
        options: of `load_ring`, for this lattice: sequence, energy, particle, monitors, correctors.
        stated: for files of readings: unit, noise, names, bad monitors, conventions.
        supplies: path of a table of knobs, or its rows; None: the file states none.
        trusted: a lattice that is Python code may be run.
    """

    path: Path
    lattice: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    stated: Stated = field(default_factory=Stated)
    supplies: Path | tuple[Mapping[str, Any], ...] | None = None
    trusted: bool = True

    def lattice_name(self) -> str:
        """The lattice, a built-in name or a path.

        Raises:
            MachineFileError: the file names none, one that is not there, or Python code in a file
                that is not trusted.
        """
        if self.lattice is None:
            raise MachineFileError(f"{self.path}: it names no lattice; add `file` to [lattice]")
        path = Path(self.lattice)
        if self.lattice.casefold() in builtin_lattices():
            return self.lattice
        if not self.trusted:
            instead = f"and this one, give --machine {self.path}"
            check_no_code(self.path, self.lattice, MachineFileError, instead)
        if not path.is_file():
            raise MachineFileError(
                f"{self.path}: no lattice file '{plain(self.lattice, 60)}'; correct `file` in "
                "[lattice], a path from the folder of the machine file"
            )
        return self.lattice

    def ring(self, lattice: str | PathLike[str] | None = None) -> Ring:
        """The machine's ring, or another lattice, see `load_ring`.

        Args:
            lattice: instead of the file's. What [lattice] states is used if it is the same lattice
                or the file names none.

        Raises:
            MachineFileError: as of `lattice_name`.
            LatticeError: as of `load_ring`.
        """
        if lattice is None:
            return load_ring(self.lattice_name(), **self.options)
        return load_ring(os.fspath(lattice), **self.options_for(lattice))

    def options_for(self, lattice: str | PathLike[str]) -> Mapping[str, Any]:
        """The options of `load_ring` for a lattice: none for one that is not the file's own."""
        own = self.lattice is None or _same(self.lattice, str(lattice))
        return self.options if own else {}

    def read(self, path: str | PathLike[str], ring: Ring | None = None) -> AnyMeasurement:
        """A measurement folder, or a file of another program by what [data] and [channels] state.

        Args:
            path: see `tmlattice.read_measurement`.
            ring: the machine's; None: it is loaded.

        Raises:
            MeasurementError: nothing there, or nothing that is known.
        """
        place = Path(path)
        if not place.is_file() or place.name == "measurement.json":
            return read_measurement(place)
        return self.bring_in(place, self.ring() if ring is None else ring).measurement

    def bring_in(self, path: Path, ring: Ring) -> Imported:
        """The measurement of a file of another program, with what was assumed of it."""
        return bring_in([path], Options(ring=ring, stated=self.stated))

    def knobs(self, ring: Ring) -> list[Knob] | None:
        """Power supplies for `correct`; None: the file states none.

        Args:
            ring: whose strengths are the present settings.

        Raises:
            MeasurementError: a supply that cannot be used, by name.
        """
        if isinstance(self.supplies, Path):
            return read_knobs(self.supplies, ring)
        return None if self.supplies is None else knobs_of([*self.supplies], self.path, ring)


def load_machine_file(path: str | PathLike[str] = NAME, trusted: bool = True) -> MachineFile:
    """Read a machine file (TOML).

    Args:
        path: of the file; the paths that it names are relative to its folder.
        trusted: whether Python code that it names as the lattice may be run.

    Raises:
        MachineFileError: no such file, no TOML, or a key or value that is unknown; one sentence.
    """
    place = Path(path)
    document = toml_of(place, MachineFileError)
    check_shape(place, document, "machine", MachineFileError)
    lattice = dict(document.get("lattice", {}))
    data = dict(document.get("data", {}))
    file = lattice.pop("file", None)
    if file is not None and file.casefold() not in builtin_lattices():
        file = str(place.parent / file)
    supplies = document.get("supplies")
    if isinstance(supplies, str):
        supplies = place.parent / supplies
    if "noise" in data:
        data["noise"] = _length(data["noise"], place)
    for name in ("bad", "assume"):
        data[name] = tuple(data.get(name, ()))
    return MachineFile(
        place,
        file,
        lattice,
        Stated(names=document.get("channels", {}), **data),
        tuple(supplies) if isinstance(supplies, list) else supplies,
        trusted,
    )


def _length(value: str | float, path: Path) -> float:
    """m, of a number or of a number with its unit."""
    match = re.match(r"^\s*([-+0-9.eE]+)\s*(m|mm|um|µm|nm)?\s*$", str(value))
    try:
        length = float(match[1]) * METRES[match[2] or "m"] if match else 0.0
    except ValueError:
        length = 0.0
    if not 0 < length < 1:
        raise MachineFileError(
            f"{path}: data.noise is '{plain(str(value), 40)}'; give a length below 1 m, such as "
            '"20 um"'
        )
    return length


def _same(one: str, other: str) -> bool:
    if one.casefold() == other.casefold():
        return True
    try:
        return Path(one).samefile(other)
    except (OSError, ValueError):
        return False
