"""Gradients of combined-function magnets in a response's fit; the machine is AT."""

from dataclasses import replace

import numpy as np
import pytest
from shared import parted, small_steps

from tmlattice.diagnosis.families.fields import BendGradient, EdgeFocusing
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.hierarchical import fit_families
from tmlattice.diagnosis.response.state import allow
from tmlattice.diagnosis.response.stated import fitted_causes
from tmlattice.effects import Cause
from tmlattice.lattice.slices import stem
from tmlattice.machine.response import simulate_response
from tmlattice.observe.response_data import response_data

GRADIENT = -0.05
WRONG = {"QD::5": 0.003, "QF::9": -0.003, "QF::3": 0.002, "QD::12": 0.003}
TRIALS = [
    trial
    for trial in STEPS
    if {family.name for family in trial}
    & {"corrector_calibration", "quadrupole_gradient", "bend_gradient"}
]


@pytest.fixture(scope="module")
def combined(small_ring):
    """The small ring with a gradient in every bend."""
    elements = tuple(e.changed(k1=GRADIENT) if e.kind == "bend" else e for e in small_ring.elements)
    return replace(small_ring, elements=elements)


@pytest.fixture(scope="module")
def bent(combined):
    """Its data, with gradients of bends and quadrupoles that are wrong; the bends, and by what."""
    rng = np.random.default_rng(20260)
    bends = [e.name for e in combined.elements if e.kind == "bend"]
    wrong = 0.02 + 1e-3 * rng.standard_normal(len(bends))  # all, and a scatter that nobody fits
    causes = [
        *(Cause("bend_gradient", n, GRADIENT * w) for n, w in zip(bends, wrong, strict=True)),
        *(Cause("quadrupole_gradient", name, amount) for name, amount in WRONG.items()),
    ]
    measured = small_steps(combined, causes, engine="at")
    return parted(combined, measured, 1), bends, wrong


def test_gradients_of_bends_are_found(bent):
    """ESRF-EBS: 96 of its magnets had none to fit; they were made up for."""
    parts, bends, wrong = bent
    fit = fit_families(*parts, TRIALS)
    assert "bend_gradient" in [own.effect for own in fit.families if own.kept]
    assert all(error > 0 for _, error in fitted_causes(fit.state)[0])
    found = {(c.effect, c.element): c.amount for c, _ in fitted_causes(fit.state)[0]}
    mean = np.mean([found["bend_gradient", name] for name in bends]) / GRADIENT
    left = [
        amount - WRONG.get(name, 0.0)
        for (effect, name), amount in found.items()
        if effect == "quadrupole_gradient"
    ]
    assert abs(mean - np.mean(wrong)) < 1e-3
    assert np.std(left) < 2e-4


def test_errors_know_that_a_family_that_was_left_out_may_be_there(bent):
    """ALS: which family is left out hangs on the seed, and the others make up for it."""
    trials = [trial for trial in TRIALS if trial[0].name != "bend_gradient"]
    state = fit_families(*bent[0], trials).state

    def pull(state):
        """rms over the quadrupoles, which make up for one number together: a single pull."""
        left = [
            (cause.amount - WRONG.get(cause.element, 0.0)) / error
            for cause, error in fitted_causes(state)[0]
            if cause.effect == "quadrupole_gradient"
        ]
        return np.sqrt(np.mean(np.square(left)))

    assert pull(state) > 4
    tried = replace(state, unneeded=(BendGradient(),))
    assert pull(tried) < 2
    assert not allow(tried, [BendGradient()]).unneeded


def test_a_family_that_the_ring_has_no_places_of_is_not_told(small_ring):
    """Its bends have no gradient."""
    causes = [Cause("quadrupole_gradient", name, amount) for name, amount in WRONG.items()]
    fit = fit_families(*parted(small_ring, small_steps(small_ring, causes), 1), TRIALS)
    assert not any(own.effect == "bend_gradient" for own in fit.families)


def test_the_scale_of_edges_is_that_of_a_rectangular_magnet(small_ring):
    """Two edges of half the angle, each of h tan(edge); a wiggler's poles have theirs too."""
    data = response_data(small_ring, simulate_response(small_ring, [], engine="ocelot").measured)
    bends = [e for e in small_ring.elements if e.kind == "bend"]
    expected = {stem(e.name): 2 * e.angle / e.length * np.tan(e.angle / 2) for e in bends}
    other_way = {e.name for e in bends[::2]}
    poles = tuple(
        e.changed(angle=-e.angle) if e.name in other_way else e for e in small_ring.elements
    )
    for ring in (small_ring, replace(small_ring, elements=poles)):
        (group,) = EdgeFocusing().groups(replace(data, ring=ring))
        assert np.allclose(np.diag(group.basis), list(expected.values()), rtol=0.01)
        assert group.most == 1.0
