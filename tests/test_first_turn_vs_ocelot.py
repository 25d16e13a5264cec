"""The network's first turn against OCELOT's own second-order maps, applied part by part."""

import copy

import numpy as np
import pytest
import torch
from ocelot.cpbd.tm_utils import SecondOrderMult, transfer_maps_mult_full_py

from tmlattice import Cause, TaylorNetwork
from tmlattice.effects import apply
from tmlattice.lattice.ocelot import SecondTM
from tmlattice.maps import LayerMaps, element_map, ring_maps


def parts(element, energy):
    """(B, R, T) of OCELOT's second-order parts of an element: three for a bend."""
    source = copy.deepcopy(element.source)
    source.set_tm(SecondTM)
    made = [part.get_params(energy) for part in source.tms]
    return [(p.B.reshape(6, 1), p.get_rotated_R(), p.get_rotated_T()) for p in made]


def ring_parts(ring):
    return [parts(element, ring.energy) for element in ring.elements]


@pytest.fixture(scope="module")
def known(petra3, small_ring):
    """Rings and their parts, made once."""
    return {"petra3": (petra3, ring_parts(petra3)), "small": (small_ring, ring_parts(small_ring))}


def whole(made):
    """The second-order map of each element, composed by OCELOT: once for all that are alike."""
    known = {}
    for some in made:
        key = b"".join(array.tobytes() for part in some for array in part)
        if key not in known:
            B, R, T = some[0]
            for part in some[1:]:
                B, R, T = transfer_maps_mult_full_py(B, R, T, *part)
            known[key] = [(np.reshape(B, (6, 1)), R, T)]
        yield known[key]


def ocelot_first_turn(ring, maps, launch):
    """Readings [batch, monitor, 2] and the last state [batch, 4], by OCELOT's own functions."""
    states = np.zeros((6, len(launch)))
    states[:4] = launch.T
    apply = SecondOrderMult().tmat_multip
    readings = []
    for element, some in zip(ring.elements, maps, strict=True):
        if element.kind == "monitor":
            readings.append(states[[0, 2]].T.copy())
        for B, R, T in some:
            apply(states, R, T)
            states += B
    return np.stack(readings, axis=1), states[:4].T


@pytest.mark.parametrize("name", ["petra3", "small"])
def test_readings_match_ocelot_maps_one_by_one(name, known, rng):
    ring, made = known[name]
    network = TaylorNetwork.from_ring(ring)
    launch = rng.standard_normal((6, 4)) * [1, 0.05, 1, 0.05]
    launch[:3] *= 1e-3
    launch[3:] *= 1e-4
    readings, last = ocelot_first_turn(ring, whole(made), launch)
    # 1e-12 m: rounding over the turn
    np.testing.assert_allclose(network(launch).detach().numpy(), readings, rtol=0, atol=1e-12)
    turn = network.track(launch, 1)[:, 1]
    np.testing.assert_allclose(turn, last, rtol=0, atol=1e-12)
    for some, amplitude in ((readings[:3], 1e-3), (readings[3:], 1e-4)):
        assert np.abs(some).max() > amplitude / 2  # the beam really went round


def test_composing_the_edges_of_a_bend_leaves_out_the_third_order_alone(known, rng):
    ring, made = known["petra3"]
    network = TaylorNetwork.from_ring(ring)
    shape = rng.standard_normal((3, 4)) * [1, 0.05, 1, 0.05]
    launch = np.concatenate([1e-3 * shape, 5e-4 * shape])
    readings, _ = ocelot_first_turn(ring, made, launch)
    errors = np.abs(network(launch).detach().numpy() - readings).reshape(2, -1).max(axis=1)
    assert errors[0] < 1e-9  # a nanometre, where the orbit has several millimetres
    assert 6 < errors[0] / errors[1] < 10  # third order: a factor of eight


def test_a_kick_in_a_corrector_reaches_the_monitors_behind_it(small_ring):
    kicked = small_ring.with_changed("v5", angle=1e-5)
    launch = np.zeros((1, 4))
    readings, _ = ocelot_first_turn(kicked, whole(ring_parts(kicked)), launch)
    maps = ring_maps(kicked)
    network = TaylorNetwork(maps)(launch).detach().numpy()
    np.testing.assert_allclose(network, readings, rtol=0, atol=1e-13)
    behind = maps.at > maps.layers.index("v5")
    assert (network[0, ~behind] == 0).all()
    assert np.abs(network[0, behind, 1]).max() > 1e-5
    assert np.abs(network[0, :, 0]).max() < 1e-8  # a vertical kick is no horizontal one


@pytest.mark.parametrize("name", ["QF::3", "bend::7", "sf::2", "wig_1", "generated_a"])
@pytest.mark.parametrize("dimension", [4, 6])
def test_element_map_matches_ocelot_to_second_order(small_ring, name, dimension, rng):
    element = small_ring[name]
    x = np.zeros((6, 20))
    x[:dimension] = 1e-5 * rng.standard_normal((dimension, 20))
    image = element_map(element, small_ring.energy, dimension)(x[:dimension].T)
    for B, R, T in parts(element, small_ring.energy):
        SecondOrderMult().tmat_multip(x, R, T)
        x += B
    np.testing.assert_allclose(image, x[:dimension].T, rtol=0, atol=1e-15)


ERRORS = [
    Cause("quadrupole_gradient", "QF::3", 0.02), Cause("quadrupole_offset_y", "QF::3", 1e-3),
    Cause("dipole_roll", "bend::7", 2e-3), Cause("quadrupole_roll", "QF::1", 0.01),
    Cause("skew_gradient", "sf::2", 1e-3), Cause("vertical_focusing", "wig_1", 1e-3),
    Cause("corrector_position", "v5", 0.02),
]  # fmt: skip


@pytest.mark.parametrize("dimension", [4, 6])
def test_maps_of_many_elements_are_those_of_each(small_ring, dimension):
    """Each of these has another kind of error, and most have none."""
    ring = apply(small_ring, ERRORS)
    together = LayerMaps(ring, dimension).maps(ring.elements)
    for element, own in zip(ring.elements, together, strict=True):
        alone = element_map(element, ring.map_energy, dimension).coefficients
        for a, b in zip(own.reduced(), alone, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def test_layers_hold_one_magnet_each(petra3, petra3_network):
    assert petra3_network.layers == tuple(e.name for e in petra3.elements if e.is_magnet)
    assert petra3_network.W0.shape == (1519, 4)
    assert petra3_network.W1.shape == (1519, 4, 4)
    assert petra3_network.W2.shape == (1519, 4, 10)
    assert petra3_network.W0.dtype == torch.float64
    assert petra3_network(np.zeros((2, 4))).shape == (2, 246, 2)
