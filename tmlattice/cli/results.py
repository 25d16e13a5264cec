"""`tmlattice report` and `tmlattice compare`: results that are rendered again, or compared."""

from pathlib import Path

import click

from tmlattice.cli.options import (
    FILE,
    Careful,
    console,
    json_option,
    outputs,
    path_option,
    print_report,
)


@click.command("report", cls=Careful)
@click.argument("result", metavar="FOLDER", type=FILE)
@path_option("--out", metavar="DIR", help="Folder to write to; where none is named, FOLDER.")
def report(result: Path, out: Path | None) -> None:
    """Render report.html and report.txt again from the diagnosis.json of FOLDER.

    FOLDER is that of `tmlattice diagnose --out` or `tmlattice correct --out`, or a diagnosis.json
    or correction.json. Figures of the readings and of the scan are those that FOLDER holds, since
    diagnosis.json does not hold what they show.
    """
    from tmlattice.report.speaking import render

    found = render(result, out)
    place = out or (result if result.is_dir() else result.parent)
    print_report(console(), found, ("", f"written: {place / 'report.html'}"))


@click.command("compare", cls=Careful)
@click.argument("first", metavar="A")
@click.argument("second", metavar="B")
@json_option
def compare(first: str, second: str, json_file: Path | None) -> None:
    """List what A and B differ in: two diagnoses, two lattices or two orbit responses.

    A and B are folders of `tmlattice diagnose --out` (or a diagnosis.json); built-in names or
    lattice files; or measurement folders. Errors are differences over their standard errors, both
    taken as independent. Of a response each corrector's orbits are compared at the kick of A: rms
    of the difference, the rms that the noise alone makes, and the ratio of the two responses.
    """
    from tmlattice.report.compare import compare as run

    with outputs(None, json_file) as (*_, write):
        found = run(first, second)
        write(found.as_json())
    print_report(console(), found, [f"written: {json_file}"] if json_file else [])
