"""The stored beam's closed orbit in the model, and how correctors, the RF and errors move it.

>>> model = ResponseModel(load_ring("petra3"))
>>> model.response(["hcor_sw_4"])                    # [corrector, monitor, 2], m/rad
>>> model.rf_response()                                 # [monitor, 2], m per relative step
>>> predict(model, measured).response                   # what was measured, in the model
"""

from tmlattice.response.derivatives import derivatives
from tmlattice.response.model import Columns, ResponseModel
from tmlattice.response.predict import predict

__all__ = ["Columns", "ResponseModel", "derivatives", "predict"]
