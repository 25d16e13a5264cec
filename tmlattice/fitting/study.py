"""The experiment of `tune_fit` over the whole ring: one magnet is not representative.

Cases run on local processes or on a Dask cluster (`tmlattice.batch`); each is written to a
folder as it ends, so a study that was stopped goes on where it was.
"""

import dataclasses
import hashlib
import json
import os
import zlib
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tmlattice.arrays import Array, pair, rms
from tmlattice.batch import fingerprint, run_batch
from tmlattice.diagnosis.records import decoded
from tmlattice.errors import TmlatticeError, UnstableRingError
from tmlattice.files import output_file, write_json
from tmlattice.fitting.experiment import (
    DEFAULT_LAUNCH,
    first_turn_of,
    fit_and_track,
    perturbed_ring,
)
from tmlattice.fitting.outcome import errors
from tmlattice.input_files import json_of
from tmlattice.lattice import Ring, load_ring
from tmlattice.lattice.checks import need_monitors
from tmlattice.lattice.load import contents
from tmlattice.maps import ring_matrix
from tmlattice.network import TaylorNetwork
from tmlattice.optics import Optics, matrix_tunes, one_turn_optics

Pair = tuple[float, float]

METHODS = ("adam", "adam-none", "adam-l1", "adam-l2", "map", "sparse", "known")
"""Adam with the symplectic penalty, without, with l1, with l2; `map`; `sparse`; and `sparse` given
the changed magnets, the best possible."""

UNSTABLE = "the perturbed ring is unstable"

NETWORK = ("network of the design",)
"""Key of it in a ring's memory."""
NEW_AMPLITUDE = 5.0
"""Amplitude of the new launches of the prediction over that of the fitted launch."""


@dataclass(frozen=True)
class Case:
    """One fault, fitted by one method.

    Attributes:
        s: of the magnet's middle, m.
        true_tunes: of the perturbed ring, or None if it is unstable.
        absolute_error, relative_error: of the tunes, or None without a prediction.
        tune_sigma: stated standard error of the tunes, or None if the method has none.
        orbit_rms: residual before and after, m.
        prediction_rms: error of the fitted network on new launches of five times the amplitude,
            against readings without noise, m.
        found: magnets that the method identifies, or None if it identifies none.
        problem: error message, or None.
    """

    magnet: str
    s: float
    method: str
    seed: int
    true_tunes: Pair | None = None
    absolute_error: Pair | None = None
    relative_error: Pair | None = None
    tune_sigma: Pair | None = None
    orbit_rms: Pair | None = None
    prediction_rms: float | None = None
    found: tuple[str, ...] | None = None
    seconds: float | None = None
    problem: str | None = None

    @property
    def right(self) -> bool | None:
        """Whether the changed magnet alone is identified."""
        return None if self.found is None else self.found == (self.magnet,)


def spread_magnets(ring: Ring, number: int | None = None) -> list[str]:
    """Return `number` powered quadrupoles, evenly in beam order; None, or more: all;
    TmlatticeError: the ring has none."""
    powered = [e.name for e in ring.magnets if e.kind == "quadrupole" and e.k1 != 0]
    if not powered:
        raise TmlatticeError(f"'{ring.name}' has no powered quadrupole to study")
    number = len(powered) if number is None else min(number, len(powered))
    return [powered[int((i + 0.5) * len(powered) / number)] for i in range(number)]


def turned_launches(optics: Optics, launch: Array, phases: Array) -> Array:
    """Return the launch [n] turned by phases [shot, 2], in rad, on its ellipses, [shot, n]."""
    launches = np.tile(launch, (len(phases), 1))
    turned = optics.normalised(launch) * np.exp(1j * phases)
    launches[:, :4] = optics.closed_orbit[:4] + np.real(turned @ optics.modes.T)
    return launches


