"""The options of a diagnosis, of any kind of measurement."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tmlattice.inference.distributed import DistributedErrors
from tmlattice.inference.judgement import DEFAULT, Judgement
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.version import __version__


@dataclass(frozen=True, eq=False)
class Options:
    """The options of a diagnosis; those without a line here are described by `diagnose`.

    Attributes:
        ring: the design.
        places: number of places of each effect, for the prior.
        judgement: thresholds.
        holdout: share of shots, or of correctors, that the fit does not see; 0: none are held out.
        max_effects: most findings; of an orbit response most families of errors; 0: no search.
        reference: an earlier measurement, or several by name.
        begun: when the diagnosis began, s.
    """

    ring: Ring
    places: Mapping[str, float] = field(default_factory=dict)
    judgement: Judgement = DEFAULT
    holdout: float = 0.0
    max_effects: int = 0
    effects: Sequence[str] | None = None
    assume: Sequence[str] = ()
    reference: Any = None
    heldout: Measurement | None = None
    background: str | Mapping[str, float | None] | None = None
    known: DistributedErrors | None = None
    radiation: bool = False
    missing: bool = False
    seed: int = 0
    progress: Callable[[str], Any] = lambda stage: None
    begun: float = field(default_factory=time.perf_counter)

    def provenance(self, **more: Any) -> dict[str, Any]:
        """The provenance of the diagnosis; `more` are further options as used."""
        return {
            "package": __version__,
            "lattice": self.ring.name,
            "measurement": None,
            "options": {
                "reference": self.reference is not None,
                "holdout": self.holdout,
                "effects": None if self.effects is None else list(self.effects),
                "max_effects": self.max_effects,
                "false_alarm": self.judgement.false_alarm,
                "radiation": self.radiation,
                **({"assume": list(self.assume)} if self.assume else {}),
                **more,
            },
            "seed": self.seed,
            "seconds": time.perf_counter() - self.begun,
        }
