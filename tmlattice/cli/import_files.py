"""`tmlattice import`: measurements of other programs as a measurement folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from tmlattice.cli.options import FILE, Careful, console, quiet_option

if TYPE_CHECKING:
    from tmlattice.importers import Imported


@click.command("import", cls=Careful)
@click.argument("files", nargs=-1, required=True, type=FILE)
@click.option(
    "--out",
    type=FILE,
    required=True,
    metavar="FOLDER",
    help="The measurement folder, with lattice.json in it where the files hold one.",
)
@click.option(
    "--iteration",
    type=click.Choice(["first", "last"]),
    default="last",
    show_default=True,
    help="Of a LOCO fit: its lattice as the file has it, with the parameters of the last "
    "iteration; or with those of the first, the model before the fit.",
)
@click.option("--lattice", metavar="LATTICE", help="Of a table or of turns.")
@click.option("--sequence", metavar="NAME", help="The lattice file's variable that holds the ring.")
@click.option(
    "--energy",
    type=click.FloatRange(0, min_open=True),
    metavar="GEV",
    help="Beam energy of LATTICE; else what it states.",
)
@click.option(
    "--turns",
    metavar="KIND",
    help="FILES is one turn-by-turn file of this kind of turn_by_turn: lhc, sps, psb, "
    "doros, iota, ptc, trackone, ascii, madng, superkekb.",
)
@click.option(
    "--unit",
    type=click.Choice(["m", "mm", "um"]),
    help="Of the readings of first turns [m] or of a turn-by-turn file [mm].",
)
@click.option(
    "--noise",
    type=click.FloatRange(0, min_open=True),
    metavar="M",
    help="Rms of a reading, or of an orbit change, m, where FILES give none.",
)
@click.option("--keep-bad", is_flag=True, help="Take monitors and correctors that are called bad.")
@click.option("--force", is_flag=True, help="Replace a measurement that is there.")
@quiet_option
def import_files(
    files: tuple[Path, ...],
    out: Path,
    iteration: Literal["first", "last"],
    lattice: str | None,
    sequence: str | None,
    energy: float | None,
    turns: str | None,
    unit: Literal["m", "mm", "um"] | None,
    noise: float | None,
    keep_bad: bool,
    force: bool,
    quiet: bool,
) -> None:
    """Bring measured data in: a measurement folder of FILES of other programs.

    FILES are a MATLAB LOCO file (.mat); the Middle Layer's response, dispersion and noise (.mat)
    with the machine's LOCO file; the HDF5 files of a response with name_mapping.json and the
    lattice (.mat); a table (.csv) with --lattice; or a turn-by-turn file. What was assumed (units,
    signs, steps) is printed, and what the data contradict: nothing is mended silently.
    """
    from tmlattice.importers import Options, bring_in, write_imported
    from tmlattice.measurement.write import check_free

    check_free(out, force)
    options = Options(iteration, keep_bad, sequence, lattice, energy, turns, unit, noise)
    brought = bring_in(files, options)
    write_imported(brought, out, force)
    if not quiet:
        _print(brought, out)


def _print(brought: "Imported", out: Path) -> None:
    from tmlattice.importers import described

    screen = console()
    screen.print(described(brought))
    for sentence in brought.assumed:
        screen.print(f"- {sentence}")
    if brought.doubts:
        screen.print("the data contradict:")
        for sentence in brought.doubts:
            screen.print(f"! {sentence}")
    screen.print(f"written: {out}")
    if brought.ring is not None:
        screen.print(f"next: tmlattice diagnose {out / 'lattice.json'} {out}")
