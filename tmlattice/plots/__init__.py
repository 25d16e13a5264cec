"""Figures. Every function takes `ax` (or makes one) and returns it; labels carry units."""

from tmlattice.plots.optics import plot_betas, plot_phase_space
from tmlattice.plots.strip import lattice_strip, save_figure
from tmlattice.plots.tune_fit import (
    plot_loss,
    plot_orbit,
    plot_orbit_fit,
    plot_spectrum,
    plot_study,
    plot_tune_fit_spectrum,
)
from tmlattice.plots.weights import plot_weights

__all__ = [
    "lattice_strip",
    "plot_betas",
    "plot_loss",
    "plot_orbit",
    "plot_orbit_fit",
    "plot_phase_space",
    "plot_spectrum",
    "plot_study",
    "plot_tune_fit_spectrum",
    "plot_weights",
    "save_figure",
]
