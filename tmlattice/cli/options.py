"""Options that several commands share."""

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.progress import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tmlattice.lattice import Ring
    from tmlattice.measurement import AnyMeasurement, Measurement

FILE = click.Path(path_type=Path)

REGULARIZATIONS = ["symplectic", "none", "l1", "l2"]


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Numbers separated by commas, as one word.

    Args:
        name: how they are shown: one name each.
        least: the smallest that is allowed.
        advice: what a wrong value is answered with.
    """

    def __init__(self, name: str, advice: str, least: float = float("-inf")) -> None:
        self.name = name
        self._advice = advice
        self._least = least

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """As many finite numbers as there are names."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        allowed = all(self._least <= n and abs(n) < float("inf") for n in numbers)
        if len(numbers) != len(self.name.split(",")) or not allowed:
            self.fail(f"'{value}'{self._advice}", param, ctx)
        return numbers


LAUNCH = Numbers(
    "x,px,y,py", " is no launch; give four numbers in m and rad, such as 1e-3,0,1e-3,0"
)
EMITTANCE = Numbers("X,Y", ": give two emittances in m rad, such as 1e-9,1e-11", least=0.0)
LAUNCH_SIGMA = Numbers(
    "X,PX,Y,PY,DELTA", ": give five rms values, such as 1e-4,2e-5,1e-4,2e-5,0", least=0.0
)


class BackgroundText(click.ParamType):  # type: ignore[type-arg]
    """NAME or NAME=RMS."""

    name = "NAME[=RMS]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float | None]:
        """Effect and rms, or None for the catalogue's."""
        if isinstance(value, tuple):
            return value
        name, _, size = str(value).partition("=")
        try:
            return name.strip(), float(size) if size else None
        except ValueError:
            self.fail(f"'{size}' is no rms; give {name}=1e-3, say", param, ctx)


