"""Correctors that stand elsewhere than in the lattice."""

import json
from dataclasses import replace

import numpy as np

from tmlattice import load_ring
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.dense import one_by_one
from tmlattice.diagnosis.response.displaced import displaced
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


def test_a_corrector_that_stands_elsewhere_is_named_with_its_place(small_ring, tmp_path):
    measured = simulate_response(
        moved(small_ring, tmp_path), kick=1e-5, noise=2e-8, rf_step=-3000.0, engine="ocelot",
        progress=False, seed=1,
    ).measured  # fmt: skip
    data = response_data(small_ring, measured)
    split = split_columns(data, 0.2, np.random.default_rng(1))
    *_, (_, state) = one_by_one(begin(data, split), STEPS[:2])
    (said,) = displaced(state)
    assert "elsewhere than in the lattice: v5 0.2 m upstream" in said
    assert said.count("stands") == 1


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
