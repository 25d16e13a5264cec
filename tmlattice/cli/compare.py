"""`tmlattice compare`: what two diagnoses, two lattices or two orbit responses differ in."""

from pathlib import Path

import click

from tmlattice.cli.options import Careful, console, json_option, outputs, print_report


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

    with outputs(None, json_file) as (_, write):
        found = run(first, second)
        write(found.as_json())
    screen = console()
    print_report(screen, found)
    if json_file:
        screen.print(f"written: {json_file}")
