"""The lattice stored with a measurement: MATLAB's structures of AT elements."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError
from tmlattice.importers.imported import is_number


@dataclass(frozen=True)
class Elements:
    """A lattice as AT's elements, before anything of it is a monitor or a corrector.

    Attributes:
        name: of the ring.
        fields: of each element, in beam order.
        energy: GeV.
        harmonic: number, and frequency, Hz, of the RF where the lattice states it.
        frequency: Hz.
    """

    name: str
    fields: list[dict[str, Any]]
    energy: float
    harmonic: int | None = None
    frequency: float | None = None


def is_lattice(value: Any) -> bool:
    """Whether a variable of a MATLAB file is a list of AT's elements."""
    return (
        isinstance(value, list)
        and len(value) > 1
        and all(isinstance(e, Mapping) and "PassMethod" in e for e in value)
    )


def elements_of(content: Mapping[str, Any], path: Path, sequence: str | None = None) -> Elements:
    """The lattice among a MATLAB file's variables.

    Args:
        content: of `read_mat`.
        path: of the file.
        sequence: the variable, where several are lattices.

    Raises:
        LatticeError: none is one, or more than one are, or no energy is stated.
    """
    found = {name: value for name, value in content.items() if is_lattice(value)}
    if sequence is not None:
        found = {name: value for name, value in found.items() if name == sequence}
    if len(found) != 1:
        which = ", ".join(found) if found else f"none of {', '.join(content) or 'its variables'}"
        raise LatticeError(
            f"'{path}' has no single lattice ({which}); name its variable: `sequence` in "
            "[lattice] of tmlattice.toml"
        )
    ((name, elements),) = found.items()
    fields = [dict(e) for e in elements if str(e.get("Class", "")).lower() != "ringparam"]
    energy = next((e["Energy"] for e in elements if _positive(e.get("Energy"))), None)
    if energy is None:
        raise LatticeError(f"the lattice '{name}' of '{path}' states no energy; add Energy")
    cavities = [
        e for e in fields if _positive(e.get("Frequency")) and _positive(e.get("HarmNumber"))
    ]
    main = min(cavities, key=lambda e: e["Frequency"], default=None)
    return Elements(
        name=path.name.split(".")[0],
        fields=fields,
        energy=float(energy) * (1e-9 if energy > 1e5 else 1.0),
        harmonic=None if main is None else round(main["HarmNumber"]),
        frequency=None if main is None else float(main["Frequency"]),
    )


def _positive(value: Any) -> bool:
    return is_number(value) and value > 0
