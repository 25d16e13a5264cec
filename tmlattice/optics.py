"""Closed orbit, Twiss parameters, integer tunes and chromaticity of a network.

Everything comes from the layers' own maps: the one-turn matrix is the product of their Jacobians
along the closed orbit, the betas and phases come from carrying its eigenvectors round the ring.

>>> optics = one_turn_optics(network)
>>> optics.tunes                                   # fractions of Qx, Qy
>>> functions = twiss(network)
>>> functions.total_tunes                          # with their integers
>>> off_momentum(TaylorNetwork.from_ring(ring, 6)).chromaticity
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.assembly import Assembly
from tmlattice.beam.chain import LayerChain, products
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.effects import Cause
from tmlattice.errors import UnstableRingError
from tmlattice.lattice import Ring
from tmlattice.maps.magnets import ring_matrix
from tmlattice.maps.taylor import symplectic_form

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Optics:
    """Linear motion at the start of the ring.

    Attributes:
        tunes: fractional tunes (x, y) in [0, 1), [2].
        modes: eigenvectors of the one-turn matrix, (x, px, y, py) by (x, y), [4, 2]; they turn
            forward and are scaled to v^H S v = 2 i.
        closed_orbit: the state that repeats, [n].
        growth: the modulus of an eigenvalue that is furthest from 1: how much the amplitude grows
            or shrinks in a turn; 1 for a symplectic map.
    """

    tunes: Array
    modes: ComplexArray
    closed_orbit: Array
    growth: float = 1.0

    @property
    def beta(self) -> Array:
        """beta of each plane, m, [2]; of the mode that lives mostly in it, where they couple."""
        return _alpha_beta(self.modes)[1]

    @property
    def alpha(self) -> Array:
        """alpha of each plane, [2]; see `beta`."""
        return _alpha_beta(self.modes)[0]

    def normalised(self, states: Array) -> ComplexArray:
        """The modes' complex amplitudes z of states [..., n >= 4], [..., 2], in sqrt(m).

        Without coupling z = x_N - i p_N, x_N = x / sqrt(beta), p_N = (alpha x + beta px) /
        sqrt(beta): it turns by +2 pi Q a turn. The modes need not be orthogonal, as those of a
        symplectic map are: they are parted by the inverse of their matrix.
        """
        both = np.concatenate([self.modes, self.modes.conj()], axis=1)
        return np.asarray(2 * (states[..., :4] - self.closed_orbit[:4]) @ np.linalg.inv(both)[:2].T)


@dataclass(frozen=True)
class Twiss:
    """Optical functions at the start and at the exit of every layer.

    Attributes:
        s: m, [layer + 1].
        beta: m, [layer + 1, 2].
        alpha: [layer + 1, 2].
        phase: turns since the start, [layer + 1, 2].
        total_tunes: Qx, Qy with their integers, [2].
        orbit: the closed orbit (x, y), m, [layer + 1, 2].
    """

    s: Array
    beta: Array
    alpha: Array
    phase: Array
    total_tunes: Array
    orbit: Array


@dataclass(frozen=True)
class OffMomentum:
    """What depends on the energy, from six-dimensional maps at +-delta.

    Attributes:
        chromaticity: dQ / d delta of each plane, [2].
        s: m, [layer + 1].
        dispersion: d(x, y) / d delta at the start and at the layers' exits, m, [layer + 1, 2].
        momentum_compaction: relative lengthening of the turn's time per delta: the path's, less
            1 / gamma^2 (7e-9 at 6 GeV).
    """

    chromaticity: Array
    s: Array
    dispersion: Array
    momentum_compaction: float


def normal_modes(matrix: Array) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues exp(2 pi i Q) [2] and eigenvectors [4, 2] of a 4x4 one-turn matrix, (x, y).

    The eigenvectors turn forward and are scaled to v^H S v = 2 i, so that beta = |v_x|^2 and
    alpha = -Re(v_x^* v_px).

    A map that is not quite symplectic (a fine-tuned network with free weights) may have
    eigenvalues off the unit circle; as long as they turn, they have a tune.

    Raises:
        UnstableRingError: motion that grows without turning, in a plane or on a sum resonance.
    """
    values, vectors = np.linalg.eig(matrix.astype(complex))
    area = np.imag(np.einsum("ak,ab,bk->k", vectors.conj(), symplectic_form(4), vectors)) / 2
    forward = np.flatnonzero(area > 1e-9)
    if len(forward) != 2:
        traces = matrix[0, 0] + matrix[1, 1], matrix[2, 2] + matrix[3, 3]
        raise UnstableRingError(
            "the ring is unstable: its one-turn matrix has half traces of "
            f"{traces[0] / 2:.4f} (x) and {traces[1] / 2:.4f} (y) and an eigenvalue of modulus "
            f"{np.abs(values).max():.4g}, so no tune exists; change the magnet by less"
        )
    vectors = vectors[:, forward] / np.sqrt(area[forward])
    in_x = np.imag(vectors[0].conj() * vectors[1])  # the share of each mode's area in x
    order = np.argsort(-in_x)
    return values[forward][order], vectors[:, order]


