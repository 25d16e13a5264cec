"""`tmlattice dev reproduce`: the paper's other systems, its figures compared with ours."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import console, is_quiet, path_option, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tmlattice.systems import Comparison

    Reproduced = tuple[list[Comparison], Figure]

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
            rows, figure = _RUN[name](small, not is_quiet())
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


def _free_fall(small: bool, progress: bool) -> "Reproduced":
    from tmlattice.plots.systems import plot_free_fall
    from tmlattice.systems.free_fall import comparisons, predicted_masses, step_errors

    errors = step_errors([1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01][: 4 if small else None])
    masses = predicted_masses([60, 70, 90, 120, 150], seed=SEED)
    return comparisons(errors, masses), plot_free_fall(errors, masses)


def _lotka_volterra(small: bool, progress: bool) -> "Reproduced":
    from tmlattice.plots.systems import plot_lotka_volterra
    from tmlattice.systems.lotka_volterra import comparisons, race

    smaller: dict[str, Any] = {"epochs": (100,), "cells": (5,), "regularizations": ("none",)}
    done = race(seed=SEED, progress=progress, **(smaller if small else {}))
    return comparisons(done), plot_lotka_volterra(done)


def _pendulum(small: bool, progress: bool) -> "Reproduced":
    from tmlattice.plots.systems import plot_pendulum
    from tmlattice.systems.pendulum import comparisons, study

    done = study(SEED)
    return comparisons(done), plot_pendulum(done)


def _magnets(small: bool, progress: bool) -> "Reproduced":
    from tmlattice.lattice import load_ring
    from tmlattice.plots.systems import plot_magnets
    from tmlattice.systems.magnets import comparisons, study

    ring = load_ring("petra3")
    done = study(ring)
    return comparisons(done), plot_magnets(done, ring)


def _cavitation(small: bool, progress: bool) -> "Reproduced":
    from tmlattice.plots.systems import plot_cavitation
    from tmlattice.systems.cavitation import comparisons, study

    smaller: dict[str, Any] = {"drive": 0.5, "periods": 1, "order": 5}
    done = study(seed=SEED, **(smaller if small else {}))
    return comparisons(done), plot_cavitation(done)


_RUN: dict[str, Callable[[bool, bool], "Reproduced"]] = {
    "free-fall": _free_fall,
    "lotka-volterra": _lotka_volterra,
    "pendulum": _pendulum,
    "magnets": _magnets,
    "cavitation": _cavitation,
}


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
