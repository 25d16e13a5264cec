"""Effect of applied settings: each knob's calibration, from a change between two measurements.

>>> for own in applied(diagnosis, read_settings(Path("settings.csv"))):
...     print(own.device, own.ratio, own.ratio_error)
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tmlattice.correction.knobs import KINDS, Knob, default_knobs
from tmlattice.diagnosis import Diagnosis
from tmlattice.errors import MeasurementError, plain
from tmlattice.input_files import text_of


@dataclass(frozen=True)
class Applied:
    """One device that was set.

    Attributes:
        device: its name.
        asked: relative change of its strength, or the change (1/m).
        found, error: of the measured change, the mean of its members.
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


def read_settings(path: Path) -> dict[str, tuple[float, float]]:
    """Return present and new setting by device, from the settings.csv of a correction.

    Raises:
        MeasurementError: a table that cannot be read.
    """
    found: dict[str, tuple[float, float]] = {}
    for row in csv.DictReader(text_of(path, MeasurementError).splitlines()):
        try:
            device, *numbers = row["device"], float(row["present"]), float(row["new"])
            if device in found:
                raise MeasurementError(f"{path}: the device '{plain(device, 40)}' occurs twice")
            if not all(map(math.isfinite, numbers)):
                raise ValueError
            found[device] = numbers[0], numbers[1]
        except (KeyError, TypeError, ValueError):
            raise MeasurementError(
                f"{path}: a row has no device, present or new; give the settings.csv of a "
                f"correction (found: {plain(str(row), 80)})"
            ) from None
    if not found:
        raise MeasurementError(f"{path}: it contains no setting")
    return found


def applied(
    diagnosis: Diagnosis,
    settings: dict[str, tuple[float, float]],
    knobs: Sequence[Knob] | None = None,
) -> list[Applied]:
    """Return requested and measured changes of the devices that a change since a reference shows.

    Args:
        diagnosis: of the measurement after, with the one before as its reference.
        settings: present and new by device, see `read_settings`.
        knobs: those of the correction; None: those of the lattice.

    Raises:
        MeasurementError: a diagnosis without a reference.
    """
    if not diagnosis.has_reference:
        raise MeasurementError(
            "settings are compared with a change: give the measurement before as --reference"
        )
    kinds = ("supplies", "quadrupoles", "skew_quadrupoles", "sextupoles")
    every = default_knobs(diagnosis.ring, kinds) if knobs is None else knobs
    named = {knob.name: knob for knob in reversed(every)}
    amounts = {
        (c.effect, (c.element or "").casefold()): (c.amount, s) for c, s, _ in diagnosis.supported
    }
    found = []
    for device, (present, new) in settings.items():
        knob = named.get(device)
        if knob is None or KINDS[knob.kind].effect is None or new == present:
            continue
        proportional = KINDS[knob.kind].relative and not knob.curve
        asked = new / present - 1 if proportional else knob.amount(new)
        family = {"quadrupole": "family_gradient", "sextupole": "family_sextupole"}.get(knob.kind)
        shared, sigma = amounts.get((str(family), device.casefold()), (0.0, 0.0))
        effect = str(KINDS[knob.kind].effect)
        members = [(effect, member.casefold()) for member in knob.members]
        own = [amounts[key] for key in members if key in amounts]
        if sigma or own:
            mean = sum(amount for amount, _ in own) / len(knob.members)
            error = float(np.hypot(sigma, np.linalg.norm([s for _, s in own]) / len(knob.members)))
            found.append(Applied(device, asked, shared + mean, error))
    return found


def sentence(own: Applied) -> str:
    """Return a sentence on one device."""
    return (
        f"{own.device}: requested {100 * own.asked:+.3g} %, measured {100 * own.found:+.3g} ± "
        f"{100 * own.error:.2g} %, calibration {own.ratio:.3g} ± {own.ratio_error:.2g}"
    )
