"""`tmlattice dev reproduce`: the paper's other systems, its figures compared with ours."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import console, is_quiet, path_option, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tmlattice.systems import Comparison

SEED = 0
"""Of noise and of first weights."""
SYSTEMS = ["free-fall", "lotka-volterra", "pendulum", "magnets", "cavitation"]


@click.command("reproduce")
@click.argument("systems", nargs=-1, metavar="[SYSTEM]...", type=click.Choice(SYSTEMS))
@path_option("--out", default="reproduce", metavar="DIR",
              help="Folder for the figures and reproduction.json.")  # fmt: skip
@click.option("--small", is_flag=True,
              help="Fewer networks, a gentler collapse: seconds, not minutes.")  # fmt: skip
def reproduce(systems: tuple[str, ...], out: Path, small: bool) -> None:
    """Reproduce the paper's SYSTEMS (all, where none is named): table and figures.

    Every number under "here" is computed anew; those under "paper" are as printed there.
    """
    from time import perf_counter

    from tmlattice import __version__
    from tmlattice.files import output_folder, write_json

    chosen = [name for name in SYSTEMS if name in systems] or SYSTEMS
    with ExitStack() as files:
        folder = files.enter_context(output_folder(out))
        from tmlattice.plots import save_figure

        entries = []
        for name in chosen:
            begin = perf_counter()
            rows, figure = _reproduced(name, small)
            save_figure(figure, folder / f"{name}.png")
            entries.append({
                "system": name,
                "figure": f"{name}.png",
                "seconds": perf_counter() - begin,
                "rows": [vars(row) for row in rows],
            })  # fmt: skip
            _print(name, rows)
        result = {
            "format": "tmlattice-reproduction",
            "version": 1,
            "package": __version__,
            "options": {"seed": SEED, "small": small},
            "systems": entries,
        }
        write_json(folder / "reproduction.json", result)
    names = ", ".join(f"{name}.png" for name in chosen)
    console().print(f"written: {out}/: {names}, reproduction.json")


def _reproduced(name: str, small: bool) -> "tuple[list[Comparison], Figure]":
    """Our numbers next to the paper's, and the figure of a system."""
    from tmlattice.plots import systems as plots
    from tmlattice.systems import cavitation, free_fall, lotka_volterra, magnets, pendulum

    less: dict[str, Any]
    match name:
        case "free-fall":
            steps = [1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01]
            errors = free_fall.step_errors(steps[:4] if small else steps)
            masses = free_fall.predicted_masses([60, 70, 90, 120, 150], seed=SEED)
            return free_fall.comparisons(errors, masses), plots.plot_free_fall(errors, masses)
        case "lotka-volterra":
            less = {"epochs": (100,), "cells": (5,), "regularizations": ("none",)} if small else {}
            race = lotka_volterra.race(seed=SEED, progress=not is_quiet(), **less)
            return lotka_volterra.comparisons(race), plots.plot_lotka_volterra(race)
        case "pendulum":
            swings = pendulum.study(SEED)
            return pendulum.comparisons(swings), plots.plot_pendulum(swings)
        case "magnets":
            from tmlattice.lattice import load_ring

            ring = load_ring("petra3")
            turns = magnets.study(ring)
            return magnets.comparisons(turns), plots.plot_magnets(turns, ring)
        case _:
            less = {"drive": 0.5, "periods": 1, "order": 5} if small else {}
            collapse = cavitation.study(seed=SEED, **less)
            return cavitation.comparisons(collapse), plots.plot_cavitation(collapse)


def _print(name: str, rows: "list[Comparison]") -> None:
    made = table(name, "paper", "here", "why they differ")
    for column, ratio in zip(made.columns, (5, None, 3, 4), strict=True):
        column.ratio = ratio
    made.columns[-1].justify = "left"
    for row in rows:
        made.add_row(row.quantity, _text(row.paper), _text(row.here), row.why)
    console().print(made)


def _text(value: float | str | None) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.9g}"
