"""Lines of lines, elements by their positions, and which line of a file is the ring."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from tmlattice.errors import LatticeError, plain, unknown_name

T = TypeVar("T")

Items = list[tuple[int, bool, Any]]
"""Of a line: how often, reversed, and a name or the items of a bracket."""

MOST_ELEMENTS = 1_000_000
DEEPEST = 50
"""Brackets within brackets; lines within lines may be twice as deep."""
_ITEM = re.compile(
    r"(-?)\s*(?:(\d+)\s*\*)?\s*(-?)\s*(\(.*\)|\"[^\"]*\"|'[^']*'|[^\s()*\",=]+)", re.DOTALL
)


def items_of(
    text: str, split: Callable[[str], list[str]], name: Callable[[str], str], depth: int = 0
) -> Items:
    """The items of `(a, 2*b, -(c, d))`.

    Args:
        text: with its brackets.
        split: of the language: a text at its separators outside brackets.
        name: of the language: what a word stands for.
        depth: of brackets.

    Raises:
        LatticeError: it is no line.
    """
    bare = text.strip()
    if depth > DEEPEST:
        raise LatticeError(f"a line has more than {DEEPEST} nested brackets")
    if bare[:1] == "(":
        if bare[-1:] != ")":
            raise LatticeError("a bracket is left open; close it")
        bare = bare[1:-1]
    items: Items = []
    for item in filter(None, split(bare)):
        match = _ITEM.fullmatch(item)
        if match is None:
            raise LatticeError(f"'{plain(item, 60)}' is no item of a line")
        times, what = int(match[2] or 1), match[4]
        if times > MOST_ELEMENTS:
            raise LatticeError(f"a line is repeated {times} times: no ring is as long")
        inner = items_of(what, split, name, depth + 1) if what[0] == "(" else name(what)
        items.append((times, bool(match[1]) != bool(match[3]), inner))
    return items


def inner_names(items: Items) -> set[str]:
    """All names in a line's items."""
    found: set[str] = set()
    for _, _, what in items:
        found |= inner_names(what) if isinstance(what, list) else {what}
    return found


def laid_out(
    items: Items, lines: Mapping[str, Items], found: Callable[[str], str] = str
) -> list[tuple[str, bool]]:
    """Elements in beam order, each with whether it is reversed.

    Args:
        items: of the line.
        lines: the items of all lines.
        found: the name of an element or a line as it is defined.

    Raises:
        LatticeError: a line that contains itself, or more elements than any ring.
    """
    _count(items, lines, found, {}, 0)
    return _names(items, lines, found, False)


def _count(
    items: Items,
    lines: Mapping[str, Items],
    found: Callable[[str], str],
    known: dict[str, int],
    depth: int,
) -> int:
    """Elements, counted before they are laid out."""
    if depth > 2 * DEEPEST:
        raise LatticeError("a line contains itself")
    total = 0
    for times, _, what in items:
        own = 1
        if isinstance(what, list):
            own = _count(what, lines, found, known, depth + 1)
        elif (name := found(what)) in lines:
            if name not in known:
                known[name] = _count(lines[name], lines, found, known, depth + 1)
            own = known[name]
        total += times * own
        if total > MOST_ELEMENTS:
            raise LatticeError("its line has more elements than any ring")
    return total


def _names(
    items: Items, lines: Mapping[str, Items], found: Callable[[str], str], backwards: bool
) -> list[tuple[str, bool]]:
    names: list[tuple[str, bool]] = []
    for times, turned, what in reversed(items) if backwards else items:
        way = turned != backwards
        if isinstance(what, list):
            own = _names(what, lines, found, way)
        elif (name := found(what)) in lines:
            own = _names(lines[name], lines, found, way)
        else:
            own = [(name, way)]
        names += times * own
    return names


def with_gaps(
    placed: Iterable[tuple[T, str, float, float]],
    whole: str,
    end: float | None,
    rounding: float,
    least: float,
) -> list[T | float]:
    """Return elements in beam order, and between them the lengths of gaps, m.

    Args:
        placed: each element with its name, start and length, m, by rising position.
        whole: name of the sequence.
        end: of the whole, m; None: that of the last element.
        rounding: overlap that positions may have, m.
        least: a gap that is not larger is none, m.

    Raises:
        LatticeError: elements that overlap.
    """
    laid: list[T | float] = []
    at, last = 0.0, "the start"

    def gap(to: float, begins: str) -> None:
        if to - at < -rounding:
            raise LatticeError(
                f"in {whole} {begins} at {to:.6f} m, before the end of {last} at {at:.6f} m; "
                "correct the positions or lengths"
            )
        if abs(to - at) > least:
            laid.append(round(to - at, 12))

    for item, name, start, length in placed:
        named = f"'{plain(name, 60)}'"
        gap(start, f"{named} begins")
        laid.append(item)
        at, last = start + length, named
    if end is not None:
        gap(end, "its length ends")
    return laid


def chosen(
    path: Path, names: Sequence[str], wanted: str | None, used: str = "", inside: Sequence[str] = ()
) -> str:
    """Of the sequences and lines of a file the one that is the ring.

    Args:
        path: of the file, for messages.
        names: of all.
        wanted: by the caller.
        used: by the file.
        inside: those that are part of another.

    Raises:
        LatticeError: none, an unknown one, or several without a choice.
    """
    if not names:
        raise LatticeError(f"'{path}' has no SEQUENCE and no LINE; give a file with one")
    known = {name.casefold(): name for name in names}
    if wanted:
        if wanted.casefold() not in known:
            raise unknown_name(f"sequence in '{path}' named", wanted, names)
        return known[wanted.casefold()]
    if used:
        if used.casefold() not in known:
            raise LatticeError(
                f"USE of '{path}' names {plain(used, 60)}, which no sequence or line is"
            )
        return known[used.casefold()]
    if "ring" in known:
        return known["ring"]
    part_of = {name.casefold() for name in inside}
    outermost = [name for name in names if name.casefold() not in part_of] or list(names)
    if len(outermost) > 1:
        raise LatticeError(
            f"'{path}' has the sequences {', '.join(outermost)}; name one with sequence="
        )
    return outermost[0]
