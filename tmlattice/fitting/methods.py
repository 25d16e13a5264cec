"""`fine_tune`: one call, four methods."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.by_name import by_name
from tmlattice.errors import unknown_choice
from tmlattice.fitting.adam import FitResult, Network, Regularization, fit_adam
from tmlattice.fitting.map_fit import Prior, fit_map
from tmlattice.fitting.sparse import (
    EFFECTS,
    FAULT,
    LARGEST_NUMBER,
    REFINED,
    fit_sparse,
    searched,
    warn_of_launches,
)
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork
from tmlattice.observe.data import NOISE_FLOOR


@by_name
def fine_tune(
    network: Network,
    measurement: Measurement,
    *,
    method: str = "adam",
    launch_sigma: ArrayLike | None = None,
    progress: bool = True,
    epochs: int = 1000,
    learning_rate: float = 1e-6,
    regularization: Regularization | str = "symplectic",
    regularization_rate: float = 1e-10,
    relative_to_design: bool = False,
    free: Sequence[str] | None = None,
    clip: float = 1.0,
    patience: int | None = 200,
    ring: Ring | None = None,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    noise: float | None = None,
    fault: float = FAULT,
    largest_number: int = LARGEST_NUMBER,
    refined: int = REFINED,
    candidates: Sequence[str] | None = None,
    prior: Prior | str = Prior.FAULTS,
    scale: float | None = None,
) -> FitResult:
    """Fit a network to the first turn of a measurement; the given network is not changed.

    Args:
        measurement: launches and readings; a path or a DataFrame is taken too.
        method: "adam", every weight free and a symplectic penalty, the paper's recipe
            (`fitting.adam.fit_adam`); "map", the most probable changes under a prior
            (`fitting.map_fit.fit_map`); "sparse", the set of changed magnets with the largest
            marginal likelihood (`fitting.sparse.fit_sparse`); "known", the same for given magnets
            (`candidates=`): nothing else can be better. All but the first state the error of their
            tunes.
        launch_sigma: standard error of the launch coordinates, one number, [n] or [shot, n], m and
            rad; 0: exact; inf: unknown; None: the measurement's own.
        epochs, learning_rate, regularization, regularization_rate: of "adam", see
            `fitting.adam.fit_adam`.
        relative_to_design, free, clip, patience: of the same.
        ring, kinds, noise: of the others: the ring whose magnets change (None: the network's own),
            the kinds of magnets, and the rms of one reading, m (None: the measurement's).
        fault, largest_number, refined: of "sparse" and "known".
        candidates: of the same: the only magnets that may have changed.
        prior, scale: of "map".

    A warning reports readings that contradict the stated errors of the launches.

    Raises:
        ValueError: an unknown method, an option's value, or an option without meaning for the
            method.
        TmlatticeError: a measurement that cannot be fitted, see the methods.
    """
    given = dict(locals())
    if method not in _FITS:
        raise unknown_choice("method", method, _FITS)
    fit = _FITS[method]
    options = _options_of(fit, given, method)
    if method == "known" and not candidates:
        raise ValueError(
            "method 'known' needs the names of the magnets that may have changed: give candidates="
        )
    if fit is not fit_adam and isinstance(network, SymplecticNetwork):
        if network.ring is None:
            raise ValueError(f"method '{method}' needs a network made from a ring")
        network = TaylorNetwork.from_ring(network.ring, network.dimension)
    result = fit(network, measurement, **options)
    if fit is fit_adam:
        _check_launches(network, measurement, launch_sigma)
    return _with_chi2(result, measurement)


_FITS: dict[str, Callable[..., FitResult]] = {
    "adam": fit_adam, "map": fit_map, "sparse": fit_sparse, "known": fit_sparse
}  # fmt: skip


def _options_of(fit: Callable[..., Any], given: dict[str, Any], method: str) -> dict[str, Any]:
    """Those of the arguments that the method has; ValueError: another one was given."""
    own = signature(fit).parameters
    options = {}
    for name, parameter in signature(fine_tune).parameters.items():
        if parameter.kind is not parameter.KEYWORD_ONLY or name == "method":
            continue
        if name in own:
            options[name] = given[name]
        elif given[name] != parameter.default:
            raise ValueError(f"the option '{name}' has no meaning for method '{method}'")
    return options


def _check_launches(network: Network, measurement: Measurement, sigma: ArrayLike | None) -> None:
    """Warn of launches that differ from those stated; silent without a ring or a noise."""
    ring = network.ring
    if ring is None or measurement.noise is None:
        return
    if any(e.k1 or e.k2 for e in ring.elements if e.kind in EFFECTS):
        warn_of_launches(searched(network, measurement, ring, tuple(EFFECTS), None, sigma))


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
