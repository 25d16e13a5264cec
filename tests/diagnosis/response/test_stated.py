"""What a prior knows of a number is no measurement of it; remainders have chi-square 1."""

from pathlib import Path

import machine_data
import pytest
from shared import valid

from tmlattice import Cause, diagnose, load_ring
from tmlattice.machine import draw_background
from tmlattice.machine.response import rf_step_of, simulate_response
from tmlattice.report.plain import report_text
from tmlattice.report.tables import error_tables

FAULTY = Cause("quadrupole_gradient", "qp41::0", 0.03)
USUAL = {"quadrupole_gradient": 1e-3, "monitor_gain_x": 0.025, "monitor_gain_y": 0.025,
         "corrector_calibration": 0.04}  # fmt: skip


@pytest.fixture(scope="module")
def causes():
    ring = load_ring(Path(machine_data.__file__).parent / "thomx.m")
    usual = [c for c in draw_background(ring, USUAL, 1) if c.element != FAULTY.element]
    return [*usual, FAULTY]


@pytest.fixture(scope="module")
def found(causes):
    ring = load_ring(Path(machine_data.__file__).parent / "thomx.m")
    measured = simulate_response(
        ring, causes, kick=2e-5, rf_step=0.1 * rf_step_of(ring), noise=4e-7, seed=1, progress=False
    ).measured
    return diagnose(ring, measured, seed=1, effects=list(USUAL))


def test_a_faulty_quadrupole_that_the_data_do_not_determine_is_covered_by_its_error(found):
    amount, sigma = found.error(FAULTY.effect, FAULTY.element)
    support = found.support(FAULTY.effect, FAULTY.element)
    assert abs(amount - FAULTY.amount) < 4 * sigma
    assert support.share_from_data < 0.5
    assert not support.determined
    assert any(name.startswith("qp") for _, name, _ in support.degenerate_with)


def test_what_is_not_determined_is_printed_as_that_and_not_as_a_value(found):
    text = " ".join(report_text(found).split())
    assert "not determined by the data: " in text
    assert f"{FAULTY.element} (degenerate with " in text
    assert f"{FAULTY.element} +" not in text
    assert "(share from the data): " in text
    magnets = next(table for table in error_tables(found) if table.title == "Magnets")
    assert magnets.head[2:5] == ("quadrupole gradient [%]", "error", "from the data [%]")
    (row,) = (row for row in magnets.rows if row[0] == FAULTY.element)
    assert row[2] == ""
    assert float(row[4]) < 50
    assert "degenerate with" in row[-1]


def test_shares_are_beside_every_amount_of_the_json(found):
    document = valid(found.as_json(), "diagnosis")
    shares = {(own["effect"], own["element"]): own["share_from_data"] for own in document["errors"]}
    assert all(0 <= share <= 1 for share in shares.values())
    # monitors' gains are measured by every corrector; a corrector that is held out by none
    gains = [share for (effect, _), share in shares.items() if effect == "monitor_gain_x"]
    assert min(gains) > 0.9
    measured = found.response.measured
    heldout = [n for n, h in zip(measured.correctors, found.response.held, strict=False) if h]
    assert max(shares["corrector_calibration", name] for name in heldout) < 0.1


def test_pulls_of_gradients_are_of_order_one(found, causes):
    true = {(c.effect, c.element): c.amount for c in causes}
    pulls = [
        (cause.amount - true[cause.effect, cause.element]) / sigma
        for cause, sigma in zip(found.causes, found.errors, strict=True)
        if cause.effect == "quadrupole_gradient"
    ]
    assert len(pulls) == 24
    assert max(map(abs, pulls)) < 4


# --- the remainder of a fit of an orbit response against what the fit predicts of the readings ----
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
