"""A ring's network as an engine for the many particles of a stored beam.

Its second-order maps are those of the diagnosis, so it is no referee. Its speed is its purpose: a
turn of 100,000 particles takes a millisecond on a graphics card, and half a minute in AT.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.rf import cavities, rf_of
from tmlattice.effects import Cause, Settings, apply
from tmlattice.errors import EffectError, TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.machine.at_engine import from_at, to_at


class NetworkEngine:
    """The network of a ring with causes, in six coordinates; on a graphics card where there is one.

    States are AT's (x, px, y, py, delta, ct), as `AtEngine`'s. The RF acts once a turn, at its end.

    Raises:
        EffectError: a cause by which the beam loses energy.
    """

    def __init__(self, ring: Ring, causes: Sequence[Cause] = ()) -> None:
        import torch

        from tmlattice.network import TaylorNetwork

        if any(cause.effect.startswith("radiation") for cause in causes):
            raise EffectError("the network has no radiation; take the engine 'at'")
        self.ring = ring
        network = TaylorNetwork.from_ring(apply(ring, causes), 6).requires_grad_(False)
        self._network = network.to("cuda") if torch.cuda.is_available() else network
        layer_of = np.zeros(len(ring.elements), dtype=np.intp)
        with_rf = cavities(ring, rf_of(ring), layer_of, 0.0, 0.0)
        self._rf = with_rf.values * [max(len(with_rf.exits), 1), 1, 1, 1]

    def stored_line(self, settings: Settings) -> tuple[Any, Any, float]:
        """See `AtEngine.stored_line`; a line is whether the RF is on; TmlatticeError: settings."""
        if settings:
            raise TmlatticeError("the network has no settings; take the engine 'at'")
        return False, bool(self._rf[0]), 0.0

    def one_pass(self, rf: Any, beam: Array) -> Array:
        """Return readings of the first state of [6, shot]; all are moved to the turn's end."""
        state, readings = self._moved(self._state(beam), rf)
        beam[:] = to_at(state.cpu().numpy(), self.ring.energy, self.ring.mass).T
        return np.asarray(readings[0].cpu().numpy())

    def centroids(self, rf: Any, beam: Array, turns: int) -> Iterator[tuple[Array, Array]]:
        """See `AtEngine.centroids`; on the card nothing but the centroid leaves it."""
        state = self._state(beam)
        for _ in range(turns):
            state, readings = self._moved(state, rf)
            seen = readings[..., 0].isfinite()
            mean = readings.where(seen[..., None], 0.0).sum(dim=0) / seen.sum(dim=0)[:, None]
            yield mean.cpu().numpy(), seen.double().mean(dim=0).cpu().numpy()

    def _moved(self, state: Any, rf: bool) -> tuple[Any, Any]:
        """States and readings after a turn, and the RF at its end; NaN where lost."""
        readings, state = self._network.one_turn(state)
        if rf:
            crest, phase, wave, _ = self._rf
            state[:, 5] += crest * ((phase - wave * state[:, 4]).sin() - np.sin(phase))
        return state, readings

    def _state(self, beam: Array) -> Any:
        own = from_at(beam.T, self.ring.energy, self.ring.mass)
        return self._network.W0.new_tensor(own)
