"""Rings that many tests share, loaded once."""

import os
import sys
import tempfile
from pathlib import Path
from unittest import mock

os.environ.setdefault("MPLBACKEND", "Agg")
if "PYTEST_XDIST_WORKER" in os.environ:  # one of several processes: a thread each, one cache
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is imported
else:
    _kept = tempfile.TemporaryDirectory(prefix="tmlattice-tests-")
    os.environ["TMLATTICE_CACHE"] = _kept.name  # not the user's own

import numpy as np
import pytest
from shared import SHORT

LONGEST = "scenarios data_checks correction diagnosis cli readme report_page turns_amplitude"


def pytest_collection_modifyitems(items):
    """The files that take longest first: processes end at the same time."""
    first = [f"test_{name}.py" for name in LONGEST.split()]
    items.sort(key=lambda item: first.index(name) if (name := item.path.name) in first else 99)


SMALL = Path(__file__).parent / "lattices" / "small_ring.py"


@pytest.fixture(scope="session")
def small_ring():
    from tmlattice import load_ring

    return load_ring(SMALL)


@pytest.fixture(scope="session")
def short_ring(tmp_path_factory):
    """Six elements, for what takes a time for each."""
    from tmlattice import load_ring

    path = tmp_path_factory.mktemp("short") / "short.py"
    path.write_text(SHORT)
    return load_ring(path)


@pytest.fixture(scope="session")
def ring_kicking_x():
    """The small ring whose correctors v0 to v15 kick in x where an expression of i holds."""
    from tests.scenarios import ring_of

    def ring(which):
        other = f'(Hcor if {which} else Vcor)(eid=f"v{{i}}")'
        return ring_of("small", (('Vcor(eid=f"v{i}")', other),))

    return ring


@pytest.fixture(scope="session")
def small_network(small_ring):
    from tmlattice import TaylorNetwork

    return TaylorNetwork.from_ring(small_ring)


@pytest.fixture(scope="session")
def petra3():
    from tmlattice import load_ring

    return load_ring("petra3")


@pytest.fixture(scope="session")
def petra3_network(petra3):
    from tmlattice import TaylorNetwork

    return TaylorNetwork.from_ring(petra3)


@pytest.fixture(scope="module")
def forked_readers():
    """Binary files are read by copies of this process, which have the libraries already."""
    import h5py  # noqa: F401
    import scipy.io  # noqa: F401
    import turn_by_turn  # noqa: F401

    sys.path.append(str(Path(__file__).parent / "fuzz"))
    from contract import forked

    with mock.patch("tmlattice.lattice.mat_file.subprocess.run", forked):
        yield


@pytest.fixture
def rng():
    return np.random.default_rng(20260)
