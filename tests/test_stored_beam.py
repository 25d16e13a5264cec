"""Orbit, tunes and modes of a stored beam against AT, and their derivatives by differences."""

from functools import partial

import at
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.scenarios import ring_of
from tmlattice import Cause, diagnose
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.stored import NO_RF, StoredBeam
from tmlattice.effects import CATALOGUE, RingEffect, apply, find
from tmlattice.errors import UnstableRingError
from tmlattice.machine import at_orbit
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.at_stored import stored_orbit
from tmlattice.machine.stored_beam import simulate_orbits, simulate_turns
from tmlattice.observe.stored import cavities_of

WRONG = [
    Cause("quadrupole_roll", "QF::2", 0.01),
    Cause("quadrupole_offset_x", "QD::5", 1e-4),
    Cause("quadrupole_offset_y", "QF::9", 1e-4),
]
"""An orbit through the sextupoles, and coupled planes: nothing is zero by symmetry."""


LOSS = Cause("radiation_loss_bends", None, 0.8)


@pytest.fixture(scope="module")
def with_cavities():
    """The small ring with two cavities of its own, where the dispersion is not zero."""
    first, last = (
        f"Cavity(l=0.3, v=2.5e-3, freq=5e8, eid='{name}'), " for name in ("first", "last")
    )
    start = '    Monitor(eid="bpm_start")'
    return ring_of("small", (("[d, generated_b", f"[{last}d, generated_b"), (start, first + start)))


def _apart(a, b):
    """Largest difference of modes [monitor, 2, mode], up to one complex factor a mode."""
    left = []
    for mode in (0, 1):
        x, y = a[..., mode].ravel(), b[..., mode].ravel()
        left.append(np.abs(y - x * (x.conj() @ y) / (x.conj() @ x)).max())
    return max(left)


