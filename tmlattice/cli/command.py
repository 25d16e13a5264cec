"""The group of commands, and how any of them ends: a result, or one sentence and a code."""

import codecs
import csv
import difflib
import io
import os
import signal
import sys
import warnings
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import click

from tmlattice import __version__
from tmlattice.cli.challenge import challenge
from tmlattice.cli.check import check
from tmlattice.cli.correct import correct
from tmlattice.cli.diagnose import diagnose
from tmlattice.cli.import_files import import_files
from tmlattice.cli.info import effects, info
from tmlattice.cli.init import init
from tmlattice.cli.options import FILE
from tmlattice.cli.predict import predict
from tmlattice.cli.progress import stopped_in
from tmlattice.cli.reproduce import reproduce
from tmlattice.cli.results import compare, report
from tmlattice.cli.simulate import simulate
from tmlattice.cli.study import study
from tmlattice.cli.tune_fit import tune_fit
from tmlattice.errors import TmlatticeError, harmless

BAD_INPUT = 2


class Sections(click.Group):
    """A group whose help lists its commands by what they are for."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """The options of all commands are taken wherever they stand."""
        own = {
            name: option
            for option in self.params
            if isinstance(option, click.Option)
            for name in option.opts
        }
        first: list[str] = []
        rest: list[str] = []
        words = iter(args)
        for word in words:
            name, _, value = word.partition("=")
            if word == "--":
                rest += [word, *words]
            elif name not in own:
                rest.append(word)
            elif value or own[name].is_flag:
                first.append(word)
            else:
                given = next(words, None)
                if given is None:
                    raise click.UsageError(f"{name} needs a value, {own[name].metavar}", ctx)
                first += [word, given]
        return super().parse_args(ctx, first + rest)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command, or a sentence with the nearest one."""
        if args and args[0] not in self.commands and not args[0].startswith("-"):
            near = difflib.get_close_matches(args[0], self.commands, 1)
            near = [f"dev {args[0]}"] if args[0] in dev.commands else near
            advice = f"did you mean '{near[0]}'?" if near else "`tmlattice --help` lists them"
            raise click.UsageError(f"no command '{args[0]}'; {advice}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """In the order of `SECTIONS`."""
        limit = formatter.width - 6 - max(map(len, self.commands))
        for title, commands in SECTIONS.items():
            rows = [(c.name or "", c.get_short_help_str(limit)) for c in commands]
            with formatter.section(title):
                formatter.write_dl(rows)


dev = click.Group(
    "dev",
    commands=[study, challenge, reproduce],
    help="Study the method: tune fits of many magnets, blind challenges, the paper's systems.",
)

SECTIONS: dict[str, tuple[click.Command, ...]] = {
    "Describe": (info, init),
    "Measure": (simulate, import_files, check),
    "Diagnose": (diagnose, report, compare, correct, effects),
    "Fit": (tune_fit, predict),
    "Develop": (dev,),
}


@click.group(
    cls=Sections,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        "show_default": True,
    },
)
@click.version_option(__version__, prog_name="tmlattice")
@click.option("--machine", "machines", type=FILE, multiple=True, metavar="FILE",
              help="Machine file: lattice, names, units, supplies; else tmlattice.toml of the "
              "working directory, if there is one. For every command.")  # fmt: skip
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors. For every command.")
@click.option("--sequence", metavar="NAME", help="The sequence, line or variable of the lattice "
              "file that is the ring.")  # fmt: skip
@click.option("--energy", type=click.FloatRange(0, min_open=True), metavar="GEV",
              help="Beam energy, if the lattice states none.")  # fmt: skip
@click.option("--particle", type=click.Choice(["electron", "proton"]), metavar="NAME",
              help="electron or proton, if the lattice states none.")  # fmt: skip
@click.option("--monitors", multiple=True, metavar="PATTERN", help="Markers or drifts that are "
              "BPMs, such as 'BPM*'; several with commas.")  # fmt: skip
@click.option("--correctors", multiple=True, metavar="PATTERN",
              help="Elements that are correctors too, such as 'COR*'.")  # fmt: skip
@click.pass_context
def tmlattice(
    context: click.Context, /, machines: tuple[Path, ...], quiet: bool, **lattice: Any
) -> None:
    """The gap between the model of a storage ring and the ring itself.

    A LATTICE is a built-in name (petra3) or a path: OCELOT code (.py), AT (.mat, .json, .m,
    .repr), MAD-X (.seq, .madx, or a TWISS table: .tfs, .twiss, .dat), elegant (.lte), Xsuite
    (.json) or the package's own JSON. OCELOT's files are Python code and are run: load only files
    that you trust. All others are data (SECURITY.md). A machine file (`tmlattice init`) names the
    LATTICE, so that it may be left out.
    """
    given = ["machine"] * bool(machines) + [name for name, value in lattice.items() if value]
    if given and context.invoked_subcommand in (dev.name, effects.name):
        raise click.UsageError(f"--{given[0]} has no meaning for {context.invoked_subcommand}")


for _commands in SECTIONS.values():
    for _command in _commands:
        tmlattice.add_command(_command)


class Terminated(BaseException):
    """SIGTERM, or a terminal that was closed: it unwinds as Ctrl-C, so that nothing is left."""


def main() -> NoReturn:
    """Run the command line. Exit code 0: done; 1: done, and errors reported (`check`); 2: input
    that cannot be used; 128 and the signal's number: stopped, 130 by Ctrl-C, 143 by SIGTERM, 141
    if no process reads the output."""
    _prepare()
    code = 0
    try:
        code = tmlattice(standalone_mode=False) or 0
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        sys.exit(BAD_INPUT)
    except click.ClickException as error:
        _fail(error.format_message())
    except TmlatticeError as error:
        _fail(str(error))
    except csv.Error as error:
        _fail(f"a table cannot be read as CSV ({error}); write it again")
    except MemoryError:
        _fail("there is not enough memory for this; give less of it")
    except (
        BrokenPipeError,
        SystemExit,
    ):  # click makes the second of the first, and of nothing else
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what is still to be flushed
        sys.exit(128 + signal.SIGPIPE)
    except OSError as error:
        _fail(f"{error.filename or 'a file'}: {error.strerror or error}")
    except (KeyboardInterrupt, click.exceptions.Abort, Terminated) as stop:
        where = f" in '{stopped_in[0]}'" if stopped_in else ""
        with suppress(OSError):  # the terminal may be gone
            click.echo(f"tmlattice: stopped{where}; nothing was written", err=True)
            sys.stdout.flush()
            sys.stderr.flush()
        by = stop.args[0] if isinstance(stop, Terminated) else signal.SIGINT
        os._exit(128 + by)  # temporary files are gone; torch and its threads need a second to end
    sys.exit(code)


def _prepare() -> None:
    """What a command does not take from its surroundings."""
    warnings.showwarning = _show_warning
    os.environ["MPLBACKEND"] = "Agg"  # figures are files
    sys.modules.setdefault("at.plot", ModuleType("at.plot"))  # AT's need Matplotlib, and a second
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed: no file that is opened may take its place
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=SPELT)
    for kind in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(kind) is signal.SIG_DFL:
            signal.signal(kind, _terminated)


def _terminated(number: int, _: object) -> None:
    raise Terminated(number)


SPELT = "tmlattice.spelt"
"""How a stream writes what its encoding does not have."""
_LETTERS = {
    "µ": "u", "±": "+-", "²": "^2", "³": "^3", "·": "*", "×": "x", "β": "beta", "σ": "sigma",
    "χ": "chi", "π": " pi", "–": "-", "−": "-", "…": "...",
}  # fmt: skip


def _spelt(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    part = error.object[error.start : error.end]
    return "".join(_LETTERS.get(c, "?") for c in part), error.end


codecs.register_error(SPELT, _spelt)


def _fail(message: str) -> NoReturn:
    click.echo(f"tmlattice: {harmless(message)}", err=True)
    sys.exit(BAD_INPUT)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if not issubclass(category, RuntimeWarning):  # numpy's, of numbers that are checked elsewhere
        click.echo(f"tmlattice: warning: {harmless(str(message))}", err=True)
