"""Work in child processes, joined to this one by pipes alone: no port is open.

A child imports modules from where this process does, except the working directory. A child that
dies fails its own piece of work and no other.

>>> with Processes(work, 4) as processes:
...     futures = [processes.submit(argument) for argument in arguments]
...     results = [heard(future.result()) for future in futures]
"""

import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import IO, Any, NamedTuple, TypeVar

from tmlattice.errors import TmlatticeError

Result = TypeVar("Result")

ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of a child: the cores are shared out among the processes."""


class WorkerLostError(TmlatticeError):
    """A worker process that ended before its work did."""


class Caught(NamedTuple):
    """What work made in another process, and the warnings on the way."""

    result: Any
    warnings: tuple[tuple[str, type[Warning]], ...]


def caught(work: Callable[..., Any], *arguments: Any) -> Caught:
    """Do the work and keep its warnings, as a worker's standard error may reach no one."""
    with warnings.catch_warnings(record=True) as told:
        result = work(*arguments)
    return Caught(result, tuple((str(w.message), w.category) for w in told))


_heard: set[str] = set()


def heard(made: Caught) -> Any:
    """Return the result and issue its warnings, each once in this process."""
    for text, category in made.warnings:
        if text not in _heard:
            _heard.add(text)
            warnings.warn(text, category, stacklevel=3)
    return made.result


class Processes:
    """Child processes that all do the same work, one thread each; they end with the block.

    Args:
        work: of one argument; can be pickled. What it remembers lasts as long as its process.
        count: processes; each is started when it is first needed.
    """

    def __init__(self, work: Callable[[Any], Any], count: int) -> None:
        self.count = count
        self._work = pickle.dumps(work)
        self._children: list[subprocess.Popen[bytes]] = []
        self._idle: list[subprocess.Popen[bytes]] = []
        self._lock = threading.Lock()
        self._ended = False
        # children inherit the mask: Ctrl-C is for this process, which ends them
        self._threads = ThreadPoolExecutor(
            count, "workers", signal.pthread_sigmask, (signal.SIG_BLOCK, {signal.SIGINT})
        )

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._ended = True
        for child in self._children:
            child.kill()
        self._threads.shutdown(cancel_futures=True)
        for child in self._children:
            child.communicate()

    def submit(self, argument: Any) -> "Future[Caught]":
        """The work's result for an argument, `Caught`; or the work's error, or a
        `WorkerLostError`."""
        return self._threads.submit(self._asked, pickle.dumps(argument))

    def _started(self) -> subprocess.Popen[bytes]:
        path = [place for place in sys.path if place]  # "" is the working directory
        code = f"import sys; sys.path[:] = {path!r}; from tmlattice.workers import serve; serve()"
        with self._lock:
            if self._ended:
                raise WorkerLostError("the work was stopped")
            child = subprocess.Popen(
                [sys.executable, "-P", "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | ONE_THREAD,
            )
            self._children.append(child)
        return child

    def _asked(self, message: bytes) -> Caught:
        said = b""
        try:
            child = self._idle.pop()
            first = False
        except IndexError:
            child, first = self._started(), True
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            if first:
                _send(child.stdin, self._work)
            _send(child.stdin, message)
            said = _received(child.stdout)
        except BrokenPipeError:
            pass
        if not said:
            child.kill()
            raise WorkerLostError(
                f"a worker process was lost ({_end(child.wait())}); fewer processes need less "
                "memory"
            )
        self._idle.append(child)
        done, made = pickle.loads(said)
        if not done:
            raise made
        assert isinstance(made, Caught)
        return made


def _end(code: int) -> str:
    return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


def _send(sink: IO[bytes], message: bytes) -> None:
    sink.write(struct.pack("<q", len(message)))
    sink.write(message)
    sink.flush()


def _received(source: IO[bytes]) -> bytes:
    """A message; nothing where the other side is gone."""
    head = source.read(8)
    size = struct.unpack("<q", head)[0] if len(head) == 8 else 0
    message = source.read(size)
    return message if len(message) == size else b""


def serve() -> None:
    """Do the work that the parent process sends, until it is gone: a child's main loop."""
    threading.Thread(target=_leave_with, args=(os.getppid(),), daemon=True).start()
    source, sink = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    code = _received(source)
    work = None
    while message := _received(source):
        try:
            work = work or pickle.loads(code)
            said = pickle.dumps((True, caught(work, pickle.loads(message))))
        except Exception as error:
            said = _failed(error)
        _send(sink, said)


def _failed(error: Exception) -> bytes:
    try:
        said = pickle.dumps((False, error))
        pickle.loads(said)
    except Exception:  # an error that cannot be sent
        said = pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))
    return said


def _leave_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
