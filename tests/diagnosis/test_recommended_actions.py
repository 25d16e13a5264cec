"""What is to be done about a finding: one line for explanations that one adjustment takes away."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.beam.chain import Chain
from tmlattice.beam.model import Model
from tmlattice.diagnosis.consequences import consequences
from tmlattice.diagnosis.next_measurement import LEAST, next_measurement
from tmlattice.diagnosis.recommended_actions import (
    compensated,
    credible,
    leading,
    recommended_action,
    recommended_actions,
)
from tmlattice.diagnosis.result import Finding, faults_of
from tmlattice.effects import CATALOGUE, Effect, apply
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.newton import fit
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.optics import off_momentum, ring_tunes, twiss
from tmlattice.report.action_texts import consequence_text
from tmlattice.report.plain import report_text

WEAK = Cause("quadrupole_gradient", "QD::5", -0.05)
SHOTS = {"shots": 4, "seed": 1, "amplitude": 3e-4, "noise": 2e-6}


def found(ring, causes, **options):
    return diagnose(ring, simulate(ring, causes, **{**SHOTS, **options}).measurement())


@pytest.fixture(scope="module")
def weak(small_ring):
    return found(small_ring, [WEAK])


def test_every_effect_says_what_to_check_and_what_to_do():
    for name, effect in CATALOGUE.items():
        assert effect.recommended_action != Effect.recommended_action, name
        assert effect.to_check != Effect.to_check, name
        assert effect.to_check.endswith("."), name


# --- what shares a action -------------------------------------------------------------------------
def matrix(ring, *causes):
    return Chain.from_ring(apply(ring, causes)).one_turn_map()[1]


@pytest.mark.parametrize(
    "cause",
    [
        Cause("gradient_absolute", "QD::5", 3e-3),
        Cause("gradient_absolute", "QF::3", 3e-3),
        Cause("gradient_absolute", "wig_1", 3e-3),
        Cause("skew_gradient", "QD::5", 3e-3),
        Cause("skew_gradient", "QF::3", -3e-3),
    ],
    ids=str,
)
def test_remedy_of_another_effect_takes_this_one_away(small_ring, cause):
    """The leading cause changes the one-turn matrix as the cause does, to some per cent."""
    lead = leading(small_ring, cause)
    assert lead.effect != cause.effect
    assert recommended_action(small_ring, cause) == recommended_action(small_ring, lead)
    design = matrix(small_ring)
    change = matrix(small_ring, cause) - design
    left = matrix(small_ring, cause, Cause(lead.effect, lead.element, -lead.amount)) - design
    assert np.abs(left).max() < 0.2 * np.abs(change).max()


def test_other_actions_and_other_places_are_other_remedies(small_ring):
    for (effect, place), (other, there) in (
        (("quadrupole_gradient", "QD::5"), ("quadrupole_gradient", "QD::6")),
        (("quadrupole_gradient", "QD::5"), ("quadrupole_roll", "QD::5")),
        (("gradient_absolute", "sd::5"), ("sextupole_offset_x", "sd::5")),
        (("monitor_gain_x", "end_3"), ("monitor_roll", "end_3")),
        (("family_gradient", "QD"), ("quadrupole_gradient", "QD::5")),
    ):
        own = recommended_action(small_ring, Cause(effect, place, 1e-3))
        assert own != recommended_action(small_ring, Cause(other, there, 1e-3))


def test_pieces_of_one_magnet_are_one_place(petra3):
    """A sextupole's halves, with a corrector between them; the next sextupole is another."""
    halves = petra3.pieces("s1::48")
    assert len(halves) == 2
    one, two = (Cause("sextupole_offset_x", name, 1e-3) for name in halves)
    other = Cause("sextupole_offset_x", "s1::46", 1e-3)
    first, second = recommended_actions(petra3, [two, one, other], [0.5, 0.4, 0.1])
    assert first.probability == pytest.approx(0.9)
    assert (first.element, first.pieces) == (two.element, halves)
    assert first.mechanisms == (("sextupole_offset_x", pytest.approx(0.9)),)
    assert second.element == "s1::46"
    assert (
        recommended_action(petra3, one)
        == recommended_action(petra3, two)
        == "move s1::48 + s1::49 back horizontally"
    )


def test_probability_of_a_remedy_is_that_of_all_that_share_it(small_ring):
    causes = [
        Cause("quadrupole_gradient", "QD::5", -0.1),
        Cause("gradient_absolute", "sd::5", 0.03),
        Cause("gradient_absolute", "QD::5", 0.036),
    ]
    first, second = recommended_actions(small_ring, causes, [0.5, 0.3, 0.2], sigma=0.01)
    assert (first.effect, first.element) == ("quadrupole_gradient", "QD::5")
    assert first.probability == pytest.approx(0.7)
    assert [effect for effect, _ in first.mechanisms] == [
        "quadrupole_gradient",
        "gradient_absolute",
    ]
    assert second.probability == pytest.approx(0.3)
    assert len(credible((first, second), 0.95)) == 2
    assert credible((first, second), 0.69) == (first,)


