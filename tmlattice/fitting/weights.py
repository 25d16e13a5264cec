"""Physics of a network's weights: every layer's weight change in parts.

>>> reading = read_network(ring, fine_tune(network, measurement).network, measurement)
>>> ring.magnets[reading.places("score")[0]].name         # the layer that changed most, in sigma

A layer's weights act on the data through the kick that they give each trajectory at the layer's
exit, (dW0 + dW1 x + dW2 x^[2]) at the state x at its entrance. The information of the readings on
that kick, launch projected out, is M [n, n], a sum over monitors downstream. So a change d has

- along the measured trajectories the information sum_s kick_s(d)^T M_s kick_s(d). Amounts, their
  errors and scores are in this metric. A few shots do not determine most weights of one layer:
  four coordinates have 60 weights, and a shot determines four combinations of them at most;
- over many trajectories of the same size the information <kick^T M kick>, M summed over the shots,
  x Gaussian with the rms coordinates of the shots over the whole ring. It has full rank where
  monitors see all of a kick. The parts of a change are orthogonal in this metric.

The parts are effects of the catalogue at that layer; other changes that leave the layer symplectic
to second order (x -> M(x) + S grad H (M(x)), H of degree 1 to 3, truncated); and the rest. The
squares of their norms sum to that of the whole. A norm is the significance of that part, in sigma,
for as many shots.

An effect is used if it acts through one layer and changes no read-out: none of families, of all
magnets, of monitors or of the beam.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from tmlattice.arrays import INVISIBLE, Array, Indices
from tmlattice.beam.model import Model
from tmlattice.effects import Hypothesis
from tmlattice.errors import LatticeError, MeasurementError
from tmlattice.fitting.weight_parts import (
    PARTS,
    LayerEffects,
    Split,
    Trajectories,
    layer_effects,
    split,
    stacked,
)
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork


@dataclass(frozen=True)
class WeightReading:
    """Weight changes of all layers, as physical effects.

    Attributes:
        ring: the design.
        raw: Euclidean norm of the change over all weights of a layer in m and rad, [layer].
        hypotheses: (effect, element) that act through one layer.
        layer: of each, [hypothesis].
        amount: each effect alone, in its unit, along the measured trajectories, [hypothesis].
        sigma: its standard deviation, launch projected out; inf if invisible.
        score: amount / sigma, signed; 0 if invisible.
        launches: fitted to the design, (x, px, y, py, delta), [shot, 5].
        chi2, readings: of the design with these launches; number of readings.
    """

    ring: Ring = field(repr=False)
    raw: Array = field(repr=False)
    hypotheses: tuple[Hypothesis, ...] = field(repr=False)
    layer: Indices = field(repr=False)
    amount: Array = field(repr=False)
    sigma: Array = field(repr=False)
    score: Array = field(repr=False)
    launches: Array = field(repr=False)
    chi2: float
    readings: int
    _take_apart: Callable[[], Split] = field(repr=False)

    @cached_property
    def split(self) -> Split:
        """Parts of the change; computed at the first call, in some seconds on a large ring."""
        return self._take_apart()

    @property
    def best(self) -> Array:
        """Largest |score| of the effects of each layer, [layer]; 0 without effects."""
        best = np.zeros(len(self.raw))
        np.maximum.at(best, self.layer, np.abs(self.score))
        return best

    def places(self, by: str = "score") -> Indices:
        """Layers, the most significant first, [layer].

        Args:
            by: "raw" for the norm of the change in weights, "score" for the largest score.

        Raises:
            ValueError: another ranking.
        """
        if by not in ("raw", "score"):
            raise ValueError(f"no ranking '{by}'; there are 'raw' and 'score'")
        return np.argsort(-(self.raw if by == "raw" else self.best), kind="stable")

    def as_json(self, first: int = 20) -> dict[str, Any]:
        """Return the `first` layers by score and by raw norm, with their effects."""
        magnets = self.ring.magnets
        split, best = self.split, self.best

        def entry(k: int) -> dict[str, Any]:
            own = [i for i in np.flatnonzero(self.layer == k) if np.isfinite(self.sigma[i])]
            return {
                "layer": int(k),
                "element": magnets[k].name,
                "s": magnets[k].s,
                "raw": float(self.raw[k]),
                "score": float(best[k]),
                "parts": {name: float(v) for name, v in zip(PARTS, split.parts[k], strict=True)},
                "shares": {name: float(v) for name, v in zip(PARTS, split.shares[k], strict=True)},
                "effects": [
                    {
                        "effect": self.hypotheses[i][0],
                        "element": self.hypotheses[i][1],
                        "amount": float(self.amount[i]),
                        "amount_sigma": float(self.sigma[i]),
                        "together": float(split.amount[i]),
                        "together_sigma": float(split.sigma[i]),
                        "score": float(self.score[i]),
                    }
                    for i in sorted(own, key=lambda i: -abs(self.score[i]))
                ],
            }

        return {
            "kind": "change",
            "chi2": self.chi2,
            "readings": self.readings,
            "by_score": [entry(int(k)) for k in self.places("score")[:first]],
            "by_raw": [entry(int(k)) for k in self.places("raw")[:first]],
        }


def read_network(
    ring: Ring,
    network: TaylorNetwork,
    measurement: Measurement,
    effects: LayerEffects | None = None,
) -> WeightReading:
    """Return the change of a network's weights from the design, layer by layer.

    Args:
        network: fine-tuned, of this ring.
        measurement: its first turn's trajectories and noise give the significance of a change.
        effects: of `layer_effects`, to be shared by many networks.

    Raises:
        LatticeError: a network of another ring.
        MeasurementError: data that cannot be used: settings that differ from the design's.
    """
    n = network.dimension
    if measurement.settings:
        raise MeasurementError(
            "a network has one set of weights for all shots, and these were taken with different "
            "settings; select the shots without (Measurement.select)"
        )
    if effects is None:
        effects = layer_effects(ring, n)
    if effects.ring is not ring or effects.dimension != n:
        raise ValueError("these effects are of another ring or of other coordinates")
    measurement.states(n)  # raises if four coordinates are too few
    seen = Trajectories(ring, measurement.select(turns=[0]), n)
    change = _change(seen.model, network)
    directions_ = (effects.D0, effects.D1, effects.D2)

    kicks = seen.kicks(effects.layer, directions_)
    M = seen.information[:, effects.layer]
    norm = np.einsum("shi,shij,shj->h", kicks, M, kicks)
    whole = np.einsum("shi,shij,shj->h", kicks, seen.whole[:, effects.layer], kicks)
    visible = (norm > INVISIBLE**2 * whole) & (norm > 0)
    own = seen.kicks(np.arange(len(ring.magnets)), change)[:, effects.layer]
    inner = np.einsum("shi,shij,shj->h", kicks, M, own)
    safe = np.where(visible, norm, 1.0)
    rows = stacked(change)
    return WeightReading(
        ring=ring,
        raw=np.sqrt((rows**2).sum(axis=(1, 2))),
        hypotheses=effects.hypotheses,
        layer=effects.layer,
        amount=np.where(visible, inner / safe, 0.0),
        sigma=np.where(visible, 1 / np.sqrt(safe), np.inf),
        score=np.where(visible, inner / np.sqrt(safe), 0.0),
        launches=seen.launches,
        chi2=seen.chi2,
        readings=seen.readings,
        _take_apart=partial(split, seen, effects, rows),
    )


def _change(model: Model, network: TaylorNetwork) -> tuple[Array, Array, Array]:
    ours, theirs = model.maps, network.maps
    same = ours.layers == theirs.layers and all(
        np.allclose(getattr(ours, w), getattr(theirs, w), rtol=1e-9, atol=1e-12)
        for w in ("W0", "W1", "W2")
    )
    if not same:
        raise LatticeError(
            f"the network ({len(theirs.layers)} layers) is of another lattice than "
            f"'{model.ring.name}' ({len(ours.layers)} layers); make it from the same one"
        )
    W0, W1, W2 = network.weights()
    return W0 - theirs.W0, W1 - theirs.W1, W2 - theirs.W2
