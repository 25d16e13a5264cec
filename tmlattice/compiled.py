"""How kernels are compiled, and where what numba made of them is kept: it is code.

It lies next to the package's own files. If those cannot be written, it lies in the cache folder
(`tmlattice.cache`), or in the folder that `NUMBA_CACHE_DIR` names, if that folder belongs to this
user and no one else can write to it.

>>> @jit
... def kernel(first, last, values): ...
"""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from tmlattice.cache import own_folder, private_or_warn

_PACKAGE = Path(__file__).parent


def _place() -> str:
    """The cache folder that is passed to numba; "": the one of the package's files, or none."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return chosen if private_or_warn(Path(chosen), "NUMBA_CACHE_DIR") else ""
    return "" if os.access(_PACKAGE, os.W_OK) else str(own_folder("numba") or "")


# set, so that numba does not take them from a .numba_config.yaml in the working directory
os.environ["NUMBA_CACHE_DIR"] = _place()
os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", "")
_KEPT = bool(os.environ["NUMBA_CACHE_DIR"]) or os.access(_PACKAGE, os.W_OK)

import numba  # noqa: E402

__all__ = ["jit", "jit_sums", "keep", "numba"]


def keep(kernel: Any) -> Any:
    """Keep what numba makes of a kernel from one process to the next, where there is a place."""
    with suppress(RuntimeError):  # nowhere to write
        if _KEPT:
            kernel.enable_caching()
    return kernel


def _compiled(function: Callable[..., Any], *fast: str) -> Any:
    options: Any = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", *fast}}
    return keep(numba.njit(**options)(function))


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel that releases the interpreter's lock."""
    return _compiled(function)


def jit_sums(function: Callable[..., Any]) -> Any:
    """As `jit`; the terms of a sum may be added in another order."""
    return _compiled(function, "reassoc")