def matrix_tunes(matrix: Array) -> Array:
    """Fractional tunes (x, y) in [0, 1) of a 4x4 one-turn matrix, [2].

    Q and 1 - Q are told apart by the direction in which the eigenvectors turn.

    Raises:
        UnstableRingError: no tune exists.
    """
    values, _ = normal_modes(matrix)
    return _fractions(values)


def ring_tunes(ring: Ring, energy: float = 0.0) -> list[float] | None:
    """Fractions of Qx, Qy about the axis, or about the closed orbit of another energy; None where
    there are none.

    Args:
        ring: with its errors.
        energy: relative deviation of the beam's.
    """
    try:
        if energy:
            turn = ResponseModel(ring).at_energy(energy).tangents[-1]
            return [float(q) for q in matrix_tunes(turn[:4, :4])]
        return [float(q) for q in matrix_tunes(ring_matrix(ring))]
    except (UnstableRingError, np.linalg.LinAlgError):
        return None


def short_way(difference: Array) -> Array:
    """Differences of tunes the short way round their circle."""
    return np.asarray((difference + 0.5) % 1.0 - 0.5)


class RingTunes:
    """Tunes of a ring with causes in it, about the axis: quick for many causes, one after another.

    Args:
        assembly: of the ring without.
    """

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        maps = assembly.maps
        steps = np.concatenate([maps.W1, maps.closing.coefficients[1][None]])[:, :4, :4]
        self._upto = products(steps)

    def of(self, causes: Sequence[Cause]) -> Array:
        """Fractional tunes (x, y), [2].

        Raises:
            UnstableRingError: there are none.
        """
        turn, last = np.eye(4), 0
        changed = self.assembly.layers_with(self.assembly.changed({}, causes))
        for k, ((_, matrix, _), _) in sorted(changed.items()):
            turn = matrix[:4, :4] @ self._between(last, k) @ turn
            last = k + 1
        return matrix_tunes(self._between(last, len(self._upto) - 1) @ turn)

    def _between(self, first: int, last: int) -> Array:
        """The matrix from one exit to a later one, [4, 4]."""
        return np.asarray(self._upto[last] @ np.linalg.inv(self._upto[first]))


def _fractions(values: ComplexArray) -> Array:
    """Fractional tunes in [0, 1) of eigenvalues exp(2 pi i Q)."""
    return np.asarray(np.angle(values) / (2 * np.pi) % 1.0)


def closed_orbit(network: LayerChain, delta: float = 0.0, tolerance: float = 1e-14) -> Array:
    """The state [n] that repeats after a turn, in x, px, y, py, by Newton's method.

    Args:
        network: four or six coordinates; in six, tau stays 0 and p stays `delta`.
        delta: relative energy deviation p, six coordinates only.
        tolerance: m and rad.

    Raises:
        UnstableRingError: there is none within reach.
    """
    return np.asarray(_on_closed_orbit(network, delta, tolerance)[0][0])


