"""The experiment of `tune_fit` over many magnets: one chosen case says little about a method."""

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from tmlattice.errors import TmlatticeError, UnstableRingError
from tmlattice.fitting.experiment import tune_fit
from tmlattice.lattice import Element, Ring, load_ring

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """One magnet, fitted by one method.

    Attributes:
        magnet: name.
        s: of its middle, m.
        method: the regularization.
        true_tunes: of the perturbed ring, [2], or None where it is unstable.
        absolute_error, relative_error: of the tunes, [2], or None where there is no prediction.
        orbit_rms: before and after, m.
        problem: what went wrong, or None.
    """

    magnet: str
    s: float
    method: str
    true_tunes: Array | None
    absolute_error: Array | None
    relative_error: Array | None
    orbit_rms: tuple[float, float] | None
    problem: str | None


def spread_magnets(ring: Ring, number: int) -> list[Element]:
    """`number` powered quadrupoles, evenly spread in beam order; all, where there are fewer.

    Raises:
        TmlatticeError: the ring has none.
    """
    powered = [e for e in ring.magnets if e.kind == "quadrupole" and e.k1 != 0]
    if not powered:
        raise TmlatticeError(f"'{ring.name}' has no powered quadrupole to study")
    number = min(number, len(powered))
    return [powered[int((i + 0.5) * len(powered) / number)] for i in range(number)]


_ring: Ring | None = None


def _start_worker(lattice: str, sequence: str | None, energy: float | None) -> None:
    global _ring
    _ring = load_ring(lattice, sequence, energy)


def _run_case(magnet: str, method: str, options: dict[str, Any]) -> Case:
    assert _ring is not None
    s = _ring[magnet].s
    try:
        found = tune_fit(_ring, magnet, progress=False, regularization=method, **options)
    except UnstableRingError:
        return Case(magnet, s, method, None, None, None, None, "the perturbed ring is unstable")
    except TmlatticeError as error:
        return Case(magnet, s, method, None, None, None, None, str(error))
    return Case(
        magnet, s, method, found.true_tunes, found.absolute_error, found.relative_error,
        found.orbit_rms, found.problem,
    )  # fmt: skip


def study_tune_fit(
    lattice: str,
    methods: Sequence[str] = ("symplectic", "none", "l1", "l2"),
    magnets: int = 40,
    workers: int | None = None,
    sequence: str | None = None,
    energy: float | None = None,
    progress: bool = True,
    **options: Any,
) -> Iterator[Case]:
    """Run `tune_fit` on magnets spread over the ring, by each regularization, case by case.

    Args:
        lattice: name or path; every worker loads it for itself.
        methods: regularizations.
        magnets: how many powered quadrupoles.
        workers: processes; else one a core.
        sequence, energy: see `load_ring`.
        progress: show a bar where there is a terminal.
        options: of `tune_fit` and `fine_tune`.

    Yields:
        Cases as they end. A case that fails says why and does not stop the rest.
    """
    names = [e.name for e in spread_magnets(load_ring(lattice, sequence, energy), magnets)]
    jobs = [(name, method) for name in names for method in methods]
    threads = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = "1"  # the workers inherit it: one core each
    pool = ProcessPoolExecutor(
        min(workers or os.cpu_count() or 1, len(jobs)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(lattice, sequence, energy),
    )
    try:
        running = [pool.submit(_run_case, *job, options) for job in jobs]
        done = as_completed(running)
        for future in tqdm(done, "cases", len(jobs), disable=None if progress else True):
            yield future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        if threads is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = threads


def summarise(cases: Sequence[Case]) -> dict[str, Any]:
    """Median, 95th percentile and worst tune error of each method.

    Returns:
        {"methods": {name: {"abs_dq": {"x": {"median", "p95", "worst"}, "y"}, "rel_dq", "orbit_rms"
        (median after, m), "predicted", "failed"}}, "cases", "unstable"}; "unstable" counts
        magnets whose perturbed ring has no tune.
    """
    methods: dict[str, Any] = {}
    unstable = {c.magnet for c in cases if c.true_tunes is None and "unstable" in str(c.problem)}
    for name in dict.fromkeys(case.method for case in cases):
        mine = [c for c in cases if c.method == name and c.magnet not in unstable]
        good = [c for c in mine if c.absolute_error is not None]
        entry: dict[str, Any] = {"predicted": len(good), "failed": len(mine) - len(good)}
        for key, attribute in (("abs_dq", "absolute_error"), ("rel_dq", "relative_error")):
            errors = np.array([getattr(c, attribute) for c in good]).reshape(-1, 2)
            entry[key] = {plane: _spread(errors[:, i]) for i, plane in enumerate("xy")}
        after = [c.orbit_rms[1] for c in good if c.orbit_rms]
        entry["orbit_rms"] = float(np.median(after)) if after else None
        methods[name] = entry
    return {
        "methods": methods,
        "cases": len({c.magnet for c in cases}),
        "unstable": len(unstable),
    }


def _spread(errors: Array) -> dict[str, float | None]:
    if not len(errors):
        return {"median": None, "p95": None, "worst": None}
    return {
        "median": float(np.median(errors)),
        "p95": float(np.percentile(errors, 95)),
        "worst": float(errors.max()),
    }
