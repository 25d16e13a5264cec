"""`tmlattice simulate`: a measurement whose cause is known."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from tmlattice.cli.options import (
    WithDefault,
    Word,
    background_option,
    console,
    each_once,
    is_quiet,
    lattice_argument,
    machine_file,
    open_ring,
    path_option,
    require,
    seed_option,
    table,
)

SHOTS = frozenset({"shots", "settings"})
KINDS: Mapping[str, frozenset[str]] = {
    "trajectory": SHOTS | {"turns", "amplitude", "radiation", "engine", "jobs"},
    "orbit-response": frozenset({"correctors", "engine"}),
    "turn-by-turn": SHOTS | {"turns", "amplitude", "radiation", "engine", "particles"},
    "closed-orbit": SHOTS | {"radiation"},
    "dispersion": frozenset(),
    "tunes": SHOTS,
}
"""The options that a kind has in addition to those of all."""
OF_ALL = frozenset({"background", "seed", "machine_seed", "noise"})


def _cause(text: str) -> tuple[str, str | None, float]:
    """Effect, element or None, amount; an element's name may have blanks."""
    words = text.split()
    require(len(words) > 1)
    return words[0], " ".join(words[1:-1]) or None, float(words[-1])


CAUSE = Word(
    '"NAME [ELEMENT] AMOUNT"', _cause,
    "'{0}' is no effect; give NAME [ELEMENT] AMOUNT in quotes, such as "
    "\"quadrupole_gradient qd::12 -0.2\" ('tmlattice effects' lists the names)",
)  # fmt: skip


@click.command("simulate", cls=WithDefault)
@lattice_argument
@click.option(
    "--effect",
    "effects",
    callback=each_once,
    type=CAUSE,
    multiple=True,
    help="What is wrong with the machine; repeat for more.",
)
@background_option("Random distributed errors")
@click.option(
    "--kind",
    type=click.Choice(list(KINDS)),
    default="trajectory",
    help="First turns; or of the stored beam: its orbit for steps of the correctors and of the RF, "
    "its turns after a kick, its orbit, its orbit for a step of the RF, its tunes.",
)
@click.option(
    "--shots",
    type=click.IntRange(1),
    show_default="6 of first turns, else 1",
    help="How many.",
)
@click.option(
    "--turns",
    type=click.IntRange(1),
    show_default="1, and 1000 turn by turn",
    help="Read in each shot.",
)
@click.option(
    "--amplitude",
    type=click.FloatRange(0, min_open=True),
    default=1e-3,
    help="Rms orbit over BPMs and planes, m.",
)
@click.option(
    "--noise",
    type=click.FloatRange(0),
    help="Rms of one reading, m; else the machine file's (of turns), or 2e-5, and of an orbit or "
    "its change 2e-6 in x and 1.2e-6 in y. Tunes: of a tune, else 2e-5.",
)
@click.option(
    "--engine",
    type=click.Choice(["at", "ocelot", "network"]),
    default="at",
    help="Thick symplectic tracking, or second-order maps: ocelot, and for many particles of a "
    "stored beam network, on a graphics card where there is one.",
)
@click.option("--radiation", is_flag=True, help="Bends and wigglers radiate.")
@path_option(
    "--settings", help="JSON: a list with the settings of each shot, as in the measurement format."
)
@seed_option("Of launches, settings and noise.")
@click.option(
    "--machine-seed",
    type=click.IntRange(0),
    help="Of the background; the same machine has the same one. Else the seed.",
)
@click.option("--jobs", type=click.IntRange(1), default=1, help="Processes.")
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
    help="Turn by turn: 1 is the middle of the beam; some hundreds decohere.",
)
@path_option("--out", required=True, metavar="DIR", help="The measurement folder.")
@path_option("--truth", help="Write the causes there; never inside a measurement folder.")
@click.option("--force", is_flag=True, help="Replace a measurement that --out holds already.")
@click.pass_context
def simulate(
    context: click.Context,
    /,
    lattice: str,
    effects: tuple[tuple[str, str | None, float], ...],
    kind: str,
    jobs: int,
    out: Path,
    truth: Path | None,
    force: bool,
    **options: Any,
) -> None:
    """Measure a machine whose errors are known.

    The virtual machine is LATTICE with effects of the catalogue in it, tracked by
    accelerator-toolbox (or by OCELOT's maps). Each shot has a launch of its own, with random
    betatron phases; BPMs read with noise. With `--kind orbit-response` the stored beam's
    closed orbit is read for a step of every corrector and of the RF; `turn-by-turn` kicks the
    stored beam, `closed-orbit`, `dispersion` and `tunes` read it as it is. The folder holds no
    truth.
    """
    from tmlattice.effects import Cause, find
    from tmlattice.files import output_file
    from tmlattice.measurement import write_measurement, write_truth
    from tmlattice.measurement.write import check_free

    check_free(out, force)
    if truth is not None:
        _check_apart(truth, out)
    _check_options(context, kind)
    ring = open_ring(lattice)
    machine = machine_file()
    if options["noise"] is None and machine is not None and kind in ("trajectory", "turn-by-turn"):
        options["noise"] = machine.stated.noise
    _warn_of_large(effects)
    causes = [Cause(find(name).name, _place(ring, name, element), amount)
              for name, element, amount in effects]  # fmt: skip
    options["background"] = dict(options["background"])
    options["correctors"] = options["correctors"] or None
    options["settings"] = _settings(options["settings"])
    options = {name: value for name, value in options.items()
               if name in OF_ALL | KINDS[kind] and value is not None}  # fmt: skip
    with ExitStack() as both:  # the folder and the truth, or neither
        file = None if truth is None else both.enter_context(output_file(truth))
        simulation, sentence = _run(kind, ring, causes, options)
        if file is not None:
            write_truth(file, **simulation.truth())
        if kind == "trajectory":
            simulation.write(out, jobs, progress=not is_quiet(), force=force)
        else:
            write_measurement(out, simulation.measured, force)
    console().print(f"{ring.name}: {sentence}, seed {options['seed']}")
    _print_causes(ring, causes)
    for name, rms in simulation.background.items():
        console().print(f"background {name}: rms {rms:g} {find(name).unit}")
    file_of = {"orbit-response": "response.csv", "tunes": "tunes.csv"}.get(kind, "readings.csv")
    more = f"; {truth}" if truth else ""
    console().print(f"written: {out}/: measurement.json, {file_of}{more}")


