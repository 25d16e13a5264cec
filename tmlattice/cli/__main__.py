"""`python -m tmlattice.cli`."""

from tmlattice.cli.command import main

main()
