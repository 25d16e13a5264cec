"""The RF's orbit as other readings predict it, against fits that never had the reading."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shared import gradients, parted, small_steps

from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.hierarchical import rough_fit
from tmlattice.diagnosis.response.linear import linear, rf_by_others
from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.response.weights import taken, weight
from tmlattice.inference.normal import solve
from tmlattice.observe.orbit_response import Predicted


@pytest.fixture(scope="module")
def settled(small_ring):
    rng = np.random.default_rng(4)
    causes = gradients(small_ring, 3e-3, rng)
    measured = small_steps(small_ring, causes, seed=1)
    data, split = parted(small_ring, measured, 1)
    design = begin(data, split)
    return rough_fit(design, STEPS[:3])


def told(state):
    there = linear(state, 0)
    found = solve(there.normal, there.groups, there.start, rounds=0)
    return there, found, rf_by_others(state, there, found)


@pytest.mark.parametrize("moving", [False, True])
def test_each_reading_vs_a_fit_without_it(settled, rng, moving):
    if moving:  # readings of a column have a jitter in common
        jitter = 1e-7 * rng.standard_normal((2, 2, settled.data.shape[1]))
        settled = dataclasses.replace(settled, jitter=jitter)
    _, _, by_others = told(settled)
    own = weight(settled, 0)[-1]
    read = np.flatnonzero(own > 0)
    assert np.isfinite(by_others).sum() == len(read) > 10
    precision = np.diag(own[read])
    if moving:
        shared = taken(settled, 0)[-1, read]
        precision -= shared @ shared.T
    covariance = np.linalg.inv(precision)
    for i in range(0, len(read), 4):
        orbits = settled.data.orbits.copy()
        orbits[-1, read[i]] = np.nan
        data = dataclasses.replace(settled.data, orbits=orbits)
        at = Predicted(data, settled.at.errors, settled.at.bent)
        there, found, _ = told(dataclasses.replace(settled, data=data, at=at))
        rows = there.of_column(len(orbits) - 1, read, settled.data.plane[-1])
        left = settled.data.pick(settled.at.left)[-1, read] - rows @ (found.values - there.start)
        rest = np.arange(len(read)) != i
        by_noise = covariance[i, rest] @ np.linalg.solve(covariance[np.ix_(rest, rest)], left[rest])
        assert_allclose(by_others[read[i]], left[i] - by_noise, rtol=1e-5, atol=1e-13)
