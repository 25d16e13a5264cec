"""`tmlattice tune-fit`: from one perturbed first-turn orbit to the tunes."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from tmlattice.cli.options import (
    FILE,
    REGULARIZATIONS,
    Careful,
    console,
    json_option,
    lattice_argument,
    open_ring,
    quiet_option,
    recipe_options,
    table,
    trajectories,
)

if TYPE_CHECKING:
    from tmlattice.fitting import TuneFit
    from tmlattice.lattice import Ring
    from tmlattice.measurement import Measurement


@click.command("tune-fit", cls=Careful)
@lattice_argument
@click.option(
    "--magnet",
    metavar="NAME",
    help="Quadrupole or sextupole to change; else the defocusing quadrupole in the "
    "middle of the first arc.",
)
@click.option(
    "--measurement",
    type=FILE,
    metavar="DIR",
    help="Fit these data, a measurement folder, and change no magnet; all shots together.",
)
@click.option(
    "--regularization",
    type=click.Choice(REGULARIZATIONS),
    default="symplectic",
    show_default=True,
)
@click.option(
    "--out",
    type=FILE,
    default="tune-fit",
    show_default=True,
    metavar="DIR",
    help="Folder for the three figures, tune-fit.json and network.pt.",
)
@recipe_options
@json_option
@quiet_option
def tune_fit(
    lattice: str,
    sequence: str | None,
    energy: float | None,
    measurement: Path | None,
    out: Path,
    json_file: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Predict the tunes of a perturbed ring from one first-turn orbit.

    One magnet of LATTICE is weakened, the monitors read one noisy first turn, the network of the
    unperturbed design is fine-tuned on it, and its tunes are held against OCELOT's true ones.

    With --measurement the data are a folder's, and the true tunes are not known.
    """  # fmt: skip
    if measurement is not None:
        _refuse_own_data(click.get_current_context())
    from tmlattice.files import output_file, output_folder, write_json

    with ExitStack() as files:
        folder = files.enter_context(output_folder(out))
        extra = files.enter_context(output_file(json_file)) if json_file else None
        from tmlattice.fitting import tune_fit as run
        from tmlattice.network import save_network

        if measurement is None:
            ring = open_ring(lattice, sequence, energy)
            outcome = run(ring, progress=not quiet, **options)
        else:
            data = trajectories(
                measurement, "; tune-fit takes a trajectory, the first turn of a beam"
            )
            ring = open_ring(lattice, sequence, energy)
            outcome = _fit(ring, data, measurement, quiet, options)
        _draw(outcome, folder)
        result = outcome.as_json()
        save_network(outcome.fit.network, folder / "network.pt")
        for path in (folder / "tune-fit.json", extra):
            if path:
                write_json(path, result)
    if not quiet:
        _print(outcome, out, json_file)


OWN_DATA = ("magnet", "change", "launch", "noise")
"""Options that say how data are made: of no use for data that are there."""


def _refuse_own_data(context: click.Context) -> None:
    for name in OWN_DATA:
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise click.UsageError(
                f"--{name} makes data and --measurement reads them: leave one of the two out"
            )


def _fit(
    ring: "Ring", data: "Measurement", path: Path, quiet: bool, options: dict[str, Any]
) -> "TuneFit":
    from tmlattice.errors import MeasurementError, UnknownNameError
    from tmlattice.fitting import tune_fit_measurement

    recipe = {k: v for k, v in options.items() if k not in (*OWN_DATA, "seed")}
    try:
        return tune_fit_measurement(ring, data, source=str(path), progress=not quiet, **recipe)
    except (MeasurementError, UnknownNameError) as error:
        raise MeasurementError(f"{path}: {error}") from error


