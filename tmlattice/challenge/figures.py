"""Metrics of scored cases: rates with their intervals, tables, quantiles."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import stats

from tmlattice.effects import CATALOGUE

BANDS = ((5.0, 10.0), (10.0, 20.0), (20.0, 50.0), (50.0, 100.0001))

RATES = (
    "detected", "place", "element_first", "element_in_three", "element_in_set", "effect_first",
    "effect_in_set", "first", "in_set",
)  # fmt: skip
"""Rates over all cases: an undetected one is not correct."""

PROBABILITIES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)

Row = dict[str, Any]

ALONE = "alone: "
"""Prefix of the answer of one kind of several."""


def rate(flags: Sequence[bool]) -> dict[str, Any]:
    """Return a rate with its 95 % interval (Wilson)."""
    k, n = int(sum(flags)), len(flags)
    if not n:
        return {"share": None, "cases": 0, "interval": None}
    interval = stats.binomtest(k, n).proportion_ci(0.95, "wilson")
    return {"share": k / n, "cases": n, "interval": [float(interval.low), float(interval.high)]}


def summary(rows: Sequence[Row], tier: str) -> dict[str, Any]:
    """Return all metrics of the rows."""
    seconds = [row["seconds"] for row in rows if row["seconds"] is not None]
    out: dict[str, Any] = {
        "seconds": _quantiles(seconds),
        "verdicts": dict(Counter(row["verdict"] for row in rows)),
    }
    if tier == "E":
        # distributed errors are no false alarm if there are some
        alarms = [row["answers"]["tool"]["detected"] if row["small"] else row["verdict"] != "none"
                  for row in rows]  # fmt: skip
        oracle = [answer["detected"] for answer in _answers(rows, "oracle")]
        return out | {"false_alarms": rate(alarms), "oracle_false_alarms": rate(oracle)}
    out["detection"] = detection(rows)
    if tier == "C":
        out["exact"] = _exact(rows)
        out["exact_above_10"] = _exact([row for row in rows if row["weakest"] >= 10])
        out["clean_gap_closed"] = _explained(rows)
        return out
    if tier == "D":
        return out | _unknowns(rows)
    clear = [row for row in rows if (row["signal_to_noise"] or np.inf) >= 10]
    strong = _between(rows, 20)
    out["methods"] = methods(clear)
    out["bands"] = {
        f"{low:g}-{round(high):g}": methods(_between(rows, low, high)) for low, high in BANDS
    }
    out["bands"]["above 20"] = methods(strong)
    effects = [name for name in CATALOGUE if any(_effect(row) == name for row in rows)]
    out["effects"] = {
        name: methods([row for row in clear if _effect(row) == name]) for name in effects
    }
    out["confusion"] = confusion(rows)
    out["calibration"] = calibration(rows)
    out["coverage"] = coverage(clear)
    out["pulls"] = pulls([answer["pull"] for answer in _answers(rows, "tool")])
    out["clean_gap_closed"] = _explained(clear)
    out["clean_gap_closed_above_20"] = _explained(strong)
    for name in ("one_action", "oracle_one_action"):
        out[name] = _known_share(clear, name)
        out[f"{name}_above_20"] = _known_share(strong, name)
    out["false_refusals"] = rate([row["refused"] for row in clear])
    out["more_than_one_finding"] = rate([row["findings"] > 1 for row in clear])
    out["relative_to_oracle"] = _relative(clear)
    out["classes"] = classes(rows)
    if tier == "M":
        out["together"] = together(rows)
    return out


def together(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the rates at which several kinds find what the best single one finds, and what none of
    them finds alone. Found is a first finding within one monitor gap."""
    split: dict[bool, list[bool]] = {True: [], False: []}
    for row in rows:
        answers = row["answers"]
        alone = [a["place"] for name, a in answers.items() if name.startswith(ALONE)]
        split[any(alone)].append(answers["tool"]["place"])
    return {"of_found_alone": rate(split[True]), "of_none_alone": rate(split[False])}


