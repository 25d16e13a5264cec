"""Which importer files are for, by what they hold and not by their names; and a measurement by its
path, of any kind of file: for `diagnose(ring, "readings.csv")`."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np

from tmlattice.by_name import by_name, is_frame
from tmlattice.errors import (
    MeasurementError,
    OtherFormatError,
    TmlatticeError,
    plain,
    unknown_name,
)
from tmlattice.importers.columns import (
    CSV,
    HDF5,
    SDDS,
    SHEETS,
    as_frame,
    is_sdds,
    label,
    of_matlab,
    read_columns,
    text_of,
)
from tmlattice.importers.conventions import compared
from tmlattice.importers.hdf5 import bring_hdf5, read_hdf5, read_mapping
from tmlattice.importers.imported import Imported, counted
from tmlattice.importers.loco import Iteration, bring_loco
from tmlattice.importers.matlab_ring import Elements, elements_of
from tmlattice.importers.middle_layer import bring_middle_layer
from tmlattice.importers.readings import bring_readings, with_unit
from tmlattice.importers.stated import Stated
from tmlattice.importers.tables import bring_table, bring_turns, is_response_table
from tmlattice.input_files import check_regular
from tmlattice.lattice import Ring, load_ring
from tmlattice.lattice.mat_file import read_mat
from tmlattice.measurement import (
    AnyMeasurement,
    OrbitResponse,
    TuneReading,
    folder,
)
from tmlattice.measurement.arrays import Unit
from tmlattice.measurement.assume import ASSUMPTIONS, assume
from tmlattice.measurement.frames import of_document

log = logging.getLogger(__name__)

MATLAB, NAMES = (".mat",), (".json",)
Content = Mapping[str, Any]


@dataclass(frozen=True)
class Options:
    """How files are read.

    Attributes:
        iteration: of a LOCO fit, see `bring_loco`.
        keep_bad: take what the files call bad, see `bring_loco`.
        sequence: the variable of a MATLAB file that is the lattice.
        lattice: name or path of the lattice of a table or of turns, see `load_ring`.
        energy: GeV; else what the lattice states.
        turns: the kind of a turn-by-turn file, see `bring_turns`.
        unit: of the readings of first turns or turns; else as the file states, or from their size.
        stated: what a machine file states about a table of readings.
        ring: instead of `lattice`, one that is loaded already, or a function that loads it where a
            file needs one.
        noise: rms of a reading, or of an orbit change, m, where the files give none.
    """

    iteration: Iteration = "first"
    keep_bad: bool = False
    sequence: str | None = None
    lattice: str | None = None
    energy: float | None = None
    turns: str | None = None
    unit: Unit | None = None
    noise: float | None = None
    stated: Stated | None = None
    ring: Ring | Callable[[], Ring] | None = None


def bring_in(
    paths: Sequence[str | PathLike[str] | Any], options: Options | None = None
) -> Imported:
    """The measurement of one file or of several that belong together.

    Args:
        paths: MATLAB LOCO (`.mat`); or the HDF5 files of a response, its dispersion and noise,
            with the table of names (`.json`) and the lattice (`.mat`); or the Middle Layer's
            response, dispersion and noise (`.mat`) with the machine's LOCO file; or a table
            (`.csv`, `.tsv`, `.txt`, `.h5`, `.sdds`) of readings or of a response; or any other
            file, which the package `turn_by_turn` is asked to read; or one pandas DataFrame or
            xarray Dataset, which is read as a table.
        options: how they are read.

    Raises:
        MeasurementError: files that are unknown, or do not fit together.
        LatticeError: a lattice that cannot be made.
    """
    options = options or Options()
    frames = [path for path in paths if is_frame(path)]
    if frames and len(frames) < len(paths):
        raise MeasurementError("a frame is imported alone; give no file with it")
    files = [] if frames else [Path(path) for path in paths]
    for path in files:
        check_regular(path, MeasurementError)
        if path.suffix.lower() in SHEETS:
            text_of(path)  # its error states what to do
    if options.turns and len(files) != 1:
        raise MeasurementError("turns are in one file; name one")
    shown = ", ".join(f"'{path}'" for path in files) or label(frames[0])
    known = [] if options.turns else files
    matlab = [(path, read_mat(path)) for path in known if path.suffix.lower() in MATLAB]
    hdf5 = [(path, read_hdf5(path)) for path in known if path.suffix.lower() in HDF5]
    try:
        if frames and (written := of_document(as_frame(frames[0]))) is not None:
            brought = Imported(
                written, _ring(options), ("everything is as `to_dataframe` wrote it",)
            )
        elif frames:
            brought = _table(frames[0], _ring(options), options)
        else:
            brought = _bring(files, matlab, hdf5, options)
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        if isinstance(error, TmlatticeError):
            raise
        log.info("not imported", exc_info=True)
        said = plain(f"{type(error).__name__}: {error}", 200)
        raise MeasurementError(
            f"{shown}: fields have other types or sizes than a reader knows ({said}); save it again"
        ) from error
    if options.stated is not None and options.stated.bad:
        brought = _without_bad(brought, options.stated)
    data = brought.measurement
    if options.noise is not None and not isinstance(data, TuneReading) and data.noise is None:
        noise = np.full((len(data.monitors), 2), options.noise)
        brought = replace(brought, measurement=replace(data, noise=noise))
        brought = brought.saying(f"the noise is taken as {1e6 * options.noise:g} µm, as stated")
    if isinstance(brought.measurement, OrbitResponse):
        if not np.isfinite(brought.measurement.response).any():
            raise MeasurementError(f"{shown}: no corrector's orbit change was read; save it again")
        brought = _with_all_noise(brought, brought.measurement)
    if brought.ring is None or not isinstance(brought.measurement, OrbitResponse):
        return brought
    confirmed, contradicted = compared(brought.ring, brought.measurement)
    return replace(brought.saying(*confirmed), doubts=(*brought.doubts, *contradicted))


def import_data(
    source: str | PathLike[str] | Sequence[str | PathLike[str]] | Any,
    *,
    ring: Ring | None = None,
    lattice: str | None = None,
    sequence: str | None = None,
    energy: float | None = None,
    unit: Unit | None = None,
    noise: float | None = None,
    turns: str | None = None,
    names: Mapping[str, str] | None = None,
    bad: Sequence[str] = (),
    iteration: Iteration = "first",
    keep_bad: bool = False,
) -> Imported:
    """Import a measurement of another program, with what was assumed of it.

    Args:
        source: a file, several that belong together (see `bring_in`), or a pandas DataFrame or
            xarray Dataset.
        ring: the lattice; or its `lattice`, `sequence` and `energy` (GeV), see `load_ring`.
        unit: of readings that state none; None: from their size.
        noise: rms of a reading, or of an orbit change, m, where the source gives none.
        turns: the kind of a turn-by-turn file, see `read_turn_by_turn`.
        names: device or column of the source -> the lattice's monitor.
        bad: monitors to leave out, by either name; patterns.
        iteration, keep_bad: of a LOCO fit, see `bring_loco`.

    Returns:
        `measurement`, `ring`, `assumed` and `doubts`; `write_imported` writes them to a folder.

    Raises:
        MeasurementError: a source that is unknown, or does not fit together.
        LatticeError: a lattice that cannot be made.
    """
    stated = Stated(names=dict(names or {}), bad=tuple(bad)) if names or bad else None
    one = is_frame(source) or isinstance(source, str | PathLike)
    options = Options(
        iteration, keep_bad, sequence, lattice, energy, turns, unit, noise, stated, ring
    )
    every: Any = [source] if one else source
    return bring_in(every, options)


def _without_bad(brought: Imported, stated: Stated) -> Imported:
    """Without the monitors that are stated to be bad.

    Raises:
        UnknownNameError: a pattern of no monitor, of the data or of the lattice.
    """
    data: Any = brought.measurement
    if isinstance(data, TuneReading):
        return brought
    devices = {name: getattr(data, "devices", {}).get(name, name) for name in data.monitors}
    ring = [] if brought.ring is None else [monitor.name for monitor in brought.ring.monitors]
    bad = stated.bad_among(devices, ring)
    if not bad:
        return brought
    kept = [name for name in data.monitors if name not in bad]
    brought = replace(brought, measurement=data.select(monitors=kept))
    return brought.saying(f"bad BPMs, left out as stated: {counted(bad)}")


def _with_all_noise(brought: Imported, data: OrbitResponse) -> Imported:
    """The typical noise of a plane where the files have none for a monitor."""
    if data.noise is None or not np.isfinite(data.noise).any(axis=0).all():
        return brought
    unknown = np.isnan(data.noise)
    read = np.isfinite(data.response).any(axis=0)
    noise = np.where(unknown, np.nanmedian(data.noise, axis=0), data.noise)
    brought = replace(brought, measurement=replace(data, noise=noise))
    names = [data.monitors[i] for i in np.unique(np.nonzero(unknown & read)[0])]
    if not names:
        return brought
    return brought.saying(f"no noise is given for {counted(names)}: that of the typical BPM")


def _bring(
    files: Sequence[Path],
    matlab: Sequence[tuple[Path, Content]],
    hdf5: Sequence[tuple[Path, Content]],
    options: Options,
) -> Imported:
    alone = len(files) == 1 and not matlab and all("matrix" not in part for _, part in hdf5)
    if options.turns or alone:
        path, ring = files[0], _ring(options)
        suffix = path.suffix.lower()
        if not options.turns and suffix in (*CSV, *HDF5):
            return _with_conventions(_table(path, ring, options), ring, options)
        if options.turns or suffix not in NAMES:
            return _with_conventions(_turns(path, ring, options), ring, options)
    loco = [(path, content) for path, content in matlab if "LocoMeasData" in content]
    rest = [(path, content) for path, content in matlab if "LocoMeasData" not in content]
    if hdf5:
        names = [path for path in files if path.suffix.lower() in NAMES]
        if not rest or not names:
            raise MeasurementError(
                f"'{hdf5[0][0]}' names inputs, not places: give the lattice (.mat) and the table "
                "of names (name_mapping.json) with it"
            )
        mapping = {key: place for path in names for key, place in read_mapping(path).items()}
        return bring_hdf5(hdf5, mapping, _lattice(rest, options))
    responses = [content for _, content in rest if "Rmat" in content]
    if responses and not loco:
        raise MeasurementError(
            "a response of the Middle Layer names devices, not elements: give the machine's LOCO "
            "file with it"
        )
    if len(loco) == 1 and len(loco) + len(rest) == len(files):
        ((path, content),) = loco
        if len(rest) == 1 and not responses:
            if not content.keys().isdisjoint(("RINGData", "THERING")):
                raise MeasurementError(
                    f"'{path}' holds a lattice, and '{rest[0][0]}' is given as well; give one"
                )
            own = _lattice(rest, options)
            content = {**content, "RINGData": {"Lattice": own.fields, "Energy": own.energy}}
            rest = []
        if not rest:
            return bring_loco(content, path, options.iteration, options.keep_bad, options.energy)
        if len(responses) == 1:
            beside = [
                content for _, content in rest if not {"BPMxDisp", "BPMxData"}.isdisjoint(content)
            ]
            return bring_middle_layer(
                responses[0], beside, content, path, options.iteration, options.keep_bad,
                options.energy,
            )  # fmt: skip
    if len(rest) == len(files) == 1 and (ring := _ring(options)) is not None:
        stated = with_unit(options.stated, options.unit, options.noise)
        return bring_readings(label(files[0]), of_matlab(*rest[0]), ring, stated)
    shown = ", ".join(f"'{path}'" for path in files)
    raise MeasurementError(
        f"{shown}: no measurement that is known; give a MATLAB LOCO file (with LocoMeasData), or "
        "the HDF5 files of a response with lattice and names"
    )


def _table(source: Path | Any, ring: Ring | None, options: Options) -> Imported:
    """A response by its columns, else a table of readings."""
    name, columns = label(source), read_columns(source)
    plain_text = not isinstance(source, Path) or source.suffix.lower() in CSV
    if plain_text and is_response_table(columns):
        return bring_table(name, columns, ring, options.stated)
    stated = with_unit(options.stated, options.unit, options.noise)
    return bring_readings(name, columns, ring, stated)


def _turns(path: Path, ring: Ring | None, options: Options) -> Imported:
    """Turns of a known kind; of SDDS of another kind, the columns as they are."""
    try:
        stated = with_unit(options.stated, options.unit, None)
        unit = cast("Unit | None", "um" if stated.unit == "µm" else stated.unit)
        return bring_turns(path, ring, options.turns, unit, stated)
    except MeasurementError as error:
        if options.turns or ring is None or not is_sdds(path):
            raise
        columns = read_columns(path)
        if not isinstance(error, OtherFormatError):  # turns, with something wrong in them
            raise
        if any(column.name.endswith("PositionsConcentratedAndSorted") for column in columns):
            raise (error.__cause__ or error) from None
        stated = with_unit(options.stated, options.unit, options.noise)
        return bring_readings(label(path), columns, ring, stated)


def _with_conventions(brought: Imported, ring: Ring | None, options: Options) -> Imported:
    """The readings with the stated conventions of signs and units undone; those that have a meaning
    for this kind of measurement."""
    data: Any = brought.measurement
    wanted = options.stated.assume if options.stated else ()
    for name in wanted:
        if name not in ASSUMPTIONS:
            raise unknown_name("assumption", name, ASSUMPTIONS)
    own = [name for name in wanted if isinstance(data, ASSUMPTIONS[name].kinds)]
    if left := [name for name in wanted if name not in own]:
        brought = brought.saying(f"of no meaning for these data, not undone: {', '.join(left)}")
    if not own:
        return brought
    names = data.monitors if ring is None else [monitor.name for monitor in ring.monitors]
    brought = replace(brought, measurement=assume(data, own, names))
    return brought.saying(f"conventions of the machine file, undone: {', '.join(own)}")


def _ring(options: Options) -> Ring | None:
    if callable(options.ring):
        return options.ring()
    if options.ring is not None or options.lattice is None:
        return options.ring
    return load_ring(options.lattice, options.sequence, options.energy)


def _lattice(matlab: Sequence[tuple[Path, Content]], options: Options) -> Elements:
    if len(matlab) > 1:
        raise MeasurementError(f"two lattices, '{matlab[0][0]}' and '{matlab[1][0]}'; give one")
    ((path, content),) = matlab
    return elements_of(content, path, options.sequence, options.energy)


# --- a measurement by its path --------------------------------------------------------------------
@by_name
def read_measurement(
    path: str | PathLike[str] | Any,
    monitors: Sequence[str] | None = None,
    turn_by_turn: str | None = None,
    unit: Unit | None = None,
    *,
    ring: Ring | None = None,
) -> AnyMeasurement:
    """Read a measurement: a folder, or any file that `diagnose` reads.

    What is assumed of a file (units, names, signs) is logged (logger `tmlattice.importers`, level
    info). Without `ring` and `monitors` the names are those of the file.

    Args:
        path: a measurement folder, its measurement.json, or a file that `bring_in` takes: a table
            (`.csv`, `.tsv`, `.txt`, `.h5`, `.sdds`), turns, a LOCO file; or a pandas DataFrame or
            an xarray Dataset.
        monitors: the ring's names. Of a folder, a monitor that is not among them is an error.
        turn_by_turn: the path is a turn-by-turn file of this kind, see `read_turn_by_turn`.
        unit: of the readings of a file that states none; else taken from their size.
        ring: the lattice, which knows the names of monitors and correctors.

    Raises:
        MeasurementError: nothing there, or nothing that is known; one sentence.
        UnknownNameError: a monitor that the ring does not have.
    """
    source = path if is_frame(path) else Path(path)
    brought = None
    if isinstance(source, Path):
        suffix = source.suffix.lower()
        if turn_by_turn is not None or not source.is_file() or source.name == "measurement.json":
            return folder.read_measurement(source, monitors, turn_by_turn, unit or "m")
        if monitors is not None and suffix in (*CSV, *HDF5, *SDDS):
            columns = read_columns(source)
            if suffix not in CSV or not is_response_table(columns):
                stated = with_unit(None, unit, None)
                brought = bring_readings(str(source), columns, None, stated, monitors)
    brought = brought or bring_in([source], Options(ring=ring, unit=unit))
    for sentence in (*brought.assumed, *brought.doubts):
        log.info("%s: %s", label(source), sentence)
    return brought.measurement


def measured(path: str | PathLike[str] | Any, ring: Ring | None = None) -> Any:
    """The measurement of a path or a frame that was given where a measurement is taken.

    Raises:
        MeasurementError: a file of another program without the ring; see `read_measurement`.
    """
    if is_frame(path):
        return read_measurement(path, ring=ring)
    place = Path(path)
    if ring is None and place.is_file() and place.name != "measurement.json":
        raise MeasurementError(f"'{place}' is a file of another program: give the ring with it")
    return read_measurement(place, ring=ring)
