"""`tmlattice dev`: studies of the method itself."""

import click

from tmlattice.cli.challenge import challenge
from tmlattice.cli.reproduce import reproduce
from tmlattice.cli.study import study


@click.group("dev")
def dev() -> None:
    """Study the method: tune fits of many magnets, blind challenges, the paper's systems."""


for _command in (study, challenge, reproduce):
    dev.add_command(_command)
