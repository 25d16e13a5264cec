"""The metrics of a challenge: the diagnosis compared with the oracle and simple baselines."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from tmlattice.batch import finished, run_batch
from tmlattice.beam.model import Model
from tmlattice.challenge.baselines import baselines
from tmlattice.challenge.case import (
    Case,
    Truth,
    case_names,
    check_contents,
    check_lattice,
    read_case,
    read_set,
    read_truth,
    ring_of,
    trusted_case,
)
from tmlattice.challenge.figures import ALONE, Row, summary
from tmlattice.challenge.oracle import dead_monitors, evaluate
from tmlattice.challenge.record import (
    ALIASED,
    REFUSED,
    Places,
    baseline_answer,
    column,
    exact,
    finding_row,
    one_action,
    oracle_answer,
    oracle_one_action,
    stated,
)
from tmlattice.effects import Cause, find
from tmlattice.errors import TmlatticeError, plain
from tmlattice.inference.validation import held_out_gap, predicted
from tmlattice.lattice import Ring
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns

log = logging.getLogger(__name__)

FORMAT = "tmlattice-challenge"


def score(
    folder: Path,
    *,
    oracle: bool = True,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
    lattice: str | None = None,
) -> dict[str, Any]:
    """Return all metrics of a challenge, in the format `tmlattice-challenge`.

    Args:
        oracle: with oracle and baselines, which take some seconds a case the first time.
        lattice: the challenge's, if it is trusted Python code, see `check_lattice`.

    Raises:
        TmlatticeError: no results.
    """
    from tmlattice import __version__

    described = read_set(folder)
    check_lattice(folder / "challenge.json", described["lattice"], lattice)
    check_contents(folder, described)
    results = finished(folder / "results")
    names = [name for name in case_names(folder) if name in results]
    if not names:
        raise TmlatticeError(f"'{folder}' has no results; `tmlattice dev challenge run` makes them")
    failed, truths = dict[str, str](), dict[str, Truth]()
    for name in names:
        try:
            truths[name] = read_truth(folder, name)
            if truths[name].tier != described["tier"]:
                raise TmlatticeError(f"its truth is of tier {truths.pop(name).tier}")
        except TmlatticeError as error:
            failed[name] = str(error)
    if not truths:
        raise TmlatticeError(failed[names[0]])
    others = sorted(set(case_names(folder)) - set(names))
    names = list(truths)
    evaluated, guessed = dict[str, dict[str, Any]](), dict[str, dict[str, Any]]()
    if oracle:
        where: dict[str, Any] = {"jobs": jobs, "scheduler": scheduler, "progress": progress}
        cases = {name: partial(trusted_case, folder, name, lattice) for name in truths}
        both = {
            name: partial(lambda load, truth: (load(), truth), cases[name], truth)
            for name, truth in truths.items()
        }
        evaluated = run_batch(evaluate, both, folder / "oracle", **where)
        if described["tier"] != "E":  # they always find something
            guessed = run_batch(baselines, cases, folder / "baselines", **where)
    ring = ring_of(described["lattice"])
    places = Places(ring)
    rows = []
    for name in names:
        if "error" in results[name]:
            continue
        try:
            row = row_of(
                results[name], truths[name], evaluated.get(name), guessed.get(name), places
            )
            row |= clean_gap(ring, partial(read_case, folder, name), truths[name], results[name])
            summary([row], described["tier"])  # invalid values spoil no other case
        except (
            ArithmeticError, LookupError, TypeError, ValueError, AttributeError, TmlatticeError
        ) as error:  # fmt: skip
            log.info("case %s", name, exc_info=True)
            failed[name] = f"its result cannot be scored ({plain(str(error), 100)}); run it again"
            continue
        rows.append(row)
    failed |= {n: str(results[n]["error"]) for n in names if "error" in results[n]}
    failed |= {f"oracle {n}": r["error"] for n, r in evaluated.items() if "error" in r}
    failed |= {f"baselines {n}": r["error"] for n, r in guessed.items() if "error" in r}
    return {
        "format": FORMAT,
        "version": 2,
        "package": __version__,
        **{key: described[key] for key in ("tier", "lattice", "reference", "shots", "amount")},
        **({"measured_kinds": described["kinds"]} if "kinds" in described else {}),
        "cases": len(names),
        "failed": failed,
        "not_run": others,
        **summary(rows, described["tier"]),
        "rows": rows,
    }


# --- a case ---------------------------------------------------------------------------------------
def row_of(
    result: Mapping[str, Any],
    truth: Truth,
    evaluated: Mapping[str, Any] | None,
    guessed: Mapping[str, Any] | None,
    places: Places,
) -> Row:
    """Return one case: the truth, and the answers of diagnosis, oracle and baselines."""
    causes, unknown = truth.causes, truth.unknown
    snr = truth.total if len(truth.signal_to_noise) != 1 else truth.signal_to_noise[0]
    row: Row = {
        "case": truth.name,
        "causes": [vars(cause) for cause in causes],
        "unknown": None if unknown is None else dict(unknown),
        "signal_to_noise": snr if np.isfinite(snr) else None,
        "verdict": result["verdict"],
        "findings": len(result["findings"]),
        "seconds": result.get("seconds"),
        "explained": result["gap"]["explained"],
        "heldout_chi2_per_dof": _after(result),
        "heldout_as_noise": _as_noise(result),
        "stated": stated(result, causes),
        "class": _class(result),
        "refused": _refused(result),
        "small": bool(truth.background),
    }
    answers: dict[str, Mapping[str, Any]] = {"tool": result}
    answers |= {f"{ALONE}{kind}": one for kind, one in result.get("alone", {}).items()}
    if truth.alone:
        row["alone"] = dict(truth.alone)
    if evaluated is not None and "error" not in evaluated:
        for ranking, name in (("class", "oracle"), ("posterior", "bayes_oracle")):
            answers[name] = oracle_answer(evaluated, ranking)
        row["residual"] = evaluated["residual"]
        if unknown is not None and evaluated["residual"] is not None:
            row["aliased"] = bool(evaluated["residual"] < ALIASED)
    if guessed is not None and "error" not in guessed:
        for name, guesses in guessed.items():
            if name != "seconds":
                # of several causes they are given the number
                separate = len(causes) if len(causes) > 1 else None
                answers[name] = baseline_answer(guesses, separate)
    row["answers"] = {name: _answer(answer, truth, places) for name, answer in answers.items()}
    if len(causes) == 1:
        row["column"] = column(result, causes[0])
        row["one_action"] = one_action(result, causes[0], places.ring)
        if evaluated is not None and "error" not in evaluated:
            row["oracle_one_action"] = oracle_one_action(evaluated, causes[0], places.ring)
    if len(causes) > 1 and truth.tier == "C":
        visible = [cause for cause in causes if find(cause.effect).modelled]
        row["exact"] = {
            name: exact(answer, visible if name.endswith("oracle") else causes)
            for name, answer in answers.items()
        }
        row["weakest"] = float(np.nanmin([np.inf, *truth.signal_to_noise]))
    return row


def _answer(answer: Mapping[str, Any], truth: Truth, places: Places) -> Row:
    findings = list(answer["findings"])
    first = findings[0] if findings else None
    small = bool(answer.get("priors"))  # distributed errors are no fault
    row: Row = {"detected": bool(findings) or (answer["verdict"] == "distributed" and not small)}
    if len(truth.causes) == 1:
        return row | finding_row(first, truth.causes[0], places)
    if truth.unknown is not None and truth.unknown.get("element"):
        at = [] if first is None else places.of(first["element"], first["s"])
        row["place"] = places.near(truth.unknown["element"], at)
    return row


def _refused(result: Mapping[str, Any]) -> bool:
    """Whether a fault outside the catalogue is reported."""
    unnamed = any(finding["effect"] is None for finding in result["findings"])
    if result.get("priors") and not result["findings"]:
        return False
    return result["verdict"] in REFUSED or unnamed


def _after(result: Mapping[str, Any]) -> float | None:
    heldout = result["gap"]["heldout"]
    return None if heldout is None else heldout["after"]["chi2_per_dof"]


def _as_noise(result: Mapping[str, Any]) -> bool | None:
    """Whether the held-out misfit of the scored readings is within its 99 % interval."""
    left = _after(result)
    if left is None or not np.isfinite(left) or not result["gap"]["heldout"]["shots"]:
        return None
    freedom = result["gap"]["heldout"]["readings"]
    low, high = stats.chi2.interval(0.99, freedom)
    return bool(low <= left * freedom <= high)


def _class(result: Mapping[str, Any]) -> Row | None:
    """Equivalent explanations of a single finding: effects, number of elements, and the proposed
    next shot: whether it changes a setting, and its separation."""
    if len(result["findings"]) != 1 or len(result["findings"][0]["credible_set"]) < 2:
        return None
    members = result["findings"][0]["credible_set"]
    shot = result["next_measurement"]
    return {
        "effects": sorted({member["effect"] for member in members}),
        "elements": len({member["element"] for member in members}),
        "by_setting": None if shot is None else bool(shot["settings"]),
        "separation_sigma": None if shot is None else shot["separation_sigma"],
    }


def clean_gap(
    ring: Ring, load: Callable[[], Case], truth: Truth, result: Mapping[str, Any]
) -> dict[str, float | None]:
    """Return the rms error on held-out readings without noise, of design and with findings, m.

    In each shot the launch is fitted to one half of the monitors, the other half is scored. None
    of kinds: they have no readings without noise, and tables of turns take long to read.
    """
    if truth.background or not truth.clean or not (truth.causes or truth.unknown):
        return {"clean_before": None, "clean_after": None}
    case = load()
    findings = [f for f in result["findings"] if f["effect"] is not None]
    causes = [
        Cause(f["effect"], f["element"], f["amount"])
        for f in findings
        if find(f["effect"]).modelled
    ]
    data = of_measurement(ring, case.heldout)
    clean = np.nan_to_num(truth.clean["heldout"])
    dropped = np.zeros(data.valid.shape, dtype=bool)
    dropped[:, dead_monitors(case, truth)] = True
    data = type(data)(**{**vars(data), "readings": clean}).without(dropped)
    design = FirstTurns(model=Model(ring, data.settings), data=data, places={})
    found = replace(design, fixed=tuple(causes))
    gap = held_out_gap([predicted(problem)[0] for problem in (design, found)])
    return {"clean_before": gap.misfits[0].rms, "clean_after": gap.misfits[-1].rms}
