"""The diagnosis: where model and machine differ, which effect causes it, how much it explains.

>>> diagnosis = diagnose(ring, read_measurement("day_1"))
>>> diagnosis.verdict
'identified'
>>> diagnosis.as_json()["findings"][0]["element"]
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.by_name import by_name
from tmlattice.diagnosis.data_checks import in_the_lattice
from tmlattice.diagnosis.kinds import kind_of
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.result import Diagnosis, Finding, Member
from tmlattice.errors import MeasurementError
from tmlattice.inference.common_factors import MAX_CHOSEN
from tmlattice.inference.distributed import DistributedErrors
from tmlattice.inference.judgement import DEFAULT, Judgement
from tmlattice.lattice import Ring
from tmlattice.measurement import AnyMeasurement, Measurement, OrbitResponse, in_words
from tmlattice.measurement.recorded import recorded
from tmlattice.observe.response_data import HELD
from tmlattice.observe.spoilt import without_spoilt

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
    ring: Ring,
    measurement: AnyMeasurement | Mapping[str, AnyMeasurement],
    *,
    reference: AnyMeasurement | Mapping[str, AnyMeasurement] | None = None,
    holdout: float | None = None,
    effects: Sequence[str] | None = None,
    max_effects: int | None = None,
    false_alarm: float = DEFAULT.false_alarm,
    assume: Sequence[str] = (),
    background: str | Mapping[str, float | None] | None = None,
    known: DistributedErrors | None = None,
    heldout: Measurement | None = None,
    radiation: bool = False,
    missing: bool = False,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda _: None,
) -> Diagnosis:
    """Where the gap between a ring and its measurement lies, what causes it, how far it shrinks.

    Args:
        ring: the design; or a built-in name, or the path of a lattice file.
        measurement: of any kind; or several of one machine by name, which are diagnosed together.
            The path of a file, a pandas DataFrame or an xarray Dataset is taken too.
        reference: of the same kind and machine, before the fault: static errors cancel.
        holdout: share of the shots, or of the correctors, that is the validation set; None: 0.33
            of shots, 0.2 of the correctors of an orbit response.
        effects: the only ones that may be the cause; None: all usual ones.
        max_effects: findings at most; None: 8, of a change between two orbit responses 40. Of an
            orbit response, families of errors at most; None: all.
        false_alarm: share of faultless data sets in which something may be found.
        assume: what was recorded wrongly everywhere, see `measurement.assume`.
        background: rms of distributed errors by effect (None: the catalogue's own), or "all";
            None: learnt. Not for an orbit response.
        known: distributed errors from an earlier diagnosis whose estimated ring this is
            (`diagnosis.twin`). Not for an orbit response.
        heldout: of first turns: the validation set itself, instead of a share.
        radiation: of first turns: bends and wigglers of the model radiate.
        missing: of an orbit response: compare effects that may be missing.
        seed: of the split, the simulated threshold and the bootstrap.
        progress: called with the name of each stage.

    BPMs and correctors that are not in the lattice are rejected with a message, up to half of the
    names.

    Up to 100,000 readings the result is the same to the bit on any number of threads; above, it is
    the same to rounding.

    Raises:
        MeasurementError: data that cannot be used, or are given twice, or an option without meaning
            for them.
        UnknownNameError: an effect that does not exist, or names that mostly are not the lattice's.
    """
    from threadpoolctl import threadpool_limits

    one = 1 if _readings(measurement) < MANY else None
    measurement, messages = _usable(ring, measurement)
    options = Options(
        ring, judgement=Judgement(false_alarm=false_alarm), effects=effects, assume=assume,
        reference=reference, heldout=heldout, background=background, known=known,
        radiation=radiation, missing=missing, seed=seed, progress=progress,
    )  # fmt: skip
    for name in ("reference", "heldout"):
        own, more = _usable(ring, getattr(options, name))
        options = replace(options, **{name: own})
        messages += [f"the {name}: {sentence}" for sentence in more if sentence not in messages]
    every = [*(measurement.values() if isinstance(measurement, Mapping) else [measurement])]
    _each_once(measurement)
    try:
        with threadpool_limits(one, "blas"):
            found = _diagnosed(measurement, options, holdout, max_effects)
    except np.linalg.LinAlgError as error:  # of data that no model of this ring describes
        raise MeasurementError(
            f"these data cannot be fitted with '{ring.name}' ({error}): run `tmlattice check`, and "
            "check the names, the order and the number of turns"
        ) from error
    except MeasurementError as error:
        if not messages:
            raise
        raise MeasurementError("; ".join([str(error), *messages])) from error
    found = with_devices(found, devices_of(ring, every))
    return replace(found, warnings=(*messages, *found.warnings)) if messages else found


def _usable(ring: Ring, measured: Any) -> tuple[Any, list[str]]:
    """The measurement, or several by name, without what is not in the lattice, repeated shots and
    clipped readings."""
    if not isinstance(measured, Mapping):
        own, absent = in_the_lattice(ring, measured)
        own, cut = recorded(own, [monitor.name for monitor in ring.monitors])
        spoilt: dict[str, str] = {}
        if isinstance(own, Measurement):
            own, spoilt = without_spoilt(ring, own)
        return own, [*absent, *cut, *spoilt.values()]
    parts = {name: _usable(ring, own) for name, own in measured.items()}
    messages = [
        f"{name}: {sentence}" if len(parts) > 1 else sentence
        for name, (_, some) in parts.items()
        for sentence in some
    ]
    return {name: own for name, (own, _) in parts.items()}, messages


def _each_once(measurement: Any) -> None:
    """Raise a MeasurementError where readings are given twice."""
    named = list(measurement.items()) if isinstance(measurement, Mapping) else []
    for i, (name, one) in enumerate(named):
        for other, before in named[:i]:
            if type(one) is type(before) and np.array_equal(
                _largest(one), _largest(before), equal_nan=True
            ):
                raise MeasurementError(
                    f"'{other}' and '{name}' contain the same readings: give each measurement once"
                )


def _largest(measured: Any) -> np.ndarray:
    """The largest array of a measurement: its readings."""
    records = [measured, *getattr(measured, "steps", ())]
    arrays = [v for record in records for v in vars(record).values() if isinstance(v, np.ndarray)]
    return max(arrays, key=np.size, default=np.zeros(0))


def _readings(measurement: Any) -> int:
    some = measurement.values() if isinstance(measurement, Mapping) else [measurement]
    return max((_largest(one).size for one in some), default=0)


def _diagnosed(
    measurement: Any, options: Options, holdout: float | None, most: int | None
) -> Diagnosis:
    """The diagnosis by its kind, with what is usual for that where no limit is given."""

    def limited(usual: float, at_most: int, **more: Any) -> Options:
        return replace(
            options, holdout=usual if holdout is None else holdout,
            max_effects=at_most if most is None else most, **more,
        )  # fmt: skip

    measurement = _alone(measurement)
    if options.known is not None and isinstance(measurement, Measurement):
        measurement = {kind_of(measurement): measurement}  # with the knowledge of another kind
    if isinstance(measurement, Measurement):
        of = "first turns"
    elif isinstance(measurement, OrbitResponse):
        of = "an orbit response"
    else:
        of = "several measurements, or those of a stored beam"
    for name in sorted(_OWN - set(_OPTIONS[of])):
        if getattr(options, name):
            raise MeasurementError(f"the option '{name}' has no meaning for {of}; leave it out")
    before = options.reference
    if isinstance(measurement, Measurement | OrbitResponse) and before is not None:
        before = _alone(before)
        if type(before) is not type(measurement):
            raise MeasurementError(
                f"the measurement is {of} and the reference {in_words(before)}: give a reference "
                "of the same kind"
            )
    if isinstance(measurement, OrbitResponse) and before is None:
        from tmlattice.diagnosis.families.steps import STEPS
        from tmlattice.diagnosis.response.procedure import diagnose_response

        return diagnose_response(measurement, limited(HELD, len(STEPS)))
    if isinstance(measurement, OrbitResponse):
        from tmlattice.diagnosis.response.before_after import diagnose_change

        if options.missing:
            raise MeasurementError("the option 'missing' has no meaning with a reference")
        return diagnose_change(before, measurement, limited(HELD, MAX_CHOSEN))
    from tmlattice.diagnosis.procedure import diagnose_together

    if not isinstance(measurement, Mapping):
        measurement = {kind_of(measurement): measurement}
    if before is not None and not isinstance(before, Mapping):
        before = {kind_of(before): before}
    return diagnose_together(measurement, limited(0.33, 8, reference=before))


def _alone(measured: Any) -> Any:
    """A single measurement out of a mapping of one."""
    if isinstance(measured, Mapping) and len(measured) == 1:
        return next(iter(measured.values()))
    return measured


def devices_of(ring: Ring, measured: Iterable[Any]) -> dict[str, str]:
    """Names of the control system by names of the lattice, of the first measurement that has one
    for an element; others are ignored."""
    names = {element.name.casefold(): element.name for element in ring.elements}
    found: dict[str, str] = {}
    for one in measured:
        for name, device in getattr(one, "devices", {}).items():
            if (own := names.get(name.casefold())) is not None:
                found.setdefault(own, device)
    return found


def with_devices(found: Diagnosis, devices: Mapping[str, str]) -> Diagnosis:
    """The diagnosis with the names of the control system, of `devices_of`."""
    if not devices:
        return found

    def named(one: Any) -> Any:
        return replace(one, device=devices.get(one.element or ""))

    findings = tuple(
        replace(
            named(finding),
            recommended_actions=tuple(map(named, finding.recommended_actions)),
            credible_set=tuple(map(named, finding.credible_set)),
            devices={
                name: devices[name]
                for name in (*finding.elements, *finding.near)
                if name in devices
            },
        )
        for finding in found.findings
    )
    suspects = tuple(map(named, found.suspects))
    return replace(found, devices=dict(devices), findings=findings, suspects=suspects)
