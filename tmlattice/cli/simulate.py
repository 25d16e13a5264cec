"""`tmlattice simulate`: a measurement whose cause is known."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from tmlattice.cli.options import (
    FILE,
    WithDefault,
    background_option,
    console,
    lattice_argument,
    machine_file,
    open_ring,
    quiet_option,
    table,
)
from tmlattice.cli.simulate_stored import KINDS, simulate_stored


class CauseText(click.ParamType):  # type: ignore[type-arg]
    """ "NAME [ELEMENT] AMOUNT" as one word."""

    name = '"NAME [ELEMENT] AMOUNT"'

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str | None, float]:
        """Effect, element or None, amount."""
        if isinstance(value, tuple):
            return value
        words = str(value).split()
        try:
            amount = float(words[-1])
        except (ValueError, IndexError):
            words = []
        if len(words) < 2:  # NAME AMOUNT; ELEMENT may have blanks
            self.fail(
                f"'{value}' is no effect; give NAME [ELEMENT] AMOUNT in quotes, such as "
                "\"quadrupole_gradient qd::12 -0.2\" ('tmlattice effects' lists the names)",
                param,
                ctx,
            )
        return words[0], " ".join(words[1:-1]) or None, amount


@click.command("simulate", cls=WithDefault)
@lattice_argument
@click.option(
    "--effect",
    "effects",
    type=CauseText(),
    multiple=True,
    help="What is wrong with the machine; repeat for more.",
)
@background_option("Random distributed errors")
@click.option(
    "--kind",
    type=click.Choice(list(KINDS)),
    default="trajectory",
    show_default=True,
    help="First turns; or of the stored beam: its orbit for steps of the correctors and of the RF, "
    "its turns after a kick, its orbit, its orbit for a step of the RF, its tunes.",
)
@click.option(
    "--shots",
    type=click.IntRange(1),
    default=6,
    show_default="6 of first turns, else 1",
    help="How many.",
)
@click.option(
    "--turns",
    type=click.IntRange(1),
    default=1,
    show_default="1, and 1000 turn by turn",
    help="Read in each shot.",
)
@click.option(
    "--amplitude",
    type=click.FloatRange(0, min_open=True),
    default=1e-3,
    show_default=True,
    help="Rms orbit over monitors and planes, m.",
)
@click.option(
    "--noise",
    type=click.FloatRange(0),
    help="Rms of one reading, m; else the machine file's (of turns), or 2e-5, and of an orbit or "
    "its change 2e-6 in x and 1.2e-6 in y. Tunes: of a tune, else 2e-5.",
)
@click.option(
    "--engine",
    type=click.Choice(["at", "ocelot"]),
    default="at",
    show_default=True,
    help="Thick symplectic tracking, or second-order maps.",
)
@click.option("--radiation", is_flag=True, help="Bends and wigglers radiate.")
@click.option(
    "--settings",
    "settings_file",
    type=FILE,
    metavar="FILE",
    help="JSON: a list with the settings of each shot, as in the measurement format.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of launches, settings and noise.",
)
@click.option(
    "--machine-seed",
    type=click.IntRange(0),
    help="Of the background; the same machine has the same one. Else the seed.",
)
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@click.option(
    "--corrector",
    "correctors",
    multiple=True,
    metavar="NAME",
    help="Orbit response: step this one; repeat for more. Else all.",
)
@click.option(
    "--particles",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Turn by turn: 1 is the middle of the beam; some hundreds decohere.",
)
@click.option("--out", type=FILE, required=True, metavar="DIR", help="The measurement folder.")
@click.option(
    "--truth",
    type=FILE,
    metavar="FILE",
    help="Write the causes there; never inside a measurement folder.",
)
@click.option("--force", is_flag=True, help="Replace a measurement that --out holds already.")
@quiet_option
@click.pass_context
def simulate(
    context: click.Context,
    /,
    lattice: str,
    effects: tuple[tuple[str, str | None, float], ...],
    background: tuple[tuple[str, float | None], ...],
    kind: str,
    settings_file: Path | None,
    jobs: int,
    noise: float | None,
    correctors: tuple[str, ...],
    out: Path,
    truth: Path | None,
    force: bool,
    quiet: bool,
    particles: int,
    **options: Any,
) -> None:
    """Measure a machine whose errors are known.

    The virtual machine is LATTICE with effects of the catalogue in it, tracked by
    accelerator-toolbox (or by OCELOT's maps). Each shot has a launch of its own, with random
    betatron phases; monitors read with noise. With `--kind orbit-response` the stored beam's
    closed orbit is read for a step of every corrector and of the RF; `turn-by-turn` kicks the
    stored beam, `closed-orbit`, `dispersion` and `tunes` read it as it is. The folder holds no
    truth.
    """
    from tmlattice.effects import Cause, find
    from tmlattice.files import output_file
    from tmlattice.machine import simulate as run
    from tmlattice.measurement import write_truth
    from tmlattice.measurement.write import check_free

    check_free(out, force)
    if truth is not None:
        _check_apart(truth, out)
    _check_options(context, kind)
    ring = open_ring(lattice)
    machine = machine_file()
    if noise is None and machine is not None and kind in ("trajectory", "turn-by-turn"):
        noise = machine.told.noise
    _warn_of_large(effects)
    causes = [Cause(find(name).name, element, amount) for name, element, amount in effects]
    causes = [_named(ring, cause) for cause in causes]
    if kind != "trajectory":
        chosen = {
            **options, "background": dict(background), "correctors": correctors or None,
            "noise": noise, "particles": particles,
            "settings": _settings(settings_file),
        }  # fmt: skip
        for name in ("shots", "turns"):  # first turns' own defaults
            if context.get_parameter_source(name) != click.core.ParameterSource.COMMANDLINE:
                del chosen[name]
        table_of, sentence, rms = simulate_stored(
            kind, ring, causes, out, truth, force, quiet, chosen
        )
        if not quiet:
            console().print(sentence)
            _print_causes(ring, causes)
            _print_background(rms)
            _print_written(out, table_of, truth)
        return
    options["noise"] = 2e-5 if noise is None else noise
    simulation = run(
        ring,
        causes,
        background=dict(background),
        settings=_settings(settings_file),
        **options,
    )
    with ExitStack() as both:  # the folder and the truth, or neither
        if truth is not None:
            write_truth(both.enter_context(output_file(truth)), **simulation.truth())
        simulation.write(out, jobs, progress=not quiet, force=force)
    if quiet:
        return
    console().print(
        f"{ring.name}: {options['shots']} shots of {options['turns']} turn(s), "
        f"{len(ring.monitors)} monitors, {1e3 * options['amplitude']:g} mm rms, noise "
        f"{1e6 * options['noise']:g} µm, engine {options['engine']}, seed {options['seed']}"
    )
    _print_causes(ring, causes)
    _print_background(simulation.background)
    _print_written(out, "readings.csv", truth)


def _check_options(context: click.Context, kind: str) -> None:
    """Refuse what other kinds of measurement have."""
    of_kinds = set().union(*KINDS.values())
    for option in context.command.params:
        name = option.name or ""
        given = context.get_parameter_source(name) == click.core.ParameterSource.COMMANDLINE
        if given and name in of_kinds and name not in KINDS[kind]:
            kinds = [other for other, own in KINDS.items() if name in own]
            raise click.UsageError(
                f"{option.opts[0]} has no meaning for --kind {kind}; take it out, or give "
                f"--kind {' or '.join(kinds)}"
            )


def _print_written(out: Path, table_of: str, truth: Path | None) -> None:
    console().print(
        f"written: {out}/: measurement.json, {table_of}" + (f"; {truth}" if truth else "")
    )


def _print_causes(ring: Any, causes: list[Any]) -> None:
    from tmlattice.effects import find

    if not causes:
        return
    shown = table("effect", "element", "s [m]", "amount", "unit")
    places = {element.name: f"{element.s:.2f}" for element in ring.elements}
    for cause in causes:
        place = cause.element or "-"
        unit = find(cause.effect).unit
        shown.add_row(cause.effect, place, places.get(place, "-"), f"{cause.amount:g}", unit)
    console().print(shown)


def _print_background(background: Any) -> None:
    from tmlattice.effects import find

    for name, rms in background.items():
        console().print(f"background {name}: rms {rms:g} {find(name).unit}")


def _check_apart(truth: Path, out: Path) -> None:
    from tmlattice.errors import MeasurementError

    folders = truth.resolve().parents
    if out.resolve() in folders or any((f / "measurement.json").exists() for f in folders):
        raise MeasurementError(
            f"the truth '{truth}' may not lie in a measurement's folder; name another place"
        )


FAR = 3.0
"""Times the largest amount that is looked for: a slip of units is further off."""


def _warn_of_large(effects: tuple[tuple[str, str | None, float], ...]) -> None:
    """Of an amount in per cent where a share was asked for, or in mm where metres were."""
    from tmlattice.effects import find

    for name, _, amount in effects:
        effect = find(name)
        if abs(amount) > FAR * effect.largest:
            share = "; a share: -0.2 is -20 %" if effect.unit == "relative" else ""
            click.echo(
                f"tmlattice: warning: {effect.name} of {amount:g} is far beyond the "
                f"{effect.largest:g} that a diagnosis looks for (unit: {effect.unit}{share})",
                err=True,
            )


def _named(ring: Any, cause: Any) -> Any:
    """The cause with its element's name as the ring spells it."""
    from dataclasses import replace

    from tmlattice.effects import find

    if cause.element is None:
        return cause
    for place in find(cause.effect).places(ring):
        if place is not None and place.casefold() == cause.element.casefold():
            return replace(cause, element=place)
    return cause


def _settings(path: Path | None) -> list[dict[str, dict[str, float]]]:
    from tmlattice.errors import MeasurementError
    from tmlattice.input_files import check_shape, json_of

    if path is None:
        return []
    value = json_of(path, MeasurementError)
    check_shape(path, value, "settings", MeasurementError)
    return list(value)