def _draw(outcome: "TuneFit", folder: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from tmlattice.plots import plot_loss, plot_orbit_fit, plot_tune_fit_spectrum

    orbit = plot_orbit_fit(outcome)
    spectrum, axes = plt.subplots(2, 1, figsize=(10, 7), sharex=True, layout="constrained")
    plot_tune_fit_spectrum(outcome, tuple(axes))
    axes[0].set_xlabel("")
    axes[0].set_title(
        f"{outcome.turns_alive} turns through the fine-tuned network, growth taken out"
    )
    loss, ax = plt.subplots(figsize=(8, 5), layout="constrained")
    monitors = len(outcome.fit.network.monitors)
    plot_loss(outcome.fit, ax, floor=2 * monitors * (outcome.noise or 0.0) ** 2)
    orbits = "one orbit" if outcome.shots == 1 else f"{outcome.shots} orbits"
    ax.set_title(f"Fine-tuning on {orbits} of {monitors} monitors")
    for figure, name in ((orbit, "orbit"), (spectrum, "spectrum"), (loss, "loss")):
        figure.savefig(folder / f"{name}.png", dpi=150)
        plt.close(figure)


def _print(outcome: "TuneFit", out: Path, json_file: Path | None) -> None:
    screen = console()
    noise = "-" if outcome.noise is None else f"{1e6 * outcome.noise:g}"
    if outcome.magnet is None or outcome.change is None:
        what = f"{outcome.shots} shots of {outcome.source}, noise {noise} µm"
    else:
        magnet = outcome.ring[outcome.magnet]
        what = (
            f"{magnet.kind} {magnet.name} at s = {magnet.s:.2f} m "
            f"changed by {100 * outcome.change:+g} %, noise {noise} µm"
        )
    network = outcome.fit.network
    screen.print(
        f"{outcome.ring.name}: {outcome.ring.length:.3f} m, "
        f"{outcome.ring.energy:g} GeV, {len(network.layers)} layers, "
        f"{len(network.monitors)} monitors\n{what}"
    )
    tunes = table("fractional tunes", "Qx", "Qy")
    rows = [
        ("design (OCELOT)", outcome.design_tunes, "{:.6f}"),
        ("true, perturbed (OCELOT)", outcome.true_tunes, "{:.6f}"),
        ("fine-tuned network", outcome.network_tunes, "{:.6f}"),
        ("absolute error", outcome.absolute_error, "{:.6f}"),
        ("error relative to the fraction", outcome.relative_error, "{:.2%}"),
    ]
    if outcome.true_tunes is None:
        rows = [row for row in rows if row[1] is not None]
    for name, value, form in rows:
        tunes.add_row(name, *(("-", "-") if value is None else map(form.format, value)))
    screen.print(tunes)
    if outcome.growth is not None and abs(outcome.growth - 1) > 1e-3:
        screen.print(
            "the fine-tuned network is not symplectic: amplitudes change by up to "
            f"{100 * abs(outcome.growth - 1):.1f} % a turn; "
            f"tunes from the first {outcome.turns_alive} turns"
        )
    if outcome.problem:
        screen.print(f"{outcome.problem}")
    before, after = outcome.orbit_rms
    fit = outcome.fit
    how = "patience ran out" if fit.stopped_early else "all epochs"
    orbit = table("readings less network", "rms [µm]")
    for name, rms in (("before", before), ("after", after), ("noise", outcome.noise)):
        orbit.add_row(name, "-" if rms is None else f"{1e6 * rms:.2f}")
    screen.print(orbit)
    stages = table("stage", *outcome.seconds)
    stages.add_row("seconds", *(f"{stage:.2f}" for stage in outcome.seconds.values()))
    screen.print(stages)
    screen.print(
        f"{len(fit.loss)} epochs ({how}), regularization {fit.options['regularization']} x "
        f"{fit.options['regularization_rate']:g}, learning rate {fit.options['learning_rate']:g}, "
        f"seed {outcome.seed}"
    )
    written = f"{out}/: orbit.png, spectrum.png, loss.png, tune-fit.json, network.pt"
    screen.print(f"written: {written}" + (f"; {json_file}" if json_file else ""))
