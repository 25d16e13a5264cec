"""Where the gap between model and machine lies, which effect causes it, how far it shrinks.

>>> diagnosis = diagnose(ring, read_measurement("day_1"))
>>> diagnosis.verdict
'identified'
>>> diagnosis.as_json()["findings"][0]["element"]
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.by_name import by_name
from tmlattice.diagnosis.absent import in_the_lattice
from tmlattice.diagnosis.devices import devices_of, with_devices
from tmlattice.diagnosis.kinds import Measured, kind_of
from tmlattice.diagnosis.result import Diagnosis, Finding, Member
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement, OrbitResponse, in_words

__all__ = ["Diagnosis", "Finding", "Member", "diagnose"]

_OPTIONS = {
    "first turns": ("reference", "background", "heldout", "radiation"),
    "an orbit response": ("reference", "missing"),
    "several measurements, or those of a stored beam": ("reference", "background", "known"),
}
_OWN = {name for names in _OPTIONS.values() for name in names}


MANY = 100_000
"""Readings from which on linear algebra is worth several threads: numpy and scipy have a pool each,
which wait for one another (ALS, 41,000 readings, two cores: 71 s with two threads, 51 with one)."""


@by_name
def diagnose(
    ring: Ring, measurement: Measured | Mapping[str, Measured], **options: Any
) -> Diagnosis:
    """Where the gap between a ring and its measurement lies, what causes it, how far it shrinks.

    Args:
        ring: the design.
        measurement: of any kind; or several of one machine by name, which are diagnosed together.
        options: for every kind holdout, effects, max_effects, false_alarm, assume, seed, progress
            and reference, a measurement of the same kind and machine from before; for first turns
            also background, heldout and radiation; for an orbit response alone missing, see
            `diagnosis.response.diagnose_response`, and with a reference
            `diagnosis.before_after.diagnose_change`; for several, and for those of a stored beam,
            background, and known, what an earlier diagnosis left known of the ring as it found it
            (`diagnosis.twin`; first turns take it too). See `diagnosis.procedure`.

    Monitors and correctors that the lattice lacks are left out, and told, where they are half of
    the names at most.

    Of fewer than 100,000 readings the result is the same to the bit on any number of threads: a
    library that shares a product among them adds in another order, and is no quicker there. Of
    more it is the same to rounding.

    Raises:
        MeasurementError: data that cannot be used, or are given twice, or an option without meaning
            for them.
        UnknownNameError: an effect that does not exist, or names that mostly are not the lattice's.
    """
    from threadpoolctl import threadpool_limits

    one = 1 if _readings(measurement) < MANY else None
    measurement, messages = _in_the_lattice(ring, measurement)
    for name in ("reference", "heldout"):
        options[name], more = _in_the_lattice(ring, options.get(name))
        messages += [f"the {name}: {sentence}" for sentence in more if sentence not in messages]
        if options[name] is None:
            del options[name]
    every = [*(measurement.values() if isinstance(measurement, Mapping) else [measurement])]
    _each_once(measurement)
    with threadpool_limits(one, "blas"):
        found = _diagnosed(ring, measurement, options)
    found = with_devices(found, devices_of(ring, every))
    return replace(found, warnings=(*messages, *found.warnings)) if messages else found


def _in_the_lattice(ring: Ring, measured: Any) -> tuple[Any, list[str]]:
    """One measurement, or several by name, without what the lattice lacks."""
    if not isinstance(measured, Mapping):
        return in_the_lattice(ring, measured)
    parts = {name: in_the_lattice(ring, own) for name, own in measured.items()}
    messages = [
        f"{name}: {sentence}" if len(parts) > 1 else sentence
        for name, (_, some) in parts.items()
        for sentence in some
    ]
    return {name: own for name, (own, _) in parts.items()}, messages


def _each_once(measurement: Any) -> None:
    """Raises a MeasurementError where readings are given twice, which would count twice."""
    named = list(measurement.items()) if isinstance(measurement, Mapping) else []
    for i, (name, one) in enumerate(named):
        for other, before in named[:i]:
            if type(one) is type(before) and np.array_equal(
                _largest(one), _largest(before), equal_nan=True
            ):
                raise MeasurementError(
                    f"'{other}' and '{name}' hold the same readings, which would count twice: give "
                    "each measurement once"
                )


def _largest(measured: Any) -> np.ndarray:
    """The largest array of a measurement: its readings."""
    records = [measured, *getattr(measured, "steps", ())]
    arrays = [v for record in records for v in vars(record).values() if isinstance(v, np.ndarray)]
    return max(arrays, key=np.size, default=np.zeros(0))


def _readings(measurement: Any) -> int:
    some = measurement.values() if isinstance(measurement, Mapping) else [measurement]
    return max((_largest(one).size for one in some), default=0)


def _diagnosed(ring: Ring, measurement: Any, options: dict[str, Any]) -> Diagnosis:
    measurement = _alone(measurement)
    if options.get("known") is not None and isinstance(measurement, Measurement):
        measurement = {kind_of(measurement): measurement}  # beside what another kind left known
    if isinstance(measurement, Measurement):
        of = "first turns"
    elif isinstance(measurement, OrbitResponse):
        of = "an orbit response"
    else:
        of = "several measurements, or those of a stored beam"
    for name in sorted(_OWN - set(_OPTIONS[of])):
        if options.pop(name, None):
            raise MeasurementError(f"the option '{name}' has no meaning for {of}; leave it out")
    if isinstance(measurement, Measurement | OrbitResponse) and "reference" in options:
        before = options["reference"] = _alone(options["reference"])
        if before is not None and type(before) is not type(measurement):
            raise MeasurementError(
                f"the measurement is {of} and the reference {in_words(before)}: give a reference "
                "of the same kind"
            )
    if isinstance(measurement, OrbitResponse) and options.get("reference") is not None:
        from tmlattice.diagnosis.response.before_after import diagnose_change

        before = options.pop("reference")
        if options.pop("missing", False):
            raise MeasurementError("the option 'missing' has no meaning beside a reference")
        return diagnose_change(ring, before, measurement, **options)
    if isinstance(measurement, OrbitResponse):
        from tmlattice.diagnosis.response.procedure import diagnose_response

        options.pop("reference", None)
        return diagnose_response(ring, measurement, **options)
    from tmlattice.diagnosis.procedure import diagnose_together

    if not isinstance(measurement, Mapping):
        measurement = {kind_of(measurement): measurement}
    before = options.pop("reference", None)
    if before is not None and not isinstance(before, Mapping):
        before = {kind_of(before): before}
    return diagnose_together(ring, measurement, reference=before, **options)


def _alone(measured: Any) -> Any:
    """One measurement that stands in a mapping, itself."""
    if isinstance(measured, Mapping) and len(measured) == 1:
        return next(iter(measured.values()))
    return measured
