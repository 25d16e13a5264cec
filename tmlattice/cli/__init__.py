"""The command `tmlattice`. Imports stay inside the commands: `--help` must answer at once."""

from tmlattice.cli.command import main

__all__ = ["main"]
