"""The machine as the chain of OCELOT's maps, with the third order of sextupoles."""

from collections.abc import Sequence

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.assembly import Group, assembly
from tmlattice.beam.readouts import positions
from tmlattice.beam.rf import NO_RF
from tmlattice.effects import Cause, Settings
from tmlattice.effects.apply import groups
from tmlattice.lattice import Ring


class OcelotEngine:
    """A ring with causes, tracked through the maps of the diagnosis.

    Over many turns the RF replaces the design orbit's loss: see `beam.rf`."""

    def __init__(
        self,
        ring: Ring,
        causes: Sequence[Cause] = (),
        *,
        radiation_bends: float = 0.0,
        radiation_wigglers: float = 0.0,
    ) -> None:
        scales = {"bends": radiation_bends, "wigglers": radiation_wigglers}
        lost = [Cause(f"radiation_loss_{what}", None, scale) for what, scale in scales.items()]
        known = [*causes, *(cause for cause in lost if cause.amount)]
        self._there = assembly(ring, known)

    def track(
        self, launches: Array, turns: int = 1, settings: Sequence[Settings] | None = None
    ) -> Array:
        """Return the beam at every monitor, see `AtEngine.track`."""
        launches, there = np.asarray(launches, dtype=float), self._there
        beam = np.empty((len(launches), turns, len(there.maps.at), 2))
        for shots, setting in groups(settings, len(launches)):
            layers = Group(0, shots, setting, there).layers
            rf = there.cavities(setting) if turns > 1 else NO_RF
            beam[shots] = positions(launches[shots], turns, layers, rf)
        return beam
