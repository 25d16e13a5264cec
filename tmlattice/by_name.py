"""All that `load_ring` takes where a ring is taken, a path where a measurement is.

>>> @by_name
... def diagnose(ring, measurement): ...
>>> diagnose("petra3", "day_1")
"""

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

from tmlattice.late import Method

F = TypeVar("F", bound=Callable[..., Any])

MEASURED = ("measurement", "data", "reference")
"""Parameters that are measurements."""

_open = Method("tmlattice.importers.speaking", "measured", "A measurement by its path.")


def by_name(function: F) -> F:
    """The function, which takes all that `load_ring` does where it takes a ring, and a path where
    it takes a measurement: `ring`, `measurement`, `data`, `reference`."""
    signature = inspect.signature(function)
    more = "options" in signature.parameters
    wanted = [name for name in ("ring", *MEASURED) if more or name in signature.parameters]

    @functools.wraps(function)
    def taken(*arguments: Any, **options: Any) -> Any:
        bound = signature.bind_partial(*arguments, **options)
        given = bound.arguments
        for name in wanted:
            given_to = given if name in given else given.get("options", {})
            value = given_to.get(name)
            ring = given.get("ring", given.get("options", {}).get("ring"))
            if name == "ring":
                if value is not None:
                    given_to[name] = _ring(value)
            elif _is_path(value):
                given_to[name] = _open.function(value, ring)
            elif isinstance(value, Mapping):
                given_to[name] = {
                    key: _open.function(own, ring) if _is_path(own) else own
                    for key, own in value.items()
                }
        return function(*bound.args, **bound.kwargs)

    return cast("F", taken)


def _is_path(value: Any) -> bool:
    return isinstance(value, str | os.PathLike)


def _ring(lattice: Any) -> Any:
    from tmlattice.lattice import load_ring

    return load_ring(lattice)
