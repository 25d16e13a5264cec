"""The beam in a ring, without torch: states, tangents, closed orbits and effects of errors.

>>> model = Model(ring, settings=[{}])                   # a ring as a measurement's shots saw it
>>> model.readings(launches, [Cause("quadrupole_gradient", "qd::12", -0.2)])
>>> ResponseModel(ring).response(["hcor_sw_4"])          # of a stored beam, m/rad
"""

from tmlattice.beam.closed_orbit import Columns, ResponseModel
from tmlattice.beam.model import Model

__all__ = ["Columns", "Model", "ResponseModel"]