def background_option(title: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`--background NAME[=RMS]`, repeated."""
    return click.option(
        "--background",
        type=BackgroundText(),
        multiple=True,
        help=f"{title}, with this rms or the catalogue's; `all`, or `all=SCALE`, for every usual "
        "one, or `none`.",
    )


class NameList(click.ParamType):  # type: ignore[type-arg]
    """Names separated by commas."""

    name = "NAME,NAME"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """One name or more."""
        if isinstance(value, tuple):
            return value
        names = tuple(name.strip() for name in str(value).split(",") if name.strip())
        if not names:
            self.fail("give one name or more, separated by commas", param, ctx)
        return names


INPUTS = (
    "lattice", "measurement", "measurements", "references", "calibration", "settings_file",
    "network", "files", "map_file", "estimated", "design", "goal", "knobs",
)  # fmt: skip
MARKS = ("monitors", "correctors", "particle")
OUTPUTS = ("json_file", "truth", "out", "lattice_out", "corrected_out", "example_file")
OF_MEASUREMENTS = ("measurement.json", "readings.csv", "response.csv", "tunes.csv")
OF_FOLDERS = ("challenge.json", "options.json")
OF_BATCHES = ("cases", "truth", "results", "oracle", "baselines")


class Careful(click.Command):
    """A command that does not write over what it reads, nor twice into one file."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run it, unless an output is an input or another output.

        Raises:
            OutputError: it is.
        """
        from tmlattice.files import OutputError

        values = [ctx.params.get(name) for name in INPUTS]
        given = [v for value in values for v in (value if isinstance(value, tuple) else [value])]
        folder = ctx.params.get("folder")
        paths = [Path(str(value)) for value in given if value]
        read = {key for path in paths for key in _identities(path)}
        for path in paths:
            read |= {key for name in OF_MEASUREMENTS for key in _identities(path / name)}
            read |= _identities(Path(f"{path}.known.json"))
        if folder or ctx.params.get("out"):
            own = Path(folder or ctx.params["out"])
            read |= {key for name in OF_FOLDERS for key in _identities(own / name)}
        written: set[Any] = set()
        for name in OUTPUTS:
            out = ctx.params.get(name)
            if not out or Path(out).is_dir():
                continue
            keys = _identities(Path(out))
            above = Path(os.path.realpath(out)).parents
            batch = folder and any(
                Path(os.path.realpath(folder)) / part in above for part in OF_BATCHES
            )
            if keys & read or batch:
                raise OutputError(f"'{out}' is read, and would be written over; name another file")
            if keys & written:
                raise OutputError(f"'{out}' is written twice; name another file for one of them")
            written |= keys
        with shown(f"tmlattice {ctx.info_name}", bool(ctx.params.get("quiet"))):
            return super().invoke(ctx)


def _identities(path: Path) -> set[Any]:
    """What a path is known by, so that links are seen through: nothing of a device."""
    try:
        status = path.stat() if path.exists() else None
    except (OSError, ValueError):
        return set()
    if status is not None and not stat.S_ISREG(status.st_mode):
        return set()
    names: set[Any] = {os.path.realpath(path)}
    return names if status is None else names | {(status.st_dev, status.st_ino)}


def no_numbers(error: Exception) -> str:
    """What to say of data whose numbers end a calculation: singular, without end, too many."""
    from tmlattice.errors import plain

    said = plain(str(error), 100) or type(error).__name__
    return (
        f"with these numbers nothing can be worked out ({said}); check launches, settings, noise "
        "and readings for units and for values that are far off (`tmlattice check`)"
    )


def _remember(context: click.Context, option: click.Parameter, value: Any) -> None:
    context.meta[f"tmlattice.{option.name}"] = value


def open_ring(
    lattice: str, sequence: str | None, energy: float | None, read: bool = True
) -> "Ring":
    """The ring that a command's lattice options name; a part of a ring is told.

    Args:
        lattice, sequence, energy: see `load_ring`.
        read: the command needs monitors.

    Raises:
        LatticeError: no such ring, or one without monitors.
    """
    from tmlattice.errors import harmless
    from tmlattice.lattice import load_ring
    from tmlattice.lattice.checks import need_monitors, no_whole_turn

    ring = load_ring(lattice, sequence, energy, **marks())
    if read:
        need_monitors(ring)
    if told := no_whole_turn(ring):
        click.echo(f"tmlattice: warning: {harmless(told)}", err=True)
    return ring


def marks() -> dict[str, Any]:
    """What `--monitors`, `--correctors` and `--particle` of the running command say, if they do."""
    meta = click.get_current_context().meta
    said = {name: meta.get(f"tmlattice.mark_{name}") for name in MARKS}
    return {name: value for name, value in said.items() if value}


def lattice_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Which sequence of the lattice, at which energy, and what is a monitor or a corrector."""
    for decorate in (
        click.option("--correctors", "mark_correctors", multiple=True, metavar="PATTERN",
                     expose_value=False, callback=_remember,
                     help="Elements that are correctors too, such as 'COR*'; see --monitors."),
        click.option("--monitors", "mark_monitors", multiple=True, metavar="PATTERN",
                     expose_value=False, callback=_remember,
                     help="Elements that are monitors although the file has them as markers or "
                     "drifts, such as 'BPM*'; several with commas."),
        click.option("--particle", "mark_particle", type=click.Choice(["electron", "proton"]),
                     expose_value=False, callback=_remember,
                     help="Else what the lattice states."),
        click.option("--energy", type=click.FloatRange(0, min_open=True), metavar="GEV",
                     help="Beam energy; else what the lattice states."),
        click.option("--sequence", metavar="NAME",
                     help="The lattice file's variable that holds the ring."),
    ):  # fmt: skip
        function = decorate(function)
    return function


def lattice_argument(function: Callable[..., Any]) -> Callable[..., Any]:
    """LATTICE, petra3 where none is named, and its options."""
    return click.argument("lattice", default="petra3")(lattice_options(function))


def change_option(
    default: float | None, text: str
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """--change, of the magnet that an experiment weakens."""
    return click.option("--change", type=float, default=default, help=text,
                        show_default=default is not None)  # fmt: skip


def recipe_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """What `tune-fit` and its study share: the perturbation, the measurement, the fit."""
    for decorate in reversed((
        click.option("--launch", type=LAUNCH, default="1e-3,0,1e-3,0", show_default=True,
                     help="State at the start of the ring, m and rad."),
        click.option("--noise", type=click.FloatRange(0), default=2e-5, show_default=True,
                     help="Rms of one reading, m."),
        click.option("--epochs", type=click.IntRange(1), default=1000, show_default=True,
                     help="Gradient steps at most."),
        click.option("--turns", type=click.IntRange(16), default=500, show_default=True,
                     help="Tracked for the tunes."),
        click.option("--regularization-rate", type=click.FloatRange(0), default=1e-10,
                     show_default=True, help="lambda: weight of the regularization."),
        click.option("--learning-rate", type=click.FloatRange(0, min_open=True), default=1e-6,
                     show_default=True, help="Adam's step."),
        click.option("--seed", type=click.IntRange(0), default=0, show_default=True,
                     help="Of the readings' noise."),
    )):  # fmt: skip
        function = decorate(function)
    return function


def assume_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """--assume NAME, repeated."""
    return click.option(
        "--assume", "assumed", multiple=True, metavar="NAME",
        help="What is written down wrongly everywhere, such as x-reversed or launches-in-mm; it is "
        "undone first. Repeat for more (docs: check).",
    )(function)  # fmt: skip


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """--json FILE."""
    return click.option("--json", "json_file", type=FILE, metavar="FILE",
                        help="Write the result as JSON.")(function)  # fmt: skip


def quiet_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """--quiet."""
    return click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors.")(function)


def table_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """--map and --unit, of a file whose columns are taken as they come."""
    for decorate in (
        click.option("--unit", type=click.Choice(["m", "mm", "um", "nm"]),
                     help="Of readings whose file states none; else taken from their size, with a "
                     "word."),
        click.option("--map", "map_file", type=FILE, metavar="FILE",
                     help="YAML: names, unit, noise, bad monitors of a file of readings "
                     "(`tmlattice import --example` writes one)."),
    ):  # fmt: skip
        function = decorate(function)
    return function


def read_data(
    path: Path, ring: "Ring", map_file: Path | None = None, unit: Any = None, quiet: bool = False
) -> "tuple[AnyMeasurement, tuple[str, ...]]":
    """A measurement folder, or a file of readings as they come, and what was assumed of it.

    The assumptions are printed too: nothing is taken for granted silently.
    """
    from tmlattice.measurement import read_measurement

    if not path.is_file() or path.name == "measurement.json":
        return read_measurement(path), ()
    from tmlattice.importers import Options, bring_in, described
    from tmlattice.importers.told import read_told

    told = None if map_file is None else read_told(map_file)
    brought = bring_in([path], Options(ring=ring, unit=unit, told=told))
    said = (*brought.assumed, *brought.doubts)
    if not quiet:
        screen = console()
        screen.print(f"{path}: {described(brought)}", soft_wrap=True)
        for sentence in said:
            screen.print(f"- {sentence}", soft_wrap=True)
        screen.print()
    return brought.measurement, said


def trajectories(path: Path, refusal: str, ring: "Ring", **given: Any) -> "Measurement":
    """The first turns of a measurement folder, or of a file of readings; see `read_data`.

    Raises:
        MeasurementError: a measurement of another kind, with what the command says to it.
    """
    from tmlattice.errors import MeasurementError
    from tmlattice.measurement import Measurement, in_words

    data, _ = read_data(path, ring, **given)
    if not isinstance(data, Measurement):
        raise MeasurementError(f"'{path}' is {in_words(data)}{refusal}")
    return data


def console() -> "Console":
    """Where results are printed: as wide as the terminal, else 100 columns; names from files steer
    nothing there."""
    from rich.console import Console
    from rich.text import Text

    from tmlattice.cli.progress import clear
    from tmlattice.errors import harmless

    class Screen(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(harmless(text), **options)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

        def print(self, *objects: Any, **options: Any) -> None:
            clear()  # the progress line
            super().print(*objects, **options)

    wide = Screen(highlight=False, markup=False)
    return wide if wide.is_terminal else Screen(highlight=False, markup=False, width=100)


def table(*columns: str) -> "Table":
    """A table with its first column left, the others right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left")
    return made
