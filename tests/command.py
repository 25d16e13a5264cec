"""`tmlattice` as a user calls it, in this process: without the seconds of a start; Python, in one
of its own."""

import contextlib
import io
import os
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


def refused(*arguments, cwd, says):
    """The command ends in one sentence that states this, and leaves its folder as it was."""

    def found():
        return {path: path.is_file() and path.read_bytes() for path in cwd.rglob("*")}

    before = found()
    done = tmlattice(*arguments, cwd=cwd, check=2)
    (line,) = done.stderr.splitlines()
    assert line.startswith("tmlattice: ")
    assert says in line
    assert "Traceback" not in line
    assert done.stdout == ""
    assert found() == before


def python(*words, cwd, **environment):
    """`python WORDS` in a process of its own, with another environment; None takes a name out."""
    changed = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=cwd, capture_output=True, text=True, check=False,
        env={name: str(value) for name, value in changed.items() if value is not None},
    )  # fmt: skip


def printed(*words, cwd, **environment):
    """What `python WORDS` prints; it ends well."""
    done = python(*words, cwd=cwd, **environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
