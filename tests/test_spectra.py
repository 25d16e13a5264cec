"""Betatron lines of turns: against signals whose lines and noise are known."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tmlattice.errors import TooFewTurnsError
from tmlattice.measurement import TurnByTurn
from tmlattice.observe.spectra import lines

NOISE = 2e-5
Q = (0.1237, 0.2746)
TURNS, MONITORS, SHOTS = 600, 40, 3


def signal(
    rng, turns=TURNS, monitors=MONITORS, tunes=Q, size=(1e-3, 5e-4), noise=NOISE, envelopes=None
):
    """Turns [shot, turn, monitor, 2] of two coupled modes, and [shot, monitor, 2, mode]."""
    turn = np.arange(turns)
    phase = 2 * np.pi * np.outer(np.arange(monitors) / monitors, (7.1, 5.3))
    amplitude = np.empty((SHOTS, monitors, 2, 2), dtype=complex)
    for plane in (0, 1):
        for mode in (0, 1):
            modulus = size[mode] * (1.0 if plane == mode else 0.1) * rng.uniform(0.5, 1.5, monitors)
            own = phase[:, mode] + (0.0 if plane == mode else 1.0)
            kick = rng.uniform(0, 2 * np.pi, (SHOTS, 1))
            amplitude[:, :, plane, mode] = modulus * np.exp(1j * own) * np.exp(1j * kick[0, 0])
    amplitude *= np.exp(1j * rng.uniform(0, 2 * np.pi, (SHOTS, 1, 1, 2)))
    readings = rng.uniform(-1e-3, 1e-3, (1, 1, monitors, 2)) + np.zeros((SHOTS, turns, 1, 1))
    for mode in (0, 1):
        envelope = np.ones(turns) if envelopes is None else envelopes[mode]
        angle = 2 * np.pi * tunes[mode] * turn + np.angle(envelope)
        cos, sin = np.abs(envelope) * np.cos(angle), np.abs(envelope) * np.sin(angle)
        own = amplitude[:, None, ..., mode]
        readings += own.real * cos[:, None, None] - own.imag * sin[:, None, None]
    return readings + noise * rng.standard_normal(readings.shape), amplitude


def recorded(readings, **more):
    return TurnByTurn(readings, tuple(f"b{i}" for i in range(readings.shape[2])), **more)


def found(readings, **options):
    """Lines, every monitor read at the same moment of the turn."""
    options.setdefault("at", np.zeros(readings.shape[2]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no mean of nothing, no division by zero
        return lines(recorded(readings), **options)


def pulls(result, amplitude, monitors=slice(None)):
    """Deviations over errors, real and imaginary, one complex scale a mode and shot taken out."""
    made = []
    for shot in range(len(result.shots)):
        for mode in (0, 1):
            true = amplitude[shot, monitors, :, mode].ravel()
            read = result.amplitude[shot, monitors, :, mode].ravel()
            error = result.error[shot, monitors, :, mode].ravel()
            good = np.isfinite(read)
            true, read, error = true[good], read[good], error[good]
            scale = np.vdot(true / error, read / error) / np.vdot(true / error, true / error)
            made += [((read - scale * true) / error).real, ((read - scale * true) / error).imag]
    return np.concatenate(made)


def assert_pulls(values):
    """Of some 900 numbers: an rms of 1 to 3 %, and none above five."""
    assert 0.9 < np.sqrt(np.mean(values**2)) < 1.1
    assert np.abs(values).max() < 5


def test_amplitudes_tunes_and_noise_hold_their_errors(rng):
    readings, amplitude = signal(rng)
    result = found(readings)
    assert result.warnings == ()
    assert_pulls(pulls(result, amplitude))
    assert_allclose(np.nanmean(np.abs(result.amplitude) / np.abs(amplitude)), 1, rtol=1e-2)
    assert_allclose(result.noise, NOISE, rtol=0.12)  # 1800 readings: 1.7 % each
    off = (result.tune - Q) / result.tune_error
    assert np.abs(off).max() < 4
    assert result.tune_error.max() < 1e-6


def test_errors_of_tunes_are_their_rms(rng):
    """Of 60 tunes: their rms is known to 9 %."""
    off = []
    for _ in range(10):
        result = found(signal(rng, turns=128, monitors=10)[0])
        off.append((result.tune - Q) / result.tune_error)
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.3


@pytest.mark.parametrize("turns", [16, 32, 64, 2000])
def test_few_and_many_turns(rng, turns):
    readings, amplitude = signal(rng, turns=turns)
    values = pulls(found(readings), amplitude)
    assert 0.85 < np.sqrt(np.mean(values**2)) < 1.25  # 16 turns: five of them are the fit's own


def test_decoherence_and_detuning_leave_the_ratios(rng):
    """Gone in 50 and 25 turns, one of them with a tune that runs: within errors of those turns."""
    turn = np.arange(TURNS)
    fading = [np.exp(-((turn / 50) ** 2) + 0.5j * (turn / 50) ** 2), np.exp(-turn / 25)]
    readings, amplitude = signal(rng, envelopes=fading)
    result = found(readings)
    assert_pulls(pulls(result, amplitude))
    steady = found(signal(rng)[0])
    share = [np.mean(r.error[..., 0, 0] / np.abs(r.amplitude[..., 0, 0])) for r in (result, steady)]
    assert share[0] > 2 * share[1]


def test_the_tune_of_what_fades_is_of_its_power_and_not_of_what_stays(rng):
    """Of few particles 6 % stay for ever at another tune; their spectrum is higher."""
    turn = np.arange(200)
    fading = np.exp(-((turn / 15) ** 2)) + 0.06 * np.exp(2j * np.pi * 0.02 * turn)
    power = np.abs(fading) ** 2
    mean = np.vdot(fading, np.gradient(fading)).imag / (2 * np.pi * power.sum())
    readings, amplitude = signal(rng, turns=200, noise=2e-6, envelopes=[fading, fading.conj()])
    result = found(readings)
    assert_allclose(result.tune, np.array([Q[0] + mean, Q[1] - mean]) + np.zeros((SHOTS, 2)),
                    atol=1e-3)  # fmt: skip
    assert abs(mean) < 5e-3
    assert np.sqrt(np.mean(pulls(result, amplitude) ** 2)) < 1.3


def test_envelope_of_a_later_monitor_is_later(rng):
    """A beam that fades in 40 turns is 2.5 % smaller a turn later: that is no gain."""
    at = np.linspace(0, 1, MONITORS, endpoint=False)
    readings, amplitude = signal(rng, envelopes=[np.exp(-np.arange(TURNS) / 40)] * 2)
    late = amplitude * np.exp(at / 40)[None, :, None, None]  # what the readings say of turn 0

    def slope(result):
        ratio = np.abs(result.amplitude / late)[:, :, [0, 1], [0, 1]].mean(axis=(0, 2))
        return np.polyfit(at, ratio / ratio.mean(), 1)[0]

    assert abs(slope(found(readings, at=at))) < 4e-3  # the scatter of 40 monitors
    assert slope(found(readings)) < -1.5e-2


def test_synchrotron_motion_and_harmonics_are_nuisances(rng):
    readings, amplitude = signal(rng)
    turn = np.arange(TURNS)
    dispersion = rng.uniform(0.5, 1.5, MONITORS)
    readings[..., 0] += 3e-4 * np.cos(2 * np.pi * 0.007 * turn)[:, None] * dispersion
    readings[..., 0] += 1e-4 * np.cos(2 * np.pi * 2 * 0.13 * turn)[:, None] * dispersion**2
    values = pulls(found(readings), amplitude)
    assert 0.8 < np.sqrt(np.mean(values**2)) < 1.15


def test_missing_readings_cost_no_more_than_themselves(rng):
    readings, amplitude = signal(rng)
    readings[rng.random(readings.shape) < 0.1] = np.nan
    readings[:, :, 3] = np.nan
    readings[:, ::2, 5, 0] = np.nan
    result = found(readings)
    assert np.isnan(result.amplitude[:, 3]).all()
    assert np.isfinite(np.delete(result.amplitude, 3, axis=1)).all()
    assert_pulls(pulls(result, amplitude))
    assert_allclose(result.error[:, 5, 0].mean() / result.error[:, 7, 0].mean(), 2**0.5, rtol=0.1)


def test_bad_monitors_harm_no_other(rng):
    readings, amplitude = signal(rng)
    readings[:, :, 2] = 1e-3  # frozen
    readings[:, ::50, 4] += 5e-3  # spikes
    readings[:, :, 6] *= -30
    readings[:, :, 8] += 1e-3 * rng.standard_normal((SHOTS, TURNS, 2))
    readings[:, :, 10] = readings[:, :, 10, ::-1]
    readings[:, 1:, 12] = readings[:, :-1, 12]
    result = found(readings)
    good = [i for i in range(MONITORS) if i not in (2, 6, 8, 10, 12)]
    assert_pulls(pulls(result, amplitude, good))  # that with spikes too
    said = " ".join(result.warnings)
    assert "monitor 'b2' stands still" in said
    assert "more than 8 times the noise from the fit" in said
    assert result.noise[8].min() > 20 * NOISE
    # a turn late: the phase of the mode's own tune
    late = result.amplitude[0, 12, 0, 0] / result.amplitude[0, 13, 0, 0]
    there = amplitude[0, 12, 0, 0] / amplitude[0, 13, 0, 0]
    turned = np.angle(late / there) / (2 * np.pi) + Q[0]
    assert abs((turned + 0.5) % 1 - 0.5) < 0.01


def test_beam_that_is_lost_is_used_until_then(rng):
    readings, _ = signal(rng)
    readings[0, 200:] = np.nan
    readings[1, 12:] = np.nan
    result = found(readings)
    assert result.turns.tolist() == [200, 0, TURNS]
    assert np.isnan(result.amplitude[1]).all()
    assert np.isnan(result.tune[1]).all()
    assert (result.envelope[0, :, 200:] == 0).all()
    assert "shot 0: the beam is read for 200 turns of 600" in " ".join(result.warnings)
    assert "shot 1: 12 turns are too few for a tune" in " ".join(result.warnings)
    with pytest.raises(TooFewTurnsError, match="no shot has 16 turns"):
        found(readings[[1]])


def test_tune_above_half_is_not_folded(rng):
    """The same signal: exp(i phi) of 1 - Q instead of Q has the conjugate amplitude."""
    readings, _ = signal(rng)
    plain, told = found(readings), found(readings, near=(0.85, 0.25))
    assert_allclose(
        told.tune, [1 - plain.tune[0, 0], plain.tune[0, 1]] * np.ones((3, 1)), atol=1e-6
    )
    assert_allclose(told.amplitude[..., 0], plain.amplitude[..., 0].conj())
    assert_allclose(told.amplitude[..., 1], plain.amplitude[..., 1])
    turn = np.arange(TURNS)
    own = (
        told.amplitude[0, 0, 0, 0]
        * told.envelope[0, 0]
        * np.exp(2j * np.pi * told.tune[0, 0] * turn)
    )
    other = told.amplitude[0, 0, 0, 1] * told.envelope[0, 1]
    other = other * np.exp(2j * np.pi * told.tune[0, 1] * turn)
    left = readings[0, :, 0, 0] - (own + other).real
    assert np.std(left) < 1.1 * NOISE  # the convention as it is stated


def test_modes_are_identified_by_plane_and_not_by_strength(rng):
    readings, _ = signal(rng, size=(5e-5, 2e-3))
    assert_allclose(found(readings).tune, [Q] * SHOTS, atol=1e-4)
    exchanged = signal(rng, tunes=Q[::-1])[0]
    assert_allclose(found(exchanged).tune, [Q[::-1]] * SHOTS, atol=1e-4)


def test_one_plane_alone(rng):
    readings, amplitude = signal(rng)
    readings[..., 1] = np.nan
    result = found(readings)
    assert np.isnan(result.amplitude[:, :, 1]).all()
    assert_pulls(pulls(result, amplitude))
    assert "no BPM reads y" in " ".join(result.warnings)


def test_mode_that_was_not_kicked_is_missing_and_reported(rng):
    result = found(signal(rng, size=(1e-3, 0.0))[0])
    assert np.isfinite(result.tune[:, 0]).all()
    assert np.isnan(result.tune[:, 1]).all()
    assert np.isnan(result.amplitude[..., 1]).all()
    assert "no line of the mode nearer to y is found" in result.warnings[0]


def test_unresolved_tunes_are_reported(rng):
    near = found(signal(rng, tunes=(0.2, 0.2 + 1.5 / TURNS), turns=TURNS)[0])
    assert np.isnan(near.amplitude).all()
    assert "600 turns do not resolve their lines" in near.warnings[0]
    nearer = found(signal(rng, tunes=(0.2, 0.2 + 0.4 / TURNS), turns=TURNS)[0])
    said = " ".join(nearer.warnings)
    assert "do not resolve" in said or "nearly equal" in said or "is in both planes" in said
    readings, amplitude = signal(rng, tunes=(0.2, 0.2 + 4 / TURNS))
    assert_pulls(pulls(found(readings), amplitude))


def test_noise_has_no_lines(rng):
    for _ in range(5):
        result = found(NOISE * rng.standard_normal((SHOTS, 200, 20, 2)))
        assert np.isnan(result.tune).all()
        assert "no betatron line exceeds the noise" in result.warnings[0]


def test_noise_that_is_stated_wrongly_is_reported(rng):
    readings, _ = signal(rng)
    assert lines(recorded(readings, noise=(NOISE, NOISE))).warnings == ()
    (said,) = lines(recorded(readings, noise=(NOISE / 5, NOISE / 5))).warnings
    assert "is 5 times the stated noise" in said
