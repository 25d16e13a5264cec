"""The model of a diagnosis: a ring with its shots, and every hypothesis."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam import signatures
from tmlattice.beam.assembly import Hypothesis
from tmlattice.beam.tracked import LAUNCH, Kicks, Paths, TrackedShots
from tmlattice.effects import CATALOGUE, ReadingEffect, find, names

__all__ = ["LAUNCH", "Hypothesis", "Kicks", "Model", "Paths"]

Array = NDArray[np.float64]


class Model(TrackedShots):
    """A ring as in the shots of a measurement, and every hypothesis.

    Args, attributes, errors: those of `TrackedShots`.
    """

    def hypotheses(self, effects: Sequence[str] | None = None) -> list[Hypothesis]:
        """Return every effect at every place, in the catalogue's order.

        Discrete effects (swapped, dead) are included; the energy's only in six coordinates.
        """
        chosen = names() if effects is None else list(effects)
        found: list[Hypothesis] = []
        for name in chosen:
            if not (CATALOGUE[name].energy and self.dimension == 4):
                found += [(name, place) for place in CATALOGUE[name].places(self.ring)]
        return found

    def signatures(self, paths: Paths, hypotheses: Sequence[Hypothesis], launches: Array) -> Array:
        """d readings / d amount ** power of every hypothesis, [hypothesis, shot, reading, 2].

        For a discrete effect: its change of the readings.

        Args:
            paths: of the model.
            hypotheses: see `hypotheses`.
            launches: those of the paths.
        """
        return signatures.signatures(self, paths, hypotheses, launches)

    def reading_signatures(self, paths: Paths, effect: str) -> Array:
        """The same for one effect on readings at every monitor, [shot, reading, 2]."""
        own = find(effect)
        assert isinstance(own, ReadingEffect)
        return signatures.of_readings(self, paths, own)

    def kick_signatures(self, paths: Paths, layers: NDArray[np.int64]) -> Array:
        """d readings / d kick (px, py) in the middle of layers' magnets.

        Returns:
            [layer, 2, shot, reading, 2], m / rad.
        """
        return signatures.kick_signatures(self, paths, layers)

    def free_kicks(
        self, paths: Paths, layers: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], Array]:
        """Kicks (px, py) in the middle of layers' magnets on one turn, as changes of the launch.

        Returns:
            The first reading behind each, [layer], and [layer, 2, shot, n].
        """
        return signatures.free_kicks(self, paths, layers)

    def single_kicks(
        self, paths: Paths, hypotheses: Sequence[Hypothesis]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Hypotheses that are one kick on one turn, as changes of the launch.

        Such a signature equals the launch's from a reading on: all that `scan` needs.

        Returns:
            Indices of these hypotheses, [kick]; the first reading behind each; and the change of
            the launch, [shot, kick, n].
        """
        return signatures.single_kicks(self, paths, hypotheses)
