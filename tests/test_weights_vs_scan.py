"""Weight changes read as physics: against torch's gradient, the scan, and maps made by hand."""

import json
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from tmlattice import TaylorMap, TaylorNetwork, fine_tune
from tmlattice.beam.model import Model
from tmlattice.effects import Cause
from tmlattice.errors import MeasurementError
from tmlattice.fitting.weight_parts import layer_effects
from tmlattice.fitting.weights import read_network
from tmlattice.inference.newton import fit
from tmlattice.inference.scan import scan
from tmlattice.machine import simulate
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.plots import plot_weights

FAULT = Cause("quadrupole_gradient", "QD::7", 0.03)


@pytest.fixture(scope="module")
def measurement(small_ring):
    return simulate(small_ring, [FAULT], shots=3, amplitude=5e-4, seed=4).measurement()


@pytest.fixture(scope="module")
def effects(small_ring):
    return layer_effects(small_ring)


@pytest.fixture(scope="module")
def unchanged(small_ring, small_network, measurement, effects):
    return read_network(small_ring, small_network, measurement, effects)


def changed(network, layer, weights):
    new = network.copy()
    with torch.no_grad():
        for own, change in zip((new.W0, new.W1, new.W2), weights, strict=True):
            own[layer] += torch.from_numpy(np.ascontiguousarray(change))
    return new


def layer_of(ring, name):
    return [magnet.name for magnet in ring.magnets].index(name)


@pytest.mark.parametrize("dimension", [4, 6])
def test_stated_errors_of_effects_are_those_of_the_scan(small_ring, measurement, dimension):
    network = TaylorNetwork.from_ring(small_ring, dimension)
    reading = read_network(small_ring, network, measurement)
    model = Model(small_ring, measurement.settings or [{}] * 3, dimension=dimension)
    data = of_measurement(small_ring, measurement)
    problem = FirstTurns(model=model, data=data, places={})
    found = fit(problem, (), data.launches)
    about = problem.metric(found.point)
    referee = scan(about, reading.hypotheses, found.residual, effective=1.0)
    # what launches leave a millionth of has lost as many digits in both
    seen = referee.information > 1e-4 * np.median(referee.information)
    assert seen.mean() > 0.7
    np.testing.assert_allclose(reading.sigma[seen] ** -2, referee.information[seen], rtol=2e-6)
    assert reading.chi2 == pytest.approx(found.chi2, rel=1e-9)


@pytest.mark.parametrize(
    ("effect", "element", "amount"),
    [
        ("quadrupole_gradient", "QD::7", 1e-3),
        ("quadrupole_offset_y", "QF::5", -1e-4),
        ("dipole_roll", "bend::8", 1e-3),
        ("sextupole_strength", "sf::6", 0.2),
    ],
)
def test_an_effects_own_change_is_that_effect(
    small_ring, small_network, measurement, effects, effect, element, amount
):
    which = effects.hypotheses.index((effect, element))
    layer = layer_of(small_ring, element)
    assert effects.layer[which] == layer
    weights = (amount * D[which] for D in (effects.D0, effects.D1, effects.D2))
    network = changed(small_network, layer, weights)
    reading = read_network(small_ring, network, measurement, effects)
    assert reading.amount[which] == pytest.approx(amount, rel=1e-9)
    split = reading.split
    assert split.amount[which] == pytest.approx(amount, rel=1e-5)
    others = np.flatnonzero((effects.layer == layer) & (np.arange(len(effects.layer)) != which))
    assert (
        np.abs(split.amount[others] / split.sigma[others]).max()
        < 1e-4 * abs(amount / split.sigma[which]) + 1e-9
    )
    np.testing.assert_allclose(split.shares[layer], [1, 0, 0], atol=1e-12)
    elsewhere = np.arange(len(reading.raw)) != layer
    assert not reading.raw[elsewhere].any()
    assert not split.parts[elsewhere].any()
    assert reading.places("raw")[0] == reading.places("score")[0] == layer


@pytest.mark.parametrize(
    ("name", "bends"),
    [
        # the flow of H = x px y: x' = dH/dpx = x y, px' = -dH/dx, py' = -dH/dy = -x px
        *((name, {(0, 2): 1e-3, (1, 5): -1e-3, (3, 1): -1e-3}) for name in ("QF::5", "bend::8")),
        ("QF::5", {(0, 2): 1e-3, (1, 5): 1e-3}),  # x and px both grow with y: no H does that
    ],
)
def test_a_change_without_a_name_is_symplectic_or_the_rest(
    small_ring, small_network, measurement, effects, name, bends
):
    """Behind a magnet; no effect of the catalogue does that."""
    layer = layer_of(small_ring, name)
    own = TaylorMap([w[layer] for w in small_network.weights()])
    W2 = np.zeros((4, 10))
    for place, amount in bends.items():
        W2[place] = amount
    bent = TaylorMap([np.zeros(4), np.eye(4), W2]).after(own, 2)
    weights = [a - b for a, b in zip(bent.coefficients, own.coefficients, strict=True)]
    reading = read_network(small_ring, changed(small_network, layer, weights), measurement, effects)
    physical, symplectic, rest = reading.split.shares[layer]
    assert physical + symplectic + rest == pytest.approx(1, abs=1e-12)
    if (3, 1) in bends:
        assert symplectic > 0.9
        assert rest < 1e-9
    else:  # a symplectic change comes near alone
        assert rest > 0.2
        assert physical < 0.01


def test_the_designs_network_has_no_score(unchanged):
    reading = unchanged
    assert not reading.raw.any()
    assert not reading.amount.any()
    assert not reading.score.any()
    assert not reading.split.parts.any()
    assert not reading.split.shares.any()


def test_fine_tuned_network_of_all_layers(small_ring, small_network, measurement, unchanged):
    launched = replace(measurement, launches=unchanged.launches)
    fitted = fine_tune(small_network, launched, epochs=100, progress=False)
    reading = read_network(small_ring, fitted.network, measurement)
    assert (reading.raw[:-1] > 0).all()
    assert np.abs(reading.score).max() > 0.1
    np.testing.assert_allclose(reading.split.shares.sum(axis=1)[10:-10], 1, atol=1e-9)
    json.dumps(reading.as_json(), allow_nan=False)


def test_shots_with_settings_are_refused(small_ring, small_network, measurement):
    settings = ({"v3": {"kick": 1e-5}}, {}, {})
    with pytest.raises(MeasurementError, match="different settings"):
        read_network(small_ring, small_network, replace(measurement, settings=settings))


def test_unknown_noise_is_estimated(small_ring, small_network, measurement, unchanged, effects):
    reading = read_network(small_ring, small_network, replace(measurement, noise=None), effects)
    which = unchanged.hypotheses.index(("quadrupole_gradient", FAULT.element))
    assert reading.sigma[which] == pytest.approx(unchanged.sigma[which], rel=0.35)


def test_figure_marks_the_first_layer_of_each_ranking(small_ring, unchanged):
    reading = unchanged  # a figure of nothing is one too
    figure = plot_weights(reading, mark=FAULT.element)
    figure.canvas.draw()
    raw, score, *_ = figure.axes
    for ax, by in ((raw, "raw"), (score, "score")):
        assert small_ring.magnets[reading.places(by)[0]].name in ax.texts[0].get_text()
    plt.close(figure)
