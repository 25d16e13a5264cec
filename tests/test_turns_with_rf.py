"""A few turns with the RF: the model's cavities against AT's, and what follows from them."""

import numpy as np
import pytest

from tests.scenarios import ring_of
from tmlattice import Cause, diagnose, simulate
from tmlattice.beam import Model
from tmlattice.beam.rf import rf_of
from tmlattice.machine import Machine, draw_shots

RADIATION = [Cause(f"radiation_loss_{kind}", None, 1.0) for kind in ("bends", "wigglers")]
FREQUENCY = {"rf": {"frequency_relative": 1e-5}}
TURNS = 3


@pytest.fixture(scope="module")
def with_cavities():
    """The small ring with two cavities of its own, one before its first magnet."""
    first = "ring = [\n    Cavity(l=0.3, v=1e-3, freq=5e8, eid='first'),\n"
    last = "[Cavity(l=0.4, v=1e-3, freq=5e8, eid='last'), generated_b"
    ring = ring_of("small", (("ring = [\n", first), ("[d, generated_b", last)))
    assert ring.counts()["cavity"] == 2
    return ring


def rms(values):
    return 1e6 * np.sqrt((values**2).mean())


@pytest.mark.parametrize("radiation", [False, True])
@pytest.mark.parametrize("settings", [{}, FREQUENCY])
@pytest.mark.parametrize("which", ["small_ring", "with_cavities", "petra3"])
def test_turns_of_the_model_vs_at(request, which, radiation, settings):
    """0.4 micrometres are left of hundreds: AT integrates through thick elements."""
    ring = request.getfixturevalue(which)
    shots = draw_shots(ring, 2, 1e-4, sigma=(1e-5, 1e-6, 1e-5, 1e-6, 1e-4), seed=1)
    launches = np.concatenate([shots.launches[:, :4], shots.launches[:, 5:]], axis=1)
    given = [settings] * 2
    at, ocelot = (
        Machine(ring, engine=engine, radiation=radiation).beam(shots.launches, TURNS, given)
        for engine in ("at", "ocelot")
    )
    model = Model(ring, given, TURNS, RADIATION if radiation else ())
    mine = model.beam(launches).reshape(at.shape)
    assert rms(mine - at) < 0.6
    assert rms(ocelot - at) < 0.6
    assert np.isfinite(at).all()


def test_without_its_rf_the_model_is_far_from_at(small_ring):
    """What the test above sees: the radiated energy alone is a hundred times its tolerance."""
    shots = draw_shots(small_ring, 1, 1e-4, sigma=(0,) * 5, seed=1)
    at = Machine(small_ring, radiation=True).beam(shots.launches, TURNS)
    each = []
    start = shots.nominal
    one = Model(small_ring, [{}], 1, RADIATION)
    for _ in range(TURNS):
        paths = one.paths(start)
        each.append(paths.beam)
        start = paths.states[:, -1][:, [0, 1, 2, 3, 5]]
    assert rms(np.stack(each, axis=1) - at) > 100


@pytest.fixture(params=[(True, {}), (False, FREQUENCY)])
def found(small_ring, request):
    """A function that diagnoses turns of the small ring, with radiation or another frequency."""
    radiation, settings = request.param

    def diagnosed(causes, amplitude):
        measured = simulate(
            small_ring, causes, shots=4, amplitude=amplitude, turns=TURNS, radiation=radiation,
            settings=[settings] * 4, seed=1,
        ).measurement()  # fmt: skip
        return diagnose(small_ring, measured, radiation=radiation)

    return diagnosed


def test_a_faultless_ring_is_faultless_over_several_turns(found):
    result = found([], 1e-4)
    assert result.verdict == "none"
    # 560 readings of three shots: chi-square per reading is 1 within 0.06, and four of that
    assert abs(result.fit_after.chi2_per_dof - 1) < 0.2
    assert not result.causes


def test_a_fault_is_named_over_several_turns(found):
    cause = Cause("quadrupole_gradient", "QF::3", -0.1)
    result = found([cause], 5e-4)
    assert [(f.effect, f.element) for f in result.findings] == [(cause.effect, cause.element)]
    assert abs(result.causes[0].amount - cause.amount) < 4 * result.findings[0].amount_sigma


@pytest.fixture(scope="module")
def radiating(with_cavities):
    """Large amplitudes of energy and time, so that the cavities' curvature is felt."""
    model = Model(with_cavities, [{}, FREQUENCY], TURNS, RADIATION)
    launches = np.array([[1e-4, 1e-5, -1e-4, 2e-5, 2e-4], [-1e-4, 0, 1e-4, 0, -1e-4]])
    return model, launches, model.paths(launches)


