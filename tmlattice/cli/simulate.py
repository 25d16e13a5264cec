"""`tmlattice simulate`: a measurement whose cause is known."""

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from tmlattice.cli.options import (
    FILE,
    LAUNCH_SIGMA,
    Careful,
    background_option,
    console,
    lattice_argument,
    open_ring,
    quiet_option,
    table,
)


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
        if len(words) not in (2, 3):
            self.fail(
                f"'{value}' is no effect; give NAME [ELEMENT] AMOUNT in quotes, such as "
                "\"quadrupole_gradient qd::12 -0.2\" ('tmlattice effects' lists the names)",
                param,
                ctx,
            )
        return words[0], words[1] if len(words) == 3 else None, amount


@click.command("simulate", cls=Careful)
@lattice_argument
@click.option(
    "--effect",
    "effects",
    type=CauseText(),
    multiple=True,
    help="What is wrong with the machine; repeat for more.",
)
@background_option("Random small errors everywhere")
@click.option(
    "--kind",
    type=click.Choice(["trajectory", "orbit-response"]),
    default="trajectory",
    show_default=True,
    help="First turns, or the stored beam's orbit for steps of the correctors and of the RF.",
)
@click.option("--shots", type=click.IntRange(1), default=6, show_default=True)
@click.option(
    "--turns", type=click.IntRange(1), default=1, show_default=True, help="Read in each shot."
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
    help="Rms of one reading, m; else 2e-5, and of an orbit change 2e-6 in x and 1.2e-6 in y.",
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
    "--launch-sigma",
    type=LAUNCH_SIGMA,
    default="1e-4,2e-5,1e-4,2e-5,0",
    show_default=True,
    help="Rms of the launches about the nominal ones.",
)
@click.option(
    "--kicks",
    type=click.FloatRange(0),
    default=0.0,
    show_default=True,
    help="Rms of random settings of all correctors, rad.",
)
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
    "--kick",
    type=click.FloatRange(0, min_open=True),
    default=1e-4,
    show_default=True,
    help="Orbit response: the step of each corrector, rad.",
)
@click.option(
    "--rf-step",
    type=float,
    default=None,
    help="Orbit response: the step of the RF, Hz; 0 for none; else 1.3 mm of orbit.",
)
@click.option(
    "--one-sided",
    is_flag=True,
    help="Orbit response: step from the setting, not from half below it to half above.",
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
    sequence: str | None,
    energy: float | None,
    effects: tuple[tuple[str, str | None, float], ...],
    background: tuple[tuple[str, float | None], ...],
    kind: str,
    settings_file: Path | None,
    jobs: int,
    noise: float | None,
    correctors: tuple[str, ...],
    kick: float,
    rf_step: float | None,
    one_sided: bool,
    out: Path,
    truth: Path | None,
    force: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure a machine whose errors are known.

    The virtual machine is LATTICE with effects of the catalogue in it, tracked by
    accelerator-toolbox (or by OCELOT's maps). Each shot has a launch of its own, with random
    betatron phases; monitors read with noise. With `--kind orbit-response` the stored beam's
    closed orbit is read for a step of every corrector and of the RF. The folder holds no truth.
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
    ring = open_ring(lattice, sequence, energy)
    causes = [Cause(find(name).name, element, amount) for name, element, amount in effects]
    causes = [_named(ring, cause) for cause in causes]
    if kind == "orbit-response":
        _response(
            ring, causes, out, truth, force, quiet,
            background=dict(background), correctors=correctors or None, kick=kick, rf_step=rf_step,
            one_sided=one_sided, engine=options["engine"], seed=options["seed"],
            machine_seed=options["machine_seed"], **({} if noise is None else {"noise": noise}),
        )  # fmt: skip
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
    screen = console()
    screen.print(
        f"{ring.name}: {options['shots']} shots of {options['turns']} turn(s), "
        f"{len(ring.monitors)} monitors, {1e3 * options['amplitude']:g} mm rms, noise "
        f"{1e6 * options['noise']:g} µm, engine {options['engine']}, seed {options['seed']}"
    )
    _print_causes(ring, causes)
    _print_background(simulation.background)
    screen.print(
        f"written: {out}/: measurement.json, readings.csv" + (f"; {truth}" if truth else "")
    )


_OF_TRAJECTORIES = (
    "shots", "turns", "amplitude", "radiation", "launch_sigma", "kicks", "settings_file", "jobs",
)  # fmt: skip
_OF_RESPONSES = ("correctors", "kick", "rf_step", "one_sided")


def _check_options(context: click.Context, kind: str) -> None:
    """Refuse what the other kind of measurement has."""
    response = kind == "orbit-response"
    for option in context.command.params:
        given = context.get_parameter_source(option.name or "")
        others = _OF_TRAJECTORIES if response else _OF_RESPONSES
        if option.name in others and given == click.core.ParameterSource.COMMANDLINE:
            mend = "take it out" if response else "add --kind orbit-response"
            raise click.UsageError(f"{option.opts[0]} has no meaning for --kind {kind}; {mend}")


def _response(
    ring: Any,
    causes: list[Any],
    out: Path,
    truth: Path | None,
    force: bool,
    quiet: bool,
    **options: Any,
) -> None:
    from tmlattice.files import output_file
    from tmlattice.machine.response import simulate_response
    from tmlattice.measurement import write_measurement, write_truth

    with ExitStack() as both:
        file = None if truth is None else both.enter_context(output_file(truth))
        simulation = simulate_response(ring, causes, progress=not quiet, **options)
        if file is not None:
            write_truth(file, **simulation.truth())
        write_measurement(out, simulation.measured, force)
    if quiet:
        return
    measured, screen = simulation.measured, console()
    rf = "" if measured.rf is None else f", RF step {measured.rf.step:g} Hz"
    sides = "one-sided" if options["one_sided"] else "two-sided"
    screen.print(
        f"{ring.name}: {len(measured.correctors)} correctors, {len(measured.monitors)} monitors, "
        f"{sides} steps of {1e6 * options['kick']:g} µrad{rf}, engine {options['engine']}, seed "
        f"{options['seed']}"
    )
    _print_causes(ring, causes)
    _print_background(simulation.background)
    screen.print(
        f"written: {out}/: measurement.json, response.csv" + (f"; {truth}" if truth else "")
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

    if path is None:
        return []
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise MeasurementError(f"'{path}' is no JSON: {error}") from error
    good = isinstance(value, list) and all(
        isinstance(shot, dict)
        and all(
            isinstance(s, dict) and all(isinstance(v, int | float) for v in s.values())
            for s in shot.values()
        )
        for shot in value
    )
    if not good:
        raise MeasurementError(
            f"'{path}' should hold a list with one object for each shot, such as "
            '[{"qd::12": {"k1_relative": 0.01}}, {}]'
        )
    return list(value)
