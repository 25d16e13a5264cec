"""Compiled kernels shared among threads.

A kernel takes a range (first, last, ...) of independent blocks, releases the interpreter lock, and
writes to the memory of its blocks alone. The result does not depend on the ranges, and no thread
pool of the compiler is needed: forked and spawned workers, and several callers at once, are safe.
`NUMBA_NUM_THREADS` sets the number of threads.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

from tmlattice.compiled import numba


@cache
def pool(threads: int) -> ThreadPoolExecutor:
    """Return the process's pool of this many threads."""
    return ThreadPoolExecutor(threads, "tmlattice")


if hasattr(os, "register_at_fork"):  # a forked child has no threads: it makes a new pool
    os.register_at_fork(after_in_child=pool.cache_clear)


def share(kernel: Callable[..., None], count: int, *arguments: object) -> None:
    """Call `kernel(first, last, *arguments)` for ranges that cover 0 to count."""
    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    threads = min(most, count)
    if threads < 2:
        kernel(0, count, *arguments)
        return
    edges = [count * part // threads for part in range(threads + 1)]
    jobs = [pool(most).submit(kernel, first, last, *arguments) for first, last in pairwise(edges)]
    for job in jobs:
        job.result()
