"""`tmlattice simulate`: a measurement whose cause is known."""

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from tmlattice.cli.options import (
    FILE,
    BackgroundText,
    console,
    lattice_argument,
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


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Five numbers separated by commas."""

    name = "X,PX,Y,PY,DELTA"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Five numbers, zero or more."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 5 or not all(0 <= n < float("inf") for n in numbers):
            self.fail(f"'{value}': give five rms values, such as 1e-4,2e-5,1e-4,2e-5,0", param, ctx)
        return numbers


@click.command("simulate")
@lattice_argument
@click.option(
    "--effect",
    "effects",
    type=CauseText(),
    multiple=True,
    help="What is wrong with the machine; repeat for more.",
)
@click.option(
    "--background",
    "background",
    type=BackgroundText(),
    multiple=True,
    help="Random small errors everywhere, with this rms or the catalogue's; "
    "`all`, or `all=SCALE`, for every usual one.",
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
    default=2e-5,
    show_default=True,
    help="Rms of one reading, m.",
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
    type=Numbers(),
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
@click.option("--out", type=FILE, required=True, metavar="DIR", help="The measurement folder.")
@click.option(
    "--truth",
    type=FILE,
    metavar="FILE",
    help="Write the causes there; never inside a measurement folder.",
)
@quiet_option
def simulate(
    lattice: str,
    sequence: str | None,
    energy: float | None,
    effects: tuple[tuple[str, str | None, float], ...],
    background: tuple[tuple[str, float | None], ...],
    settings_file: Path | None,
    jobs: int,
    out: Path,
    truth: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure a machine whose errors are known.

    The virtual machine is LATTICE with effects of the catalogue in it, tracked by
    accelerator-toolbox (or by OCELOT's maps). Each shot has a launch of its own, with random
    betatron phases; monitors read with noise. The folder holds no truth.
    """
    from tmlattice.effects import Cause, find
    from tmlattice.files import output_file
    from tmlattice.lattice import load_ring
    from tmlattice.machine import simulate as run
    from tmlattice.measurement import write_truth

    if truth is not None:
        _check_apart(truth, out)
    ring = load_ring(lattice, sequence, energy)
    causes = [Cause(find(name).name, element, amount) for name, element, amount in effects]
    causes = [_named(ring, cause) for cause in causes]
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
        simulation.write(out, jobs, progress=not quiet)
    if quiet:
        return
    screen = console()
    screen.print(
        f"{ring.name}: {options['shots']} shots of {options['turns']} turn(s), "
        f"{len(ring.monitors)} monitors, {1e3 * options['amplitude']:g} mm rms, noise "
        f"{1e6 * options['noise']:g} µm, engine {options['engine']}, seed {options['seed']}"
    )
    if causes:
        shown = table("effect", "element", "s [m]", "amount", "unit")
        places = {element.name: f"{element.s:.2f}" for element in ring.elements}
        for cause in causes:
            effect = find(cause.effect)
            place = cause.element or "-"
            shown.add_row(
                cause.effect, place, places.get(place, "-"), f"{cause.amount:g}", effect.unit
            )
        screen.print(shown)
    for name, rms in simulation.background.items():
        screen.print(f"background {name}: rms {rms:g} {find(name).unit}")
    screen.print(
        f"written: {out}/: measurement.json, readings.csv" + (f"; {truth}" if truth else "")
    )


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
