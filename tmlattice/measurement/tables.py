"""Readings from elsewhere: plain CSV tables, and the turn-by-turn files of many laboratories."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.measurement.monitors import merge_spellings
from tmlattice.measurement.trajectory import Measurement

Array = NDArray[np.float64]
Unit = Literal["m", "mm", "um"]

_METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6}
