"""Parts of a layer's change: effects, other symplectic changes, and the rest.

See `fitting.weights` for their use.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.beam import tangents as kernels
from tmlattice.beam.model import Model
from tmlattice.effects import CATALOGUE, Hypothesis, RingEffect, directions, names
from tmlattice.fitting.launches import with_noise
from tmlattice.inference.newton import fit
from tmlattice.lattice import Ring
from tmlattice.maps import LayerMaps, TaylorMap
from tmlattice.measurement import Measurement
from tmlattice.network.generators import field_matrix
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.metric import behind

PARTS = ("physical", "symplectic", "non-symplectic")
"""Parts of a change: effects of the catalogue, other symplectic changes, the rest."""

ALIKE = 1e-6
"""Share of an effect independent of the others below which it is no direction of its own."""

DEPENDENT = 1e-3
"""The same for symplectic changes given the effects: an offset of a thick sextupole, in
second-order maps, is symplectic but for its third order, which is cut."""

UNSEEN = 1e-10
"""Share of information independent of the launches below which a kick is invisible."""


@dataclass(frozen=True)
class LayerEffects:
    """The catalogue as directions in the weights of single layers.

    Attributes:
        hypotheses: (effect, element).
        layer: of each, [hypothesis].
        D0, D1, D2: d weights / d amount, [hypothesis, n], [hypothesis, n, n],
            [hypothesis, n, n (n + 1) / 2].
    """

    ring: Ring = field(repr=False)
    dimension: int
    hypotheses: tuple[Hypothesis, ...] = field(repr=False)
    layer: Indices = field(repr=False)
    D0: Array = field(repr=False)
    D1: Array = field(repr=False)
    D2: Array = field(repr=False)


def layer_effects(ring: Ring, dimension: int = 4) -> LayerEffects:
    """Return directions of all usual effects that act through one layer and change no read-out
    (dimension: of the network, 4 or 6)."""
    chosen = [name for name in names() if isinstance(CATALOGUE[name], RingEffect)]
    if dimension == 4:
        chosen = [name for name in chosen if not CATALOGUE[name].energy]
    asked = [(name, place) for name in chosen for place in CATALOGUE[name].places(ring)]
    d = directions(LayerMaps(ring, dimension), asked)
    rows = np.bincount(d.owner, minlength=len(asked))
    moves = np.isin(np.arange(len(asked)), d.read_owner)
    kept = ((rows == 1) & ~moves)[d.owner] & (d.layer < len(ring.magnets))
    return LayerEffects(
        ring,
        dimension,
        tuple(asked[i] for i in d.owner[kept]),
        d.layer[kept],
        d.D0[kept],
        d.D1[kept],
        d.D2[kept],
    )


@dataclass(frozen=True)
class Split:
    """Parts of every layer's change, over many trajectories of the measured size.

    Attributes:
        amount, sigma: of every effect, all effects of its layer at once, in its unit; the smallest
            ones for dependent effects, [hypothesis].
        parts: norms of the parts, see `PARTS`, in sigma, [layer, 3].
    """

    amount: Array
    sigma: Array
    parts: Array

    @property
    def shares(self) -> Array:
        """Shares of the parts in the squared norm of a layer's change, [layer, 3]; 0 if none."""
        squares = self.parts**2
        whole = squares.sum(axis=1, keepdims=True)
        return np.asarray(squares / np.where(whole > 0, whole, 1.0))


def stacked(weights: Sequence[Array]) -> Array:
    """[layer, n, 1 + n + n (n + 1) / 2] of W0, W1, W2."""
    return np.concatenate([weights[0][..., None], *weights[1:]], axis=-1)


