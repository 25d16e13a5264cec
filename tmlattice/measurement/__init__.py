"""What the monitors read: shots, turns, monitors, noise."""

from tmlattice.measurement.trajectory import Measurement

__all__ = ["Measurement"]
