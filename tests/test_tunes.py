"""Tunes against signals of known frequency, and against OCELOT's one-turn matrices."""

import numpy as np
import pytest

from tmlattice import TaylorNetwork, one_turn_optics, tunes
from tmlattice.errors import TooFewTurnsError, UnstableRingError
from tmlattice.maps import ring_matrix
from tmlattice.optics import Optics, matrix_tunes, normal_modes


def rotation(tune, beta, alpha):
    c, s = np.cos(2 * np.pi * tune), np.sin(2 * np.pi * tune)
    gamma = (1 + alpha**2) / beta
    return np.array([[c + alpha * s, beta * s], [-gamma * s, c - alpha * s]])


def signal(qx, qy, turns=500, batch=1):
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = rotation(qx, 12.0, -0.7)
    matrix[2:, 2:] = rotation(qy, 4.0, 1.3)
    states = [np.array([1e-3, 2e-5, -5e-4, 1e-5])]
    for _ in range(turns):
        states.append(matrix @ states[-1])
    return matrix, np.repeat(np.array(states)[None], batch, axis=0)


@pytest.mark.parametrize(("qx", "qy"), [(0.1236, 0.2747), (0.8764, 0.7253), (0.31, 0.69)])
@pytest.mark.parametrize(("method", "tolerance"), [("naff", 1e-8), ("fft", 1e-6)])
def test_tune_above_half_is_not_folded(qx, qy, method, tolerance):
    matrix, states = signal(qx, qy)
    known = Optics(np.array([qx, qy]), normal_modes(matrix)[1], np.zeros(4))
    for optics in (known, None):  # given, or from the signal's own moments
        found = tunes(states, optics, method)
        assert found.fraction.shape == (1, 2)
        np.testing.assert_allclose(found.fraction[0], [qx, qy], atol=tolerance)
        assert (found.error[0] < 1e-4).all()
        assert found.turns == 501
    np.testing.assert_allclose(matrix_tunes(matrix), [qx, qy], atol=1e-14)


def test_amplitude_of_the_line_is_the_action():
    matrix, states = signal(0.1236, 0.2747)
    x, px = states[0, 0, :2]
    action = np.sqrt((x**2 + (12.0 * px - 0.7 * x) ** 2) / 12.0)
    optics = Optics(np.zeros(2), normal_modes(matrix)[1], np.zeros(4))
    y, py = states[0, 0, 2:]
    normalised = [  # x_N - i p_N, of beta and alpha as they are in `signal`
        (x - 1j * (12.0 * px - 0.7 * x)) / np.sqrt(12.0),
        (y - 1j * (4.0 * py + 1.3 * y)) / np.sqrt(4.0),
    ]
    np.testing.assert_allclose(optics.normalised(states[0, 0]), normalised, rtol=1e-12)
    for method, tolerance in (("naff", 1e-3), ("fft", 1e-3)):
        found = tunes(states, optics, method).amplitude[0, 0]
        np.testing.assert_allclose(found, action, rtol=tolerance)


@pytest.mark.parametrize("growth", [0.9, 0.99, 1.05])
def test_growing_or_damped_motion_keeps_its_tune(growth):
    matrix, _ = signal(0.1236, 0.7253)
    coupling = np.zeros((4, 4))
    coupling[0, 3], coupling[3, 0] = 0.3, 0.02  # not symplectic, and the planes talk
    matrix = matrix + coupling
    matrix[:2, :2] *= growth
    exact = matrix_tunes(matrix)
    states = [np.array([1e-9, 2e-11, -5e-10, 1e-11])]
    for _ in range(160):
        states.append(matrix @ states[-1])
    optics = Optics(exact, normal_modes(matrix)[1], np.zeros(4))
    found = tunes(np.array(states)[None], optics)
    np.testing.assert_allclose(found.fraction[0], exact, atol=1e-7)
    assert abs(exact[0] - 0.1236) < 0.03
    assert abs(exact[1] - 0.7253) < 0.03


def test_error_grows_when_the_tune_drifts():
    turns = np.arange(500)
    for drift in (0.0, 1e-5):
        phase = 2 * np.pi * (0.2 * turns + drift * turns**2 / 2)
        states = np.zeros((1, 500, 4))
        states[0, :, 0], states[0, :, 1] = np.cos(phase), -np.sin(phase)
        states[0, :, 2:] = states[0, :, :2]
        error = tunes(states).error[0, 0]
        assert error < 1e-6 if drift == 0 else 2e-4 < error < 5e-3


def test_signals_that_have_no_tune_are_refused():
    _, states = signal(0.1, 0.2)
    with pytest.raises(TooFewTurnsError, match="10 turns"):
        tunes(states[:, :10])
    lost = states.copy()
    lost[0, 77:, 0] = np.nan
    with pytest.raises(TooFewTurnsError, match="trajectory 0 is lost in turn 77"):
        tunes(lost)
    with pytest.raises(ValueError, match="should be"):
        tunes(states[0])


def test_unstable_matrix_has_no_tune():
    matrix = np.diag([2.0, 0.5, 1.0, 1.0])
    matrix[2:, 2:] = rotation(0.2, 3.0, 0.0)
    with pytest.raises(UnstableRingError, match="unstable"):
        matrix_tunes(matrix)


def test_design_ring_tunes_match_ocelot_matrix(petra3, petra3_network):
    exact = matrix_tunes(ring_matrix(petra3))
    optics = one_turn_optics(petra3_network)
    np.testing.assert_allclose(optics.tunes, exact, atol=1e-12)
    states = petra3_network.track([[1e-5, 0, 1e-5, 0]], 500)
    np.testing.assert_allclose(tunes(states, optics).fraction[0], exact, atol=1e-6)
    np.testing.assert_allclose(tunes(states, optics, "fft").fraction[0], exact, atol=1e-6)


def test_coupled_ring_has_the_tunes_of_its_normal_modes(small_ring):
    coupled = small_ring.with_changed("QF::3", tilt=0.05)
    matrix = ring_matrix(coupled)
    exact = np.sort(np.abs(np.angle(np.linalg.eigvals(matrix)))) / (2 * np.pi)
    found = matrix_tunes(matrix)
    folded = np.sort(np.minimum(found, 1 - found))
    np.testing.assert_allclose(folded, exact[::2], atol=1e-10)
    network = TaylorNetwork.from_ring(coupled)
    states = network.track([[1e-6, 0, 1e-6, 0]], 1000)
    np.testing.assert_allclose(
        tunes(states, one_turn_optics(network)).fraction[0], found, atol=1e-5
    )
