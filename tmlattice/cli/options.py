"""Options that several commands share."""

import functools
import os
import re
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.progress import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tmlattice.lattice import Ring
    from tmlattice.machine_file import MachineFile
    from tmlattice.measurement import AnyMeasurement, Measurement

FILE = click.Path(path_type=Path)


class Launch(click.ParamType):  # type: ignore[type-arg]
    """A launch as one word."""

    name = "x,px,y,py"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Four finite numbers."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 4 or not all(abs(n) < float("inf") for n in numbers):
            say = "is no launch; give four numbers in m and rad, such as 1e-3,0,1e-3,0"
            self.fail(f"'{value}' {say}", param, ctx)
        return numbers


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
            self.fail(f"'{size}' is no rms; give for example {name}=1e-3", param, ctx)


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
        machine = machine_file()
        if machine is not None:
            given += [machine.path, machine.lattice]
            given += [machine.supplies] if isinstance(machine.supplies, Path) else []
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
        with shown(f"tmlattice {ctx.info_name}", is_quiet()):
            return super().invoke(ctx)


class OfMachine(Careful):
    """A command on a lattice, which a machine file may name.

    Of its arguments LATTICE is the first one where it may be left out.
    """

    default = ""
    """The lattice where neither the command line nor a machine file names one; none: an error."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the machine file, and fill in the LATTICE that was left out.

        Raises:
            MachineFileError: the machine file cannot be used.
            click.UsageError: neither names a lattice.
        """
        try:
            rest = super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.option_name not in STATED:
                raise
            raise click.UsageError(
                f"no option {error.option_name}: {STATED[error.option_name]} of the machine file "
                "states it (`tmlattice init` writes one)",
                ctx,
            ) from error
        machine = _machine(ctx)
        arguments = {p.name: p for p in self.params if isinstance(p, click.Argument)}
        if "lattice" not in arguments:
            return rest
        given = ctx.params
        data = next((name for name in ("measurements", "measurement") if name in arguments), None)
        word = given["lattice"]
        if data and word is not None and machine is not None and machine.lattice:
            more = given[data]
            if not more or (isinstance(more, tuple) and not _is_lattice(word)):
                given[data] = (Path(word), *more) if arguments[data].nargs == -1 else Path(word)
                given["lattice"] = None
        if data and not given[data]:
            raise click.UsageError(
                "name a MEASUREMENT, and before it the LATTICE where no machine file does "
                "(`tmlattice init LATTICE` writes one)",
                ctx,
            )
        if given["lattice"] is None:
            if machine is not None and machine.lattice:
                given["lattice"] = machine.lattice_name()
            elif self.default:
                given["lattice"] = self.default
            else:
                raise click.UsageError(f"name the LATTICE{HINT}", ctx)
        return rest

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Where the rest is stated."""
        text = (
            "Names, units and supplies: in the machine file (`tmlattice init`). --machine FILE, "
            "--quiet, --sequence, --energy, --particle, --monitors and --correctors: see "
            "`tmlattice --help`."
        )
        formatter.write_paragraph()
        formatter.write_text(text)


class WithDefault(OfMachine):
    """A command that takes the built-in ring where no lattice is named."""

    default = "petra3"


STATED = {"--unit": "[data]", "--noise": "[data]", "--map": "[channels]"}
"""Options that a machine file takes the place of, and where it states them."""
HINT = ", or state it in a machine file (`tmlattice init LATTICE` writes one)"
_MACHINE = "tmlattice.machine"


LATTICE_OPTIONS = (
    click.option("--sequence", metavar="NAME", help="The sequence, line or variable of the lattice "
                 "file that is the ring."),
    click.option("--energy", type=click.FloatRange(0, min_open=True), metavar="GEV",
                 help="Beam energy, if the lattice states none."),
    click.option("--particle", type=click.Choice(["electron", "proton"]), metavar="NAME",
                 help="electron or proton, if the lattice states none."),
    click.option("--monitors", multiple=True, metavar="PATTERN", help="Markers or drifts that are "
                 "BPMs, such as 'BPM*'; several with commas."),
    click.option("--correctors", multiple=True, metavar="PATTERN",
                 help="Elements that are correctors too, such as 'COR*'."),
)  # fmt: skip


def lattice_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """How the LATTICE is read, for every command; a machine file states it once and for all."""
    for option in reversed(LATTICE_OPTIONS):
        function = option(function)
    return function


def stated_options() -> dict[str, Any]:
    """The options of `load_ring` that the command line states."""
    given = click.get_current_context().find_root().params
    names = ("sequence", "energy", "particle", "monitors", "correctors")
    chosen = {name: given.get(name) for name in names}
    return {key: list(v) if isinstance(v, tuple) else v for key, v in chosen.items() if v}


def is_quiet() -> bool:
    """Whether `--quiet` was given, anywhere on the command line."""
    return bool(click.get_current_context().find_root().params.get("quiet"))


def machine_file() -> "MachineFile | None":
    """The machine file of the running command."""
    context = click.get_current_context(silent=True)
    return None if context is None else context.meta.get(_MACHINE)


def _machine(ctx: click.Context) -> "MachineFile | None":
    """The file of `--machine`, else the one in the working directory, with a word on which it is.

    Raises:
        MachineFileError: it cannot be used.
        click.UsageError: two are named.
    """
    given: tuple[Path, ...] = ctx.find_root().params.get("machines") or ()
    found = Path("tmlattice.toml")
    if not given and not found.exists():
        return None
    from tmlattice.errors import harmless
    from tmlattice.machine_file import load_machine_file

    if len(given) > 1:
        raise click.UsageError(f"--machine is given twice, '{given[0]}' and '{given[1]}'", ctx)
    # one that was found may be anybody's: what it names is not run
    made = load_machine_file(given[0] if given else found, trusted=bool(given))
    ctx.meta[_MACHINE] = made
    if not ctx.find_root().params.get("quiet"):
        click.echo(harmless(f"tmlattice: machine file {made.path}"), err=True)
    return made


def _is_lattice(word: str) -> bool:
    """Whether a word is a lattice, and not the first of several measurements."""
    from tmlattice.lattice.load import SUFFIXES, builtin_lattices

    path = Path(word)
    if path.is_dir() or path.name == "measurement.json":
        return False
    return word.casefold() in builtin_lattices() or path.suffix.lower() in SUFFIXES


def _identities(path: Path) -> set[Any]:
    """What a path is known by, so that links are seen through: nothing of a device."""
    try:
        status = path.stat() if path.exists() else None
        names: set[Any] = {os.path.realpath(path)}
    except (OSError, ValueError):  # such as a NUL byte
        return set()
    if status is not None and not stat.S_ISREG(status.st_mode):
        return set()
    return names if status is None else names | {(status.st_dev, status.st_ino)}


def no_numbers(error: Exception) -> str:
    """The message for data whose numbers end a calculation: singular, not finite, too many."""
    from tmlattice.errors import plain

    said = plain(str(error), 100) or type(error).__name__
    return (
        f"with these numbers nothing can be worked out ({said}); check launches, settings, noise "
        "and readings for units and for values that are far off (`tmlattice check`)"
    )


def open_ring(lattice: str, read: bool = True) -> "Ring":
    """The ring of a lattice, as the machine file states it; warn if it is a part of a ring.

    Args:
        lattice: a built-in name or a path.
        read: the command needs monitors.

    Raises:
        LatticeError: no such ring, or one without monitors.
    """
    machine = machine_file()
    options = {} if machine is None else dict(machine.options_for(lattice))
    return checked_ring(lattice, options | stated_options(), read)


def checked_ring(lattice: str, options: Mapping[str, Any], read: bool = True) -> "Ring":
    """As `open_ring`, with options of `load_ring`."""
    from tmlattice.errors import LatticeError, harmless
    from tmlattice.lattice import load_ring
    from tmlattice.lattice.checks import need_monitors, no_whole_turn

    try:
        ring = load_ring(lattice, **options)
    except LatticeError as error:
        if not re.search(r"\b(energy|sequence)=", str(error)):
            raise
        where = "on the command line: --energy GEV, --sequence NAME, or [lattice] of tmlattice.toml"
        raise LatticeError(f"{error}; {where}") from error
    if read:
        need_monitors(ring)
    if told := no_whole_turn(ring):
        click.echo(f"tmlattice: warning: {harmless(told)}", err=True)
    return ring


lattice_argument = click.argument("lattice", required=False)


class Workers(click.ParamType):  # type: ignore[type-arg]
    """A number of local processes, or the address of a Dask scheduler."""

    name = "N|ADDRESS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, Any]:
        """The option `jobs` or `scheduler` of `run_batch`."""
        if isinstance(value, dict):
            return value
        if ":" in str(value):
            return {"scheduler": str(value)}
        try:
            number = int(value)
        except ValueError:
            number = 0
        if number < 1:
            self.fail(f"'{value}': give a number of processes, or tcp://HOST:PORT", param, ctx)
        return {"jobs": number}


epochs_option = click.option(
    "--epochs", type=click.IntRange(1), default=1000, show_default=True,
    help="Gradient steps at most.",
)  # fmt: skip

jobs_option = click.option(
    "--jobs", "workers", type=Workers(), default={},
    help="Local processes (else one a core), or the address of a Dask scheduler.",
)  # fmt: skip


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
    """`quiet`, which `--quiet` of the whole command line sets."""

    @functools.wraps(function)
    def run(*arguments: Any, **options: Any) -> Any:
        return function(*arguments, quiet=is_quiet(), **options)

    return run


def read_data(path: Path, ring: "Ring", quiet: bool) -> "tuple[AnyMeasurement, tuple[str, ...]]":
    """A measurement folder, or a file of another program, and what was assumed of it.

    The assumptions are printed too: nothing is taken for granted silently.
    """
    from tmlattice.measurement import read_measurement

    if not path.is_file() or path.name == "measurement.json":
        return read_measurement(path), ()
    from tmlattice.importers import Options, bring_in, described

    machine = machine_file()
    brought = bring_in([path], Options(ring=ring, told=None if machine is None else machine.told))
    said = (*brought.assumed, *brought.doubts)
    if not quiet:
        screen = console()
        screen.print(f"{path}: {described(brought)}", soft_wrap=True)
        for sentence in said:
            screen.print(f"- {sentence}", soft_wrap=True)
        screen.print()
    return brought.measurement, said


def trajectories(path: Path, refusal: str, ring: "Ring", quiet: bool) -> "Measurement":
    """The first turns of a measurement folder, or of a file of readings; see `read_data`.

    Raises:
        MeasurementError: a measurement of another kind, with the command's message about it.
    """
    from tmlattice.errors import MeasurementError
    from tmlattice.measurement import Measurement, in_words

    data, _ = read_data(path, ring, quiet)
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
