"""Which importer files are for: by what they hold, not by their names."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tmlattice.errors import MeasurementError
from tmlattice.importers.conventions import doubts
from tmlattice.importers.hdf5 import bring_hdf5, read_hdf5, read_mapping
from tmlattice.importers.imported import Imported
from tmlattice.importers.lattices import Elements, elements_of
from tmlattice.importers.loco import Iteration, bring_loco, is_loco
from tmlattice.lattice.mat_file import read_mat
from tmlattice.measurement import OrbitResponse

MATLAB, HDF5, TABLE, NAMES = (".mat",), (".h5", ".hdf5", ".hdf"), (".csv",), (".json",)
Content = Mapping[str, Any]


@dataclass(frozen=True)
class Options:
    """How files are read.

    Attributes:
        iteration: of a LOCO fit, see `bring_loco`.
        keep_bad: take what the files call bad, see `bring_loco`.
        sequence: the variable of a MATLAB file that is the lattice.
    """

    iteration: Iteration = "last"
    keep_bad: bool = False
    sequence: str | None = None


def bring_in(paths: Sequence[str | Path], options: Options | None = None) -> Imported:
    """The measurement of one file or of several that belong together.

    Args:
        paths: MATLAB LOCO (`.mat`); or the HDF5 files of a response, its dispersion and noise,
            with the table of names (`.json`) and the lattice (`.mat`).
        options: how they are read.

    Raises:
        MeasurementError: files that are not known, or do not fit together.
        LatticeError: a lattice that cannot be made.
    """
    options = options or Options()
    files = [Path(path) for path in paths]
    for path in files:
        if not path.is_file():
            raise MeasurementError(f"no file '{path}'; check the path")
    matlab = [(path, read_mat(path)) for path in files if path.suffix.lower() in MATLAB]
    hdf5 = [(path, read_hdf5(path)) for path in files if path.suffix.lower() in HDF5]
    brought = _bring(files, matlab, hdf5, options)
    if brought.ring is None or not isinstance(brought.measurement, OrbitResponse):
        return brought
    more = doubts(brought.ring, brought.measurement)
    return replace(brought, doubts=(*brought.doubts, *more))


def _bring(
    files: Sequence[Path],
    matlab: Sequence[tuple[Path, Content]],
    hdf5: Sequence[tuple[Path, Content]],
    options: Options,
) -> Imported:
    loco = [(path, content) for path, content in matlab if is_loco(content)]
    rest = [(path, content) for path, content in matlab if not is_loco(content)]
    if hdf5:
        names = [path for path in files if path.suffix.lower() in NAMES]
        if not rest or not names:
            raise MeasurementError(
                f"'{hdf5[0][0]}' names inputs, not places: give the lattice (.mat) and the table "
                "of names (name_mapping.json) with it"
            )
        mapping = {key: place for path in names for key, place in read_mapping(path).items()}
        return bring_hdf5(hdf5, mapping, _lattice(rest, options))
    if len(loco) == 1 and len(files) == 1:
        ((path, content),) = loco
        return bring_loco(content, path, options.iteration, options.keep_bad)
    shown = ", ".join(f"'{path}'" for path in files)
    raise MeasurementError(
        f"{shown}: no measurement that is known; give a MATLAB LOCO file (with LocoMeasData), or "
        "the HDF5 files of a response with lattice and names"
    )


def _lattice(matlab: Sequence[tuple[Path, Content]], options: Options) -> Elements:
    if len(matlab) > 1:
        raise MeasurementError(f"two lattices, '{matlab[0][0]}' and '{matlab[1][0]}'; give one")
    ((path, content),) = matlab
    return elements_of(content, path, options.sequence)
