"""Measurements of each kind as inference problems: residuals, Jacobians, noise, nuisances."""