def _run(kind: str, ring: Any, causes: list[Any], options: dict[str, Any]) -> tuple[Any, str]:
    """The simulation, and what it measures in a line."""
    from tmlattice.machine import simulate, stored_beam
    from tmlattice.machine.response import simulate_response

    monitors = f"{len(ring.monitors)} BPMs"
    made: Any
    if kind == "trajectory":
        made = simulate(ring, causes, **options)
        return made, (
            f"{len(made.shots)} shots of {made.turns} turn(s), {monitors}, "
            f"{1e3 * options['amplitude']:g} mm rms, noise {1e6 * made.machine.noise[0]:g} µm, "
            f"engine {options['engine']}"
        )
    if kind == "orbit-response":
        made = simulate_response(ring, causes, progress=not is_quiet(), **options)
        rf = "" if made.measured.rf is None else f", RF step {made.measured.rf.step:g} Hz"
        return made, (
            f"{len(made.measured.correctors)} correctors, {monitors}, two-sided steps of "
            f"{1e6 * abs(made.measured.kicks[0]):g} µrad{rf}, engine {options['engine']}"
        )
    if kind == "turn-by-turn":
        made = stored_beam.simulate_turns(ring, causes, **options)
        shots, turns = made.measured.readings.shape[:2]
        return made, (
            f"{shots} shots of {turns} turns of a stored beam, {monitors}, "
            f"{1e3 * options['amplitude']:g} mm rms, {options['particles']} particle(s), "
            f"engine {options['engine']}"
        )
    if kind == "closed-orbit":
        made = stored_beam.simulate_orbits(ring, causes, **options)
        return made, f"{len(made.measured.shots)} closed orbit(s), {monitors}, engine at"
    if kind == "dispersion":
        made = stored_beam.simulate_dispersion(ring, causes, **options)
        (step,) = (one.step for one in made.measured.steps)
        return made, f"{monitors}, a two-sided RF step of {step:g} Hz, engine at"
    if "noise" in options:
        options["noise"] = options["noise"], stored_beam.TUNE_NOISE[1]
    made = stored_beam.simulate_tunes(ring, causes, **options)
    return made, f"{len(made.measured.shots)} reading(s) of the tunes, engine at"


def _check_options(context: click.Context, kind: str) -> None:
    """Refuse what other kinds of measurement have."""
    for option in context.command.params:
        name = option.name or ""
        given = context.get_parameter_source(name) == click.core.ParameterSource.COMMANDLINE
        kinds = [other for other, own in KINDS.items() if name in own]
        if given and kinds and kind not in kinds:
            raise click.UsageError(
                f"{option.opts[0]} has no meaning for --kind {kind}; take it out, or give "
                f"--kind {' or '.join(kinds)}"
            )


def _print_causes(ring: Any, causes: list[Any]) -> None:
    from tmlattice.effects import find

    places = {element.name: f"{element.s:.2f}" for element in ring.elements}
    rows = [(c.effect, c.element or "-", places.get(c.element, "-"), f"{c.amount:g}",
             find(c.effect).unit) for c in causes]  # fmt: skip
    if rows:
        console().print(table("effect", "element", "s [m]", "amount", "unit", rows=rows))


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


def _place(ring: Any, effect: str, element: str | None) -> str | None:
    """The place of an effect as the ring spells it; an unknown one as it is given."""
    from tmlattice.effects import find

    if element is None:
        return None
    spelt = {place.casefold(): place for place in find(effect).places(ring) if place is not None}
    return spelt.get(element.casefold(), element)


def _settings(path: Path | None) -> list[dict[str, dict[str, float]]]:
    from tmlattice.errors import MeasurementError
    from tmlattice.input_files import check_shape, json_of

    if path is None:
        return []
    value = json_of(path, MeasurementError)
    check_shape(path, value, "settings", MeasurementError)
    return list(value)
