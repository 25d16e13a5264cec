"""The symplectic penalty against the equations in one plane, the map algebra, and differences."""

import numpy as np
import pytest
import torch

from tmlattice import TaylorNetwork
from tmlattice.maps import TaylorMap, symplectic_form
from tmlattice.network import penalty_parts, symplectic_penalty
from tmlattice.network.symplectic import symplectic_coefficients


def random_weights(rng, layers, n):
    return (
        torch.from_numpy(rng.standard_normal((layers, n, n))).requires_grad_(),
        torch.from_numpy(rng.standard_normal((layers, n, n * (n + 1) // 2))).requires_grad_(),
    )


def test_one_plane_gives_the_papers_five_equations_and_the_sixth(rng):
    W1, W2 = random_weights(rng, 1, 2)
    (a, b), (c, d) = W1[0].tolist()
    (p11, p12, p22), (q11, q12, q22) = W2[0].tolist()
    equations = [
        1 * (a * d - b * c - 1),
        1 * (a * q12 - c * p12 + 2 * d * p11 - 2 * b * q11),
        1 * (d * p12 - b * q12 + 2 * a * q22 - 2 * c * p22),
        2 * (p11 * q12 - p12 * q11),  # of x^2: the paper leaves it out
        4 * (p11 * q22 - p22 * q11),
        2 * (p12 * q22 - p22 * q12),
    ]
    np.testing.assert_allclose(symplectic_coefficients(W1, W2).ravel(), equations, rtol=1e-12)
    total = symplectic_penalty(W1, W2)[0].item()
    np.testing.assert_allclose(total, np.square(equations).sum(), rtol=1e-12)


@pytest.mark.parametrize("n", [2, 4, 6])
def test_coefficients_match_the_map_algebra(n, rng):
    W1, W2 = random_weights(rng, 70, n)  # more layers than stand side by side in the kernel
    coefficients = symplectic_coefficients(W1, W2)
    b, c = np.triu_indices(n, 1)
    for layer in (0, 31, 32, 69):
        m = TaylorMap([np.zeros(n), W1[layer].detach().numpy(), W2[layer].detach().numpy()])
        defect = m.symplectic_defect()
        by_algebra = np.concatenate([part[b, c].T for part in defect])
        np.testing.assert_allclose(coefficients[layer], by_algebra, rtol=1e-11, atol=1e-11)
        parts = penalty_parts(W1, W2)[layer].tolist()
        expected = [np.square(part[b, c]).sum() for part in defect]
        np.testing.assert_allclose(parts, expected, rtol=1e-12)


@pytest.mark.parametrize(("n", "relative"), [(2, True), (4, False), (4, True), (6, False)])
def test_gradients(n, relative, rng):
    W1, W2 = random_weights(rng, 3, n)
    design = rng.standard_normal(symplectic_coefficients(W1, W2).shape) if relative else None
    assert torch.autograd.gradcheck(lambda a, b: penalty_parts(a, b, design), (W1, W2))


def test_six_coordinates_need_the_opposite_sign_of_the_last_pair(small_ring):
    network = TaylorNetwork.from_ring(small_ring, 6)
    constant = penalty_parts(network.W1, network.W2)[:, 0]
    magnets = [i for i, name in enumerate(network.layers) if name.startswith("bend")]
    assert constant[magnets].max().item() < 1e-24
    bend = network.W1[magnets[0]].detach().numpy()
    wrong = np.kron(np.eye(3), [[0.0, 1.0], [-1.0, 0.0]])
    assert np.abs(bend.T @ wrong @ bend - wrong).max() > 0.01
    assert np.abs(bend.T @ symplectic_form(6) @ bend - symplectic_form(6)).max() < 1e-12


def test_dimension_without_a_symplectic_form_is_refused(rng):
    W1, W2 = torch.zeros(1, 3, 3, dtype=torch.float64), torch.zeros(1, 3, 6, dtype=torch.float64)
    with pytest.raises(ValueError, match="2, 4 and 6"):
        symplectic_penalty(W1, W2)
