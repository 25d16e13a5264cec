"""Simple methods on a case: they have the design, and fit the nuisances first.

Each returns three suspects at most for any data: none of them can report that nothing is wrong.
"""

import warnings
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.challenge.case import Case, ring_of
from tmlattice.challenge.kinds import problem_of_case
from tmlattice.challenge.oracle import hypotheses_of
from tmlattice.errors import missing_package
from tmlattice.fitting import fine_tune
from tmlattice.inference.newton import Fit, fit
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork

Guesses = list[dict[str, Any]]

SUSPECTS = 3

MOST_NUMBERS = 2**27
"""Numbers of all signatures: a gigabyte; simple methods are not run with more."""


def baselines(case: Case) -> dict[str, Guesses]:
    """Return first guesses, {"effect", "element"}, by method.

    "svd_gradients" is the pseudo-inverse over all gradients, "omp" orthogonal matching pursuit and
    "lasso" the LASSO over the whole catalogue; of first turns "weight_change" is the magnet whose
    layer changes most when a network is fine-tuned by the paper's recipe, without an effect.
    """
    problem = problem_of_case(case, {})
    start = fit(problem, (), problem.first)
    hypotheses = hypotheses_of(case, problem)
    if len(hypotheses) * len(start.residual) > MOST_NUMBERS:
        return {}
    metric = problem.metric(start.point)
    chunks = range(0, len(hypotheses), metric.chunk)
    rows = np.concatenate(
        [metric.projection.out(metric.rows(hypotheses[i : i + metric.chunk])) for i in chunks]
    )
    found = pursuits(rows, start.clean)
    gradients = [i for i, (name, _) in enumerate(hypotheses) if name == "quadrupole_gradient"]
    if gradients:
        found["svd_gradients"] = np.zeros(len(rows))
        solved = np.linalg.pinv(rows[gradients].T, rcond=1e-2) @ start.clean
        found["svd_gradients"][gradients] = solved
    guesses = {
        method: [
            dict(zip(("effect", "element"), hypotheses[i], strict=True))
            for i in np.argsort(-np.abs(values))[:SUSPECTS] if values[i] != 0
        ]
        for method, values in found.items()
    }  # fmt: skip
    return guesses if case.kinds else {**guesses, "weight_change": _weight_change(case, start)}


def _weight_change(case: Case, start: Fit) -> Guesses:
    """Layers that change most, fine-tuned on the orbits of the unset ring.

    The network is the design's, without the correctors that a shot sets: their modelled effect is
    subtracted from the readings.
    """
    ring = ring_of(case.lattice)
    network = TaylorNetwork.from_ring(ring)
    shots = len(case.fit.shots)
    launches = start.nuisances.reshape(-1, 5)[:shots] * [1, 1, 1, 1, 0]  # a network of four
    modelled = start.point.view[0].view.readings
    ordered = case.fit.in_order_of(network.monitors)
    readings = ordered.readings[:, 0] - modelled + network.readings(launches[:, :4])
    orbit = Measurement(launches, readings[:, None], network.monitors, noise=ordered.noise)
    tuned = fine_tune(network, orbit, progress=False).network
    assert isinstance(tuned, TaylorNetwork)
    change = sum(
        ((after - before) ** 2).reshape(len(after), -1).sum(axis=1)
        for after, before in zip(tuned.weights(), network.weights(), strict=True)
    )
    order = np.argsort(-np.asarray(change))[:SUSPECTS]
    return [{"effect": None, "element": ring.magnets[int(k)].name} for k in order]


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
