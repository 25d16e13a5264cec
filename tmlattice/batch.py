"""One function over many cases: on local processes or on a cluster, and resumable.

Every case has a JSON file of its own, which appears when the case is done. A second run does what
is missing, and what has failed, again.

>>> files = diagnose("ring.json", Path("shift").iterdir(), "found", jobs=4)
>>> files = diagnose("ring.json", Path("shift").iterdir(), "found", scheduler="tcp://HOST:8786")
"""

import hashlib
import logging
import os
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm.auto import tqdm

from tmlattice.errors import TmlatticeError, missing_package
from tmlattice.files import OutputError, output_file, write_json
from tmlattice.input_files import content_of, json_of
from tmlattice.workers import Caught, Processes, caught, heard

if TYPE_CHECKING:
    from tmlattice.lattice import Ring

log = logging.getLogger(__name__)

MADE_BY = "made_by"
"""Key of a result's fingerprint."""
PATIENCE = 60.0
"""s; a scheduler without workers is given that long to find some."""

Work = Callable[[Any], dict[str, Any]]


def diagnose(
    ring: "Ring | str | Path",
    measurements: Mapping[str, Any] | Iterable[str | Path],
    folder: str | Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
    **options: Any,
) -> dict[str, Path]:
    """Diagnose many measurements of one ring, each by itself, with one result file each.

    What is there already, of the same ring, data, options and version, is not done again. No more
    measurements and results are in memory than the workers need.

    Args:
        ring: the design, a built-in name, or a path.
        measurements: paths of measurement folders or files of readings; or by name, paths or
            measurements. Of a path the last part is the name.
        folder: of the results: NAME.json, as `Diagnosis.as_json` makes it.
        jobs, scheduler, progress: see `run_batch`.
        options: of `tmlattice.diagnose`.

    Returns:
        The result files by name. That of a measurement that cannot be diagnosed holds "error".

    Raises:
        LatticeError: no such ring.
        OutputError: the folder cannot be written.
        TmlatticeError: two measurements of one name, no scheduler answers, or Dask is not
            installed.
    """
    from tmlattice.importers.bring_in import measured
    from tmlattice.lattice import Ring, load_ring
    from tmlattice.lattice.load import contents
    from tmlattice.version import __version__

    design = ring if isinstance(ring, Ring) else load_ring(ring)
    place = Path(folder)
    named: dict[str, Any]
    if isinstance(measurements, Mapping):
        named = dict(measurements)
    else:
        paths = [Path(path) for path in measurements]
        named = {path.resolve().name: path for path in paths}
        if len(named) < len(paths):
            raise TmlatticeError("two of the measurements have one name; give them by name")
    of_all = (__version__, contents(design), pickle.dumps(options))

    def load(given: Any) -> Any:
        return measured(given, design) if isinstance(given, str | os.PathLike) else given

    def mark(given: Any) -> str:
        if not isinstance(given, str | os.PathLike):
            return fingerprint(*of_all, pickle.dumps(given))
        path = Path(given)
        return fingerprint(*of_all, *(sorted(path.iterdir()) if path.is_dir() else [path]))

    done = run_batch(
        partial(_diagnosed, design, options),
        {name: partial(load, given) for name, given in named.items()},
        place,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
        made_by={name: mark(given) for name, given in named.items()},
        keep=("error",),
    )
    return {name: place / f"{name}.json" for name in done}


def _diagnosed(ring: "Ring", options: dict[str, Any], measurement: Any) -> dict[str, Any]:
    from tmlattice.diagnosis import diagnose as run

    return run(ring, measurement, **options).as_json()


def finished(folder: Path, keep: Iterable[str] | None = None) -> dict[str, dict[str, Any]]:
    """The results that are there, by case; failed ones have a key "error".

    Args:
        keep: keys to keep of each; None: all.
    """
    results = {}
    for path in sorted(folder.glob("*.json")):
        try:
            result = json_of(path, TmlatticeError)
        except TmlatticeError:
            result = None  # another program's, or cut off: done again
        if isinstance(result, dict):
            results[path.stem] = _kept(result, keep)
        else:
            log.warning("%s is no result; it is left aside", path)
    return results


