"""What a user tells of a file in a small YAML file: names, unit, noise, monitors to leave out."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tmlattice.errors import MeasurementError, plain
from tmlattice.input_files import check_shape, yaml_of

METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9}
IN_ORDER = "in-order"
COLUMNS = ("monitor", "plane", "value", "shot", "turn")

TEMPLATE = """\
# What tmlattice is told of a file of readings (--map FILE); every line may be left out.
unit: mm               # of readings whose header has none: m, mm, um or nm; else taken from size
noise: 20 um           # rms of one reading; else estimated from the readings
names:                 # device or column in the file: the lattice's monitor (or: names: in-order)
{names}
bad: [{bad}]  # monitors to leave out; patterns such as 'BPM_9*' too
columns: {{}}            # where they are called otherwise, e.g. {{monitor: pv, shot: cycle}}
"""


@dataclass(frozen=True)
class Told:
    """Of a file.

    Attributes:
        unit: of readings whose header has none; None: from their size.
        noise: rms of a reading, m; None: not known.
        names: device or column in the file -> the lattice's monitor.
        in_order: the devices are the lattice's monitors in beam order, whatever their names.
        bad: monitors to leave out, by either name; patterns.
        columns: what columns are called: of `COLUMNS`, the name in the file.
    """

    unit: str | None = None
    noise: float | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    in_order: bool = False
    bad: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)


def read_told(path: Path) -> Told:
    """The file of `--map`.

    Raises:
        MeasurementError: no YAML, or a key or value that is not known.
    """
    document = yaml_of(path, MeasurementError)
    document = {} if document is None else document
    check_shape(path, document, "map", MeasurementError)
    stated = {key: value for key, value in document.items() if value is not None}
    names = stated.get("names", {})
    if isinstance(names, str) and names != IN_ORDER:
        raise MeasurementError(f"{path}: names are 'device: monitor', or {IN_ORDER}")
    bad = stated.get("bad", [])
    return Told(
        unit=stated.get("unit"),
        noise=_length(stated["noise"], path) if "noise" in stated else None,
        names={} if names == IN_ORDER else names,
        in_order=names == IN_ORDER,
        bad=(bad,) if isinstance(bad, str) else tuple(bad),
        columns=stated.get("columns", {}),
    )


def _length(value: str, path: Path) -> float:
    """m, of a number or of a number with its unit."""
    match = re.match(r"^\s*([-+0-9.eE]+)\s*(m|mm|um|µm|nm)?\s*$", value)
    try:
        length = float(match[1]) * METRES[match[2] or "m"] if match else 0.0
    except ValueError:
        length = 0.0
    if not 0 < length < 1:
        raise MeasurementError(
            f"{path}: the noise is '{plain(value, 40)}'; give a length below 1 m, such as 20 um"
        )
    return length
