"""Which importer files are for: by what they hold, not by their names."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tmlattice.errors import MeasurementError
from tmlattice.importers.conventions import doubts
from tmlattice.importers.imported import Imported
from tmlattice.importers.loco import VARIABLES, Iteration, bring_loco, is_loco
from tmlattice.lattice.mat_file import read_mat
from tmlattice.measurement import OrbitResponse


def bring_in(
    paths: Sequence[Path], *, iteration: Iteration = "last", keep_bad: bool = False
) -> Imported:
    """The measurement of one file or of several that belong together.

    Args:
        paths: MATLAB LOCO (`.mat`).
        iteration: of a LOCO fit, see `bring_loco`.
        keep_bad: take what the files call bad, see `bring_loco`.

    Raises:
        MeasurementError: files that are not known, or do not fit together.
        LatticeError: a lattice that cannot be made.
    """
    if len(paths) != 1:
        raise MeasurementError("one file at a time")
    (path,) = paths
    content = read_mat(path, VARIABLES)
    if not is_loco(content):
        raise MeasurementError(f"'{path}' holds no LocoMeasData; give a LOCO file")
    brought = bring_loco(content, path, iteration, keep_bad)
    return with_doubts(brought)


def with_doubts(brought: Imported) -> Imported:
    """With what the design contradicts, where there is one to compare with."""
    if brought.ring is None or not isinstance(brought.measurement, OrbitResponse):
        return brought
    more = doubts(brought.ring, brought.measurement)
    return replace(brought, doubts=(*brought.doubts, *more))
