"""The group of commands, and how any of them ends: a result, or one sentence and a code."""

import os
import sys
import warnings
from typing import NoReturn, TextIO

import click

from tmlattice import __version__
from tmlattice.cli.challenge import challenge
from tmlattice.cli.check import check
from tmlattice.cli.diagnose import diagnose
from tmlattice.cli.effects import effects
from tmlattice.cli.import_files import import_files
from tmlattice.cli.info import info
from tmlattice.cli.predict import predict
from tmlattice.cli.reproduce import reproduce
from tmlattice.cli.simulate import simulate
from tmlattice.cli.study import study
from tmlattice.cli.tune_fit import tune_fit
from tmlattice.errors import TmlatticeError, harmless

BAD_INPUT = 2
STOPPED = 130  # as the shell has it for Ctrl-C


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="tmlattice")
def tmlattice() -> None:
    """The gap between the model of a storage ring and the ring itself.

    A LATTICE is a built-in name (petra3) or a path: OCELOT code (.py), AT (.mat, .json, .m,
    .repr), MAD-X (.seq, .madx, or a TWISS table: .tfs, .twiss, .dat), elegant (.lte), Xsuite
    (.json) or the package's own JSON. OCELOT's files are Python code and are run: load only files
    that you trust. All others are data (SECURITY.md).
    """


tmlattice.add_command(tune_fit)
tmlattice.add_command(info)
tmlattice.add_command(study)
tmlattice.add_command(import_files)
tmlattice.add_command(simulate)
tmlattice.add_command(effects)
tmlattice.add_command(check)
tmlattice.add_command(diagnose)
tmlattice.add_command(predict)
tmlattice.add_command(reproduce)
tmlattice.add_command(challenge)


def main() -> NoReturn:
    """Run the command line. Exit code 0: done; 1: done, and told what is wrong (`check`); 2: input
    that cannot be used; 130: Ctrl-C."""
    warnings.showwarning = _show_warning
    code = 0
    try:
        code = tmlattice(standalone_mode=False) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        sys.exit(BAD_INPUT)
    except click.ClickException as error:
        _fail(error.format_message(), BAD_INPUT)
    except TmlatticeError as error:
        _fail(str(error), BAD_INPUT)
    except OSError as error:
        _fail(f"{error.filename or 'a file'}: {error.strerror or error}", BAD_INPUT)
    except (KeyboardInterrupt, click.exceptions.Abort):
        click.echo("tmlattice: stopped; nothing was written", err=True)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(STOPPED)  # temporary files are gone; torch and its threads need a second to end
    sys.exit(code)


def _fail(message: str, code: int) -> NoReturn:
    click.echo(f"tmlattice: {harmless(message)}", err=True)
    sys.exit(code)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    if not issubclass(category, RuntimeWarning):  # numpy's, of numbers that are judged elsewhere
        click.echo(f"tmlattice: warning: {harmless(str(message))}", err=True)
