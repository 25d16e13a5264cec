"""`tmlattice dev challenge`: the diagnosis checked on data whose cause is withheld."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import (
    FILE,
    Careful,
    background_option,
    console,
    is_quiet,
    jobs_option,
    json_option,
    outputs,
    path_option,
    seed_option,
    table,
)

if TYPE_CHECKING:
    from rich.console import Console

METHODS = {
    "tool": "diagnose",
    "oracle": "oracle",
    "bayes_oracle": "oracle, with prior",
    "svd_gradients": "SVD, gradients",
    "omp": "matching pursuit",
    "lasso": "LASSO",
    "weight_change": "largest weight change",
}


@click.group("challenge")
def challenge() -> None:
    """Check the diagnosis on data whose cause is withheld: make cases, run, score."""


code_option = click.option(
    "--lattice",
    metavar="FILE.py",
    help="The challenge's lattice where it is Python code: named here, it is run.",
)


@challenge.command("make")
@click.argument(
    "tier", metavar="A|B|C|D|E|R|T|P|M", type=click.Choice(list("ABCDERTPM"), case_sensitive=False)
)
@click.option("--cases", type=click.IntRange(1), default=300, help="How many.")
@seed_option("Of all that is drawn.")
@path_option("--out", "folder", metavar="PATH", required=True, help="Folder of the challenge.")
@click.option("--lattice", default="petra3", help="Built-in name or path.")
@click.option("--reference", is_flag=True, help="Tier B: with a measurement before the fault.")
@click.option(
    "--learnt",
    is_flag=True,
    help="Tier B: the diagnosis starts from an orbit response of the machine before the fault.",
)
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    type=click.Choice(
        ["trajectory", "turn_by_turn", "closed_orbit", "dispersion", "tunes", "orbit_response"]
    ),
    help="Tiers E, M and P: of measurement (repeat); M draws two or three of them for a case.",
)
@click.option(
    "--shots", type=click.IntRange(1), default=4, help="Of the fit; two more are held out."
)
@click.option("--effect", "effects", multiple=True, help="Draw from these alone (repeat).")
@click.option("--amount", type=float, help="Of the effect, instead of a drawn signal to noise.")
@background_option("Tiers B, E, R, T, P and M: distributed errors")
def make(
    tier: str,
    folder: Path,
    effects: tuple[str, ...],
    background: tuple[tuple[str, float | None], ...],
    **options: Any,
) -> None:
    """Make cases of a TIER: A one effect, B one among distributed errors, C two or three, D one
    outside the catalogue, E none, all in first turns; R one in an orbit response, T in turns of a
    stored beam, M in two or three kinds together, P what changed between two.

    AT simulates the real machine. The folder's `truth` holds the truth; only `score` opens it.
    """  # fmt: skip
    from tmlattice.challenge import make as make_cases

    lost = make_cases(
        tier.upper(), folder=folder, effects=effects or None, background=dict(background),
        progress=not is_quiet(), **options,
    )  # fmt: skip
    screen = console()
    screen.print(f"{options['cases']} cases of tier {tier.upper()} in {folder}")
    if lost:
        rows = ", ".join(f"{name} {count}" for name, count in sorted(lost.items()))
        screen.print(f"drawn anew, for no amount has the signal to noise asked for: {rows}")


@challenge.command("run")
@click.argument("folder", type=FILE)
@code_option
@jobs_option
@click.pass_context
def run(context: click.Context, folder: Path, workers: dict[str, Any], lattice: str | None) -> None:
    """Diagnose every case in FOLDER that has no result yet; the truth is not read.

    The exit code is 1 where a case failed.
    """
    from tmlattice.challenge import run as run_cases

    results = run_cases(folder, progress=not is_quiet(), lattice=lattice, **workers)
    failed = {name: result["error"] for name, result in results.items() if "error" in result}
    screen = console()
    screen.print(f"{len(results) - len(failed)} of {len(results)} cases diagnosed")
    for name, error in failed.items():
        screen.print(f"case {name}: {error}")
    if failed:
        context.exit(1)


@challenge.command("score", cls=Careful)
@click.argument("folder", type=FILE)
@path_option("--out", metavar="DIR", help="Figures: confusion, calibration, detection.")
@click.option(
    "--oracle/--no-oracle",
    default=True,
    help="With the oracle and plain baselines, some seconds a case the first time.",
)
@code_option
@jobs_option
@json_option
def score(
    folder: Path,
    out: Path | None,
    oracle: bool,
    workers: dict[str, Any],
    lattice: str | None,
    json_file: Path | None,
) -> None:
    """Score the results in FOLDER against the truth, together with oracle and baselines."""
    from tmlattice.challenge import score as score_cases

    with outputs(out, json_file) as (figures, _, write):
        result = score_cases(
            folder, oracle=oracle, progress=not is_quiet(), lattice=lattice, **workers
        )
        write(result)
        if figures:
            from tmlattice.plots.challenge import save_challenge

            save_challenge(result, figures)
    print_score(console(), result)


def _share(rate: dict[str, Any] | None) -> str:
    if not rate or rate["share"] is None:
        return "-"
    low, high = rate["interval"]
    return f"{rate['share']:.1%} ({low:.0%}-{high:.0%})"


def _number(value: float | None, form: str = "{:.3g}") -> str:
    return "-" if value is None else form.format(value)


def print_score(screen: "Console", result: dict[str, Any]) -> None:
    """The tables."""
    more = " with a reference" if result["reference"] else ""
    screen.print(f"tier {result['tier']}{more}: {result['cases']} cases, "
                 f"{len(result['failed'])} failed; median "
                 f"{_number(result['seconds']['median'])} s a case")  # fmt: skip
    if result["not_run"]:
        screen.print(
            f"{len(result['not_run'])} more cases have no result and count for nothing here; "
            "`tmlattice dev challenge run` makes them"
        )
    verdicts = ", ".join(f"{name} {count}" for name, count in result["verdicts"].items())
    screen.print(f"verdicts: {verdicts}")
    for key, title in (
        ("false_alarms", "false alarms"),
        ("oracle_false_alarms", "false alarms of the oracle"),
        ("false_refusals", "false refusals"),
        ("more_than_one_finding", "more than one finding"),
    ):
        if key in result:
            screen.print(f"{title}: {_share(result[key])} of {result[key]['cases']}")
    if "exact" in result:
        exact, above = result["exact"], result["exact_above_10"]
        rows = ((METHODS[n], _share(exact[n]), _share(above.get(n))) for n in METHODS if n in exact)
        screen.print(
            table("all causes found, up to equivalence", "all cases", "each above 10", rows=rows)
        )
    if "methods" in result:
        _print_methods(screen, "signal to noise >= 10", result["methods"])
        for name, methods in result["bands"].items():
            _print_methods(screen, f"signal to noise {name}", methods)
    if "together" in result:
        for key, title in (("of_found_alone", "one kind"), ("of_none_alone", "none")):
            rate = result["together"][key]
            screen.print(f"found together where {title} alone finds it: {_share(rate)} of "
                         f"{rate['cases']}")  # fmt: skip
    if "detection" in result:
        screen.print(table("signal to noise", "detected", "oracle", "cases", rows=(
            (f"{entry['from']:.0f} to {entry['to']:.0f}", _share(entry["tool"]),
             _share(entry["oracle"]), str(entry["tool"]["cases"]))
            for entry in result["detection"]
        )))  # fmt: skip
    if "effects" in result:
        keys = ("place", "element_first", "element_in_set", "effect_first", "effect_in_set")
        head = ("effect, signal to noise >= 10", *(key.replace("_", " ") for key in keys))
        screen.print(table(*head, rows=(
            (name, *(_plain(methods["tool"][key]) for key in keys))
            for name, methods in result["effects"].items() if "tool" in methods
        )))  # fmt: skip
    if result.get("classes"):
        head = ("stay together", "cases", "elements", "next shot parts by, sigma", "settings")
        screen.print(table(*head, rows=(
            (", ".join(entry["effects"]), str(entry["cases"]), _number(entry["elements"]),
             _number(entry["separation_sigma"]), _plain(entry["by_setting"]))
            for entry in result["classes"][:12]
        )))  # fmt: skip
    if "coverage" in result:
        _print_sets(screen, result)
    if "kinds" in result:
        screen.print(table("unknown, not aliased", "refused", "place", "aliased", "cases", rows=(
            (name, _share(entry["refused"]), _share(entry["place"]), _plain(entry["aliased"]),
             str(entry["aliased"]["cases"]))
            for name, entry in {"all": result["unknown"], **result["kinds"]}.items()
        )))  # fmt: skip
        places = result["place_by_method"]
        screen.print(table("not aliased, within one BPM gap", "place", rows=(
            (METHODS[name], _share(places[name])) for name in METHODS if name in places
        )))  # fmt: skip


def _plain(rate: dict[str, Any]) -> str:
    return "-" if rate["share"] is None else f"{rate['share']:.0%} of {rate['cases']}"


def _print_methods(screen: "Console", title: str, methods: dict[str, Any]) -> None:
    if not methods:
        return
    names = [name for name in METHODS if name in methods]
    names += [name for name in methods if name not in METHODS]  # each kind alone
    screen.print(table(title, *(METHODS.get(name, name) for name in names), rows=(
        (key.replace("_", " "), *(_number(methods[n][key]["share"], "{:.1%}") for n in names))
        for key in methods[names[0]]
    )))  # fmt: skip


def _print_sets(screen: "Console", result: dict[str, Any]) -> None:
    coverage, pulls, closed = result["coverage"], result["pulls"], result["clean_gap_closed"]
    screen.print(
        f"credible sets hold the truth in {_share(coverage['holds_truth'])}, stated "
        f"{_number(coverage['mean_stated_mass'], '{:.1%}')}; median "
        f"{_number(coverage['median_elements'])} elements at signal to noise >= 20; no larger than "
        f"the oracle's class in {_share(coverage['no_larger_than_oracle'])}"
    )
    screen.print(
        "one named finding with the element and the recommended action: "
        f"{_share(result['one_action'])} (the exact posterior "
        f"{_plain(result['oracle_one_action'])}), at signal to noise >= 20 "
        f"{_share(result['one_action_above_20'])} "
        f"({_plain(result['oracle_one_action_above_20'])})"
    )
    screen.print(
        f"pulls of {pulls['cases']} amounts: mean {_number(pulls['mean'], '{:+.2f}')}, width "
        f"{_number(pulls['width'], '{:.2f}')} (central 68 %: "
        f"{_number(pulls['robust_width'], '{:.2f}')})"
    )
    screen.print(
        f"error on held-out readings without noise: median {_number(closed['ratio']['median'])} of "
        f"that before; at most 5 % in {_share(closed['within_5_percent'])}, "
        f"{_number(closed['expected_within_5_percent'], '{:.1%}')} expected of the data; with "
        f"noise it is noise, within 99 %, in {_share(closed['as_noise'])}"
    )
    own = result["relative_to_oracle"]["element_first"]
    screen.print(f"element first where the oracle has it first: {_share(own)}")