class Trajectories:
    """The measured trajectories through the design, and the readings' information on kicks.

    Attributes:
        states: at every exit, [shot, layer + 2, n].
        whole, information: of the readings on a kick at a layer's exit, before and after the
            launch is projected out, [shot, layer, n, n].
        launches, chi2, readings: see `WeightReading`.
    """

    def __init__(self, ring: Ring, measurement: Measurement, n: int) -> None:
        monitors = [monitor.name for monitor in ring.monitors]
        measurement, _ = with_noise(ring, measurement.in_order_of(monitors), n)
        data = of_measurement(ring, measurement)
        launch_sigma = data.launch_sigma.copy()
        if n == 4:
            launch_sigma[:, 4] = 0.0
        data = replace(data, launch_sigma=launch_sigma)
        self.model = model = Model(ring, data.settings, dimension=n)
        problem = FirstTurns(model=model, data=data, places={})
        found = fit(problem, (), data.launches)
        self.launches, self.chi2 = found.nuisances, found.chi2
        self.readings = int(data.valid.sum())
        paths = found.point.view
        self.states = np.ascontiguousarray(paths.states)

        shots, count = data.shots, len(model.at)
        G = (paths.beam_launch * problem.whitening.weight[..., None]).reshape(shots, count, 2, n)
        Q = found.projection.Q[:, :-5].reshape(shots, count, 2, -1)
        # by a change of the launch before the monitors from each one on
        H = behind(np.einsum("smpi,smpj->smij", G, G))
        K = behind(np.einsum("smpi,smpq->smiq", G, Q))
        layers = len(model.maps.layers)
        start = model.maps.start[1 : layers + 1]
        back = np.linalg.inv(paths.tangents[:, 1 : layers + 1])  # kick -> change of the launch
        forth = back.swapaxes(-1, -2)
        H, K = H[:, start], K[:, start]
        self.whole = forth @ H @ back
        self.information = forth @ (H - K @ K.swapaxes(-1, -2)) @ back

    def kicks(self, layer: Indices, weights: Sequence[Array]) -> Array:
        """Kicks by weights' rows at the exits of layers, along the trajectories, [shot, row, n]."""
        out = np.empty((len(self.states), 1, len(layer), self.states.shape[2]))
        D0, D1, D2 = (np.ascontiguousarray(w) for w in weights)
        kernels.kicks(layer, D0, D1, D2, self.states, self.states.shape[1] - 1, out)
        return out[:, 0]

    def ensemble(self) -> Array:
        """Root of the second moments of (1, x, x^[2]), [P, P]: root root^T."""
        n = self.states.shape[2]
        rms = np.sqrt((self.states**2).mean(axis=(0, 1)))
        i, j = np.triu_indices(n)
        eye = np.eye(n)
        moments = np.zeros((1 + n + len(i),) * 2)
        moments[0, 0] = 1.0
        moments[1 : 1 + n, 1 : 1 + n] = eye
        moments[0, 1 + n :] = moments[1 + n :, 0] = eye[i, j]
        moments[1 + n :, 1 + n :] = (  # of four Gaussian numbers, pair by pair
            np.outer(eye[i, j], eye[i, j])
            + eye[np.ix_(i, i)] * eye[np.ix_(j, j)]
            + eye[np.ix_(i, j)] * eye[np.ix_(j, i)]
        )
        scale = np.concatenate([[1.0], rms, rms[i] * rms[j]])
        return np.asarray(scale[:, None] * np.linalg.cholesky(moments))

    def roots(self) -> Array:
        """Root of the information on a kick at each exit, all shots, [layer, n, n]: root root^T;
        zero in invisible directions."""
        whole, information = self.whole.sum(axis=0), self.information.sum(axis=0)
        size = np.sqrt(np.einsum("kii->ki", whole))
        safe = np.where(size > 0, size, 1.0)
        values, vectors = np.linalg.eigh(information / safe[:, :, None] / safe[:, None])
        values = np.where(values > UNSEEN, values, 0.0)
        return np.asarray(size[:, :, None] * vectors * np.sqrt(values)[:, None])


def symplectic_directions(W0: Array, W1: Array, W2: Array) -> Array:
    """Return changes of a layer that keep it symplectic to second order.

    The layer is followed by the flow of a polynomial H of degree 1, 2 or 3: d image = S grad H at
    the image, truncated at second order.

    Args:
        W0, W1, W2: one layer, [n], [n, n], [n, n (n + 1) / 2].

    Returns:
        A row for each monomial of H, [generator, n, 1 + n + n (n + 1) / 2]: changes of W0, W1, W2
        side by side. They are independent where W1 is regular.
    """
    image = TaylorMap([W0, W1, W2]).powers(2, 2)
    return np.asarray(np.einsum("amk,mp->kap", field_matrix(len(W0)), image))


def split(seen: Trajectories, effects: LayerEffects, weights: Array) -> Split:
    """Return the parts: effects, other symplectic changes, the rest (weights: change, [layer, n,
    P])."""
    maps = seen.model.maps
    kicked, trajectory = seen.roots(), seen.ensemble()
    rows = stacked((effects.D0, effects.D1, effects.D2))
    together, sigma = np.zeros(len(rows)), np.full(len(rows), np.inf)
    parts = np.zeros((len(weights), 3))
    order = np.argsort(effects.layer, kind="stable")
    first = np.searchsorted(effects.layer[order], np.arange(len(weights) + 1))
    for k in np.flatnonzero(kicked.any(axis=(1, 2))):
        left, right = kicked[k].T, trajectory  # change -> root^T change root: sigma

        def sized(change: Array, left: Array = left, right: Array = right) -> Array:
            return np.asarray(left @ change @ right).reshape(*change.shape[:-2], -1)

        vector = sized(weights[k])
        own = order[first[k] : first[k + 1]]
        columns = sized(rows[own]).T
        size = np.linalg.norm(columns, axis=0)
        unit = columns / np.where(size > 0, size, 1.0)
        U, values, V = np.linalg.svd(unit, full_matrices=False)
        kept = values > ALIKE
        physical = U[:, kept]
        inside = physical.T @ vector
        size = np.where(size > 0, size, np.inf)
        inverse = V[kept].T / values[kept]
        together[own] = inverse @ inside / size
        sigma[own] = np.where(size < np.inf, np.linalg.norm(inverse, axis=1) / size, np.inf)
        other = sized(symplectic_directions(maps.W0[k], maps.W1[k], maps.W2[k])).T
        size = np.linalg.norm(other, axis=0)
        other = other[:, size > 0] / size[size > 0]
        other -= physical @ (physical.T @ other)
        U, values, _ = np.linalg.svd(other, full_matrices=False)
        symplectic = U[:, values > DEPENDENT]
        along = symplectic.T @ vector
        rest = vector - physical @ inside - symplectic @ along
        parts[k] = [np.linalg.norm(part) for part in (inside, along, rest)]
    return Split(together, sigma, parts)
