"""`tmlattice import`: measurements of other programs as a measurement folder."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import click

from tmlattice.cli.options import FILE, OfMachine, console, machine_file, open_ring, path_option


@click.command("import", cls=OfMachine)
@click.argument("files", nargs=-1, type=FILE)
@path_option(
    "--out",
    required=True,
    metavar="FOLDER",
    help="The measurement folder, with lattice.json in it where the files hold one.",
)
@click.option(
    "--iteration",
    type=click.Choice(["first", "last"]),
    default="first",
    help="Of a LOCO fit: the model before the fit, with the parameters of the first iteration; or "
    "the fitted lattice, with those of the last.",
)
@click.option(
    "--lattice", metavar="LATTICE", help="Of a table or of turns; else the machine file's."
)
@click.option(
    "--turns",
    metavar="KIND",
    help="FILES is one turn-by-turn file of this kind of turn_by_turn: lhc, sps, psb, "
    "doros, iota, ptc, trackone, ascii, madng, superkekb.",
)
@click.option(
    "--unit",
    type=click.Choice(["m", "mm", "um", "nm"]),
    help="Of readings whose file states none (else as the machine file states, or from their "
    "size), or of a turn-by-turn file [mm].",
)
@click.option(
    "--example",
    is_flag=True,
    help="Write a template of each kind of file and a machine file into --out, for --lattice "
    "(else the machine file's, or petra3), and import nothing.",
)
@click.option("--keep-bad", is_flag=True, help="Take BPMs and correctors that are called bad.")
@click.option("--force", is_flag=True, help="Replace a measurement that is there.")
def import_files(
    files: tuple[Path, ...],
    out: Path,
    iteration: Literal["first", "last"],
    lattice: str | None,
    turns: str | None,
    unit: Literal["m", "mm", "um", "nm"] | None,
    example: bool,
    keep_bad: bool,
    force: bool,
) -> None:
    """Bring measured data in: a measurement folder of FILES of other programs.

    FILES are a MATLAB LOCO file (.mat); the Middle Layer's response, dispersion and noise (.mat)
    with the machine's LOCO file; the HDF5 files of a response with name_mapping.json and the
    lattice (.mat); a table of readings or of a response (.csv, .txt, .h5, .sdds) with --lattice,
    whose columns are recognised; or a turn-by-turn file. The assumptions (units, signs, steps) are
    printed, and what the data contradict: nothing is corrected silently.
    """
    if example:
        if files:
            raise click.UsageError("--example writes templates and reads no FILES")
        machine = machine_file()
        own = machine.lattice_name() if machine is not None and machine.lattice else "petra3"
        _example(lattice or own, out)
        return
    if not files:
        raise click.UsageError("name the FILES to import, or --example for a template of each")
    from tmlattice.importers import Options, bring_in, described, write_imported
    from tmlattice.measurement.write import check_free

    check_free(out, force)
    machine = machine_file()
    options = Options(iteration, keep_bad, turns=turns, unit=unit)
    if lattice:
        options = replace(options, ring=lambda: open_ring(lattice))
    elif machine is not None and machine.lattice:
        options = replace(options, ring=lambda: open_ring(machine.lattice_name()))
    if machine is not None:
        of_file = machine.options_for(files[0])  # of a lattice that is among the files
        options = replace(
            options,
            stated=machine.stated,
            sequence=of_file.get("sequence"),
            energy=machine.options.get("energy"),
        )
    brought = bring_in(files, options)
    write_imported(brought, out, force)
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


def _example(lattice: str, out: Path) -> None:
    from tmlattice.effects import Cause
    from tmlattice.importers.example import FILES, write_example
    from tmlattice.lattice import middle_of_first_arc
    from tmlattice.machine.simulate import simulate

    ring = open_ring(lattice)
    fault = Cause("quadrupole_gradient", middle_of_first_arc(ring).name, -0.05)
    write_example(
        out, lattice, ring, simulate(ring, [fault], shots=6, engine="ocelot").measurement()
    )
    screen = console()
    for name, what in FILES.items():
        screen.print(f"{out / name}: {what}", soft_wrap=True)
    screen.print(f"the readings are of '{lattice}' with {fault.element} by {fault.amount:+.0%}")
    screen.print(
        f"next: tmlattice diagnose {out / 'readings_wide.csv'} --machine {out / 'tmlattice.toml'}",
        soft_wrap=True,
    )
