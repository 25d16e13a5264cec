"""Simple methods on a case: they have the design, and fit the launches first.

Each returns three suspects at most for any data: none of them can report that nothing is wrong.
"""

import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model, Paths
from tmlattice.challenge.case import Case, ring_of
from tmlattice.effects import modelled
from tmlattice.errors import missing_package
from tmlattice.fitting import fine_tune
from tmlattice.inference.whitening import Projection, Whitening
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork
from tmlattice.observe.data import Data, of_measurement

Array = NDArray[np.float64]
Guesses = list[dict[str, Any]]

SUSPECTS = 3
CHUNK = 512


def baselines(case: Case) -> dict[str, Guesses]:
    """Return first guesses, {"effect", "element"}, by method.

    "svd_gradients" is the pseudo-inverse over all gradients, "omp" orthogonal matching pursuit and
    "lasso" the LASSO over the whole catalogue; "weight_change" is the magnet whose layer changes
    most when a network is fine-tuned by the paper's recipe, without an effect.
    """
    ring = ring_of(case.lattice)
    data = of_measurement(ring, case.fit)
    model = Model(ring, data.settings)
    whitening = Whitening(data)
    launches = data.launches
    for _ in range(4):
        paths = model.paths(launches)
        difference = np.where(data.valid, data.readings - paths.readings, 0.0)
        residual = whitening.residual(difference, launches)
        projection = Projection(whitening.launch(paths.launch))
        moved = projection.coordinates(residual).reshape(data.shots, -1)
        launches = launches.copy()
        launches[:, whitening.columns] += moved
    residual = projection.out(residual)
    hypotheses = model.hypotheses(modelled(case.options.get("effects")))
    parts = []
    for start in range(0, len(hypotheses), CHUNK):
        some = hypotheses[start : start + CHUNK]
        change = np.nan_to_num(model.signatures(paths, some, launches))
        parts.append(whitening.signature(change))
    rows = np.concatenate(parts)

    def guess(order: Sequence[int]) -> Guesses:
        found = [hypotheses[i] for i in order]
        return [{"effect": effect, "element": element} for effect, element in found]

    out = {}
    gradients = [i for i, (name, _) in enumerate(hypotheses) if name == "quadrupole_gradient"]
    if gradients:
        solved = np.linalg.pinv(rows[gradients].T, rcond=1e-2) @ residual
        order = np.argsort(-np.abs(solved))[:SUSPECTS]
        out["svd_gradients"] = guess([gradients[i] for i in order])
    for name, values in pursuits(rows, residual).items():
        order = np.argsort(-np.abs(values))[:SUSPECTS]
        out[name] = guess([int(i) for i in order if values[i] != 0])
    out["weight_change"] = _weight_change(case, data, paths, launches)
    return out


def pursuits(rows: Array, residual: Array) -> dict[str, Array]:
    """Return weights of signatures of unit length by matching pursuit and by the LASSO.

    Args:
        rows: signatures, nuisances projected out, [hypothesis, row].
        residual: [row].
    """
    try:
        from sklearn.linear_model import Lasso, orthogonal_mp
    except ModuleNotFoundError as error:
        raise missing_package(error, "the baselines need", "challenge") from error

    size = np.sqrt(np.einsum("hr,hr->h", rows, rows))
    seen = np.flatnonzero(size > 0)
    unit = (rows[seen] / size[seen, None]).T
    atoms, weights = np.zeros((2, len(rows)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nearly equal columns
        atoms[seen] = orthogonal_mp(unit, residual, n_nonzero_coefs=SUSPECTS)
        level = np.sqrt(2 * np.log(len(seen)))  # the universal threshold
        strong = np.flatnonzero(np.abs(unit.T @ residual) >= level)  # the others start at zero
        if len(strong):
            lasso = Lasso(alpha=level / len(residual), fit_intercept=False, max_iter=100, tol=1e-3)
            weights[seen[strong]] = lasso.fit(unit[:, strong], residual).coef_
    return {"omp": atoms, "lasso": weights}


@lru_cache(maxsize=2)
def _design(lattice: str) -> TaylorNetwork:
    return TaylorNetwork.from_ring(ring_of(lattice))


def _weight_change(case: Case, data: Data, paths: Paths, launches: Array) -> Guesses:
    """Layers that change most, fine-tuned on the orbits of the unset ring.

    The network is the design's, without the correctors that a shot sets: their modelled effect is
    subtracted from the readings.
    """
    network = _design(case.lattice)
    at_energy = launches.copy()
    at_energy[:, 4] = 0.0  # not a coordinate of a network of four
    unset = network.readings(at_energy[:, :4])
    readings = np.where(data.valid, data.readings - paths.readings + unset, np.nan)
    orbit = Measurement(at_energy, readings[:, None], network.monitors, noise=case.fit.noise)
    tuned = fine_tune(network, orbit, progress=False).network
    assert isinstance(tuned, TaylorNetwork)
    change = sum(
        ((after - before) ** 2).reshape(len(after), -1).sum(axis=1)
        for after, before in zip(tuned.weights(), network.weights(), strict=True)
    )
    magnets = ring_of(case.lattice).magnets
    order = np.argsort(-np.asarray(change))[:SUSPECTS]
    return [{"effect": None, "element": magnets[int(k)].name} for k in order]
