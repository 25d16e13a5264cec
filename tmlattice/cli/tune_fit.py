"""`tmlattice tune-fit`: from one perturbed first-turn orbit to the tunes."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from tmlattice.cli.options import (
    WithDefault,
    Word,
    console,
    epochs_option,
    is_quiet,
    json_option,
    lattice_argument,
    named_data,
    open_ring,
    outputs,
    path_option,
    read_data,
    require,
    seed_option,
    table,
)

METHODS = ("adam", "sparse", "map")

if TYPE_CHECKING:
    from rich.table import Table

    from tmlattice.fitting import TuneFit
    from tmlattice.lattice import Ring


def _launch(text: str) -> tuple[float, ...]:
    numbers = tuple(map(float, text.split(",")))
    require(len(numbers) == 4 and all(abs(number) < float("inf") for number in numbers))
    return numbers


LAUNCH = Word(
    "x,px,y,py", _launch,
    "'{0}' is no launch; give four numbers in m and rad, such as 1e-3,0,1e-3,0",
)  # fmt: skip


@click.command("tune-fit", cls=WithDefault)
@lattice_argument
@click.option(
    "--magnet",
    metavar="NAME",
    help="Quadrupole or sextupole to change; else the defocusing quadrupole in the "
    "middle of the first arc.",
)
@path_option(
    "--measurement",
    metavar="DIR",
    help="Fit these data, a measurement folder or a file of readings, and change no magnet; all "
    "shots together.",
)
@path_option(
    "--out",
    default="tune-fit",
    metavar="DIR",
    help="Folder for the figures, tune-fit.json and network.pt.",
)
@click.option(
    "--method",
    "methods",
    type=click.Choice(METHODS),
    multiple=True,
    help="Repeat for more; all three where none is named. Figures and JSON have the same ones.",
)
@click.option(
    "--change",
    type=float,
    help="Relative change of the magnet's strength; else -0.2, or less where that makes "
    "the ring unstable.",
)
@click.option(
    "--launch",
    type=LAUNCH,
    default="1e-3,0,1e-3,0",
    help="State at the start of the ring, m and rad.",
)
@click.option("--noise", type=click.FloatRange(0), default=2e-5, help="Rms of one reading, m.")
@epochs_option
@seed_option("Of the readings' noise.")
@json_option
def tune_fit(
    lattice: str,
    measurement: Path | None,
    out: Path,
    json_file: Path | None,
    methods: tuple[str, ...],
    **options: Any,
) -> None:
    """Predict the tunes of a perturbed ring from one first-turn orbit.

    One magnet of LATTICE is weakened, the BPMs read one noisy first turn, the network of the
    unperturbed design is fine-tuned on it, and its tunes are held against OCELOT's true ones. There
    is a column for each method: adam, the paper's recipe, which frees every weight; sparse, as few
    changed magnets as the readings ask for; map, the most probable changes of all magnets. Under
    them stands which one to trust, and why.

    With --measurement the data are a folder's. The launches are fitted too, within their stated
    errors, and the true tunes are unknown.
    """  # fmt: skip
    if measurement is not None:
        context = click.get_current_context()
        for name in OWN_DATA:
            if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
                raise click.UsageError(
                    f"--{name} makes data and --measurement reads them: leave one of the two out"
                )
    from tmlattice.files import write_json

    with outputs(out, json_file) as (folder, _, write):
        options["methods"] = methods or METHODS
        from tmlattice.fitting import tune_fit as run
        from tmlattice.network import save_network

        ring = open_ring(lattice)
        if measurement is None:
            outcome = run(ring, progress=not is_quiet(), **options)
        else:
            outcome = _fit(ring, measurement, options)
        best = outcome.best.fit
        assert folder is not None
        assert best is not None
        written = _draw(outcome, folder)
        save_network(best.network, folder / "network.pt")
        write_json(folder / "tune-fit.json", outcome.as_json())
        write(outcome.as_json())
    _print(outcome, out, [*written, "tune-fit.json", "network.pt"], json_file)


OWN_DATA = ("magnet", "change", "launch", "noise")
"""Options that determine how data are simulated; they have no use for measured data."""


def _fit(ring: "Ring", path: Path, options: dict[str, Any]) -> "TuneFit":
    from tmlattice.errors import MeasurementError
    from tmlattice.fitting import tune_fit_measurement
    from tmlattice.measurement import Measurement, in_words

    data, _ = read_data(path, ring)
    if not isinstance(data, Measurement):
        raise MeasurementError(
            f"'{path}' is {in_words(data)}; tune-fit takes a trajectory, the first turn of a beam"
        )
    recipe = {k: v for k, v in options.items() if k not in (*OWN_DATA, "seed")}
    with named_data(path):
        return tune_fit_measurement(ring, data, source=str(path), progress=not is_quiet(), **recipe)


def _draw(outcome: "TuneFit", folder: Path) -> list[str]:
    """The figures, and their names; a loss there is where the recipe was asked for."""
    import matplotlib.pyplot as plt

    from tmlattice.plots import plot_loss, plot_orbit_fit, plot_tune_fit_spectrum, save_figure

    figures = {"orbit": plot_orbit_fit(outcome)}
    figures["spectrum"], axes = plt.subplots(2, 1, figsize=(10, 7), sharex=True,
                                             layout="constrained")  # fmt: skip
    plot_tune_fit_spectrum(outcome, tuple(axes))
    axes[0].set_xlabel("")
    axes[0].set_title(f"{outcome.turns} turns through each fitted network, growth taken out")
    if outcome.methods[0].method == "adam":
        figures["loss"], ax = plt.subplots(figsize=(8, 5), layout="constrained")
        monitors = len(outcome.fit.network.monitors)
        plot_loss(
            outcome.fit, ax, floor=2 * monitors * (outcome.noise or 0.0) ** 2,
            others={m.method: m.fit.loss[-1] for m in outcome.methods[1:] if m.fit is not None},
        )  # fmt: skip
        orbits = "one orbit" if outcome.shots == 1 else f"{outcome.shots} orbits"
        ax.set_title(f"Fine-tuning on {orbits} of {monitors} BPMs")
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png")
    return [f"{name}.png" for name in figures]


def _print(outcome: "TuneFit", out: Path, written: list[str], json_file: Path | None) -> None:
    screen = console()
    noise = "-" if outcome.noise is None else f"{1e6 * outcome.noise:.4g}"
    estimated = " (estimated)" if outcome.noise_estimated else ""
    if outcome.magnet is None or outcome.change is None:
        what = f"{outcome.shots} shots of {outcome.source}, with fitted launches"
    else:
        magnet = outcome.ring[outcome.magnet]
        what = (
            f"{magnet.kind} {magnet.name} at s = {magnet.s:.2f} m "
            f"changed by {100 * outcome.change:+g} %"
        )
    network = outcome.fit.network
    screen.print(
        f"{outcome.ring.name}: {outcome.ring.length:.3f} m, "
        f"{outcome.ring.energy:g} GeV, {len(network.layers)} layers, "
        f"{len(network.monitors)} BPMs\n{what}"
    )
    tunes = table("fractional tunes", "Qx", "Qy")
    tunes.add_row("design (OCELOT)", *map("{:.6f}".format, outcome.design_tunes))
    if outcome.true_tunes is not None:
        tunes.add_row("true, perturbed (OCELOT)", *map("{:.6f}".format, outcome.true_tunes))
    screen.print(tunes)
    screen.print(
        f"readings less the design: rms {1e6 * outcome.rms_before:.2f} µm, "
        f"noise {noise} µm{estimated}"
    )
    screen.print(_columns(outcome))
    growth = outcome.methods[0].growth
    if growth is not None and abs(growth - 1) > 1e-3:
        screen.print(
            f"the network of {outcome.methods[0].method} is not symplectic: amplitudes change by "
            f"up to {100 * abs(growth - 1):.1f} % a turn; its tunes are from the first "
            f"{outcome.methods[0].turns_alive} turns"
        )
    for method in outcome.methods:
        if method.problem:
            screen.print(f"{method.method}: {method.problem}")
    screen.print(f"\n{outcome.advice}\n")
    seconds = ("seconds", *(f"{stage:.2f}" for stage in outcome.seconds.values()))
    screen.print(table("stage", *outcome.seconds, rows=[seconds]))
    if outcome.methods[0].method == "adam":
        fit = outcome.fit
        how = "patience ran out" if fit.stopped_early else "all epochs"
        screen.print(
            f"adam: {len(fit.loss)} epochs ({how}), regularization {fit.options['regularization']} "
            f"x {fit.options['regularization_rate']:g}, learning rate "
            f"{fit.options['learning_rate']:g}, seed {outcome.seed}"
        )
    files = f"{out}/: {', '.join(written)} (of {outcome.best.method})"
    screen.print(f"written: {files}" + (f"; {json_file}" if json_file else ""))


def _columns(outcome: "TuneFit") -> "Table":
    """What each method made of the readings."""
    from tmlattice.fitting.outcome import errors

    made = table("method", *(method.method for method in outcome.methods))

    def row(name: str, form: str, values: Iterable[float | None]) -> None:
        made.add_row(name, *("-" if value is None else form.format(value) for value in values))

    away = [errors(method.tunes, outcome.true_tunes) for method in outcome.methods]
    for i, tune in enumerate(("Qx", "Qy")):
        row(tune, "{:.6f}", (None if m.tunes is None else m.tunes[i] for m in outcome.methods))
        if outcome.true_tunes is not None:
            row("  absolute error", "{:.6f}", (None if a is None else a[i] for a, _ in away))
            row("  relative to the fraction", "{:.2%}",
                (None if r is None else r[i] for _, r in away))  # fmt: skip
        sigmas = (None if m.tune_sigma is None else m.tune_sigma[i] for m in outcome.methods)
        row("  stated error", "{:.6f}", sigmas)
    row("rms [µm] left of readings", "{:.2f}",
        (1e6 * m.rms if m.fit is not None else None for m in outcome.methods))  # fmt: skip
    shown = max((len(m.named) for m in outcome.methods), default=0)
    for i in range(shown):
        named = [list(m.named.items())[i : i + 1] for m in outcome.methods]
        made.add_row(
            "changed magnets" if i == 0 else "",
            *(f"{n[0][0]} {100 * n[0][1][0]:+.2f} ± {100 * n[0][1][1]:.2f} %" if n else ""
              for n in named),
        )  # fmt: skip
    row("seconds", "{:.2f}", (m.seconds for m in outcome.methods))
    return made