def _on_closed_orbit(
    network: LayerChain, delta: float = 0.0, tolerance: float = 1e-14
) -> tuple[Array, Array]:
    """`LayerChain.tangents` about the closed orbit of an energy."""
    start = np.zeros(network.dimension)
    if network.dimension == 6:
        start[5] = delta
    return network.closed_orbit(start, tolerance=tolerance)


def one_turn_optics(network: LayerChain) -> Optics:
    """Tunes, alpha and beta at the start of the ring, on the network's own closed orbit.

    Raises:
        UnstableRingError: no closed orbit, or no tune.
    """
    path, total = _on_closed_orbit(network)
    values, vectors = normal_modes(total[-1, :4, :4])
    moduli = np.abs(values)
    return Optics(
        tunes=_fractions(values),
        modes=vectors,
        closed_orbit=path[0],
        growth=float(moduli[np.abs(moduli - 1).argmax()]),
    )


def _alpha_beta(vectors: ComplexArray) -> tuple[Array, Array]:
    """alpha, beta [..., 2] of eigenvectors [..., 4, 2], each mode in its own plane."""
    x = np.stack([vectors[..., 0, 0], vectors[..., 2, 1]], axis=-1)
    p = np.stack([vectors[..., 1, 0], vectors[..., 3, 1]], axis=-1)
    return -np.real(x.conj() * p), np.abs(x) ** 2


def twiss(network: LayerChain) -> Twiss:
    """Betas, alphas and phases along the ring, and the tunes with their integers.

    The phase of each step is that of the eigenvector, taken between -0.1 and 2 pi - 0.1: every
    layer advances the phase, except for rounding (drifts of slightly negative length), which
    must not count as a whole turn.

    Raises:
        UnstableRingError: no closed orbit, or no tune.
    """
    path, total = _on_closed_orbit(network)
    values, modes = normal_modes(total[-1, :4, :4])
    vectors = total[:, :4, :4] @ modes
    position = np.stack([vectors[:, 0, 0], vectors[:, 2, 1]], axis=-1)
    steps = np.angle(position[1:] / position[:-1])
    steps = (steps + 0.1) % (2 * np.pi) - 0.1
    phase = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) / (2 * np.pi)
    alpha, beta = _alpha_beta(vectors[:-1])
    fraction = _fractions(values)
    whole = np.round(phase[-1] - fraction)
    s = np.concatenate([[0.0], network.maps.s])
    return Twiss(
        s=s,
        beta=beta,
        alpha=alpha,
        phase=phase[:-1],
        total_tunes=whole + fraction,
        orbit=path[:-1, [0, 2]],
    )


def off_momentum(network: LayerChain, length: float, delta: float = 1e-4) -> OffMomentum:
    """Chromaticity, dispersion and momentum compaction by differences between +delta and -delta.

    Args:
        network: six coordinates, `TaylorNetwork.from_ring(ring, 6)`.
        length: circumference, m.
        delta: relative energy deviation of the two closed orbits.

    Raises:
        UnstableRingError: no closed orbit or no tune at one of the energies.
        ValueError: a network of four coordinates knows no energy.
    """
    if network.dimension != 6:
        raise ValueError("energy needs six coordinates: TaylorNetwork.from_ring(ring, 6)")
    tunes, paths = [], []
    for side in (delta, -delta):
        path, total = _on_closed_orbit(network, side)
        tunes.append(matrix_tunes(total[-1, :4, :4]))
        paths.append(path)
    shift = (tunes[0] - tunes[1] + 0.5) % 1.0 - 0.5  # a tune may cross an integer in between
    change = (paths[0] - paths[1]) / (2 * delta)
    slip = change[-1, 4] - change[0, 4]  # tau is c t: later is positive
    return OffMomentum(
        chromaticity=shift / (2 * delta),
        s=np.concatenate([[0.0], network.maps.s]),
        dispersion=change[:-1][:, [0, 2]],
        momentum_compaction=float(slip / length),
    )
