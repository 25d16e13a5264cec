"""Readings of one plane: the other one carries no information, and nothing is named in it."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.measurement.trajectory import UNKNOWN_LAUNCH

PLANES = ("x", "y")
SOME = ("quadrupole_gradient", "quadrupole_roll", "monitor_gain_x", "monitor_roll")


def one_plane(data, plane, launches_known=True):
    """The measurement without readings in the other plane."""
    readings = data.readings.copy()
    readings[..., 1 - PLANES.index(plane)] = np.nan
    known = {}
    if not launches_known:
        shots = len(data.launches)
        known = {
            "launches": np.zeros((shots, 5)), "launch_sigma": np.tile(UNKNOWN_LAUNCH, (shots, 1))
        }  # fmt: skip
    return replace(data, readings=readings, **known)


def measured(ring, causes, plane, launches_known=True, seed=1, **options):
    made = simulate(ring, causes, shots=6, seed=seed, **options).measurement()
    return one_plane(made, plane, launches_known)


@pytest.mark.parametrize(
    ("plane", "cause"),
    [
        ("x", Cause("quadrupole_offset_y", "QD::5", 3e-4)),
        ("y", Cause("quadrupole_offset_x", "QD::5", 3e-4)),
    ],
)
def test_what_acts_in_the_other_plane_alone_is_not_named(small_ring, plane, cause):
    result = diagnose(small_ring, measured(small_ring, [cause], plane))
    assert result.verdict in ("none", "distributed")
    assert result.findings == ()
    unread = PLANES[1 - PLANES.index(plane)]
    assert any(f"no BPM reads {unread}" in warning for warning in result.warnings)


def test_an_energy_offset_is_seen_in_y_by_the_focusing(small_ring):
    result = diagnose(small_ring, measured(small_ring, [Cause("energy_offset", None, 1e-3)], "y"))
    members = {m.effect: m for m in result.findings[0].credible_set}
    assert members["energy_offset"].amount == pytest.approx(1e-3, rel=0.25)


def test_a_strong_kick_in_the_other_plane_has_a_place_and_no_amount(small_ring):
    """Sextupoles pass it on to the plane that was read."""
    cause = Cause("quadrupole_offset_y", "QD::5", 3e-3)
    result = diagnose(small_ring, measured(small_ring, [cause], "x", seed=2))
    (finding,) = result.findings
    low, high = finding.where
    assert (finding.verdict, finding.amount) == ("localised", None)
    assert low <= small_ring["QD::5"].s <= high
    assert any("upstream in y" in warning for warning in result.warnings)


def test_a_corrector_is_named_in_its_own_plane_alone(small_ring):
    cause = Cause("corrector_kick_y", "v5", 3e-5)
    result = diagnose(small_ring, measured(small_ring, [cause], "y"))
    members = {(m.effect, m.element) for m in result.findings[0].credible_set}
    assert (cause.effect, cause.element) in members
    assert not any(effect.endswith("_x") for effect, _ in members)


def test_the_check_states_which_plane_was_not_read(petra3):
    """Sections of eight BPMs leave the noise that is there, whatever the other plane would do."""
    fault = [Cause("quadrupole_gradient", "qd::12", -0.05)]
    found = check_data(petra3, measured(petra3, fault, "x"))
    (planes,) = [check for check in found.checks if check.name == "planes"]
    assert planes.status == "note"
    assert planes.sentence.startswith("no BPM reads y")
    assert {check.name for check in found.reported} == {"planes"}


def test_what_passes_an_unknown_orbit_on_has_no_amount(small_ring):
    """Half of the other orbit and twice the roll read the same."""
    cause = Cause("quadrupole_roll", "QD::5", 0.05)
    unknown = measured(small_ring, [cause], "x", launches_known=False)
    result = diagnose(small_ring, unknown, effects=SOME)
    assert all(finding.effect is None for finding in result.findings)
    known = diagnose(small_ring, measured(small_ring, [cause], "x"), effects=SOME)
    assert any(
        (m.effect, m.element) == (cause.effect, cause.element)
        for finding in known.findings for m in finding.credible_set
    )  # fmt: skip


def test_bpms_of_one_plane_that_alternate_are_validated_in_both_planes(small_ring):
    cause = Cause("quadrupole_gradient", "QD::5", -0.2)
    data = simulate(small_ring, [cause], shots=6, seed=1).measurement()
    readings = data.readings.copy()
    readings[:, :, ::2, 1] = readings[:, :, 1::2, 0] = np.nan
    gap = diagnose(small_ring, replace(data, readings=readings)).heldout
    assert np.isfinite(gap.residuals[-1]).any(axis=0).sum(axis=0).min() >= 6
    assert gap.explained > 0.99
