"""Where the gap between model and machine lies, which effect causes it, how far it shrinks.

>>> diagnosis = diagnose(ring, read_measurement("day_1"))
>>> diagnosis.verdict
'named'
>>> diagnosis.as_json()["findings"][0]["element"]
"""

from typing import Any

from tmlattice.diagnosis.procedure import diagnose as diagnose_trajectories
from tmlattice.diagnosis.result import Diagnosis, Finding, Member
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement, OrbitResponse

__all__ = ["Diagnosis", "Finding", "Member", "diagnose", "diagnose_trajectories"]

_OF_TRAJECTORIES = ("background", "heldout", "radiation")


def diagnose(ring: Ring, measurement: Measurement | OrbitResponse, **options: Any) -> Diagnosis:
    """Where the gap between a ring and its measurement lies, what causes it, how far it shrinks.

    Args:
        ring: the design.
        measurement: first turns (or a few turns) of one or more shots, or an orbit response.
        options: for both kinds holdout, effects, max_effects, false_alarm, seed and progress; for
            both too reference, a measurement of the same kind and machine from before; for
            trajectories also background, heldout and radiation, see
            `diagnosis.procedure.diagnose`; for an orbit response missing, see
            `diagnosis.response.diagnose_response`, and with a reference
            `diagnosis.before_after.diagnose_change`.

    Raises:
        MeasurementError: data that cannot be used, or an option without meaning for them.
        UnknownNameError: a monitor or an effect that does not exist.
    """
    response = isinstance(measurement, OrbitResponse)
    reference: Measurement | OrbitResponse | None = options.get("reference")
    if reference is not None and isinstance(reference, OrbitResponse) != response:
        own, other = ("first turns", "an orbit response")[:: -1 if response else 1]
        raise MeasurementError(
            f"the measurement is {own} and the reference {other}: give a reference of the same kind"
        )
    for name in _OF_TRAJECTORIES if response else ("missing",):
        if options.pop(name, None):
            kind = "an orbit response" if response else "first turns"
            raise MeasurementError(f"the option '{name}' has no meaning for {kind}; leave it out")
    if isinstance(measurement, OrbitResponse) and isinstance(reference, OrbitResponse):
        from tmlattice.diagnosis.before_after import diagnose_change

        del options["reference"]
        if options.pop("missing", False):
            raise MeasurementError("the option 'missing' has no meaning beside a reference")
        return diagnose_change(ring, reference, measurement, **options)
    if isinstance(measurement, OrbitResponse):
        from tmlattice.diagnosis.response import diagnose_response

        options.pop("reference", None)
        return diagnose_response(ring, measurement, **options)
    return diagnose_trajectories(ring, measurement, **options)
