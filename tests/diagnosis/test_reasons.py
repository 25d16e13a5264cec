"""The few numbers behind many gradients, on simulated responses whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice.diagnosis.families import CorrectorCalibration, MonitorGain
from tmlattice.diagnosis.fields import QuadrupoleGradient
from tmlattice.diagnosis.magnets import magnets
from tmlattice.diagnosis.reasons import candidates, explain_gradients
from tmlattice.diagnosis.rounds import settle
from tmlattice.diagnosis.state import allow, begin
from tmlattice.effects import Cause
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import response_data, split_columns

SINGLE = QuadrupoleGradient()


def explained(ring, shared, extra=(), seed=1):
    """Of gradients that scatter by a tenth of a per cent about what they share."""
    rng = np.random.default_rng(seed)
    causes = [
        Cause("quadrupole_gradient", f"{name}::{i}", shared[name] + 1e-3 * rng.standard_normal())
        for name in ("QF", "QD")
        for i in range(16)
    ]
    measured = simulate_response(
        ring, [*causes, *extra], kick=1e-5, noise=2e-8, rf_step=-3000.0, engine="ocelot",
        progress=False, seed=seed,
    ).measured  # fmt: skip
    data = response_data(ring, measured)
    state = begin(data, split_columns(data, 0.2, np.random.default_rng(0)))
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
    assert found.reasons[0].name == name
    assert abs(found.reasons[0].amount - amount) < 4 * found.reasons[0].amount_sigma
    assert found.reasons[0].amount_sigma < 0.3 * amount
    assert len(found.reasons) == 1
    assert found.share > 0.9
    assert found.outliers == ()


def test_a_magnet_that_no_magnet_is_like_is_flagged(small_ring, monkeypatch):
    more = [Cause("quadrupole_gradient", "QD::5", 0.04)]
    found = explained(small_ring, {"QF": 0.0, "QD": 0.0}, more)
    assert [own.name for own in found.reasons] == ["QD::5"]
    (outlier,) = found.outliers
    assert outlier.element == "QD::5"
    assert abs(outlier.amount - 0.04) < 0.005
    # ALS: six magnets -3 +- 3 %, whose family's size is unknown
    monkeypatch.setattr(
        "tmlattice.diagnosis.reasons.of_sizes",
        lambda state, block, there: 0.03 * np.eye(len(there.start)),
    )
    assert explained(small_ring, {"QF": 0.0, "QD": 0.0}, more).outliers == ()


def test_small_scatter_alone_has_no_reason(small_ring):
    assert explained(small_ring, {"QF": 0.0, "QD": 0.0}).reasons == ()


def test_arcs_and_straights_are_regions(small_ring):
    """Two bends go: what stands there is a straight."""
    gone = [i for i, e in enumerate(small_ring.elements) if e.name in ("bend::5", "bend::6")]
    other = {i: replace(small_ring.elements[i], kind="drift", angle=0.0) for i in gone}
    ring = small_ring.with_elements(other)
    own = magnets(ring, ("quadrupole",), powered=True)
    _, names, members = candidates(ring, own)
    straight = members[:, names.index("straights")]
    inside = {own[i][0].name for i in np.flatnonzero(straight)}
    assert inside == {"QD::2", "QF::3", "QD::3"}
    assert (straight + members[:, names.index("arcs")] == 1).all()
