"""Effect of applied settings: each knob's calibration, from a change between two measurements.

>>> for own in applied(diagnosis, read_settings(Path("settings.csv"), ring)):
...     print(own.device, own.ratio, own.ratio_error)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.correction.knobs import KINDS, Knob
from tmlattice.diagnosis import Diagnosis
from tmlattice.errors import MeasurementError


@dataclass(frozen=True)
class Applied:
    """One device that was set.

    Attributes:
        device: its name.
        asked: relative change of its strength, or the change (1/m, rad).
        found, error: of the measured change, the mean of its members; 0 and infinite if the
            diagnosis does not determine it.
    """

    device: str
    asked: float
    found: float
    error: float

    @property
    def ratio(self) -> float:
        """Measured over requested change."""
        return self.found / self.asked

    @property
    def ratio_error(self) -> float:
        """Its standard deviation."""
        return abs(self.error / self.asked)


def applied(diagnosis: Diagnosis, settings: Sequence[tuple[Knob, float]]) -> list[Applied]:
    """Return requested and measured changes of devices that were set since a reference.

    Args:
        diagnosis: of the measurement after, with the one before as its reference.
        settings: devices and their new settings, see `read_settings`.

    Raises:
        MeasurementError: a diagnosis without a reference.
    """
    if not diagnosis.has_reference:
        raise MeasurementError(
            "settings are compared with a change: give the measurement before as --reference"
        )
    amounts = {
        (c.effect, (c.element or "").casefold()): (c.amount, s) for c, s, _ in diagnosis.supported
    }
    found = []
    for knob, new in settings:
        if new == knob.present:
            continue
        shared, sigma = amounts.get((KINDS[knob.kind].family, knob.name.casefold()), (0.0, 0.0))
        members = [(str(KINDS[knob.kind].effect), member.casefold()) for member in knob.members]
        own = [amounts[key] for key in members if key in amounts]
        mean, error = shared, math.inf
        if sigma or own:
            mean += sum(amount for amount, _ in own) / len(knob.members)
            error = float(np.hypot(sigma, np.linalg.norm([s for _, s in own]) / len(knob.members)))
        found.append(Applied(knob.name, knob.amount(new), mean, error))
    return found


def sentence(own: Applied) -> str:
    """Return a sentence on one device."""
    asked = f"{own.device}: requested {100 * own.asked:+.3g} %, measured"
    if math.isinf(own.error):
        return f"{asked} nothing: this change does not determine it"
    return (
        f"{asked} {100 * own.found:+.3g} ± {100 * own.error:.2g} %, calibration {own.ratio:.3g} ± "
        f"{own.ratio_error:.2g}"
    )