def _between(rows: Sequence[Row], low: float, high: float = np.inf) -> list[Row]:
    """Rows with a signal to noise in this interval."""
    return [row for row in rows if low <= (row["signal_to_noise"] or 0) < high]


def _answers(rows: Sequence[Row], method: str) -> list[dict[str, Any]]:
    """Answers of a method, of the rows that have one."""
    return [row["answers"][method] for row in rows if method in row["answers"]]


def _known_share(rows: Sequence[Row], name: str) -> dict[str, Any]:
    """Rate over the cases in which this flag is known."""
    flags = [row.get(name) for row in rows]
    return rate([flag for flag in flags if flag is not None])


def _exact(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Rate of cases in which all causes were found, by method."""
    found = dict.fromkeys(name for row in rows for name in row["exact"])
    return {n: rate([row["exact"][n] for row in rows if n in row["exact"]]) for n in found}


def _effect(row: Row) -> str | None:
    return row["causes"][0]["effect"] if len(row["causes"]) == 1 else None


def methods(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Return every rate, by method."""
    found = dict.fromkeys(name for row in rows for name in row["answers"])
    return {
        name: {key: rate([answer[key] for answer in _answers(rows, name)]) for key in RATES}
        for name in found
    }


def detection(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the detection rate by signal to noise, of tool and oracle."""
    edges = np.geomspace(5, 100, 8)
    out = []
    for low, high in pairwise(edges.tolist()):
        some = _between(rows, low, high * (1 + 1e-9))
        found = {name: rate([answer["detected"] for answer in _answers(some, name)])
                 for name in ("tool", "oracle")}  # fmt: skip
        out.append({"from": float(low), "to": float(high), **found})
    return out


def confusion(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    """Return true effect -> column -> cases; further columns: ambiguous, unknown, nothing."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        name = _effect(row)
        if name is not None:
            table.setdefault(name, Counter())[row["column"]] += 1
    return {name: dict(table[name]) for name in CATALOGUE if name in table}


def calibration(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return mean stated probability and true share of members of credible sets."""
    both = [pair for row in rows for pair in row["stated"]]
    out = []
    for low, high in pairwise(PROBABILITIES):
        some = [pair for pair in both if low <= pair[0] < (high if high < 1 else 2)]
        mean, true = _mean([p for p, _ in some]), rate([t for _, t in some])
        out.append({"from": low, "to": high, "stated": mean, "true": true})
    return out


def coverage(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the share of credible sets that contain the truth, and their stated mass."""
    named = [answer for answer in _answers(rows, "tool") if answer["mass"]]
    strong = [answer for answer in _answers(_between(rows, 20), "tool") if answer["mass"]]
    oracle = [
        (r["answers"]["tool"]["members"], r["answers"]["oracle"]["members"])
        for r in rows
        if "oracle" in r["answers"] and r["answers"]["tool"]["members"]
    ]
    return {
        "holds_truth": rate([a["in_set"] for a in named]),
        "mean_stated_mass": _mean([a["mass"] for a in named]),
        "median_elements": _quantiles([a["elements"] for a in strong])["median"],
        "median_members": _quantiles([a["members"] for a in strong])["median"],
        "no_larger_than_oracle": rate([tool <= own for tool, own in oracle]),
    }


def classes(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return effects that were not distinguished, by frequency, and the gain of one more shot."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        if row["class"] is not None:
            found.setdefault(tuple(row["class"]["effects"]), []).append(row["class"])
    return [
        {
            "effects": list(effects),
            "cases": len(some),
            "elements": float(np.median([one["elements"] for one in some])),
            "by_setting": _known_share(some, "by_setting"),
            "separation_sigma": _quantiles([one["separation_sigma"] for one in some])["median"],
        }
        for effects, some in sorted(found.items(), key=lambda item: -len(item[1]))
    ]


def pulls(values: Sequence[float | None]) -> dict[str, Any]:
    """Return mean and width of (amount - true) / error; the width also without the outer 5 %."""
    there = np.array([v for v in values if v is not None])
    if len(there) < 2:
        return {"cases": len(there), "mean": None, "width": None, "robust_width": None}
    low, high = np.quantile(there, [0.15865, 0.84135])
    return {
        "cases": len(there),
        "mean": float(there.mean()),
        "width": float(there.std(ddof=1)),
        "robust_width": float(high - low) / 2,
    }


def _explained(rows: Sequence[Row]) -> dict[str, Any]:
    """Rate of visible faults with an error on clean held-out readings of at most 5 % of before.

    An amount known to 1 / (signal to noise) leaves that share of the gap: no method reaches 5 % at
    a signal to noise of 10. `of_the_floor` is the share left in units of that.
    `expected_within_5_percent` is the rate of a least squares fit of the true cause's amount.
    """
    ratios, floors, expected = [], [], []
    for row in rows:
        oracle = row["answers"].get("oracle")
        if row["clean_before"] and (oracle is None or oracle["detected"]):
            ratios.append(row["clean_after"] / row["clean_before"])
            if row["signal_to_noise"]:
                floors.append(ratios[-1] * row["signal_to_noise"])
                expected.append(float(2 * stats.norm.cdf(0.05 * row["signal_to_noise"]) - 1))
    return {
        "within_5_percent": rate([ratio <= 0.05 for ratio in ratios]),
        "within_10_percent": rate([ratio <= 0.10 for ratio in ratios]),
        "expected_within_5_percent": _mean(expected),
        "ratio": _quantiles(ratios),
        "of_the_floor": _quantiles(floors),
        "chi2_per_dof": _quantiles([r["heldout_chi2_per_dof"] for r in rows if r["findings"]]),
        "as_noise": _known_share([r for r in rows if r["findings"]], "heldout_as_noise"),
    }


def _unknowns(rows: Sequence[Row]) -> dict[str, Any]:
    def kind(row: Row) -> str:
        name = str(row["unknown"]["kind"])
        return f"without {row['causes'][0]['effect']}" if name == "taken_out" else name

    def both(some: Sequence[Row]) -> dict[str, Any]:
        clear = [row for row in some if not row.get("aliased", False)]
        return {
            "refused": rate([row["refused"] for row in clear]),
            "place": rate([row["answers"]["tool"].get("place", False) for row in clear]),
            "aliased": rate([bool(row.get("aliased", False)) for row in some]),
        }

    def placed(some: Sequence[Row]) -> dict[str, dict[str, Any]]:
        found = dict.fromkeys(name for row in some for name in row["answers"])
        return {n: rate([own.get("place", False) for own in _answers(some, n)]) for n in found}

    kinds = dict.fromkeys(kind(row) for row in rows)
    return {
        "unknown": both(rows),
        "place_by_method": placed([row for row in rows if not row.get("aliased", False)]),
        "kinds": {name: both([row for row in rows if kind(row) == name]) for name in kinds},
    }


def _relative(rows: Sequence[Row]) -> dict[str, Any]:
    """Rate at which the tool is right first, among cases in which the oracle is."""
    out = {}
    for key in ("element_first", "effect_first", "first"):
        own = [r for r in rows if "oracle" in r["answers"] and r["answers"]["oracle"][key]]
        out[key] = rate([row["answers"]["tool"][key] for row in own])
    return out


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _quantiles(values: Sequence[float | None]) -> dict[str, float | None]:
    there = [v for v in values if v is not None and np.isfinite(v)]
    if not there:
        return {"median": None, "p90": None, "p95": None, "largest": None}
    cuts = np.quantile(there, [0.5, 0.9, 0.95, 1.0])
    return dict(zip(("median", "p90", "p95", "largest"), map(float, cuts), strict=True))
