"""Options that several commands share."""

import logging
import os
import re
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.progress import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tmlattice.correction import Correction
    from tmlattice.diagnosis import Diagnosis
    from tmlattice.lattice import Ring
    from tmlattice.machine_file import MachineFile
    from tmlattice.measurement import AnyMeasurement
    from tmlattice.report.compare import Differences

log = logging.getLogger(__name__)

FILE = click.Path(path_type=Path)


class Word(click.ParamType):  # type: ignore[type-arg]
    """A word of the command line that a function reads.

    Args:
        read: of the word; ValueError where it cannot be read.
        refusal: the message then; {0} is the word, {1} and {2} its parts around the first "=".
    """

    def __init__(self, name: str, read: Callable[[str], Any], refusal: str) -> None:
        self.name, self.read, self.refusal = name, read, refusal

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read it; a default that is no text is taken as it is."""
        if not isinstance(value, str):
            return value
        try:
            return self.read(value)
        except ValueError:
            name, _, rest = value.partition("=")
            self.fail(self.refusal.format(value, name, rest), param, ctx)


def require(condition: bool) -> None:
    """Refuse a word."""
    if not condition:
        raise ValueError


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    require(bool(names))
    return names


def _workers(text: str) -> dict[str, Any]:
    """The option `jobs` or `scheduler` of `run_batch`."""
    if ":" in text:
        return {"scheduler": text}
    require(int(text) > 0)
    return {"jobs": int(text)}


def named_number(text: str) -> tuple[str, float | None]:
    """NAME or NAME=NUMBER."""
    from tmlattice.input_files import number

    name, _, value = text.partition("=")
    return name.strip(), number(value) if value else None


NAMES = Word("NAME,NAME", _names, "give one name or more, separated by commas")
WORKERS = Word("N|ADDRESS", _workers, "'{0}': give a number of processes, or tcp://HOST:PORT")
BACKGROUND = Word("NAME[=RMS]", named_number, "'{2}' is no rms; give for example {1}=1e-3")


def each_once(context: click.Context, parameter: click.Parameter, values: Any) -> Any:
    """The values of an option that is repeated, each a name, maybe a place, and an amount.

    Raises:
        click.UsageError: two of one name and place, of which the first would not count.
    """
    places = [tuple(str(word).casefold() for word in own) for *own, _ in values]
    for place, (*own, _) in zip(places, values, strict=True):
        if places.count(place) > 1:
            named = " ".join(str(word) for word in own if word is not None)
            raise click.UsageError(f"{parameter.opts[0]} '{named}' is given twice; give it once")
    return values


def background_option(title: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`--background NAME[=RMS]`, repeated."""
    return click.option(
        "--background",
        type=BACKGROUND,
        multiple=True,
        callback=each_once,
        help=f"{title}, with this rms or the catalogue's; `all`, or `all=SCALE`, for every usual "
        "one, or `none`.",
    )


