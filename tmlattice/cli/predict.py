"""`tmlattice predict`: the orbit response of correctors that were not measured."""

from pathlib import Path

import click

from tmlattice.cli.options import OfMachine, console, lattice_argument, open_ring, path_option


@click.command("predict", cls=OfMachine)
@lattice_argument
@path_option(
    "--calibration",
    help="JSON with the gains, rolls and couplings of BPMs, the calibrations and rolls of "
    "correctors, and the energies of the beam.",
)
@click.option(
    "--corrector",
    "correctors",
    multiple=True,
    metavar="NAME",
    help="Predict this one; repeat for more. Else all.",
)
@click.option("--kick", type=float, default=1e-4, help="Of each, rad.")
@path_option("--out", required=True, help="A table: .csv.")
def predict(
    lattice: str, calibration: Path | None, correctors: tuple[str, ...], kick: float, out: Path
) -> None:
    """Predict how the stored beam's orbit answers a kick of each corrector, at fixed RF frequency.

    The table has the columns of a measurement's response.csv: corrector, monitor, and the orbit
    change x, y in m. It is linear in the kick. Silent BPMs and channels that the fit rejected
    are left empty.
    """
    from tmlattice.files import output_file
    from tmlattice.measurement.kinds import write_response_table
    from tmlattice.observe.calibration import Calibration, calibrated_response, read_calibration

    if kick == 0 or not abs(kick) < float("inf"):
        raise click.BadParameter(f"a kick of {kick:g} rad; it is finite and not zero")
    with output_file(out) as file:
        ring = open_ring(lattice)
        own = read_calibration(calibration, ring) if calibration else Calibration()
        columns, response = calibrated_response(
            ring, own.causes, correctors or None, own.dispersion, own.rejected
        )
        monitors = [monitor.name for monitor in ring.monitors]
        orbits = list(zip(columns.names, kick * response, strict=True))
        with file.open("w", encoding="utf-8", newline="") as table:
            write_response_table(table, monitors, orbits)
    console().print(
        f"{ring.name}: {len(columns.names)} correctors, {len(monitors)} BPMs, kick "
        f"{1e6 * kick:g} µrad\nwritten: {out}"
    )
