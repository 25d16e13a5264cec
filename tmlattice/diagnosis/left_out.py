"""What of several measurements took no part, in words: monitors without a reading, and spikes."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.diagnosis.kinds import Part
from tmlattice.inference.search import Explanation
from tmlattice.inference.together import Together
from tmlattice.lattice import Ring


def with_silent(ring: Ring, part: Part, measured: Any) -> Part:
    """The part, saying which monitors of its measurement read nothing that can be used.

    Args:
        ring: with the monitors.
        part: made of the measurement; what it found dead becomes a finding, and is not said again.
        measured: of any kind; one without monitors has nothing to say.
    """
    problem = part.problem
    owners = problem.owner()
    heard = {
        ring[problem.monitors[m]].name for m in np.unique(owners[problem.valid & (owners >= 0)])
    }
    heard |= {ring.monitors[m].name for m, _ in part.dead}
    names = [ring[name].name for name in getattr(measured, "monitors", ())]
    silent = [name for name in names if name not in heard]
    if not silent:
        return part
    said = f"no reading that can be used of {', '.join(silent)}: left out"
    return replace(part, said=(*part.said, said))


def spikes(parts: Sequence[Part], problem: Together, found: Explanation) -> Iterator[str]:
    """A sentence for each measurement with single readings that the search left out."""
    ends = np.cumsum([part.valid.size for part in problem.parts])
    own: dict[int, list[int]] = {}
    for reading in found.spikes:
        flat = int(np.ravel(reading)[-1])
        own.setdefault(int(np.searchsorted(ends, flat, side="right")), []).append(flat)
    for index, (part, one) in enumerate(zip(parts, problem.parts, strict=False)):
        if index not in own:
            continue
        owners = one.owner().ravel()
        start = int(ends[index]) - one.valid.size
        count = Counter(one.monitors[owners[flat - start]] for flat in own[index])
        told = [name if many == 1 else f"{name} ({many})" for name, many in count.items()]
        yield f"{part.label}: single readings left out as spikes: {', '.join(told)}"