def test_magnets_own_amount_is_told_where_the_thin_one_is_likelier(small_ring):
    """A thin fit converted is off by the magnet's length; the ring as found has the own one."""
    causes = [
        Cause("gradient_absolute", "QD::5", 0.036),
        Cause("quadrupole_gradient", "QD::5", -0.1),
    ]
    (recommended_action,) = recommended_actions(small_ring, causes, [0.6, 0.4])
    assert recommended_action.cause == causes[1]
    assert recommended_action.strength.after == pytest.approx(0.9 * small_ring["QD::5"].k1)
    thin = Finding(
        effect="gradient_absolute", element="QD::5", s=None, amount=0.036, unit="1/m",
        detection=None, where=None, near=(), recommended_actions=(recommended_action,),
    )  # fmt: skip
    assert faults_of([thin], causes[:1]) == (causes[1],)


def test_thin_gradient_is_told_as_the_magnets_own_strength(small_ring):
    magnet = small_ring["QD::5"]
    thin = 0.1 * magnet.length  # k1 L of 0.1 1/m2 over the magnet
    (recommended_action,) = recommended_actions(
        small_ring, [Cause("gradient_absolute", "QD::5", thin)], [1.0], 1e-4
    )
    assert recommended_action.strength.before == magnet.k1
    assert recommended_action.strength.after == pytest.approx(magnet.k1 + 0.1)
    assert recommended_action.amount_sigma == pytest.approx(1e-4 / abs(magnet.k1 * magnet.length))


@pytest.mark.parametrize("cause", [WEAK, Cause("quadrupole_roll", "QF::9", 6e-3)], ids=str)
def test_wrong_quadrupole_of_the_at_machine_is_one_finding(small_ring, cause):
    """Named, though a thin field in its middle explains the data as well."""
    result = found(small_ring, [cause])
    (finding,) = result.findings
    assert result.verdict == finding.verdict == "identified"
    assert len(finding.credible_set) == 2
    assert len({member.recommended_action for member in finding.credible_set}) == 1
    assert finding.recommended_action.effect == cause.effect
    assert finding.recommended_action.element == cause.element
    assert (
        abs(finding.recommended_action.amount - cause.amount)
        < 4 * finding.recommended_action.amount_sigma + 1e-3
    )
    assert finding.probability == finding.recommended_action.probability > 0.95
    assert result.next is None  # which mechanism it is changes nothing


# --- the repair -----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("cause", "left"),
    [
        (Cause("quadrupole_gradient", "QD::5", -0.05), 1e-9),
        (Cause("family_gradient", "QD", -0.005), 1e-9),
        (Cause("gradient_absolute", "QD::5", 0.02), 0.05),  # thick against thin
        (Cause("sextupole_strength", "sd::5", -2.0), None),
    ],
    ids=str,
)
def test_ring_with_the_settings_acts_as_designed(small_ring, cause, left):
    mended, by_hand = compensated(small_ring, [cause])
    assert by_hand == ()
    there = apply(mended, [cause])
    if left is None:
        assert there[cause.element].k2 == pytest.approx(small_ring[cause.element].k2)
        return
    design, faulty = (np.array(ring_tunes(r)) for r in (small_ring, apply(small_ring, [cause])))
    assert np.abs(faulty - design).max() > 1e-3
    off = np.abs(np.array(ring_tunes(there)) - design).max()
    assert off < left * np.abs(faulty - design).max()


@pytest.mark.parametrize(
    "cause",
    [Cause("dipole_field", "bend::3", 1e-3), Cause("corrector_kick_y", "v3", 2e-5)],
    ids=str,
)
def test_kick_is_taken_away_by_the_opposite_setting(small_ring, cause):
    mended, by_hand = compensated(small_ring, [cause])
    assert by_hand == ()
    orbits = [
        np.abs(Chain.from_ring(ring).closed_orbit()[0][:, [0, 2]]).max()
        for ring in (apply(small_ring, [cause]), apply(mended, [cause]))
    ]
    assert orbits[0] > 1e-5
    assert orbits[1] < 1e-3 * orbits[0]


def test_what_no_setting_mends_is_handed_back(small_ring):
    causes = [
        Cause("quadrupole_roll", "QD::5", 0.01),
        Cause("quadrupole_gradient", "QD::7", -1.0),  # no field at all
        Cause("corrector_kick_x", "v3", 1e-5),  # a vertical corrector
        Cause("monitor_swap", "end_3", 1.0),
    ]
    mended, by_hand = compensated(small_ring, causes)
    assert list(by_hand) == causes
    assert mended.elements == small_ring.elements


