"""Prediction of a measured orbit response by a model."""

from dataclasses import replace

import numpy as np

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import MeasurementError
from tmlattice.measurement import OrbitResponse


def predict(model: ResponseModel, measured: OrbitResponse) -> OrbitResponse:
    """Return the model's orbit changes for the same correctors, kicks, monitors and RF step.

    It is linear in kicks and step, and has no missing readings.

    Args:
        model: with six coordinates if the RF was stepped.
        measured: for its names, kicks and RF step.

    Raises:
        UnknownNameError: a corrector or a monitor that is not in the ring.
        MeasurementError: a corrector of another plane, or an element that is not a corrector.
    """
    columns = model.columns(measured.correctors)
    for name, plane, own in zip(measured.correctors, measured.planes, columns.planes, strict=True):
        if plane != own:
            raise MeasurementError(
                f"corrector '{name}' is stated to kick in {plane}; the ring's kicks in {own}"
            )
    order = {name: i for i, name in enumerate(model.monitors)}
    ring = model.ring
    at = [order[ring[name].name] for name in measured.monitors]
    response = model.response(measured.correctors)[:, at]
    rf = measured.rf
    if rf is not None and model.dimension == 6:
        rf = replace(rf, orbit=model.rf_change(rf.step / rf.frequency)[at])
    return replace(measured, response=np.asarray(measured.kicks)[:, None, None] * response, rf=rf)