def run_case(
    ring: Ring,
    magnet: str,
    method: str,
    *,
    change: float = -0.2,
    launch: Sequence[float] = DEFAULT_LAUNCH,
    shots: int = 1,
    noise: float = 2e-5,
    turns: int = 500,
    seed: int = 0,
    **recipe: Any,
) -> Case:
    """Return one case; a failed fit has its error message in the case.

    Args:
        launch: of the first shot; the others are the same turned by pi / shots each, in both
            planes.
        noise: rms of one reading, m.
    """
    empty = Case(ring[magnet].name, ring[magnet].s, method, seed)
    machine = perturbed_ring(ring, magnet, change)
    try:
        true = matrix_tunes(ring_matrix(machine))
    except UnstableRingError:
        return dataclasses.replace(empty, problem=UNSTABLE)
    design = ring.remembered(NETWORK, lambda: TaylorNetwork.from_ring(ring))
    optics = one_turn_optics(design)
    start = np.asarray(launch, dtype=float)
    phases = np.pi * np.arange(shots)[:, None] / shots * np.ones(2)
    launches = turned_launches(optics, start, phases)
    # independent noise for each magnet, so that the cases are independent
    generator = np.random.default_rng([seed, zlib.crc32(empty.magnet.encode())])
    measurement = first_turn_of(machine, launches, noise, generator)
    known = dataclasses.replace(empty, true_tunes=pair(true))
    kind, _, regularization = method.partition("-")
    options: dict[str, Any] = {"candidates": [magnet]} if kind == "known" else {}
    if kind == "adam":
        options = {**recipe, "regularization": regularization or "symplectic"}
    try:
        found = fit_and_track(kind, design, measurement, turns, progress=False, **options)
    except TmlatticeError as error:
        return dataclasses.replace(known, problem=str(error))
    if found.fit is None or found.tunes is None:
        return dataclasses.replace(known, problem=found.problem)
    fit = found.fit
    absolute, relative = errors(found.tunes, true)
    assert absolute is not None
    assert relative is not None
    new = turned_launches(optics, NEW_AMPLITUDE * start, 2 * np.pi * np.random.default_rng(
        [seed, 1]).random((4, 2)))  # fmt: skip
    try:
        miss = TaylorNetwork.from_ring(machine).readings(new) - fit.network.readings(new)
        prediction = rms(miss)
    except TmlatticeError:
        prediction = None  # lost at five times the amplitude in one of them
    before = rms(measurement.readings[:, 0] - design.readings(launches))
    return dataclasses.replace(
        known,
        absolute_error=pair(absolute),
        relative_error=pair(relative),
        tune_sigma=None if fit.tune_sigma is None else pair(fit.tune_sigma),
        orbit_rms=(before, found.rms),
        prediction_rms=prediction,
        found=tuple(fit.changes) if method in ("sparse", "known") else None,
        seconds=fit.seconds,
    )


@cache
def _ring(lattice: str) -> Ring:
    return load_ring(lattice)


def _work(task: tuple[str, tuple[str, str], dict[str, Any]]) -> dict[str, Any]:
    """A worker's task: plain data in and out, the ring loaded once."""
    lattice, job, options = task
    return dataclasses.asdict(run_case(_ring(lattice), *job, **options))


def _name_of(job: tuple[str, str]) -> str:
    """File name of a case, without characters of magnets' names that files may not have."""
    return hashlib.sha256("\0".join(map(str, job)).encode()).hexdigest()[:16]


def _open_folder(folder: Path, identity: dict[str, Any]) -> None:
    """Make the folder of a study, or check that it is this study's; TmlatticeError: it contains the
    cases of another study, or cannot be written."""
    stated = folder / "options.json"
    text = json.loads(json.dumps(identity))
    if stated.exists():
        try:
            there = json_of(stated, TmlatticeError)
        except TmlatticeError as error:
            raise TmlatticeError(
                f"'{stated}' is damaged ({error}); name another folder with --out, or remove it"
            ) from error
        if there != text:
            raise TmlatticeError(
                f"'{folder}' contains a study with other options; name another folder with --out"
            )
        return
    try:
        (folder / "cases").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TmlatticeError(
            f"cannot write to '{folder}': {error.strerror or error}; choose another place"
        ) from error
    with output_file(stated) as path:
        write_json(path, text)


def _case(job: tuple[str, str], values: dict[str, Any]) -> Case:
    if "error" in values:  # the code, or the worker, failed
        return Case(job[0], float("nan"), job[1], 0, problem=values["error"])
    case: Case = decoded(Case, values)
    return case