def test_tangents_through_the_cavities_vs_finite_change(radiating):
    model, launches, paths = radiating
    for column in range(5):
        h = np.zeros(5)
        h[column] = 1e-7
        change = (model.readings(launches + h) - model.readings(launches - h)) / 2e-7
        slope = paths.launch[..., column]
        assert np.abs(change - slope).max() < 1e-6 * np.abs(slope).max()


@pytest.mark.parametrize(
    ("effect", "place", "step"),
    [
        ("quadrupole_gradient", "QD::0", 1e-5),
        ("dipole_field", "bend::15", 1e-6),
        ("corrector_kick_x", "v7", 1e-7),
        ("radiation_loss_bends", None, 1e-3),
        ("radiation_loss_wigglers", None, 1e-3),
        ("energy_offset", None, 1e-7),
    ],
)
def test_signatures_through_the_cavities_vs_finite_change(radiating, effect, place, step):
    model, launches, paths = radiating
    signature = model.signatures(paths, [(effect, place)], launches)[0]
    up, down = (model.readings(launches, [Cause(effect, place, a)]) for a in (step, -step))
    change = (up - down) / (2 * step)
    # a kick's own tau at a magnet before a cavity is left out of what the cavity gives: 1e-5
    assert np.linalg.norm(change - signature) < 3e-5 * np.linalg.norm(change)


def test_radiation_is_found_over_turns_without_rf(small_ring):
    """The model without loss has its RF off; with the hypothesis it comes on, and gives back."""
    measured = simulate(
        small_ring, [], shots=4, amplitude=1e-4, turns=2, radiation=True, seed=2
    ).measurement()
    found = diagnose(small_ring, measured, effects=["radiation_loss_bends"])
    assert found.causes[0].effect == "radiation_loss_bends"
    assert abs(found.causes[0].amount - 1) < 0.02  # the wiggler's share is 0.1 %


def test_a_cavity_gives_its_harmonic_and_voltage(with_cavities):
    rf = rf_of(with_cavities)
    assert rf.harmonic == round(5e8 * with_cavities.length / 299792458)
    assert rf.voltage == pytest.approx(2e6)
    assert rf.own
    assert rf_of(with_cavities, harmonic=7, voltage=1e5).harmonic == 7


def test_a_lost_beam_states_shot_turn_and_magnet(small_ring):
    """Between the last monitor that sees it and the first that does not."""
    settings = [{}, {"v5": {"kick": 0.02}}, {}]
    model = Model(small_ring, settings, 2)
    launches = np.zeros((3, 5))
    launches[0, 0] = 1e-4
    launches[2, :4] = [2e-3, 0, 9e-3, 0]
    paths = model.paths(launches)
    names = {found.shot: found for found in model.lost(paths)}
    gone = np.isnan(paths.beam).any(axis=2)
    assert set(names) == set(np.flatnonzero(gone.any(axis=1)))
    assert 0 not in names
    assert 1 in names
    s = {element.name: element.s for element in small_ring.elements}
    count = len(small_ring.monitors)
    for shot, found in names.items():
        turn, monitor = divmod(int(gone[shot].argmax()), count)
        first = small_ring.monitors[monitor].s + turn * small_ring.length
        before = small_ring.monitors[monitor - 1].s + (turn - (monitor == 0)) * small_ring.length
        there = s[found.element] + found.turn * small_ring.length
        assert before <= there <= first
        assert found.element in str(found)


@pytest.mark.parametrize(
    ("dimension", "turns", "causes"),
    [
        (4, 1, [Cause("quadrupole_gradient", "QD::5", -0.1)]),
        (4, 2, []),
        (6, 1, [Cause("energy_spread", None, 2e-3)]),
        (6, TURNS, [Cause("energy_offset", None, 1e-3), *RADIATION]),
    ],
)
def test_positions_along_the_trajectories_are_the_beams(with_cavities, dimension, turns, causes):
    """Read from trajectories with their derivatives, and tracked: shots of two settings, a kick in
    one shot, a lost beam; of particles of several energies too."""
    settings = [{}, {"v5": {"kick": 1e-4}}, {}, {"v5": {"kick": 0.02}}]
    model = Model(with_cavities, settings, turns, dimension=dimension)
    launches = np.zeros((4, 5))
    launches[:, :4] = 1e-4 * np.random.default_rng(1).standard_normal((4, 4))
    kicks = {3: np.array([[0.0, 0.0], [1e-4, 0.0], [0.0, 0.0], [0.0, 0.0]])}
    for given in ({}, kicks):
        tracked = model.beam(launches, causes, given)
        along = model.paths(launches, causes, given).beam
        np.testing.assert_allclose(along, tracked, rtol=0, atol=1e-15)  # of 1e-3 m
        assert np.isfinite(tracked[:3]).all()
        assert np.isnan(tracked[3]).any()
