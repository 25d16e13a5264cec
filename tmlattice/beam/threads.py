"""Compiled kernels shared among threads.

A kernel takes a range (first, last, ...) of independent blocks, releases the interpreter lock, and
writes to the memory of its blocks alone. The result does not depend on the ranges, and no thread
pool of the compiler is needed: forked and spawned workers, and several callers at once, are safe.
`NUMBA_NUM_THREADS` sets the number of threads.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

from tmlattice.compiled import numba

_pool: ThreadPoolExecutor | None = None


def _forget_pool() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):  # a forked child has no threads: it makes a new pool
    os.register_at_fork(after_in_child=_forget_pool)


def _threads() -> int:
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def share(kernel: Callable[..., None], count: int, *arguments: object) -> None:
    """Call `kernel(first, last, *arguments)` for ranges that cover 0 to count."""
    global _pool
    threads = min(_threads(), count)
    if threads < 2:
        kernel(0, count, *arguments)
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(_threads(), "tmlattice")
    edges = [count * part // threads for part in range(threads + 1)]
    jobs = [_pool.submit(kernel, first, last, *arguments) for first, last in pairwise(edges)]
    for job in jobs:
        job.result()
