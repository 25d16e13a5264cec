"""Closed orbit, Twiss parameters, integer tunes and chromaticity of a network.

Everything comes from the layers' own maps: the one-turn matrix is the product of their Jacobians
along the closed orbit, the betas and phases come from carrying its eigenvectors round the ring.

>>> optics = one_turn_optics(network)
>>> optics.tunes                                   # fractions of Qx, Qy
>>> functions = twiss(ring)                        # or of a network
>>> functions.total_tunes                          # with their integers
>>> functions.betx, functions.to_dataframe()       # columns as MAD-X names them
>>> off_momentum(TaylorNetwork.from_ring(ring, 6)).chromaticity
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any

import numpy as np

from tmlattice.arrays import Array, ComplexArray
from tmlattice.beam.assembly import Assembly
from tmlattice.beam.chain import Chain, LayerChain, products
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.effects import Cause
from tmlattice.errors import UnstableRingError
from tmlattice.lattice import Ring, load_ring
from tmlattice.maps.magnets import LayerMaps, ring_matrix
from tmlattice.maps.taylor import symplectic_form
from tmlattice.speaks import Speaks


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


@dataclass(frozen=True, eq=False, repr=False)
class Twiss(Speaks):
    """Optical functions along a ring: a column for each attribute, as MAD-X names them.

    The first row is the start of the ring, each further one the exit of an element: of all elements
    of a ring, of the layers (magnets) of a network.

    Attributes:
        name: "$start", then the names of the elements, [row].
        s: m, [row].
        betx, alfx, mux: beta (m), alpha, and phase since the start (in units of 2 pi) of the mode
            that is mostly in x, on the closed orbit, [row].
        bety, alfy, muy: those of the other mode, [row].
        x, px, y, py: the closed orbit, m and units of the reference momentum, [row].
        dx, dpx, dy, dpy: its derivatives by pt = dE / (p0 c), as MAD-X's; of a ring whose particles
            are as fast as light those by delta. NaN of a network of four coordinates, [row].
        total_tunes: Qx, Qy with their integers, [2].
    """

    name: tuple[str, ...]
    s: Array
    betx: Array
    alfx: Array
    mux: Array
    bety: Array
    alfy: Array
    muy: Array
    x: Array
    px: Array
    y: Array
    py: Array
    dx: Array
    dpx: Array
    dy: Array
    dpy: Array
    total_tunes: Array

    @property
    def beta(self) -> Array:
        """Both betas, m, [row, 2]."""
        return np.column_stack([self.betx, self.bety])

    def along(self, step: float = 0.1) -> tuple[Array, Array]:
        """Return both betas between the rows as well, [point, 2], at s, [point]: cubics with the
        slope -2 alpha at the rows, exact in drifts.

        Args:
            step: largest distance of two points, m; at least 1/8000 of the ring.
        """
        alpha = np.column_stack([self.alfx, self.alfy])
        s, beta = [self.s[:1]], [self.beta[:1]]
        for i, length in enumerate(np.diff(self.s)):
            count = int(np.ceil(length / max(step, self.s[-1] / 8000)))
            if count < 1:  # thin, or a drift back
                continue
            t = np.arange(1, count + 1)[:, None] / count
            ends, slopes = self.beta[i : i + 2], -2 * length * alpha[i : i + 2]
            turned = (1 - t) * (slopes[0] - ends[1] + ends[0]) + t * (ends[1] - ends[0] - slopes[1])
            s.append(self.s[i] + t[:, 0] * length)
            beta.append((1 - t) * ends[0] + t * ends[1] + t * (1 - t) * turned)
        return np.concatenate(s), np.concatenate(beta)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame, its index the names, its columns from `s` to `dpy`."""
        pandas = import_module("pandas")
        columns = {f.name: getattr(self, f.name) for f in fields(self)[1:-1]}
        return pandas.DataFrame(columns, index=pandas.Index(self.name, name="name"))

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.name)

    def _told(self) -> tuple[str, dict[str, str]]:
        qx, qy = self.total_tunes
        return "", {
            "rows": str(len(self)),
            "tunes": f"{qx:.5f}, {qy:.5f}",
            "largest beta": f"{self.betx.max():.1f} m, {self.bety.max():.1f} m",
        }


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

    Q and 1 - Q are distinguished by the direction in which the eigenvectors turn.

    Raises:
        UnstableRingError: no tune exists.
    """
    values, _ = normal_modes(matrix)
    return _fractions(values)


def ring_tunes(ring: Ring, energy: float = 0.0) -> list[float] | None:
    """Fractions of Qx, Qy about the axis, or about the closed orbit of another energy; None where
    there are none.

    Args:
        energy: relative deviation of the beam's.
    """
    try:
        model = ResponseModel(ring).at_energy(energy) if energy else None
        turn = ring_matrix(ring) if model is None else model.tangents[-1]
        return [float(q) for q in matrix_tunes(turn[:4, :4])]
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
        for k, ((_, matrix, _), *_) in sorted(changed.items()):
            turn = matrix[:4, :4] @ self._between(last, k) @ turn
            last = k + 1
        return matrix_tunes(self._between(last, len(self._upto) - 1) @ turn)

    def _between(self, first: int, last: int) -> Array:
        """The matrix from one exit to a later one, [4, 4]."""
        return np.asarray(self._upto[last] @ np.linalg.inv(self._upto[first]))


def _fractions(values: ComplexArray) -> Array:
    """Fractional tunes in [0, 1) of eigenvalues exp(2 pi i Q)."""
    return np.asarray(np.angle(values) / (2 * np.pi) % 1.0)


def closed_orbit(network: LayerChain, delta: float = 0.0) -> Array:
    """The state [n] that repeats after a turn, in x, px, y, py, by Newton's method.

    Args:
        network: four or six coordinates; in six, tau stays 0 and p stays `delta`.
        delta: relative energy deviation p, six coordinates only.

    Raises:
        UnstableRingError: there is none within reach.
    """
    return np.asarray(_on_closed_orbit(network, delta)[0][0])


def _on_closed_orbit(network: LayerChain, delta: float = 0.0) -> tuple[Array, Array]:
    """`LayerChain.tangents` about the closed orbit of an energy."""
    start = np.zeros(network.dimension)
    if network.dimension == 6:
        start[5] = delta
    return network.closed_orbit(start)


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


def twiss(ring: Ring | LayerChain | Any) -> Twiss:
    """Return the optical functions at the exits of a ring's elements, or of a network's layers.

    The phase of each step is that of the eigenvector, taken between -0.1 and 2 pi - 0.1: every
    element advances the phase, except for rounding (drifts of slightly negative length), which
    must not count as a whole turn.

    Args:
        ring: a ring, all that `load_ring` takes, or a network.

    Raises:
        UnstableRingError: no closed orbit, or no tune.
    """
    if isinstance(ring, LayerChain):
        names, s = ring.layers, ring.maps.s
        path, total = _on_closed_orbit(ring)
        end, path, total = total[-1], path[:-1], total[:-1]
    else:
        ring = load_ring(ring)
        names = tuple(element.name for element in ring.elements)
        s = np.cumsum([element.length for element in ring.elements])
        path, total = _through(ring, _on_closed_orbit(Chain.from_ring(ring, 6))[0][0])
        end = total[-1]
    values, modes = normal_modes(end[:4, :4])
    vectors = total[:, :4, :4] @ modes
    position = np.stack([vectors[:, 0, 0], vectors[:, 2, 1]], axis=-1)
    last = (end[:4, :4] @ modes)[[0, 2], [0, 1]]
    steps = np.angle(np.concatenate([position[1:], last[None]]) / position)
    steps = (steps + 0.1) % (2 * np.pi) - 0.1
    phase = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) / (2 * np.pi)
    alpha, beta = _alpha_beta(vectors)
    fraction = _fractions(values)
    dispersion = np.full((len(total), 4), np.nan)
    if total.shape[-1] == 6:
        start = np.linalg.solve(np.eye(4) - end[:4, :4], end[:4, 5])
        dispersion = total[:, :4, :4] @ start + total[:, :4, 5]
    (ax, ay), (bx, by), (mx, my) = alpha.T, beta.T, phase[:-1].T
    x, px, y, py = path[:, :4].T
    dx, dpx, dy, dpy = dispersion.T
    return Twiss(
        ("$start", *names), np.concatenate([[0.0], s]), bx, ax, mx, by, ay, my, x, px, y, py,
        dx, dpx, dy, dpy, total_tunes=np.round(phase[-1] - fraction) + fraction,
    )  # fmt: skip


def _through(ring: Ring, start: Array) -> tuple[Array, Array]:
    """States [element + 1, 6] at the start and at the exits of all elements, and the matrices from
    the start to there [element + 1, 6, 6]."""
    layers = LayerMaps.of(ring, 6)
    path, total = [start], [np.eye(6)]
    for element in ring.elements:
        image, slopes = layers.map(element)(path[-1])
        path.append(image)
        total.append(slopes @ total[-1])
    return np.array(path), np.array(total)


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
    change = (paths[0] - paths[1]) / (2 * delta)
    slip = change[-1, 4] - change[0, 4]  # tau is c t: later is positive
    return OffMomentum(
        chromaticity=short_way(tunes[0] - tunes[1]) / (2 * delta),  # a tune may cross an integer
        s=np.concatenate([[0.0], network.maps.s]),
        dispersion=change[:-1][:, [0, 2]],
        momentum_compaction=float(slip / length),
    )
