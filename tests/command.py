"""`tmlattice` as a user calls it, in this process: without the seconds of a start."""

import contextlib
import io
import subprocess
import sys
import warnings
from unittest import mock

from tmlattice.cli.command import main


def tmlattice(*arguments, cwd, check=None):
    """Exit code, stdout and stderr of `python -m tmlattice ARGUMENTS` in the folder `cwd`."""
    words = ["tmlattice", *map(str, arguments)]
    out, errors = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd),
        mock.patch.object(sys, "argv", words),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(errors),
        warnings.catch_warnings(),
    ):
        warnings.resetwarnings()  # pytest's filters go: warnings are shown as they are to a user
        for library in (DeprecationWarning, PendingDeprecationWarning, ImportWarning):
            warnings.simplefilter("ignore", library)
        try:
            main()
        except SystemExit as end:
            code = end.code
    done = subprocess.CompletedProcess(words, code, out.getvalue(), errors.getvalue())
    if check is not None:
        assert done.returncode == check, done.stdout + done.stderr
    return done
