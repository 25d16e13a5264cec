"""The ring and its optics against AT: thick symplectic elements that share no map with OCELOT."""

import at
import numpy as np
import pytest

from tmlattice import TaylorNetwork, load_ring, off_momentum, one_turn_optics, twiss
from tmlattice.machine.at_engine import AtEngine
from tmlattice.maps import element_map

pytestmark = pytest.mark.filterwarnings("ignore:Maximum number of iterations")  # see the step


@pytest.fixture(scope="module")
def referee(petra3):
    return AtEngine(petra3).lattice()


@pytest.fixture(scope="module")
def referee_optics(referee):
    # exact bends round x to 3e-14 m: AT's own steps of 3e-8 m would see that
    return at.get_optics(
        referee,
        refpts=range(len(referee) + 1),
        get_chrom=True,
        method=at.linopt4,
        XYStep=3e-6,
        DPStep=1e-3,
    )


def test_tunes_with_their_integers(petra3_network, referee, referee_optics):
    mine = twiss(petra3_network).total_tunes
    _, _, elements = referee_optics
    phase = elements.mu[-1] / (2 * np.pi)  # AT's own phase count round the ring
    np.testing.assert_allclose(mine, phase, atol=1e-5)  # 1e-6 was measured
    np.testing.assert_allclose(mine, [37.1236, 30.2747], atol=0.01)


def test_betas_and_alphas_at_the_start(petra3_network, referee_optics):
    optics = one_turn_optics(petra3_network)
    _, _, elements = referee_optics
    np.testing.assert_allclose(optics.beta, elements.beta[0], rtol=1e-3)
    np.testing.assert_allclose(optics.alpha, elements.alpha[0], atol=2e-3)


def test_betas_along_the_ring(petra3, petra3_network, referee_optics):
    functions = twiss(petra3_network)
    _, _, elements = referee_optics
    exits = [i + 1 for i, e in enumerate(petra3.elements) if e.is_magnet]
    np.testing.assert_allclose(functions.beta[1:], elements.beta[exits], rtol=2e-3)


def test_chromaticity_dispersion_and_compaction(petra3, referee, referee_optics):
    mine = off_momentum(TaylorNetwork.from_ring(petra3, 6), petra3.length)
    _, ring_data, elements = referee_optics
    # 0.001 was measured; AT's usual bend pass, which lacks h x (px^2 + py^2) / 2, is 0.1 off
    np.testing.assert_allclose(mine.chromaticity, ring_data.chromaticity, atol=0.02)
    exits = [i + 1 for i, e in enumerate(petra3.elements) if e.is_magnet]
    np.testing.assert_allclose(mine.dispersion[1:, 0], elements.dispersion[exits, 0], atol=2e-3)
    compaction = at.get_mcf(referee, DPStep=1e-4)
    np.testing.assert_allclose(mine.momentum_compaction, compaction, rtol=5e-3)


def test_time_through_a_bend_with_a_sextupole(tmp_path):
    path = tmp_path / "ring.madx"
    path.write_text(
        "beam, particle=electron, energy=3;\nb: sbend, l=1, angle=0.39, k2=0.9; ring: line=(b);\n"
    )
    mine = element_map(load_ring(path)["b"], 3.0, 6)
    bend = at.Dipole("b", 1.0, 0.39, PolynomB=[0, 0, 0.45], MaxOrder=2, NumIntSteps=100)
    delta = 1e-4
    launches = np.zeros((6, 2), order="F")
    launches[4] = delta, -delta
    late = at.lattice_track(at.Lattice([bend], energy=3e9), launches)[0][5].ravel()
    own = [mine(np.array([0, 0, 0, 0, 0, d]))[4] for d in (delta, -delta)]
    # AT lacks h x px^2 / 2: 4e-4; OCELOT's own second order is 0.09 off
    np.testing.assert_allclose(sum(own) / 2, late.sum() / 2, rtol=0, atol=1e-3 * delta**2)
    np.testing.assert_allclose(own, late, rtol=1e-5)
