"""Correctors that stand elsewhere than in the lattice."""

import json

import numpy as np
import pytest
from shared import small_steps, valid

from tmlattice import diagnose, load_ring
from tmlattice.effects import Cause
from tmlattice.lattice import save_ring
from tmlattice.observe.response_data import response_data, split_columns

BY = 0.2


def moved(ring, folder, name):
    """The ring with a corrector BY metres upstream, in the drift before two monitors."""
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
    return small_steps(ring, seed=1)


@pytest.mark.parametrize(("name", "by", "held"), [("v5", -BY, True), ("v0", BY, False)])
def test_it_is_the_finding_whether_it_was_fitted_or_held_out(
    small_ring, further_up, name, by, held
):
    """BPMs stand between the two places; its step is neither fitted nor used for validation."""
    lattice, machine = small_ring, further_up[name]
    if by > 0:
        lattice, machine = machine, lattice
    measured = measured_with(machine)
    data = response_data(lattice, measured)
    column = measured.correctors.index(name)
    seed = next(
        seed
        for seed in range(99)
        if split_columns(data, 0.2, np.random.default_rng(seed)).held[column] == held
    )
    known = ["quadrupole_gradient", "corrector_calibration"]
    found = diagnose(lattice, measured, seed=seed, effects=known)
    assert not found.response.held[column]
    assert found.verdict == "localised"
    (one,) = found.findings
    where = "down" if by > 0 else "up"
    assert one.words.startswith(f"corrector {name} responds like one 0.2 m {where}stream")
    assert one.elements == (name,)
    assert one.s == lattice[name].s
    if name == "v5":  # the region of v0 goes over the ring's end
        assert one.where[0] < one.s < one.where[1]
    document = valid(found.as_json(), "diagnosis")
    assert document["findings"][0]["to_check"].startswith("Check its position")
    assert f"LOCALISED: {one.words[0].upper()}{one.words[1:]}." in " ".join(found.report().split())
    assert not any("spurious kick" in message for message in found.warnings)
    assert found.steps[-1].heldout_chi2_per_dof < 2
    assert f"steps of misplaced correctors, rejected: {name} (0.2 m" in " ".join(
        document["warnings"]
    )
    assert not any(c.element == name and abs(c.amount) > 0.01 for c in found.causes)


def test_small_errors_beside_it_are_told_too_and_it_takes_nobody_s_place(small_ring, further_up):
    """Its statistic is large; `max_effects` counts what is fitted."""
    causes = [Cause("quadrupole_gradient", "QD::5", 0.03)]
    measured = small_steps(
        further_up["v5"], causes, background={"quadrupole_gradient": 1e-3}, seed=1
    )
    found = diagnose(small_ring, measured, max_effects=1, effects=["quadrupole_gradient"])
    assert found.verdict == "localised"
    assert [own.elements for own in found.findings if own.words] == [("v5",)]
    assert [own.element for own in found.findings if own.effect] == ["QD::5"]
    text = " ".join(found.report().split())
    assert "Distributed errors" in text
    assert "--corrected-out" in text
