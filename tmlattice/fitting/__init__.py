"""Fine-tuning of a network on measured trajectories, and what it says of the tunes.

>>> result = fine_tune(network, measurement)       # the paper's recipe
>>> outcome = tune_fit(load_ring("petra3"))        # the whole experiment of `tmlattice tune-fit`
"""

from tmlattice.fitting.adam import FitResult, Regularization, fit_adam as fine_tune
from tmlattice.fitting.experiment import TuneFit, tune_fit

__all__ = ["FitResult", "Regularization", "TuneFit", "fine_tune", "tune_fit"]
