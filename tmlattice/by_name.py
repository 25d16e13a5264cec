"""All that `load_ring` takes where a ring is taken, a path where a measurement is.

>>> @by_name
... def diagnose(ring, measurement): ...
>>> diagnose("petra3", "day_1")
"""

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

MEASURED = ("measurement", "data", "reference", "heldout")
"""Parameters that are measurements."""


def by_name(function: F) -> F:
    """The function, which takes all that `load_ring` does where it takes a ring, and a path, a
    DataFrame or an xarray Dataset where it takes a measurement (`MEASURED`)."""
    signature = inspect.signature(function)
    wanted = [name for name in ("ring", *MEASURED) if name in signature.parameters]

    @functools.wraps(function)
    def taken(*arguments: Any, **options: Any) -> Any:
        bound = signature.bind_partial(*arguments, **options)
        given = bound.arguments
        for name in wanted:
            value = given.get(name)
            if name == "ring":
                if value is not None:
                    from tmlattice.lattice import load_ring

                    given[name] = load_ring(value)
                continue
            ring = given.get("ring", getattr(given.get("network"), "ring", None))
            if isinstance(value, Mapping) and not is_frame(value):  # a Dataset is a Mapping
                given[name] = {key: _measured(own, ring) for key, own in value.items()}
            else:
                given[name] = _measured(value, ring)
        return function(*bound.args, **bound.kwargs)

    return cast("F", taken)


def _measured(value: Any, ring: Any) -> Any:
    if not (isinstance(value, str | os.PathLike) or is_frame(value)):
        return value
    return import_module("tmlattice.importers.bring_in").measured(value, ring)


def is_frame(value: Any) -> bool:
    """Whether it is a pandas DataFrame, or an xarray Dataset or DataArray."""
    frame = hasattr(value, "columns") and hasattr(value, "reset_index")
    return frame or (hasattr(value, "dims") and hasattr(value, "to_dataframe"))
