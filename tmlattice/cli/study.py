"""`tmlattice dev study`: an experiment over many magnets."""

from pathlib import Path
from typing import Any

import click

from tmlattice.cli.options import (
    Careful,
    Word,
    checked_ring,
    console,
    epochs_option,
    is_quiet,
    jobs_option,
    path_option,
    require,
    table,
)


@click.group("study")
def study() -> None:
    """Run an experiment over many magnets."""


def _number(text: str) -> int | None:
    """None: all of them."""
    if text == "all":
        return None
    require(int(text) > 0)
    return int(text)


NUMBER = Word("all|N", _number, "'{0}' is no number of magnets; give 'all' or 1, 2, ...")


@study.command("tune-fit", cls=Careful)
@click.argument("lattice", default="petra3")
@click.option(
    "--magnets", type=NUMBER, default="40", help="Powered magnets, evenly spread over the ring."
)
@click.option(
    "--methods",
    default="adam,map,sparse",
    metavar="NAME,...",
    help="adam, adam-none, adam-l1, adam-l2 (its regularizations), map, sparse, known (sparse with "
    "the known magnet).",
)
@path_option(
    "--out",
    default="study-tune-fit",
    metavar="DIR",
    help="Folder for the cases, study.png and study.json; a study that was stopped goes on there.",
)
@click.option(
    "--change", type=float, default=-0.2, help="Relative change of the magnet's strength."
)
@epochs_option
@jobs_option
def tune_fit(
    lattice: str, methods: str, out: Path, workers: dict[str, Any], **options: Any
) -> None:
    """Tune errors of fine-tuning over many magnets, each changed in turn."""
    from tmlattice import __version__
    from tmlattice.files import output_file, write_json
    from tmlattice.fitting.study import study_tune_fit, summarise
    from tmlattice.plots import plot_study, save_figure

    chosen = tuple(name.strip() for name in methods.split(","))
    cases = study_tune_fit(
        lattice, chosen, progress=not is_quiet(), folder=out, **workers, **options
    )
    cases.sort(key=lambda case: (case.s, case.magnet, case.method, case.seed))
    summary = {
        "format": "tmlattice-study-tune-fit",
        "version": 3,
        "package": __version__,
        "lattice": lattice,
        "options": options,
        **summarise(cases),
        "results": [
            {
                "magnet": case.magnet,
                "s": case.s,
                "method": case.method,
                "seed": case.seed,
                "abs_dq": case.absolute_error,
                "rel_dq": case.relative_error,
                "tune_sigma": case.tune_sigma,
                "orbit_rms": case.orbit_rms,
                "prediction_rms": case.prediction_rms,
                "found": case.found,
                "problem": case.problem,
            }
            for case in cases
        ],
    }
    with output_file(out / "study.json") as own:
        write_json(own, summary)
    with output_file(out / "study.png") as path:
        save_figure(plot_study(checked_ring(lattice, {}), cases), path)
    _print(summary)


def _print(summary: dict[str, Any]) -> None:
    screen = console()
    screen.print(
        f"{summary['cases']} magnets, {summary['unstable']} of them with an unstable ring "
        "(no tune exists; left out)"
    )
    for key, title, form in (
        ("abs_dq", "|dQ|", "{:.2e}"),
        ("rel_dq", "|dQ| relative to the fraction", "{:.2%}"),
    ):
        errors = table(title, "x median", "p95", "worst", "y median", "p95", "worst",
                       "predicted", "no tune")  # fmt: skip
        for name, entry in summary["methods"].items():
            values = [entry[key][plane][which] for plane in "xy" for which in entry[key][plane]]
            errors.add_row(
                name,
                *("-" if value is None else form.format(value) for value in values),
                str(entry["predicted"]),
                str(entry["failed"]),
            )
        screen.print(errors)
    more = table("", "right magnet", "stated error x, median", "y", "within 95 % of it, x", "y",
                 "residual [µm]", "new launches [µm]", "seconds")  # fmt: skip
    for name, entry in summary["methods"].items():
        shown = (
            (entry["right"], 1, "{:.1%}"),
            (entry["stated"]["x"]["median"], 1, "{:.2e}"),
            (entry["stated"]["y"]["median"], 1, "{:.2e}"),
            (entry["coverage"]["x"], 1, "{:.1%}"),
            (entry["coverage"]["y"], 1, "{:.1%}"),
            (entry["orbit_rms"], 1e6, "{:.2f}"),
            (entry["prediction_rms"]["median"], 1e6, "{:.2f}"),
            (entry["seconds"], 1, "{:.2f}"),
        )
        more.add_row(name, *("-" if v is None else form.format(v * f) for v, f, form in shown))
    screen.print(more)
