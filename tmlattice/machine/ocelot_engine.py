"""The machine as the chain of OCELOT's second-order maps, in six coordinates."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.readouts import positions
from tmlattice.effects import Cause, RingEffect, Settings, apply, find, set_elements
from tmlattice.effects.settings import groups
from tmlattice.lattice import Ring
from tmlattice.maps import LayerMaps, ring_maps
from tmlattice.maps.magnets import Weights

Array = NDArray[np.float64]


class OcelotEngine:
    """A ring with causes in it, tracked through second-order maps.

    Over many turns a beam that radiates is given back, at the end of each turn, the energy that the
    design orbit loses, by a linear cavity.

    Args:
        ring: the design.
        causes: those that act on readings or on the launch are the caller's.
        radiation_bends, radiation_wigglers: scale of the expected energy loss.
        voltage: of the cavity, V.
        harmonic: of the cavity; else 3840 for a circumference of 2303.952 m, in proportion.
    """

    name = "ocelot"

    def __init__(
        self,
        ring: Ring,
        causes: Sequence[Cause] = (),
        *,
        radiation_bends: float = 0.0,
        radiation_wigglers: float = 0.0,
        voltage: float = 20e6,
        harmonic: int | None = None,
    ) -> None:
        self.ring = ring
        self._causes = [
            *causes,
            *_radiation("radiation_loss_bends", radiation_bends),
            *_radiation("radiation_loss_wigglers", radiation_wigglers),
        ]
        self._layers = LayerMaps(apply(ring, self._causes), 6)
        self._at: dict[int, list[Cause]] = {}
        for cause in self._causes:
            effect = find(cause.effect)
            if isinstance(effect, RingEffect):
                for place in effect.members(ring, cause.element):
                    self._at.setdefault(place, []).append(cause)
        self._maps = ring_maps(self._layers.ring, 6, self._layers)
        self._voltage = voltage
        self._harmonic = harmonic or round(3840 * ring.length / 2303.952)

    def track(
        self,
        launches: Array,
        turns: int = 1,
        settings: Sequence[Settings] | None = None,
    ) -> Array:
        """Where the beam is at every monitor.

        Args:
            launches: OCELOT's (x, px, y, py, tau, p) at the start of the ring, [shot, 6].
            turns: at least 1.
            settings: of each shot, see `apply`.

        Returns:
            (x, y) in m, [shot, turn, monitor, 2]; NaN once the beam is lost.
        """
        launches = np.asarray(launches, dtype=float)
        beam = np.empty((len(launches), turns, len(self._maps.at), 2))
        for shots, setting in groups(settings, len(launches)):
            slip = setting.get("rf", {}).get("frequency_relative", 0.0) * self.ring.length
            weights, readouts, closing = self._with(setting)
            if turns > 1:
                closing = self._with_cavity(closing, slip)
            chain = [np.concatenate([w, c[None]]) for w, c in zip(weights, closing, strict=True)]
            beam[shots] = positions(launches[shots], turns, chain, readouts, self._maps.at)
        return beam

    def _with(self, setting: Settings) -> tuple[Weights, Weights, Weights]:
        """Weights, read-outs and closing map of a shot's settings."""
        maps, layers = self._maps, self._layers
        weights = (maps.W0, maps.W1, maps.W2)
        readouts = (maps.R0, maps.R1, maps.R2)
        W0, W1, W2 = maps.closing.coefficients
        closing = (W0, W1, W2)
        if not setting:
            return weights, readouts, closing
        replaced = set_elements(self.ring, setting)
        for place, element in replaced.items():
            for cause in self._at.get(place, []):  # errors act on what was set
                effect = find(cause.effect)
                assert isinstance(effect, RingEffect)
                element = effect.changed(element, cause.amount, self.ring.energy)  # noqa: PLW2901
            replaced[place] = element
        weights = (maps.W0.copy(), maps.W1.copy(), maps.W2.copy())
        for k in {int(layers.layer_of[place]) for place in replaced}:
            own, _ = layers.layer(k, replaced)
            for stack, new in zip(weights, own, strict=True):
                stack[k] = new  # what is set is a magnet: no read-out changes
        return weights, readouts, closing

    def _with_cavity(self, closing: Weights, slip: float) -> Weights:
        """The closing map, then a linear cavity that restores the design orbit's loss."""
        ring = self._layers.ring
        loss = sum(element.errors.loss for element in ring.elements)
        if loss == 0 and slip == 0:
            return closing
        energy = ring.energy * 1e9
        wave = 2 * np.pi * self._harmonic / ring.length
        # above transition a late particle (tau > 0) must be given less
        slope = -np.sqrt(max(self._voltage**2 - (loss * energy) ** 2, 0.0)) / energy * wave
        cavity, offset = np.eye(6), np.zeros(6)
        cavity[5, 4] = slope
        offset[4] = slip
        offset[5] = loss + slope * slip
        W0, W1, W2 = closing
        return cavity @ W0 + offset, cavity @ W1, cavity @ W2


def _radiation(name: str, scale: float) -> list[Cause]:
    return [Cause(name, None, scale)] if scale else []
