"""`tmlattice study`: an experiment over many magnets."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from tmlattice.cli.options import (
    REGULARIZATIONS,
    console,
    json_option,
    lattice_argument,
    quiet_option,
    recipe_options,
    table,
)


@click.group("study")
def study() -> None:
    """Run an experiment over many magnets."""


@study.command("tune-fit")
@lattice_argument
@click.option(
    "--magnets",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Powered quadrupoles, evenly spread over the ring.",
)
@click.option(
    "--regularization",
    "methods",
    type=click.Choice(REGULARIZATIONS),
    multiple=True,
    help="Repeat for several; all where none is named.",
)
@click.option("--workers", type=click.IntRange(1), help="Processes; else one a core.")
@recipe_options
@json_option
@quiet_option
def tune_fit(
    lattice: str,
    methods: tuple[str, ...],
    json_file: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Median, 95th percentile and worst tune error of the paper's recipe, by regularization."""
    from tmlattice import __version__
    from tmlattice.files import output_file, write_json
    from tmlattice.fitting.study import study_tune_fit, summarise

    chosen = methods or tuple(REGULARIZATIONS)
    with output_file(json_file) if json_file else nullcontext() as path:
        cases = list(study_tune_fit(lattice, chosen, progress=not quiet, **options))
        summary = {
            "format": "tmlattice-study-tune-fit",
            "version": 1,
            "package": __version__,
            "lattice": lattice,
            "options": {**options, "launch": list(options["launch"])},
            **summarise(cases),
            "results": [
                {
                    "magnet": case.magnet,
                    "s": case.s,
                    "method": case.method,
                    "abs_dq": None if case.absolute_error is None else [*case.absolute_error],
                    "rel_dq": None if case.relative_error is None else [*case.relative_error],
                    "orbit_rms": case.orbit_rms,
                    "problem": case.problem,
                }
                for case in sorted(cases, key=lambda c: (c.s, c.method))
            ],
        }
        if path:
            write_json(path, summary)
    if not quiet:
        _print(summary)


@study.command("localisation")
@lattice_argument
@click.option(
    "--cases",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Faults, at random.",
)
@click.option(
    "--signal-to-noise",
    type=click.FloatRange(0, min_open=True),
    multiple=True,
    default=(20.0,),
    show_default=True,
    help="Norm of the change of all readings over the noise, launch fitted; repeat for several.",
)
@click.option(
    "--shots",
    type=click.IntRange(1),
    multiple=True,
    default=(1, 4),
    show_default=True,
    help="Of a measurement; repeat for several.",
)
@click.option(
    "--noise",
    type=click.FloatRange(0, min_open=True),
    default=2e-5,
    show_default=True,
    help="Rms of one reading, m.",
)
@click.option(
    "--epochs",
    type=click.IntRange(1),
    default=1000,
    show_default=True,
    help="Gradient steps at most.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of faults, launches and noise.",
)
@json_option
@quiet_option
def localisation(
    lattice: str,
    sequence: str | None,
    energy: float | None,
    json_file: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """The place of a gradient fault, as a network's raw and its normalised weights name it."""
    from tmlattice import __version__
    from tmlattice.challenge.localisation import study_localisation, summarise
    from tmlattice.files import output_file, write_json
    from tmlattice.lattice import load_ring

    with output_file(json_file) if json_file else nullcontext() as path:
        ring = load_ring(lattice, sequence, energy)
        cases = list(study_localisation(ring, progress=not quiet, **options))
        rows = summarise(cases)
        if path:
            summary = {
                "format": "tmlattice-study-localisation",
                "version": 1,
                "package": __version__,
                "lattice": lattice,
                "options": {name: _plain(value) for name, value in options.items()},
                "summary": rows,
                "results": [
                    {name: _plain(value) for name, value in vars(case).items()} for case in cases
                ],
            }
            write_json(path, summary)
    if not quiet:
        _print_localisation(rows)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _print_localisation(rows: list[dict[str, Any]]) -> None:
    screen = console()
    for row in rows:
        names = table(
            f"signal to noise {row['signal_to_noise']:g}, {row['shots']} shots, "
            f"{row['cases']} faults",
            "element", "within one monitor gap", "median gaps off",
        )  # fmt: skip
        for name, found in row["rankings"].items():
            names.add_row(
                name,
                f"{found['element']:.0%}",
                f"{found['within_one_gap']:.0%}",
                f"{found['median_gaps']:g}",
            )
        screen.print(names)
        screen.print(
            f"chi-square a reading {row['chi2_before']:.3f} before fine-tuning, "
            f"{row['chi2_after']:.3f} after; seconds: fine-tuning "
            f"{row['seconds_fine_tuning']:.1f}, reading {row['seconds_reading']:.1f}"
        )


def _print(summary: dict[str, Any]) -> None:
    screen = console()
    screen.print(
        f"{summary['cases']} magnets, {summary['unstable']} of them with an unstable ring "
        "(no tune exists; left out)"
    )
    for key, title, form in (
        ("abs_dq", "|dQ|", "{:.5f}"),
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
    for name, entry in summary["methods"].items():
        if entry["orbit_rms"] is not None:
            screen.print(f"{name}: median residual {1e6 * entry['orbit_rms']:.2f} µm rms")
