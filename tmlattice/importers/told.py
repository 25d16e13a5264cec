"""What a user tells of a file in a small YAML file: names, unit, noise, monitors to leave out."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tmlattice.errors import MeasurementError

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
    import yaml

    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise MeasurementError(f"cannot read '{path}': {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        said = " ".join(str(error).split())[:200]
        raise MeasurementError(f"'{path}' is no YAML ({said})") from error
    if not isinstance(document, dict):
        raise MeasurementError(f"'{path}' is no table; its lines are such as 'unit: mm'")
    known = ("unit", "noise", "names", "bad", "columns")
    for key in document:
        if key not in known:
            raise MeasurementError(f"'{path}': no key '{key}'; there are {', '.join(known)}")
    unit, names = document.get("unit"), document.get("names") or {}
    if unit is not None and unit not in METRES:
        raise MeasurementError(f"'{path}': no unit '{unit}'; there are {', '.join(METRES)}")
    if names != IN_ORDER and not isinstance(names, dict):
        raise MeasurementError(f"'{path}': names are 'device: monitor', or {IN_ORDER}")
    columns = document.get("columns") or {}
    wrong = [key for key in columns if key not in COLUMNS]
    if wrong:
        raise MeasurementError(f"'{path}': no column '{wrong[0]}'; there are {', '.join(COLUMNS)}")
    bad = document.get("bad") or []
    return Told(
        unit=unit,
        noise=None if document.get("noise") is None else _length(document["noise"], path),
        names={} if names == IN_ORDER else {str(k): str(v) for k, v in names.items()},
        in_order=names == IN_ORDER,
        bad=tuple(str(name) for name in (bad if isinstance(bad, list) else [bad])),
        columns={key: str(value) for key, value in columns.items()},
    )


def _length(value: Any, path: Path) -> float:
    """m, of a number or of a number with its unit."""
    match = re.match(r"^\s*([-+0-9.eE]+)\s*(m|mm|um|µm|nm)?\s*$", str(value))
    try:
        length = float(match[1]) * METRES[match[2] or "m"] if match else 0.0
    except ValueError:
        length = 0.0
    if not length > 0:
        raise MeasurementError(f"'{path}': a noise of '{value}' cannot be; give 20 um, say")
    return length
