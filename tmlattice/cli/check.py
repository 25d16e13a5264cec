"""`tmlattice check`: what is wrong with a measurement as a whole."""

from pathlib import Path

import click

from tmlattice.cli.options import (
    FILE,
    OfMachine,
    assume_option,
    console,
    json_option,
    lattice_argument,
    named_data,
    open_ring,
    outputs,
    radiation_option,
    read_data,
)


@click.command("check", cls=OfMachine)
@lattice_argument
@click.argument("measurement", type=FILE, required=False)
@assume_option
@radiation_option
@json_option
@click.pass_context
def check(
    context: click.Context,
    lattice: str,
    measurement: Path,
    assumed: tuple[str, ...],
    radiation: bool,
    json_file: Path | None,
) -> None:
    """Check a measurement as a whole for errors of the data, in a second.

    The check finds wrong signs, units, names and orders; launches and noise that contradict the
    stated ones; silent, frozen and copied BPMs; and outliers. MEASUREMENT is a folder of any
    kind. The exit code is 0 if the data can be diagnosed, and 1 if they must be corrected first.
    """
    with outputs(None, json_file) as (*_, write):
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        from tmlattice.diagnosis.data_checks import check_data

        ring = open_ring(lattice)
        data, _ = read_data(measurement, ring, assumed)
        with named_data(measurement):
            found = check_data(ring, data, assumed=assumed, radiation=radiation)
        document = found.as_json()
        document["provenance"] = {**document["provenance"], "measurement": str(measurement)}
        write(document)
    screen = console()
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_header=False)
    for own in found.checks:
        table.add_row(own.name, "ok" if own.status == "fine" else own.status, own.sentence)
    screen.print(table)
    made = found.provenance
    screen.print(f"{made['lattice']}: {len(found.checks)} checks, {made['seconds']:.1f} s")
    if json_file:
        screen.print(f"written: {json_file}")
    if found.status == "wrong":
        context.exit(1)
