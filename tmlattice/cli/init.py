"""`tmlattice init`: the machine file, from a lattice and a file of data."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import FILE, Careful, checked_ring, console, stated_options

if TYPE_CHECKING:
    from tmlattice.lattice import Ring


@click.command("init", cls=Careful)
@click.argument("lattice", required=False)
@click.argument("measurement", metavar="[DATA]", type=FILE, required=False)
@click.option("--force", is_flag=True, help="Replace a machine file that is there.")
@click.pass_context
def init(
    context: click.Context, /, lattice: str | None, measurement: Path | None, force: bool
) -> None:
    """Write the machine file tmlattice.toml, or that of --machine, of LATTICE and of DATA.

    DATA is a file as the control room has it, or a measurement folder. What both state is filled
    in; the rest is there as comments. On a terminal LATTICE and DATA are asked for.
    """
    from tmlattice.files import OutputError, output_file
    from tmlattice.importers.stated import machine_text
    from tmlattice.lattice import builtin_lattices
    from tmlattice.machine_file import NAME

    given: list[Path] = [*context.find_root().params.get("machines", ())] or [Path(NAME)]
    path = given[0]
    if len(given) > 1:
        raise click.UsageError(f"--machine is given twice, '{path}' and '{given[1]}'")
    if path.exists() and not force:
        raise OutputError(f"'{path}' is there already; --force replaces it")
    if lattice is None:
        if not on_a_terminal():
            raise click.UsageError("name the LATTICE: a lattice file, or a built-in name")
        lattice = str(click.prompt("Lattice file, or built-in name", default="petra3"))
        asked = click.prompt("File of data (empty: none)", default="", show_default=False)
        measurement = Path(asked) if asked else None
    chosen = stated_options()
    ring = checked_ring(lattice, chosen, read=measurement is not None)
    named = lattice.casefold() in builtin_lattices()
    stated, silent, channels, said = _of_data(ring, measurement)
    silent |= {"energy": ring.energy, "particle": "proton" if ring.mass > 0.5 else "electron"}
    text = machine_text(
        lattice if named else os.path.relpath(lattice, path.parent),
        {**chosen, **stated}, silent, channels, _knob(ring),
    )  # fmt: skip
    with output_file(path) as file:
        file.write_text(text, encoding="utf-8")
    counts = ring.counts()
    correctors = counts.get("hcorrector", 0) + counts.get("vcorrector", 0)
    screen = console()
    screen.print(
        f"{ring.name}: {ring.length:.3f} m, {ring.energy:g} GeV, {len(ring.monitors)} BPMs, "
        f"{correctors} correctors"
    )
    for sentence in said:
        screen.print(f"- {sentence}", soft_wrap=True)
    if Path(lattice).suffix.casefold() == ".py" and not named:
        screen.print(
            f"- the lattice is Python code, which is run only where --machine {path} names the file"
        )
    screen.print(f"written: {path}")


def on_a_terminal() -> bool:
    """Whether somebody can answer."""
    return sys.stdin.isatty()


def _of_data(
    ring: "Ring", path: Path | None
) -> tuple[dict[str, Any], dict[str, Any], dict[str, str | None], list[str]]:
    """What data state: keys of [data], keys for comments, channels, and sentences on them. A
    channel that is none of the lattice's is None."""
    import numpy as np

    from tmlattice.errors import MeasurementError, UnknownNameError
    from tmlattice.importers import Options, bring_in, described
    from tmlattice.measurement import read_measurement

    if path is None:
        return {}, {}, {}, []
    if not path.is_file() or path.name == "measurement.json":
        data, stated, said = read_measurement(path), {}, []
    else:
        try:
            brought = bring_in([path], Options(ring=ring))
        except MeasurementError as error:
            if not isinstance(error.__cause__, UnknownNameError):
                raise
            brought = bring_in([path])
            names = getattr(brought.measurement, "monitors", ())
            sentence = (
                f"none of its {len(names)} channels is a BPM of the lattice: fill in [channels]"
            )
            return {}, {}, dict.fromkeys(names), [f"{path}: {sentence}"]
        data, stated = brought.measurement, {"unit": brought.unit} if brought.unit else {}
        said = [f"{path}: {described(brought)}", *brought.assumed, *brought.doubts]
    noise = getattr(data, "noise", None)
    known = [] if noise is None else np.asarray(noise)[np.isfinite(noise)]
    silent = {"noise": f"{1e6 * float(np.median(known)):.3g} um"} if len(known) else {}
    devices = getattr(data, "devices", {})
    return stated, silent, {device: name for name, device in devices.items()}, said


def _knob(ring: "Ring") -> dict[str, Any]:
    """A supply of the ring, with settings that are made up: 100 A make its present strength."""
    from tmlattice.correction.knobs import default_knobs

    knobs = [knob for knob in default_knobs(ring, ["supplies"]) if knob.present]
    name, strength = (knobs[0].name, knobs[0].present) if knobs else ("qd", -0.5)
    curve = [[0, 0], [100, float(f"{strength:.6g}")]]
    return {
        "knob": name, "unit": "A", "present": 100.0, "low": 0.0, "high": 150.0, "step": 0.01,
        "curve": curve, "error": 0.01,
    }  # fmt: skip