def _hypotheses(ring):
    for name, effect in CATALOGUE.items():
        if isinstance(effect, RingEffect) and effect.power == 1:
            places = effect.places(ring)
            yield from ((name, place) for place in places[:: max(len(places) // 2, 1)][:2])
    yield "energy_offset", None


@pytest.mark.parametrize("rf_is_felt", [False, True])
def test_every_effect_vs_differences(small_ring, with_cavities, rf_is_felt):
    ring, felt = apply(small_ring, WRONG), NO_RF
    if rf_is_felt:
        ring = apply(with_cavities, [*WRONG, LOSS])
        felt = cavities_of(with_cavities, ResponseModel(ring))
        assert len(felt.exits) == 2
    hypotheses = list(_hypotheses(ring))
    assert len(hypotheses) > 30
    beam = StoredBeam(ResponseModel(ring), felt)
    moved = beam.moved(hypotheses)
    for i, (name, place) in enumerate(hypotheses):
        step = 1e-4 * find(name).largest
        up, down = (
            StoredBeam(
                beam.model.at_energy(change)
                if name == "energy_offset"
                else ResponseModel(apply(ring, [Cause(name, place, change)])),
                felt,
            )
            for change in (step, -step)
        )
        orbit = (up.model.readings - down.model.readings) / (2 * step)
        tunes = (up.tunes - down.tunes) / (2 * step)
        modes = (up.modes - down.modes) / (2 * step)
        # differences err by the square of the step, and by rounding where little moves
        scale = [max(np.abs(x).max(), 1e-4) for x in (orbit, tunes, modes)]
        assert_allclose(moved.orbit[i], orbit, atol=1e-5 * scale[0], err_msg=f"{name} {place}")
        assert_allclose(moved.tunes[i], tunes, atol=1e-4 * scale[1], err_msg=f"{name} {place}")
        clean = beam.modes
        for mode in (0, 1):
            E = clean[..., mode]
            left = [d[..., mode] - E * np.vdot(E, d[..., mode]) / np.vdot(E, E)
                    for d in (modes, moved.modes[i])]  # fmt: skip
            assert np.abs(left[0] - left[1]).max() < 1e-4 * scale[2], f"{name} {place}"


def test_tunes_and_modes_vs_at(small_ring):
    """AT's coupled eigenvectors of its own tracked turn, about its own orbit."""
    causes = WRONG[:1]  # AT's 4-d orbit has no energy of its own: none is moved
    beam = StoredBeam(ResponseModel(apply(small_ring, causes)))
    lattice = AtEngine(small_ring, causes).lattice()
    lattice.disable_6d()
    at_monitors = [i for i, e in enumerate(lattice) if isinstance(e, at.Monitor)]
    turn, along = at.find_m44(lattice, refpts=at_monitors)
    values, vectors = np.linalg.eig(turn)
    order = [int(np.abs(np.angle(values) / (2 * np.pi) % 1 - q).argmin()) for q in beam.tunes]
    theirs = np.angle(values[order]) / (2 * np.pi) % 1
    assert_allclose(beam.tunes, theirs, atol=2e-6)  # integration steps of AT's magnets
    modes = (along @ vectors[:, order])[:, [0, 2]]
    assert (
        _apart(modes / np.abs(modes).max(), beam.modes / np.abs(modes).max())
        < 1e-4 * np.abs(beam.modes).max() / np.abs(modes).max()
    )


@pytest.mark.parametrize("which", ["small_ring", "with_cavities"])
def test_tunes_and_modes_with_rf_vs_at(request, which):
    """A cavity where the dispersion is not zero beats the modes by a hundredth."""
    ring = request.getfixturevalue(which)
    causes = [WRONG[0], LOSS]
    model = ResponseModel(apply(ring, causes))
    felt = cavities_of(ring, model)
    beam, deaf = StoredBeam(model, felt), StoredBeam(model)
    engine = AtEngine(ring, causes)
    line, with_rf, late = engine.stored_line({})
    before = stored_orbit(engine, line, late)
    state = at_orbit.closed(partial(engine.one_pass, with_rf), before, range(6))
    steps = np.diag(at_orbit.STEPS)
    moving = np.asfortranarray(np.vstack([state + steps, state - steps]).T)
    seen = engine.run(with_rf, moving, 1)[:, 0]
    ends = moving.T
    values, vectors = np.linalg.eig((ends[:6] - ends[6:]).T / (2 * at_orbit.STEPS))
    own = [int(np.abs(np.angle(values) / (2 * np.pi) % 1 - q).argmin()) for q in beam.tunes]
    assert_allclose(beam.tunes, np.angle(values[own]) / (2 * np.pi) % 1, atol=1e-5)
    along = np.moveaxis((seen[:6] - seen[6:]) / (2 * at_orbit.STEPS[:, None, None]), 0, 2)
    modes = along @ vectors[:, own]
    modes *= np.abs(beam.modes).max() / np.abs(modes).max()
    size = np.abs(beam.modes).max()
    assert _apart(modes, beam.modes) < 1e-4 * size
    assert _apart(modes, deaf.modes) > 5e-3 * size


def test_turns_tell_the_loss_of_energy(small_ring):
    """It was `distributed`; the RF, which comes on with it, does more than the loss itself."""
    turns = simulate_turns(small_ring, [LOSS], shots=2, turns=250, seed=3).measured
    (found,) = diagnose(small_ring, turns).findings
    assert found.effect == LOSS.effect
    assert abs(found.amount - LOSS.amount) < 4 * found.amount_sigma


def test_no_fault_has_a_sign_that_it_cannot_have(small_ring):
    """A horizontal kick changes the energy as a loss below nothing would, which has one place."""
    kick = Cause("quadrupole_offset_x", "QF::7", -6e-5)
    turns = simulate_turns(small_ring, [kick], shots=4, turns=500, noise=3e-5, seed=8).measured
    effects = ["quadrupole_offset_x", "corrector_kick_x", "radiation_loss_bends"]
    findings = diagnose(small_ring, turns, effects=effects).findings
    assert findings
    for found in findings:
        assert "radiation_loss_bends" not in {one.effect for one in found.credible_set}


def test_a_changed_model_is_the_model_of_the_changed_ring(small_ring):
    changed = apply(small_ring, WRONG)
    made = ResponseModel(changed)
    from_design = ResponseModel(small_ring).changed_to(changed)
    assert_allclose(from_design.readings, made.readings, atol=1e-15)
    assert_allclose(from_design.tangents, made.tangents, atol=1e-12)
    some = list(_hypotheses(small_ring))[:12]
    mine, theirs = (StoredBeam(model).moved(some) for model in (from_design, made))
    assert_allclose(mine.orbit, theirs.orbit, rtol=1e-9, atol=1e-12)
    assert _apart(mine.modes[0] + 1e-9, theirs.modes[0] + 1e-9) < 1e-6 * np.abs(mine.modes[0]).max()


def test_an_unstable_ring_has_no_modes(small_ring):
    strong = [Cause("family_gradient", "QF", 1.5)]
    with pytest.raises(UnstableRingError):
        StoredBeam(ResponseModel(apply(small_ring, strong), 4))


def test_a_bends_field_is_spread_over_its_arc(small_ring):
    """As one kick by the whole angle in the middle it made an orbit that was 1.6e-3 too large."""
    for place in ("bend::3", "bend::16"):
        causes = [Cause("dipole_field", place, 2.5e-4)]
        at = simulate_orbits(small_ring, causes, noise=0.0).measured.orbit[0]
        model = ResponseModel(apply(small_ring, causes)).readings
        # where in the arc the beam is moved changes its path's length, and so its energy, by 5e-4
        assert np.linalg.norm(at - model) < 6e-4 * np.linalg.norm(at)
