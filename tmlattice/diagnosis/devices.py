"""Names of the control system beside those of the lattice, in all that a diagnosis states."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from tmlattice.diagnosis.result import Diagnosis
from tmlattice.lattice import Ring


def devices_of(ring: Ring, measured: Iterable[Any]) -> dict[str, str]:
    """Names of the control system by names of the lattice.

    Args:
        ring: whose names they are; others are passed over.
        measured: of any kinds; the first that has a name for an element gives it.
    """
    names = {element.name.casefold(): element.name for element in ring.elements}
    found: dict[str, str] = {}
    for one in measured:
        for name, device in getattr(one, "devices", {}).items():
            if (own := names.get(name.casefold())) is not None:
                found.setdefault(own, device)
    return found


def with_devices(found: Diagnosis, devices: Mapping[str, str]) -> Diagnosis:
    """The diagnosis with the names of the control system.

    Args:
        found: the diagnosis.
        devices: of `devices_of`.
    """
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
