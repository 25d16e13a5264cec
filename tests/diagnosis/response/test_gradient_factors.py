"""The few numbers behind many gradients, on simulated responses whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
from shared import parted, small_steps

from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.families.steps import CorrectorCalibration, MonitorGain
from tmlattice.diagnosis.response.common_factors import (
    Candidates,
    candidates,
    explain_gradients,
    weighed,
)
from tmlattice.diagnosis.response.rounds import settle
from tmlattice.diagnosis.response.state import allow, begin
from tmlattice.effects import Cause
from tmlattice.lattice.slices import families
from tmlattice.lattice.supplies import magnets, supplied_alike

SINGLE = QuadrupoleGradient()


def explained(ring, shared, extra=(), seed=1):
    """Of gradients that scatter by a tenth of a per cent about what they share."""
    rng = np.random.default_rng(seed)
    causes = [
        Cause("quadrupole_gradient", f"{name}::{i}", shared[name] + 1e-3 * rng.standard_normal())
        for name in ("QF", "QD")
        for i in range(16)
    ]
    measured = small_steps(ring, [*causes, *extra], seed=seed)
    state = begin(*parted(ring, measured))
    return explain_gradients(settle(allow(state, [CorrectorCalibration(), MonitorGain(), SINGLE])))


@pytest.mark.parametrize(
    ("shared", "name", "amount"),
    [
        ({"QF": 0.008, "QD": 0.008}, "all quadrupoles", 0.008),
        ({"QF": 0.012, "QD": 0.0}, "all focusing quadrupoles", 0.012),
    ],
)
def test_what_all_or_one_polarity_share_is_one_reason(small_ring, shared, name, amount):
    found = explained(small_ring, shared)
    assert found.common_factors[0].name == name
    assert abs(found.common_factors[0].amount - amount) < 4 * found.common_factors[0].amount_sigma
    assert found.common_factors[0].amount_sigma < 0.3 * amount
    assert len(found.common_factors) == 1
    assert found.share > 0.9


def test_a_magnet_that_no_magnet_is_like_is_flagged(small_ring):
    more = [Cause("quadrupole_gradient", "QD::5", 0.04)]
    found = explained(small_ring, {"QF": 0.0, "QD": 0.0}, more)
    assert [own.name for own in found.common_factors] == ["QD::5"]
    assert abs(found.common_factors[0].amount - 0.04) < 0.005


def test_small_scatter_alone_has_no_reason(small_ring):
    assert explained(small_ring, {"QF": 0.0, "QD": 0.0}).common_factors == ()


def test_arcs_and_straights_are_regions(small_ring):
    """Two bends go: what stands there is a straight."""
    gone = [i for i, e in enumerate(small_ring.elements) if e.name in ("bend::5", "bend::6")]
    other = {i: replace(small_ring.elements[i], kind="drift", angle=0.0) for i in gone}
    ring = small_ring.with_elements(other)
    own = magnets(ring, ("quadrupole",), powered=True)
    _, names, members, _ = candidates(ring, own)
    straight = members[:, names.index("straights")]
    inside = {own[i][0].name for i in np.flatnonzero(straight)}
    assert inside == {"QD::2", "QF::3", "QD::3"}
    assert (straight + members[:, names.index("arcs")] == 1).all()


def test_magnets_with_names_of_their_own_are_families_by_strength(small_ring):
    """BESSY II and MLS: q1m1t1r, q1m2t1r, ... are one supply, and nothing shares a name."""
    here = magnets(small_ring, ("quadrupole",), powered=True)
    renamed = {small_ring.index(first.name): replace(first, name=f"q{i}m2r", family=f"q{i}m2r")
               for i, (first,) in enumerate(here)}  # fmt: skip
    last = max(renamed)
    renamed[last] = replace(renamed[last], k1=1.01 * renamed[last].k1)
    ring = replace(small_ring.with_elements(renamed), known_supplies=None)
    own = magnets(ring, ("quadrupole",), powered=True)
    assert families([pieces[0].name for pieces in own])[0] == []
    names, members = supplied_alike(ring)
    assert members.sum(axis=0).tolist() == [16, 15]
    first = own[0][0].name
    assert names[0] == f"{first} and 15 of its strength"
    k1 = np.array([pieces[0].k1 for pieces in own])
    assert all(np.ptp(k1[column > 0]) == 0 for column in members.T)
    alike = [pieces for pieces in own if pieces[0].k1 == own[0][0].k1]
    others = {ring.index(name): replace(ring[name], k1=0.0)
              for name in ring.supplies[names[0]][2:]}  # fmt: skip
    two = replace(ring.with_elements(others), known_supplies=None)
    assert supplied_alike(two)[0][0] == f"{first} and {alike[1][0].name}"
    # a changed ring has the supplies of its design, and those that share a name stay as they are
    assert supplied_alike(ring.with_changed(first, k1=0.5))[0] == names
    kinds = families([pieces[0].name for pieces in here])[0]
    assert supplied_alike(small_ring)[0] == kinds


def of_families(amounts, seed=0, noise=2e-3):
    """Six families of eight magnets, each gradient known to `noise`, that scatter by 1e-3."""
    rng = np.random.default_rng(seed)
    families = np.kron(np.eye(6), np.ones((8, 1)))
    values = families @ np.array(amounts) + 1e-3 * rng.standard_normal(48)
    information = np.eye(48) / noise**2
    members = np.hstack([np.ones((48, 1)), families[:, :3].sum(axis=1)[:, None], families])
    # a family that is all magnets of a type too is one candidate, of either kind
    kinds = ("all", "focusing", "type", "family", "type", "family", "region", "family")
    among = Candidates(kinds, kinds, members, np.arange(8) >= 2)
    pull = information @ (values + noise * rng.standard_normal(48))
    return weighed(information, pull, among, 1e-6 * np.eye(48))


def test_families_that_each_have_their_own_amount_are_told_so():
    """Not as a sum of a few, whose errors would be those of families that are alike."""
    pulls = []
    for seed in range(4):  # the fifth draws two families by 0.56 % and three by none: a sum of few
        amounts = 0.01 * np.random.default_rng(100 + seed).standard_normal(6)
        between, _, sets = of_families(amounts, seed)
        assert 0.005 <= between <= 0.02
        assert set(sets[0].chosen) == set(range(2, 8))
        sigma = np.sqrt([sets[0].variance(c) for c in range(2, 8)])
        pulls += [*(([sets[0].amount(c) for c in range(2, 8)] - amounts) / sigma)]
        # of eight magnets: noise 2e-3 and scatter 1e-3
        assert sigma == pytest.approx(np.sqrt(5 / 8) * 1e-3, rel=0.05)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_families_that_share_all_are_alike():
    between, _, sets = of_families([0.01] * 6)
    assert between == 0
    assert sets[0].chosen == (0,)
    between, _, sets = of_families([0.01] * 3 + [0.0] * 3)
    assert between == 0
    assert sets[0].chosen == (1,)
    between, _, sets = of_families([0, 0, 0, 0.01, 0, 0])
    assert between == 0
    assert sets[0].chosen == (5,)