# --- what it does to the stored beam --------------------------------------------------------------
def test_consequences_vs_twiss_and_orbits_of_two_energies(small_ring, weak):
    """The referee is `optics`, on a ring that is made anew, with closed orbits at two energies."""
    told = weak.findings[0].consequences
    chains = [Chain.from_ring(ring) for ring in (small_ring, weak.as_found)]
    design, faulty = map(twiss, chains)
    beat = faulty.beta / design.beta - 1
    assert told.design == pytest.approx(tuple(design.total_tunes % 1), abs=1e-9)
    assert told.found.tunes == pytest.approx(tuple(faulty.total_tunes % 1), abs=1e-9)
    assert told.found.beta_beat_rms == pytest.approx(tuple(np.sqrt(np.mean(beat**2, axis=0))))
    assert told.found.beta_beat_max == pytest.approx(tuple(np.abs(beat).max(axis=0)))
    length = small_ring.length
    design_d, faulty_d = (
        off_momentum(Chain.from_ring(ring, 6), length).dispersion
        for ring in (small_ring, weak.as_found)
    )
    change = np.sqrt(np.mean((faulty_d - design_d) ** 2, axis=0))
    # differences over +-1e-4 leave the third order in delta
    assert told.found.dispersion_rms[0] == pytest.approx(change[0], rel=1e-3)
    assert told.corrected.tunes == pytest.approx(told.design, abs=1e-9)
    assert max(told.corrected.beta_beat_max) < 1e-9


def test_orbit_of_an_offset_is_told_and_repaired(small_ring):
    cause = Cause("quadrupole_offset_x", "QD::5", 2e-4)
    result = found(small_ring, [cause])
    told = result.findings[0].consequences
    orbit = Chain.from_ring(result.as_found).closed_orbit()[0][:-1, 0]
    assert told.found.orbit_rms[0] == pytest.approx(np.sqrt(np.mean(orbit**2)), rel=1e-6)
    assert told.corrected.orbit_rms[0] < 1e-9


def test_of_two_faults_the_other_is_still_there_after_a_repair(small_ring):
    causes = [WEAK, Cause("quadrupole_gradient", "QF::11", 0.04)]
    result = found(small_ring, causes)
    assert len(result.findings) == 2
    for finding in result.findings:
        (other,) = (c for c in result.causes if c.element != finding.element)
        left = ring_tunes(apply(small_ring, [other]))
        assert finding.consequences.corrected.tunes == pytest.approx(tuple(left), abs=1e-9)


def test_ring_without_a_stable_orbit_is_said_to_be_unstable(small_ring, weak):
    strong = Cause("quadrupole_gradient", "QD::5", -3.0)
    assert ring_tunes(apply(small_ring, [strong])) is None
    (told,) = consequences(small_ring, [strong]).values()
    assert told.found is None
    assert told.corrected is not None
    text = consequence_text(replace(weak.findings[0], consequences=told))
    assert "unstable: no beam can be stored" in text


def test_wrong_monitor_does_nothing_to_the_beam(small_ring):
    result = found(small_ring, [Cause("monitor_gain_x", "end_3", -0.5)])
    assert result.findings[0].consequences is None
    assert "no effect on the stored beam" in report_text(result)


# --- the next measurement -------------------------------------------------------------------------
def rivals_of(ring, data, *causes):
    """Of hypotheses that were refitted to the data."""
    of = of_measurement(ring, data)
    model = Model(ring, of.settings)
    problem = FirstTurns(model=model, data=of, places={c.effect: 1 for c in causes})
    return of, [Alternative((c.effect, c.element), fit(problem, [c], of.launches)) for c in causes]


def test_next_measurement_is_silent_where_it_tells_nothing(small_ring):
    """A thick and a thin gradient of two per mille cannot be parted by a shot; two magnets can."""
    cause = Cause("quadrupole_gradient", "QD::5", 0.02)
    data = simulate(small_ring, [cause], **SHOTS).measurement()
    thin = Cause("gradient_absolute", "QD::5", -0.02 * 0.9 * 0.4)
    far = Cause("quadrupole_gradient", "QD::9", 0.02)
    of, (first, second, third) = rivals_of(small_ring, data, cause, thin, far)
    assert next_measurement(small_ring, of, first, second) is None
    assert next_measurement(small_ring, of, first, third).separation > LEAST


def test_next_measurement_never_launches_on_the_axis(small_ring):
    """Where the measured beam came in on the axis, the proposed one does not."""
    cause = Cause("quadrupole_offset_x", "QD::5", 2e-4)
    data = simulate(small_ring, [cause], **SHOTS).measurement()
    data = replace(data, launches=np.zeros_like(data.launches))
    name = next(e.name for e in small_ring.elements if e.kind == "hcorrector")
    other = Cause("corrector_kick_x", name, 1e-5)
    of, (first, second) = rivals_of(small_ring, data, cause, other)
    shot = next_measurement(small_ring, of, first, second)
    assert shot is not None
    assert any(shot.launch[k] for k in ("x", "px", "y", "py"))
