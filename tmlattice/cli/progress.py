"""A progress line on a terminal, for every command that works for more than a few seconds.

>>> with shown("tmlattice diagnose", quiet) as line:
...     line.show("noise")      # what is being done
"""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
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

    def show(self, stage: str) -> None:
        """State what is being done."""
        self.stage = stage

    def start(self) -> None:
        """Begin to count; nothing is shown before `AFTER` seconds."""
        self._thread.start()

    def clear(self) -> None:
        """Make room for other output; the line comes back after `AFTER` more seconds."""
        with self._lock:
            self._silent_since = time.monotonic()
            if self._bar is not None:
                self._bar.close()
                self._bar = None

    def close(self) -> None:
        """End; the line is gone."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        self.clear()

    def _run(self) -> None:
        while not self._end.wait(EVERY):
            with self._lock:
                if self._end.is_set() or time.monotonic() - self._silent_since < AFTER:
                    continue
                self._show()

    def _show(self) -> None:
        from tqdm.auto import tqdm

        if tqdm_is_at_work() and self._bar is None:
            return  # the command's own bar
        if self._bar is None:
            self._bar = tqdm(
                total=None, file=sys.stderr, bar_format="{desc}", leave=False, disable=None
            )
        stage = f": {self.stage}" if self.stage else ""
        self._bar.set_description_str(f"{self.name}{stage}, {time.monotonic() - self._begun:.0f} s")


def tqdm_is_at_work() -> bool:
    """Whether some progress bar is shown."""
    from tqdm.auto import tqdm

    return any(not bar.disable for bar in list(getattr(tqdm, "_instances", ())))


_shown: list[Line] = []


@contextmanager
def shown(name: str, quiet: bool = False) -> Iterator[Line]:
    """Show the progress of a command as long as it runs."""
    line = Line(name)
    if not quiet and sys.stderr.isatty():
        line.start()
    _shown.append(line)
    try:
        yield line
    except KeyboardInterrupt:
        stopped_in[:] = [line.stage] * bool(line.stage)
        raise
    finally:
        _shown.remove(line)
        line.close()


stopped_in: list[str] = []
"""The stage in which Ctrl-C came."""


def tell(stage: str) -> None:
    """State what the command is doing."""
    if _shown:
        _shown[-1].show(stage)


def clear() -> None:
    """Make room for output."""
    if _shown:
        _shown[-1].clear()
