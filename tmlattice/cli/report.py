"""`tmlattice report`: the report of a diagnosis, rendered again."""

from pathlib import Path

import click

from tmlattice.cli.options import FILE, Careful, console, print_report


@click.command("report", cls=Careful)
@click.argument("result", metavar="FOLDER", type=FILE)
@click.option(
    "--out", type=FILE, metavar="DIR", help="Folder to write to; where none is named, FOLDER."
)
def report(result: Path, out: Path | None) -> None:
    """Render report.html and report.txt again from the diagnosis.json of FOLDER.

    FOLDER is that of `tmlattice diagnose --out` or `tmlattice correct --out`, or a diagnosis.json
    or correction.json. Figures of the readings and of the scan are those that FOLDER holds, since
    diagnosis.json does not hold what they show.
    """
    from tmlattice.report.speaking import render

    found = render(result, out)
    screen = console()
    print_report(screen, found)
    place = out or (result if result.is_dir() else result.parent)
    screen.print(f"\nwritten: {place / 'report.html'}", soft_wrap=True)