def run_batch(
    work: Work,
    cases: Mapping[str, Callable[[], Any]],
    folder: Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
    made_by: Mapping[str, str] | None = None,
    keep: Iterable[str] | None = None,
) -> dict[str, dict[str, Any]]:
    """The result of every case.

    Args:
        work: takes what a case needs and returns its result; importable by other processes.
        cases: by name, which is the file's: a function that loads what the case needs. It is
            called here, shortly before the case runs: the workers need no files of ours.
        jobs: local processes, one thread each; 1: this process; None: one a core.
        scheduler: address of a Dask scheduler, instead of local processes.
        progress: show a bar where there is a terminal.
        made_by: what each result depends on, see `fingerprint`; one that depends on anything else
            is done again.
        keep: keys of the results that are returned, for many large ones; None: all.

    Returns:
        By case, with "made_by" where that is given; a failed one has only "error" and "seconds".

    Raises:
        OutputError: the folder cannot be written.
        TmlatticeError: no scheduler answers, or Dask is not installed.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write to '{folder}': {error.strerror or error}") from error
    marks = made_by or {}
    some = None if keep is None else (*keep, "error", MADE_BY)
    there = {n: r for n, r in finished(folder, some).items() if n in cases and "error" not in r}
    done = {n: r for n, r in there.items() if n not in marks or r.get(MADE_BY) == marks[n]}
    if len(done) < len(there):
        log.warning("%d results are of other data or options; done again", len(there) - len(done))
    todo = [name for name in cases if name not in done]
    bar = tqdm(total=len(cases), initial=len(done), unit="case", disable=None if progress else True)
    with bar:
        for name, result in _results(work, cases, todo, jobs, scheduler):
            if name in marks and "error" not in result:
                result = {**result, MADE_BY: marks[name]}  # noqa: PLW2901
            with output_file(folder / f"{name}.json") as path:
                write_json(path, result)
            done[name] = _kept(result, some)
            bar.update()
    return {name: done[name] for name in cases}


def _kept(result: dict[str, Any], keep: Iterable[str] | None) -> dict[str, Any]:
    return result if keep is None else {key: result[key] for key in keep if key in result}


def _results(
    work: Work,
    cases: Mapping[str, Callable[[], Any]],
    todo: list[str],
    jobs: int | None,
    scheduler: str | None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    count = min(jobs or os.cpu_count() or 1, max(len(todo), 1))
    if not todo:
        return
    if scheduler is None and count == 1:
        for name in todo:
            yield name, _loaded(work, cases[name])
        return
    work = partial(guarded, work)
    with _cluster(work, scheduler) if scheduler else Processes(work, count) as workers:
        waiting = iter(todo)
        running: dict[Future[Caught], str] = {}
        failed: dict[str, dict[str, Any]] = {}

        def feed() -> None:
            for name in waiting:
                try:
                    argument = cases[name]()
                except Exception as error:
                    failed[name] = _error(error, 0.0)
                    continue
                running[workers.submit(argument)] = name
                return

        for _ in range(2 * workers.count):  # no more in flight than the workers need
            feed()
        while running:
            done, _ = wait(running, 1.0, FIRST_COMPLETED)
            if isinstance(workers, _Cluster):
                workers.check()
            for future in done:
                name = running.pop(future)
                try:
                    result = heard(future.result())
                except Exception as error:  # the worker itself was lost
                    result = _error(error, 0.0)
                feed()
                yield name, result
        yield from failed.items()


def fingerprint(*parts: object) -> str:
    """Of everything that a result depends on: values by their repr, regular files by their
    content."""
    digest = hashlib.sha256()
    for part in parts:
        content = repr(part).encode()
        if isinstance(part, Path):
            try:
                content = content_of(part, TmlatticeError)
            except TmlatticeError:
                content = b"absent"
        digest.update(b"%d:" % len(content) + content)
    return digest.hexdigest()[:32]


def guarded(work: Work, argument: Any) -> dict[str, Any]:
    """The result, or what went wrong: one failed case does not stop the rest."""
    begun = time.perf_counter()
    try:
        return work(argument)
    except Exception as error:
        log.info("a case failed", exc_info=True)
        return _error(error, time.perf_counter() - begun)


def _loaded(work: Work, load: Callable[[], Any]) -> dict[str, Any]:
    try:
        argument = load()
    except Exception as error:
        return _error(error, 0.0)
    return guarded(work, argument)


def _error(error: Exception, seconds: float) -> dict[str, Any]:
    return {"error": f"{type(error).__name__}: {error}", "seconds": seconds}


class _Cluster:
    """The workers of a Dask scheduler, used as `Processes`."""

    def __init__(self, client: Any, work: Work, address: str) -> None:
        self.count = sum(client.nthreads().values())
        self._client, self._work, self._address = client, work, address
        self._executor = client.get_executor(pure=False)
        self._seen = time.monotonic()

    def submit(self, argument: Any) -> "Future[Caught]":
        """As `Processes.submit`."""
        future: Future[Caught] = self._executor.submit(caught, self._work, argument)
        return future

    def check(self) -> None:
        """See to it that somebody is at work; TmlatticeError: the scheduler is gone, or there has
        been no worker for long."""
        if self._client.status != "running":
            raise TmlatticeError(
                f"the Dask scheduler at '{self._address}' is gone; start it and run this again: "
                "finished cases are kept"
            )
        now = time.monotonic()
        if self._client.scheduler_info()["workers"]:
            self._seen = now
        if now - self._seen > PATIENCE:
            raise TmlatticeError(
                f"all workers are gone, and none came back in {PATIENCE:.0f} s; start some and run "
                "this again: finished cases are kept"
            )


@contextmanager
def _cluster(work: Work, address: str) -> Iterator[_Cluster]:
    """The workers of the scheduler at an address."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        instead = "without it, local processes do the work"
        raise missing_package(error, "a Dask scheduler needs", "dask", instead) from error
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # the error is one sentence of ours
    try:
        client = Client(address, timeout=PATIENCE / 3)
    except (OSError, ValueError, TimeoutError) as error:
        raise TmlatticeError(
            f"no Dask scheduler answers at '{address}'; start one with `dask scheduler`, or "
            "leave the address out"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as error:
            raise TmlatticeError(
                f"the Dask scheduler at '{address}' has no worker; start one with `dask "
                f"worker {address}`"
            ) from error
        yield _Cluster(client, work, address)
