"""A progress line on a terminal, for every command that works for more than a few seconds."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

AFTER = 3.0
"""s without output after which the line is shown."""
EVERY = 0.5
"""s between two updates."""


class Line:
    """What a command is doing, and for how long: a line on a terminal's stderr, else nothing."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.stage = ""
        self._begun = self._silent_since = time.monotonic()
        self._bar: Any = None
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> None:
        if sys.stderr.isatty():
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        self.clear()

    def clear(self) -> None:
        """Make room for other output; the line comes back after `AFTER` more seconds."""
        with self._lock:
            self._silent_since = time.monotonic()
            if self._bar is not None:
                self._bar.close()
                self._bar = None

    def _run(self) -> None:
        while not self._end.wait(EVERY):
            with self._lock:
                if not self._end.is_set() and time.monotonic() - self._silent_since >= AFTER:
                    self._show()

    def _show(self) -> None:
        from tqdm.auto import tqdm

        if self._bar is None:
            if any(not bar.disable for bar in list(getattr(tqdm, "_instances", ()))):
                return  # the command's own bar
            self._bar = tqdm(
                total=None, file=sys.stderr, bar_format="{desc}", leave=False, disable=None
            )
        stage = f": {self.stage}" if self.stage else ""
        self._bar.set_description_str(f"{self.name}{stage}, {time.monotonic() - self._begun:.0f} s")


_shown: list[Line] = []
stopped_in: list[str] = []
"""The stage in which Ctrl-C came."""


@contextmanager
def shown(name: str, quiet: bool = False) -> Iterator[None]:
    """Show the progress of a command as long as it runs."""
    line = Line(name)
    _shown.append(line)
    try:
        with nullcontext() if quiet else line:
            yield
    except KeyboardInterrupt:
        stopped_in[:] = [line.stage] * bool(line.stage)
        raise
    finally:
        _shown.remove(line)


def tell(stage: str) -> None:
    """State what the command is doing."""
    if _shown:
        _shown[-1].stage = stage


def clear() -> None:
    """Make room for output."""
    if _shown:
        _shown[-1].clear()
