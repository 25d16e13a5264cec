"""What an object shows of itself: a line for `repr`, a small table for a notebook."""

from collections.abc import Sequence
from html import escape
from pathlib import PurePath


class Speaks:
    """Shows the title and rows that `_told` returns. Its dataclasses have `repr=False`."""

    def _told(self) -> tuple[str, dict[str, str]]:
        """A title, and what is worth knowing, each with its name."""
        raise NotImplementedError

    def __repr__(self) -> str:
        """In a line."""
        title, rows = self._told()
        shown = ", ".join(f"{name} {text}" for name, text in rows.items() if text)
        return f"<{f'{type(self).__name__} {title}'.rstrip()}: {shown}>"

    def _repr_html_(self) -> str:
        """In a notebook."""
        title, rows = self._told()
        lines = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th>"
            f"<td style='text-align:left'>{escape(text)}</td></tr>"
            for name, text in rows.items()
            if text
        )
        return f"<b>{type(self).__name__} {escape(title)}</b><table>{lines}</table>"


def last_part(name: str) -> str:
    """Of a path; a built-in name as it is."""
    return PurePath(name).name


def counted(number: int, word: str) -> str:
    """`1 shot`, `3 shots`."""
    return f"{number} {word}" + ("" if number == 1 else "s")


def listed(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first names, and how many more there are."""
    more = f"{between.lstrip(',')}and {len(names) - most} more" if len(names) > most else ""
    return between.join(names[:most]) + more


def micrometres(metres: float) -> str:
    """A size in micrometres: one decimal, or two digits of what is below one; nan stays nan."""
    return f"{1e6 * metres:.1f} µm" if metres >= 1e-6 else f"{1e6 * metres:.2g} µm"
