"""What a measured orbit response would be in the model."""

from dataclasses import replace

import numpy as np

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import MeasurementError
from tmlattice.measurement import OrbitResponse


def predict(model: ResponseModel, measured: OrbitResponse) -> OrbitResponse:
    """The model's orbit changes for the same correctors, kicks, monitors and RF step.

    Linear in the kicks and in the step; missing readings are there.

    Args:
        model: six coordinates where the RF was stepped.
        measured: its numbers are not read, but for kicks and the RF.

    Raises:
        UnknownNameError: a corrector or a monitor that the ring does not have.
        MeasurementError: a corrector that kicks in another plane than the ring's, or is none.
    """
    columns = model.columns(measured.correctors)
    for name, plane, own in zip(measured.correctors, measured.planes, columns.planes, strict=True):
        if plane != own:
            raise MeasurementError(
                f"corrector '{name}' is said to kick in {plane}; the ring's kicks in {own}"
            )
    order = {name: i for i, name in enumerate(model.monitors)}
    ring = model.ring
    at = [order[ring[name].name] for name in measured.monitors]
    response = model.response(measured.correctors)[:, at]
    rf = measured.rf
    if rf is not None and model.dimension == 6:
        rf = replace(rf, orbit=model.rf_change(rf.step / rf.frequency)[at])
    return replace(measured, response=np.asarray(measured.kicks)[:, None, None] * response, rf=rf)