def path_option(
    *names: str, help: str, metavar: str = "FILE", **more: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """An option whose value is a path."""
    return click.option(*names, type=FILE, metavar=metavar, help=help, **more)


def seed_option(purpose: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`--seed N`."""
    return click.option("--seed", type=click.IntRange(0), default=0, help=purpose)


INPUTS = (
    "lattice", "measurement", "measurements", "references", "calibration", "settings_file",
    "settings", "network", "files", "estimated", "design", "goal", "knobs", "first", "second",
)  # fmt: skip
OUTPUTS = ("json_file", "truth", "out", "lattice_out", "corrected_out", "example_file")
DIAGNOSES = ("estimated", "first", "second")
OF_MEASUREMENTS = ("measurement.json", "readings.csv", "response.csv", "tunes.csv")
OF_DIAGNOSES = ("diagnosis.json", "diagnosis.lattice.json", "estimated.json")
OF_FOLDERS = ("challenge.json", "options.json")
OF_BATCHES = ("cases", "truth", "results", "oracle", "baselines")


class Careful(click.Command):
    """A command that does not write over what it reads, nor twice into one file."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run it, unless an output is an input or another output; OutputError: it is."""
        from tmlattice.files import OutputError

        def given(names: Sequence[str]) -> list[Path]:
            values = [ctx.params.get(name) for name in names]
            each = [v for own in values for v in (own if isinstance(own, tuple) else [own])]
            return [Path(str(value)) for value in each if value]

        folder = ctx.params.get("folder")
        paths, machine = given(INPUTS), machine_file()
        if machine is not None:
            paths += [machine.path, *([Path(machine.lattice)] if machine.lattice else [])]
            paths += [machine.supplies] if isinstance(machine.supplies, Path) else []
        files = [*paths, *(Path(f"{path}.known.json") for path in paths)]
        files += [path / name for path in paths for name in OF_MEASUREMENTS]
        files += [path / name for path in given(DIAGNOSES) for name in OF_DIAGNOSES]
        if folder or ctx.params.get("out"):
            files += [Path(folder or ctx.params["out"]) / name for name in OF_FOLDERS]
        read = {key for path in files for key in _identities(path)}
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


def stated_options() -> dict[str, Any]:
    """The options of `load_ring` that the command line states."""
    given = click.get_current_context().find_root().params
    names = ("sequence", "energy", "particle", "monitors", "correctors")
    chosen = {name: given.get(name) for name in names}
    return {key: list(v) if isinstance(v, tuple) else v for key, v in chosen.items() if v}


def is_quiet() -> bool:
    """Whether `--quiet` was given, anywhere on the command line."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.find_root().params.get("quiet"))


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


@contextmanager
def named_data(where: object) -> Iterator[None]:
    """An error of the data names their folder; numbers that end a calculation (singular, not
    finite, too many) are one."""
    from tmlattice.errors import MeasurementError, UnknownNameError, plain

    try:
        yield
    except (MeasurementError, UnknownNameError) as error:
        raise MeasurementError(f"{where}: {error}") from error
    except (ArithmeticError, AssertionError, ValueError, MemoryError) as error:  # singular, lost
        log.info("the numbers of a measurement", exc_info=True)
        reason = plain(str(error), 100) or type(error).__name__
        raise MeasurementError(
            f"{where}: with these numbers nothing can be worked out ({reason}); check launches, "
            "settings, noise and readings for units and for values that are far off (`tmlattice "
            "check`)"
        ) from error


def open_ring(lattice: str, read: bool = True) -> "Ring":
    """The ring of a lattice, as the machine file states it; warn if it is a part of a ring."""
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


epochs_option = click.option(
    "--epochs", type=click.IntRange(1), default=1000, help="Gradient steps at most."
)
jobs_option = click.option(
    "--jobs", "workers", type=WORKERS, default={}, show_default=False,
    help="Local processes (else one a core), or the address of a Dask scheduler.",
)  # fmt: skip
assume_option = click.option(
    "--assume", "assumed", multiple=True, metavar="NAME",
    help="What is written down wrongly everywhere, such as x-reversed or launches-in-mm; it is "
    "undone first. Repeat for more (docs: check).",
)  # fmt: skip
radiation_option = click.option(
    "--radiation", is_flag=True, help="The model radiates in bends and wigglers."
)
json_option = path_option("--json", "json_file", help="Write the result as JSON.")


@contextmanager
def outputs(
    folder: Path | None, json_file: Path | None, replaced: Collection[str] = ()
) -> Iterator[tuple[Path | None, Callable[[Path], Path], Callable[[Any], None]]]:
    """What a command writes: all of it when it ends well, else nothing.

    Yields the folder that is filled (None: none was asked for), the place where a file is written
    (one of the folder: in that which is filled), and the function that writes the result as JSON,
    where that was asked for. Older files of the folder with names of `replaced` are removed if they
    are not written again.
    """
    from tmlattice.files import output_file, output_folder, write_json

    with ExitStack() as files:
        made = files.enter_context(output_folder(folder, replaced)) if folder else None

        def place(path: Path) -> Path:
            return made / path.name if made and is_in(path, folder) else path

        path = files.enter_context(output_file(place(json_file))) if json_file else None
        yield made, place, lambda result: write_json(path, result) if path else None


def is_in(path: Path, folder: Path | None) -> bool:
    """Whether a file is one of a folder, which need not exist."""
    if folder is None:
        return False
    return os.path.dirname(os.path.abspath(path)) == os.path.abspath(folder)


def read_data(
    path: Path, ring: "Ring", assumed: Sequence[str] = ()
) -> "tuple[AnyMeasurement, tuple[str, ...]]":
    """A measurement folder, or a file of another program, and what was assumed of it.

    The assumptions are printed too: nothing is taken for granted silently.

    Raises:
        click.UsageError: one of `assumed` is undone already, by the machine file.
    """
    from tmlattice.measurement import read_measurement

    if not path.is_file() or path.name == "measurement.json":
        return read_measurement(path), ()
    from tmlattice.importers import Options, bring_in, described

    machine = machine_file()
    undone = () if machine is None else machine.stated.assume
    if both := [name for name in assumed if name in undone]:
        raise click.UsageError(
            f"--assume {both[0]} is in the machine file too, which would undo it twice; leave it "
            "out"
        )
    brought = bring_in(
        [path], Options(ring=ring, stated=None if machine is None else machine.stated)
    )
    said = (*brought.assumed, *brought.doubts)
    screen = console()
    screen.print(f"{path}: {described(brought)}", soft_wrap=True)
    for sentence in said:
        screen.print(f"- {sentence}", soft_wrap=True)
    screen.print()
    return brought.measurement, said


def console() -> "Console":
    """Where results are printed: as wide as the terminal, up to 120 columns, else 100; nowhere with
    `--quiet`. Names from files steer nothing there."""
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

    look: dict[str, Any] = {"highlight": False, "markup": False, "quiet": is_quiet()}
    wide = Screen(**look)
    return Screen(**look, width=min(wide.width, 120) if wide.is_terminal else 100)


LINES = 40
"""Of a terminal, in all."""


def print_report(
    screen: "Console",
    found: "Diagnosis | Correction | Differences",
    after: Sequence[str] = (),
    before: Sequence[str] = (),
) -> None:
    """Print a report and the lines after it; on a terminal, which scrolls, its most important
    lines, so many that `LINES` hold all (before: what is printed already)."""
    others = sum(max(1, -(-len(line) // screen.width)) for line in (*before, *after))
    most = LINES - others if screen.is_terminal else None
    for text in (found.report(screen.width, most), *after):
        screen.print(text, soft_wrap=True)


def table(*columns: str, rows: Iterable[Sequence[str]] = ()) -> "Table":
    """A table with its first column left, the others right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left")
    for row in rows:
        made.add_row(*row)
    return made
