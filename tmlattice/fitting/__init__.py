"""Fine-tuning of a network on measured trajectories, and its prediction of the tunes.

>>> result = fine_tune(network, measurement)       # the paper's recipe
>>> fine_tune(network, measurement, method="sparse").changes    # which magnet, by how much
>>> outcome = tune_fit(load_ring("petra3"))        # the whole experiment of `tmlattice tune-fit`
"""

import tmlattice.network  # noqa: F401  (first: its error names what to install without torch)
from tmlattice.fitting.adam import FitResult, Regularization
from tmlattice.fitting.experiment import tune_fit, tune_fit_measurement
from tmlattice.fitting.methods import fine_tune
from tmlattice.fitting.outcome import METHODS, MethodFit, TuneFit

__all__ = [
    "METHODS",
    "FitResult",
    "MethodFit",
    "Regularization",
    "TuneFit",
    "fine_tune",
    "tune_fit",
    "tune_fit_measurement",
]