def study_tune_fit(
    lattice: str | os.PathLike[str],
    methods: Sequence[str] = ("adam", "map", "sparse"),
    magnets: int | None = 40,
    *,
    scheduler: str | None = None,
    jobs: int | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **options: Any,
) -> list[Case]:
    """Change quadrupole after quadrupole, measure, fine-tune by each method, compare with the
    truth.

    Args:
        lattice: name or path; every worker loads it.
        magnets: number of magnets, evenly spread; None: all.
        scheduler: address of a Dask scheduler; None: local processes.
        jobs: local processes; 1: this one; else one a core.
        folder: where every case is written as it ends, and read from when the study goes on.
        options: of `run_case`.

    Returns:
        The cases. A failed one has its error message; one whose worker failed is tried again when
        the study is resumed.

    Raises:
        TmlatticeError: an unknown method, another study's folder, or no scheduler.
    """
    from tmlattice import __version__

    unknown = [m for m in methods if m not in METHODS]
    if unknown or not methods:
        raise TmlatticeError(f"no method '{', '.join(unknown)}'; there are {', '.join(METHODS)}")
    lattice = os.fspath(lattice)
    folder = None if folder is None else Path(folder)
    ring = load_ring(lattice)
    need_monitors(ring)
    tasks = [(n, m) for n in spread_magnets(ring, magnets) for m in dict.fromkeys(methods)]
    made_from = (__version__, contents(ring), sorted(options.items(), key=str))
    with nullcontext() if folder is not None else TemporaryDirectory() as temporary:
        if folder is not None:
            _open_folder(folder, {"lattice": lattice, **options})
        results = run_batch(
            _work,
            {_name_of(job): partial(tuple, (lattice, job, options)) for job in tasks},
            folder / "cases" if folder is not None else Path(str(temporary)),
            jobs=jobs,
            scheduler=scheduler,
            progress=progress,
            made_by=dict.fromkeys(map(_name_of, tasks), fingerprint(*made_from)),
        )
    return [_case(job, results[_name_of(job)]) for job in tasks]


def summarise(cases: Sequence[Case]) -> dict[str, Any]:
    """Return median, 95th percentile and worst tune error of each method, and other metrics.

    Returns:
        {"methods": {name: {"abs_dq": {"x": {"median", "p95", "worst"}, "y"}, "rel_dq", "orbit_rms"
        (median after, m), "prediction_rms" {"median", "p95", "worst"} (m), "right" (fraction of
        cases with exactly the right magnets, or null), "coverage" ({"x", "y"}: fraction of cases
        within the stated 95 % error, or null), "stated" (standard errors of the tunes, as "abs_dq";
        those of "known" are the Cramer-Rao bound, the readings' information on a known magnet),
        "seconds" (median), "predicted", "failed"}},
        "cases", "unstable"}; "unstable" counts magnets whose perturbed ring has no tune.
    """
    methods: dict[str, Any] = {}
    unstable = {c.magnet for c in cases if c.problem == UNSTABLE}
    for name in dict.fromkeys(case.method for case in cases):
        mine = [c for c in cases if c.method == name and c.magnet not in unstable]
        good = [c for c in mine if c.absolute_error is not None]
        entry: dict[str, Any] = {"predicted": len(good), "failed": len(mine) - len(good)}
        for key, attribute in (("abs_dq", "absolute_error"), ("rel_dq", "relative_error")):
            errors = np.array([getattr(c, attribute) for c in good]).reshape(-1, 2)
            entry[key] = {plane: _spread(errors[:, i]) for i, plane in enumerate("xy")}
        after = [c.orbit_rms[1] for c in good if c.orbit_rms]
        entry["orbit_rms"] = float(np.median(after)) if after else None
        entry["prediction_rms"] = _spread(
            np.array([c.prediction_rms for c in good if c.prediction_rms is not None])
        )
        named = [c.right for c in mine if c.right is not None]
        entry["right"] = sum(named) / len(mine) if named else None
        stated = [(c.absolute_error, c.tune_sigma) for c in good if c.tune_sigma is not None]
        sigmas = np.array([sigma for _, sigma in stated]).reshape(-1, 2)
        entry["stated"] = {plane: _spread(sigmas[:, i]) for i, plane in enumerate("xy")}
        entry["coverage"] = {
            plane: float(np.mean([e[i] <= 1.96 * s[i] for e, s in stated if e is not None]))
            if stated
            else None
            for i, plane in enumerate("xy")
        }
        times = [c.seconds for c in good if c.seconds is not None]
        entry["seconds"] = float(np.median(times)) if times else None
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
