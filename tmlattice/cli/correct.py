"""`tmlattice correct`: from a diagnosis to settings of power supplies, with the expected gain."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import (
    FILE,
    HINT,
    OfMachine,
    console,
    json_option,
    machine_file,
    open_ring,
    quiet_option,
)
from tmlattice.cli.progress import tell

if TYPE_CHECKING:
    from tmlattice.lattice import Ring

KINDS = "supplies, quadrupoles, skew_quadrupoles, correctors, sextupoles, rf"


class TargetText(click.ParamType):  # type: ignore[type-arg]
    """NAME or NAME=TOLERANCE."""

    name = "NAME[=TOLERANCE]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float | None]:
        """Target and tolerance, or None for the usual one."""
        if isinstance(value, tuple):
            return value
        name, _, text = str(value).partition("=")
        try:
            tolerance = float(text) if text else None
        except ValueError:
            tolerance = -1.0
        if tolerance is not None and not 0 < tolerance < float("inf"):
            self.fail(f"'{text}' is no tolerance; give for example {name}=0.01", param, ctx)
        return name.strip(), tolerance


@click.command("correct", cls=OfMachine)
@click.argument("estimated", metavar="ESTIMATED", type=FILE)
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
    type=TargetText(),
    multiple=True,
    help="Repeat for more: beta_beating, phase_advance, dispersion, tunes, chromaticity, coupling, "
    "closed_orbit, with the rms error that is tolerated; or first_turn alone, which threads a beam "
    "that is not stored. Else the optics.",
)
@click.option(
    "--example",
    "example_file",
    type=FILE,
    metavar="FILE",
    help="Write the table of the knobs, and end.",
)
@json_option
@click.option(
    "--out",
    type=FILE,
    metavar="DIR",
    help="Folder for settings.csv, statements of MAD-X, AT and elegant, report.html.",
)
@quiet_option
def correct(
    estimated: Path,
    design: str | None,
    goal: str | None,
    knobs: str | None,
    targets: tuple[tuple[str, float | None], ...],
    example_file: Path | None,
    json_file: Path | None,
    out: Path | None,
    quiet: bool,
) -> None:
    """Settings of power supplies that bring the ESTIMATED ring to the design, with their gain.

    ESTIMATED is a lattice file of `diagnose --lattice-out`, with the file of remaining
    uncertainties next to it, or the folder of `diagnose --out` with it. Predicted rms errors have
    68 % intervals. A correction whose expected gain is below its error changes no setting.
    """
    from contextlib import ExitStack

    from tmlattice.correction import correct as run
    from tmlattice.correction.estimate import read_estimate
    from tmlattice.correction.knobs import write_knobs
    from tmlattice.files import output_file, output_folder, write_json
    from tmlattice.report.correction_texts import correction_text
    from tmlattice.report.speaking import write_correction

    with ExitStack() as files:
        folder = files.enter_context(output_folder(out)) if out else None
        extra = files.enter_context(output_file(json_file)) if json_file else None
        path, named = _sources(estimated)
        machine = machine_file()
        start = design or named or (machine.lattice_name() if machine else None)
        if not start:
            raise click.UsageError(f"name the lattice that was diagnosed with --design{HINT}")
        settings = open_ring(start)
        devices = _devices(knobs, settings, dict(targets))
        if example_file:
            with output_file(example_file) as temporary:
                write_knobs(temporary, devices)
            console().print(f"written: {example_file}")
            return
        tell("estimated ring")
        estimate, warnings = read_estimate(path, settings, open_ring(str(path)))
        wanted = open_ring(goal) if goal else None
        options: dict[str, Any] = {"targets": dict(targets)} if targets else {}
        found = run(estimate, goal=wanted, knobs=devices, progress=tell, **options)
        if folder:
            write_correction(found, folder)
        if extra:
            write_json(extra, found.as_json())
    if not quiet:
        screen = console()
        screen.print(correction_text(found, min(screen.width, 120)), soft_wrap=True)
        for sentence in warnings:
            screen.print(f"\nNote: {sentence}.", soft_wrap=True)
        written = [f"{out}/: report.html, settings.csv, ..."] if out else []
        written += [str(json_file)] if json_file else []
        if written:
            screen.print(f"\nwritten: {'; '.join(written)}", soft_wrap=True)


def _sources(estimated: Path) -> tuple[Path, str | None]:
    """The estimated lattice's file, and the design where a diagnosis names it.

    Raises:
        MeasurementError: no such file, or a diagnosis that wrote no estimated lattice.
    """
    from tmlattice.errors import MeasurementError
    from tmlattice.input_files import json_of

    if not estimated.exists():
        raise MeasurementError(f"'{estimated}' is not there; check the path")
    document = estimated / "diagnosis.json" if estimated.is_dir() else estimated
    if document.name != "diagnosis.json":
        return estimated, None
    made = json_of(document, MeasurementError).get("provenance", {})
    if not made.get("lattice_out"):
        raise MeasurementError(
            f"'{document}' names no estimated ring; run `tmlattice diagnose` with --lattice-out, "
            "and give that file"
        )
    return Path(made["lattice_out"]), made.get("lattice")


def _devices(knobs: str | None, settings: "Ring", targets: dict[str, float | None]) -> list[Any]:
    from tmlattice.correction.knobs import default_knobs, kinds_for, read_knobs
    from tmlattice.correction.targets import OPTICS

    machine = machine_file()
    if knobs is None and machine is not None and (own := machine.knobs(settings)) is not None:
        return own
    if knobs is None:
        return default_knobs(settings, kinds_for(targets or OPTICS))
    if Path(knobs).suffix:
        return read_knobs(Path(knobs), settings)
    return default_knobs(settings, [kind.strip() for kind in knobs.split(",")])
