"""Correctors that stand elsewhere than in the lattice."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tmlattice import diagnose, load_ring
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.dense import one_by_one
from tmlattice.diagnosis.response.displaced import displaced, in_words
from tmlattice.diagnosis.response.odd_steps import odd_in_the_end
from tmlattice.diagnosis.response.state import begin
from tmlattice.effects import Cause
from tmlattice.lattice.json_file import save_ring
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import response_data
from tmlattice.observe.split import split_columns

UPSTREAM = 0.2


def moved(ring, folder):
    """The ring with v5 that many metres further up, in the drift before the monitors before it."""
    path = folder / "moved.json"
    save_ring(ring, path)
    content = json.loads(path.read_text())
    sequence, defined = content["sequence"], content["definitions"]
    i = sequence.index("v5")
    assert sequence[i - 3 : i] == ["d", "end_4", "bpm"]
    whole = defined["d"]["parameters"]["l"]
    for name, length in (("before", whole - UPSTREAM), ("after", UPSTREAM)):
        defined[name] = defined["d"] | {"parameters": {"l": length}}
    sequence[i - 3 : i + 1] = ["before", "v5", "after", "end_4", "bpm"]
    path.write_text(json.dumps(content))
    return load_ring(path)


@pytest.fixture(scope="module")
def measured(small_ring, tmp_path_factory):
    return simulate_response(
        moved(small_ring, tmp_path_factory.mktemp("moved")), kick=1e-5, noise=2e-8, rf_step=-3000.0,
        engine="ocelot", progress=False, seed=1,
    ).measured  # fmt: skip


def test_a_corrector_that_stands_elsewhere_is_seen_where_it_stands(small_ring, measured):
    data = response_data(small_ring, measured)
    split = split_columns(data, 0.2, np.random.default_rng(1))
    *_, (_, state) = one_by_one(begin(data, split), STEPS[:2])
    (found,) = displaced(state)
    assert data.measured.correctors[found.column] == "v5"
    assert found.by == pytest.approx(-UPSTREAM, abs=0.01)  # a drift, thin kicks; the fit's bends
    assert found.gain > 1e4
    (said,) = in_words(state, [found])
    assert "elsewhere than in the lattice: v5 0.2 m upstream" in said
    wide = replace(state, split=replace(split, inner=data.plane == 1))
    own = [one.misplaced for one in odd_in_the_end(wide)]
    assert not any(own) or own[0][0].column == found.column


@pytest.mark.parametrize("seed", [0, 2])
def test_it_is_the_finding_and_spoils_nobody_s_figure(small_ring, measured, seed):
    """Fitted, or held out. A monitor stands between the two places: as a jump in its place the
    corrector had left more than another kick elsewhere would, and was told as a supply that
    jumps."""
    found = diagnose(small_ring, measured, seed=seed)
    assert found.verdict == "located"
    (one,) = found.findings
    assert one.words.startswith("corrector v5 answers as if it stood 0.2 m upstream")
    place = small_ring["v5"].s
    assert one.where[0] < place - UPSTREAM < place < one.where[1]
    assert found.as_json()["findings"][0]["to_check"].startswith("Check its place")
    assert f"LOCATED: {one.words[0].upper()}{one.words[1:]}." in " ".join(found.report().split())
    assert any("left out: v5 0.2 m" in said for said in found.warnings)
    assert not any("kicked the beam" in said for said in found.warnings)
    assert found.steps[-1].heldout_chi2_per_dof < 1.5
    assert "corrector_calibration" not in {
        cause.effect for cause in found.causes if cause.element == "v5" and abs(cause.amount) > 0.01
    }


def test_nothing_is_said_of_correctors_that_stand_where_they_should(small_ring):
    """Not of a wrong calibration, nor of wrong readings, though these leave most by far."""
    measured = simulate_response(
        small_ring, [Cause("corrector_calibration", "v7", 0.1)], kick=1e-5, noise=2e-8,
        rf_step=-3000.0, engine="ocelot", progress=False, seed=1,
    ).measured  # fmt: skip
    response = measured.response.copy()
    response[measured.correctors.index("v5"), ::6, 1] *= 1.5
    data = response_data(small_ring, replace(measured, response=response))
    split = split_columns(data, 0.2, np.random.default_rng(1))
    assert displaced(begin(data, split)) == []
