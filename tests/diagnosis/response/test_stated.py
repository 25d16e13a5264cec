"""What a prior knows of a number is no measurement of it: ThomX, where single magnets are weak."""

import json
from importlib.resources import files
from pathlib import Path

import jsonschema
import machine_data
import pytest

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
    document = json.loads(json.dumps(found.as_json()))
    schema = json.loads(files("tmlattice").joinpath("schemas/diagnosis.schema.json").read_text())
    jsonschema.validate(document, schema)
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
