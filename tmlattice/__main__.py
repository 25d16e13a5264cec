"""`python -m tmlattice`."""

from tmlattice.cli.command import main

main()
