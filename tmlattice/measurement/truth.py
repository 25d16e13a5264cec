"""What was really wrong with a simulated machine: written apart, never into the folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.files import output_file, write_json
from tmlattice.measurement.documents import read_document
from tmlattice.measurement.trajectory import COORDINATES

FORMAT = "tmlattice-truth"


@dataclass(frozen=True, eq=False)
class Truth:
    """The cause of a simulated measurement, as plain data.

    Attributes:
        effects: each with "effect", "element" (None for the beam and the whole ring), "s" (m,
            or None) and "amount" (in the effect's own unit).
        launches: the true launches (x, px, y, py, delta), [shot, 5].
        background: what lay under the effects, by name of effect.
        seed: of all that was drawn, or None.
        package: version that made it, or None.
    """

    effects: tuple[Mapping[str, Any], ...]
    launches: Array
    background: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    package: str | None = None


def write_truth(
    path: str | Path,
    effects: Sequence[Mapping[str, Any]],
    launches: Any,
    background: Mapping[str, Any] | None = None,
    seed: int | None = None,
) -> None:
    """Write a truth file; the arguments are as in `Truth`.

    Raises:
        MeasurementError: the place is a measurement's folder, or an entry has other keys.
        OutputError: it cannot be written.
    """
    from tmlattice import __version__

    path = Path(path)
    if (path.absolute().parent / "measurement.json").exists():
        raise MeasurementError(
            f"'{path}' lies in a measurement's folder, where no truth may lie; name another place"
        )
    keys = ("effect", "element", "s", "amount")
    for effect in effects:
        if set(effect) != set(keys):
            raise MeasurementError(f"an effect of the truth has the keys {', '.join(keys)}")
    states = np.atleast_2d(np.asarray(launches, dtype=float))
    document = {
        "format": FORMAT,
        "version": 1,
        "package": __version__,
        "effects": [{key: _plain(effect[key]) for key in keys} for effect in effects],
        "launches": [
            dict(zip(COORDINATES, state, strict=True)) for state in _five(path, states.tolist())
        ],
        "background": _plain(dict(background or {})),
        "seed": None if seed is None else int(seed),
    }
    with output_file(path) as temporary:
        write_json(temporary, document)


def read_truth(path: str | Path) -> Truth:
    """Read a truth file.

    Raises:
        MeasurementError: one sentence with the file and the correction.
    """
    path = Path(path)
    document = read_document(path, "truth", FORMAT)
    states = [
        [state.get(name, 0.0) for name in COORDINATES] if isinstance(state, dict) else state
        for state in document.get("launches", [])
    ]
    return Truth(
        effects=tuple(document["effects"]),
        launches=np.array(_five(path, states), dtype=float).reshape(-1, 5),
        background=document.get("background") or {},
        seed=document.get("seed"),
        package=document.get("package"),
    )


def _five(path: Path, states: list[list[Any]]) -> list[list[float]]:
    for state in states:
        if len(state) not in (4, 5):
            raise MeasurementError(f"{path}: a launch has x, px, y, py and delta")
    return [[*map(float, state), *[0.0] * (5 - len(state))] for state in states]


def _plain(value: Any) -> Any:
    """Numpy's numbers and arrays as Python's, which JSON knows."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
