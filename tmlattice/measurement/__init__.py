"""What is read of a ring: one record for each kind of measurement, and the folder that holds it.

>>> measurement = read_measurement("day_1", monitors=[m.name for m in ring.monitors])
>>> fit, held_out = measurement.split(0.2, seed=1)
>>> fit.compare(model).chi2_per_dof                   # model [shot, turn, monitor, 2], m
>>> with measurement_writer("day_2", names, noise=(2e-5, 2e-5)) as writer:
...     writer.add(0, launch, None, {}, readings)     # readings [turn, monitor, 2]
"""

from tmlattice.measurement.dispersion import Dispersion
from tmlattice.measurement.folder import AnyMeasurement, in_words, read_measurement
from tmlattice.measurement.orbit_response import OrbitResponse, RfStep
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.tables import read_table, read_turn_by_turn
from tmlattice.measurement.trajectory import Comparison, Measurement
from tmlattice.measurement.truth import Truth, read_truth, write_truth
from tmlattice.measurement.tune_reading import TuneReading
from tmlattice.measurement.write import MeasurementWriter, measurement_writer, write_measurement

__all__ = [
    "AnyMeasurement",
    "ClosedOrbit",
    "Comparison",
    "Dispersion",
    "Measurement",
    "MeasurementWriter",
    "OrbitResponse",
    "RfStep",
    "Truth",
    "TuneReading",
    "TurnByTurn",
    "in_words",
    "measurement_writer",
    "read_measurement",
    "read_table",
    "read_truth",
    "read_turn_by_turn",
    "write_measurement",
    "write_truth",
]
