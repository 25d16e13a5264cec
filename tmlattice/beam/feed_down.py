"""Feed-down: changes of the matrices by a displaced closed orbit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.maps.taylor import second_derivatives

Array = NDArray[np.float64]


def feed_down(
    model: ResponseModel, back: NDArray[np.floating[Any]], into: NDArray[np.floating[Any]]
) -> Array:
    """Sources C^-1 T''(., C da) C for a change da of the closed orbit's launch, summed before each
    exit, [layer + 2, n, n, n], da the last axis.

    Args:
        back, into: matrices from the layers' exits to the start and from there into the layers, of
            the motion around the closed orbit, [layer + 2, n, n].
    """
    maps, n = model.maps, model.dimension
    W2 = np.concatenate([maps.W2, maps.closing.coefficients[2][None]])  # with the closing drift
    j = np.flatnonzero(W2.any(axis=(1, 2)))
    summed = np.zeros((len(W2) + 1, n, n, n))
    summed[j + 1] = np.einsum(
        "kai,kijl,klc,kjb->kabc", back[j + 1], second_derivatives(W2[j]), model.tangents[j],
        into[j], optimize=True,
    )  # fmt: skip
    return np.cumsum(summed, axis=0)
