"""`fine_tune`: one call, four methods."""

from dataclasses import replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.by_name import by_name
from tmlattice.errors import unknown_choice
from tmlattice.fitting.adam import FitResult, fit_adam
from tmlattice.fitting.map_fit import fit_map
from tmlattice.fitting.sparse import EFFECTS, fit_sparse, sparse_causes, warn_of_launches
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork
from tmlattice.observe.data import NOISE_FLOOR, first_turn


class Method(StrEnum):
    """Method of fine-tuning a network."""

    ADAM = "adam"
    MAP = "map"
    SPARSE = "sparse"
    TOLD = "told"


@by_name
def fine_tune(
    network: TaylorNetwork | SymplecticNetwork,
    measurement: Measurement,
    *,
    method: Method | str = "adam",
    **options: Any,
) -> FitResult:
    """Fit a network to the first turn of a measurement; the given network is not changed.

    Args:
        network: the design.
        measurement: launches and readings.
        method: "adam", every weight free and a symplectic penalty, the paper's recipe
            (`fitting.adam.fit_adam`); "map", the most probable changes under a prior
            (`fitting.map_fit.fit_map`); "sparse", the set of changed magnets with the largest
            evidence (`fitting.sparse.fit_sparse`); "told", the same with known candidates
            (`candidates=`), the best possible. All but the first state the error of their tunes.
        options: of the method, see there.

    Launches are as exact as the measurement states (`launch_sigma=` overrides it). A warning
    reports readings that contradict that.

    Raises:
        ChoiceError: an unknown method; it is a ValueError too.
        ValueError: an option's value.
        TmlatticeError: a measurement that cannot be fitted, see the methods.
    """
    try:
        chosen = Method(method)
    except ValueError:
        raise unknown_choice("method", method, Method) from None
    if chosen is Method.ADAM:
        result = fit_adam(network, measurement, **options)
        _check_launches(network, measurement, options.get("launch_sigma"))
        return _with_chi2(result, measurement)
    if chosen is Method.MAP:
        return _with_chi2(fit_map(network, measurement, **options), measurement)
    if chosen is Method.TOLD and not options.get("candidates"):
        raise ValueError("method 'told' needs the magnets that may have changed: give candidates=")
    if isinstance(network, SymplecticNetwork):
        if network.ring is None:
            raise ValueError("methods 'sparse' and 'told' need a network made from a ring")
        network = TaylorNetwork.from_ring(network.ring, network.dimension)
    return _with_chi2(fit_sparse(network, measurement, **options), measurement)


def _check_launches(
    network: TaylorNetwork | SymplecticNetwork, measurement: Measurement, sigma: ArrayLike | None
) -> None:
    """Warn of launches that differ from those stated; silent without a ring or a noise."""
    ring, n = network.ring, network.dimension
    if ring is None or measurement.noise is None:
        return
    if not any(e.k1 or e.k2 for e in ring.elements if e.kind in EFFECTS):
        return
    data = first_turn(network.monitors, measurement, None, sigma, n)
    warn_of_launches(ring, data, n, sparse_causes(ring, data, dimension=n))


def _with_chi2(result: FitResult, measurement: Measurement) -> FitResult:
    """Add chi-square to the result."""
    noise = result.options.get("noise")
    ordered = measurement.in_order_of(result.network.monitors)
    sigma = ordered.noise if noise is None else np.full((len(ordered.monitors), 2), noise)
    if sigma is None:
        return result
    n = result.network.dimension
    launches = ordered.states(n) if result.launches is None else result.launches
    left = ordered.readings[:, 0] - result.network.readings(launches)
    return replace(result, chi2=float(np.nanmean((left / np.maximum(sigma, NOISE_FLOOR)) ** 2)))
