"""Warnings of other processes: caught there, told here, each once.

>>> result = heard(pool.submit(caught, work, argument).result())
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

Result = TypeVar("Result")


class Caught(NamedTuple):
    """What work made in another process, and the warnings on the way."""

    result: Any
    warnings: tuple[tuple[str, type[Warning]], ...]


def caught(work: Callable[..., Any], *arguments: Any) -> Caught:
    """Do the work, its warnings kept: a worker's standard error reaches nobody for certain."""
    with warnings.catch_warnings(record=True) as told:
        result = work(*arguments)
    return Caught(result, tuple((str(w.message), w.category) for w in told))


_heard: set[str] = set()


def heard(made: Caught) -> Any:
    """The result; its warnings are told here, each once in this process."""
    for text, category in made.warnings:
        if text not in _heard:
            _heard.add(text)
            warnings.warn(text, category, stacklevel=3)
    return made.result
