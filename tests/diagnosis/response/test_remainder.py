"""The remainder of a fit of an orbit response against what the fit predicts of the readings."""

import pytest

from tmlattice import diagnose
from tmlattice.machine.response import simulate_response

SMALL = {"quadrupole_gradient": 2e-3, "monitor_gain_x": 0.02, "monitor_gain_y": 0.02,
         "corrector_calibration": 0.04}  # fmt: skip


@pytest.fixture(scope="module")
def remainders(small_ring):
    """Blocks of three machines whose errors are all of families that are fitted."""
    found = []
    for seed in (1, 2, 3):
        data = simulate_response(
            small_ring, background=SMALL, engine="ocelot", progress=False, seed=seed
        ).measured
        found.append(diagnose(small_ring, data, effects=list(SMALL)).compared)
    return found


@pytest.mark.parametrize("name", ["fitted, in-plane", "held-out, in-plane", "held-out, RF"])
def test_chi_square_per_degree_of_freedom_is_one(remainders, name):
    """In all about 1100, 300 and 50 degrees of freedom: 1 within four standard errors."""
    own = [block for blocks in remainders for block in blocks if block.name == name]
    chi2, freedom = sum(block.chi2 for block in own), sum(block.freedom for block in own)
    assert chi2 / freedom == pytest.approx(1, abs=4 * (2 / freedom) ** 0.5)


def test_fitted_numbers_are_no_degrees_of_freedom(remainders):
    for blocks in remainders:
        fitted = next(block for block in blocks if block.name == "fitted, in-plane")
        readings = 14 * 35
        assert 0.5 * readings < fitted.freedom < readings - 30
