"""Correctors that stand elsewhere than in the lattice."""

import json
from dataclasses import replace
from importlib.resources import files

import jsonschema
import numpy as np
import pytest

from tmlattice import diagnose, load_ring
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.misplaced import misplaced, moved_text
from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.response.stepwise import one_by_one
from tmlattice.effects import Cause
from tmlattice.lattice import save_ring
from tmlattice.machine.response import simulate_response
from tmlattice.observe.response_data import response_data
from tmlattice.observe.split import split_columns

BY = 0.2


def moved(ring, folder, name):
    """The ring with a corrector that many metres further up, in the drift before the monitors
    before it; that of v0 ends the ring."""
    path = folder / f"{name}.json"
    save_ring(ring, path)
    content = json.loads(path.read_text())
    sequence, defined = content["sequence"], content["definitions"]
    i = sequence.index(name)
    up = next(k for k in range(1, 9) if sequence[i - k] == "d")
    assert up == 3  # two monitors
    for own, length in (("before", defined["d"]["parameters"]["l"] - BY), ("after", BY)):
        defined[own] = defined["d"] | {"parameters": {"l": length}}
    places = [[own] for own in sequence]
    places[i] = []
    places[i - up] = ["before", name, "after"]
    content["sequence"] = [own for place in places for own in place]
    path.write_text(json.dumps(content))
    return load_ring(path)


@pytest.fixture(scope="module")
def further_up(small_ring, tmp_path_factory):
    return {name: moved(small_ring, tmp_path_factory.mktemp(name), name) for name in ("v5", "v0")}


def measured_with(ring):
    return simulate_response(
        ring, kick=1e-5, noise=2e-8, rf_step=-3000.0, engine="ocelot", progress=False, seed=1
    ).measured


@pytest.mark.parametrize(("name", "by"), [("v5", -BY), ("v5", BY), ("v0", -BY), ("v0", BY)])
def test_a_corrector_that_stands_elsewhere_is_seen_where_it_stands(
    small_ring, further_up, name, by
):
    """Monitors between the two places, and the lattice's first place."""
    lattice, machine = small_ring, further_up[name]
    if by > 0:
        lattice, machine = machine, lattice
    data = response_data(lattice, measured_with(machine))
    split = split_columns(data, 0.2, np.random.default_rng(1))
    *_, (_, state) = one_by_one(begin(data, split), STEPS[:2])
    (found,) = misplaced(state)
    assert found.name == data.measured.correctors[found.column] == name
    assert found.by == pytest.approx(by, abs=0.01)  # beside noise of 2e-8 m in orbits of 1e-6
    assert found.gain > 1e4
    assert moved_text(found).startswith(f"0.2 m {'down' if by > 0 else 'up'}stream (")


@pytest.mark.parametrize("held", [False, True])
def test_it_is_the_finding_whether_it_was_fitted_or_held_out(small_ring, further_up, held):
    """As a jump in its place the corrector had left more than another kick elsewhere would, at the
    monitor between, and was told as a supply that jumps. Held out it stays a judge."""
    measured = measured_with(further_up["v5"])
    data = response_data(small_ring, measured)
    v5 = measured.correctors.index("v5")
    seed = next(
        seed
        for seed in range(99)
        if split_columns(data, 0.2, np.random.default_rng(seed)).held[v5] == held
    )
    found = diagnose(small_ring, measured, seed=seed)
    assert found.response.held[v5] == held
    assert found.verdict == "localised"
    (one,) = found.findings
    assert one.words.startswith("corrector v5 responds like one 0.2 m upstream")
    assert one.elements == ("v5",)
    assert one.s == small_ring["v5"].s
    assert one.where[0] < one.s < one.where[1]
    document = found.as_json()
    schema = json.loads((files("tmlattice") / "schemas" / "diagnosis.schema.json").read_text())
    jsonschema.validate(json.loads(json.dumps(document)), schema)
    assert document["findings"][0]["to_check"].startswith("Check its position")
    assert f"LOCALISED: {one.words[0].upper()}{one.words[1:]}." in " ".join(found.report().split())
    assert not any("spurious kick" in said for said in found.warnings)
    assert (found.steps[-1].heldout_chi2_per_dof > 10) == held
    assert not any(c.element == "v5" and abs(c.amount) > 0.01 for c in found.causes)


def test_small_errors_beside_it_are_told_too_and_it_takes_nobody_s_place(small_ring, further_up):
    """Its statistic is large; `max_effects` counts what is fitted."""
    causes = [Cause("quadrupole_gradient", "QD::5", 0.03)]
    measured = simulate_response(
        further_up["v5"], causes, background={"quadrupole_gradient": 1e-3}, kick=1e-5, noise=2e-8,
        rf_step=-3000.0, engine="ocelot", progress=False, seed=1,
    ).measured  # fmt: skip
    found = diagnose(small_ring, measured, max_effects=1)
    assert found.verdict == "localised"
    assert [own.elements for own in found.findings if own.words] == [("v5",)]
    assert [own.element for own in found.findings if own.effect] == ["QD::5"]
    text = " ".join(found.report().split())
    assert "Distributed errors" in text
    assert "--corrected-out" in text


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
    assert misplaced(begin(data, split)) == []
