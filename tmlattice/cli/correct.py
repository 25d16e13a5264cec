"""`tmlattice correct`: from a diagnosis to settings of power supplies, with the expected gain."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import (
    FILE,
    HINT,
    OfMachine,
    Word,
    console,
    json_option,
    machine_file,
    named_data,
    named_number,
    open_ring,
    outputs,
    path_option,
    print_report,
    require,
)
from tmlattice.cli.progress import tell

if TYPE_CHECKING:
    from tmlattice.lattice import Ring
    from tmlattice.measurement import Measurement

KINDS = "supplies, quadrupoles, skew_quadrupoles, correctors, sextupoles, rf"


def _target(text: str) -> tuple[str, float | None]:
    name, tolerance = named_number(text)
    require(tolerance is None or 0 < tolerance < float("inf"))
    return name, tolerance


TARGET = Word("NAME[=TOLERANCE]", _target, "'{2}' is no tolerance; give for example {1}=0.01")


@click.command("correct", cls=OfMachine)
@click.argument("estimated", metavar="ESTIMATED...", type=FILE, nargs=-1, required=True)
@click.option(
    "--design",
    metavar="LATTICE",
    help="The lattice that the diagnosis started from: its strengths are the present settings, and "
    "its optics the goal. Of a folder of `diagnose --out` it is known; else that of the machine "
    "file.",
)
@click.option("--goal", metavar="LATTICE", help="The optics that are wanted, if not the design's.")
@click.option(
    "--knobs",
    metavar="FILE|KINDS",
    help="A table of devices with units, settings, limits, steps and excitation curves (.csv, "
    f".yaml; see --example); or kinds with commas: {KINDS}. Else [[supplies]] of the machine file; "
    "else supplies and skew quadrupoles, and correctors where the closed orbit is a target.",
)
@click.option(
    "--target",
    "targets",
    type=TARGET,
    multiple=True,
    help="Repeat for more: beta_beating, phase_advance, dispersion, tunes, chromaticity, coupling, "
    "closed_orbit, with the rms error that is tolerated; or first_turn alone, which threads a beam "
    "that is not stored. Else the optics.",
)
@path_option("--example", "example_file", help="Write the table of the knobs, and end.")
@json_option
@path_option(
    "--out",
    metavar="DIR",
    help="Folder for settings.csv, statements of MAD-X, AT and elegant, report.html.",
)
def correct(
    estimated: tuple[Path, ...],
    design: str | None,
    goal: str | None,
    knobs: str | None,
    targets: tuple[tuple[str, float | None], ...],
    example_file: Path | None,
    json_file: Path | None,
    out: Path | None,
) -> None:
    """Settings of power supplies that bring the ESTIMATED ring to the design, with their gain.

    ESTIMATED is the folder of `diagnose --out`, or a lattice file of `diagnose --lattice-out` with
    the file of remaining uncertainties next to it; or, to thread a lost beam
    (--target first_turn), the folders of its measured first turns, in the order of time. Predicted
    rms errors have 68 % intervals. Changes that may make the ring worse are shortened, or not made.
    """
    from tmlattice.correction import correct as run
    from tmlattice.correction.estimate import read_estimate
    from tmlattice.correction.first_turn import estimate_of_turns
    from tmlattice.correction.knobs import write_knobs
    from tmlattice.files import output_file
    from tmlattice.report.speaking import write_correction

    with outputs(out, json_file) as (folder, _, write):
        turns = _first_turns(estimated)
        path, start = (estimated[0], design) if turns else _sources(estimated[0], design)
        machine = machine_file()
        start = start or (machine.lattice_name() if machine else None)
        if not start:
            raise click.UsageError(f"name the lattice that was diagnosed with --design{HINT}")
        settings = open_ring(start)
        if turns:
            tell("estimated ring")
            with named_data(" or ".join(map(str, estimated))):
                estimate = estimate_of_turns(settings, turns)
            settings = estimate.settings
        devices = _devices(knobs, settings, dict(targets))
        if example_file:
            with output_file(example_file) as temporary:
                write_knobs(temporary, devices)
            console().print(f"written: {example_file}")
            return
        warnings: tuple[str, ...] = ()
        if not turns:
            tell("estimated ring")
            estimate, warnings = read_estimate(path, settings, open_ring(str(path)))
        wanted = open_ring(goal) if goal else None
        options: dict[str, Any] = {"targets": dict(targets)} if targets else {}
        found = run(estimate, goal=wanted, knobs=devices, progress=tell, **options)
        if folder:
            write_correction(found, folder)
        write(found.as_json())
    after = [line for sentence in warnings for line in ("", f"Note: {sentence}.")]
    written = [f"{out}/: report.html, settings.csv, ..."] if out else []
    written += [str(json_file)] if json_file else []
    after += ["", f"written: {'; '.join(written)}"] if written else []
    print_report(console(), found, after)


def _first_turns(folders: tuple[Path, ...]) -> list["Measurement"]:
    """Measured first turns; empty: an estimated ring is given.

    Raises:
        MeasurementError: several estimated rings, or another measurement.
    """
    from tmlattice.errors import MeasurementError
    from tmlattice.measurement import Measurement, read_measurement

    if len(folders) == 1 and not (folders[0] / "measurement.json").is_file():
        return []
    found: list[Measurement] = []
    for folder in folders:
        one = read_measurement(folder)
        if not isinstance(one, Measurement):
            raise MeasurementError(
                f"'{folder}' holds no first turns; run `tmlattice diagnose` with --lattice-out, "
                "and give that file"
            )
        found.append(one)
    return found


def _sources(estimated: Path, design: str | None) -> tuple[Path, str | None]:
    """The estimated lattice's file, and the design: the one that is given, else a diagnosis's.

    Raises:
        MeasurementError: no such file, no diagnosis, or one that wrote no estimated lattice or
            names Python code.
    """
    from tmlattice.diagnosis.load import DOCUMENT, FORMAT, LATTICE, VERSION
    from tmlattice.errors import MeasurementError, plain
    from tmlattice.input_files import check_no_code
    from tmlattice.measurement.documents import read_document

    if not estimated.exists():
        raise MeasurementError(f"'{estimated}' is not there; check the path")
    document = estimated / DOCUMENT if estimated.is_dir() else estimated
    if document.name != DOCUMENT:
        return estimated, design
    made = read_document(document, "diagnosis", FORMAT, VERSION)["provenance"]
    if not made.get("lattice_out"):
        raise MeasurementError(
            f"'{document}' names no estimated ring; run `tmlattice diagnose` without --reference, "
            "with --out or --lattice-out"
        )
    found, named, kept = made["lattice_out"], made["lattice"], document.with_name(LATTICE)
    check_no_code(document, found, MeasurementError, f"give it instead of {estimated}")
    if design is None and named.casefold().endswith(".py") and kept.is_file():
        design = str(kept)  # the same ring, as data
    if design is None:
        check_no_code(document, named, MeasurementError, f"give --design {plain(named, 60)}")
    return document.parent / found, design or named


def _devices(knobs: str | None, settings: "Ring", targets: dict[str, float | None]) -> list[Any]:
    from tmlattice.correction.knobs import chosen_knobs
    from tmlattice.correction.targets import OPTICS

    machine = machine_file()
    own: Any = knobs
    if knobs is None and machine is not None:
        own = machine.knobs(settings)
    elif knobs and not Path(knobs).suffix:
        own = [kind.strip() for kind in knobs.split(",")]
    return chosen_knobs(own, settings, targets or OPTICS)
