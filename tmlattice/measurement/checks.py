"""What records of a stored beam's measurements have in common: checks, and monitors in order."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, first_of, unknown_name
from tmlattice.measurement.monitors import HIGHEST_ENERGY, Names

Array = NDArray[np.float64]
Settings = Mapping[str, Mapping[str, float]]
Values = TypeVar("Values", Array, None, Array | None)

SETTINGS = ("kick", "k1_relative", "k2_relative", "frequency_relative")
"""What may be changed on purpose: rad, relative strengths, and the RF's relative frequency."""


def check_values(values: Array, one: str) -> None:
    """None is infinite, one at least is there.

    Raises:
        MeasurementError: "a reading is infinite", where `one` is "reading".
    """
    if np.isinf(values).any():
        article = "an" if one[0] in "aeiou" else "a"
        raise MeasurementError(f"{article} {one} is infinite; a missing one is NaN")
    if not np.isfinite(values).any():
        raise MeasurementError(f"every {one} is missing; nothing can be fitted")


def check_energy(energy: float | None) -> None:
    """Raises a MeasurementError for an energy that is not above zero, GeV."""
    if energy is not None and not 0 < energy < HIGHEST_ENERGY:
        raise MeasurementError(
            f"an energy of {energy:g} GeV cannot be; it is above zero, and in GeV"
        )


def check_settings(shot: int, settings: Settings) -> None:
    """Settings of a shot are known, finite, and each element's own.

    Raises:
        MeasurementError: states which is not.
        UnknownNameError: a setting that no element has.
    """
    Names("element", settings)
    for element, changed in settings.items():
        for name, amount in changed.items():
            if name not in SETTINGS:
                raise unknown_name("setting", name, SETTINGS)
            if (name == "frequency_relative") != (element.casefold() == "rf"):
                raise MeasurementError(
                    f"shot {shot} sets '{name}' of '{element}'; frequency_relative belongs to "
                    "the name 'rf', and nothing else does"
                )
            if not abs(amount) < np.inf:
                raise MeasurementError(
                    f"shot {shot} sets '{name}' of '{element}' to {amount}; give a finite number"
                )


def checked_shots(
    shots: Sequence[int], settings: Sequence[Settings], number: int, what: str
) -> tuple[tuple[int, ...], tuple[Settings, ...]]:
    """Ids and settings of `number` shots of readings: 0, 1, ... where there are none; () for none.

    Raises:
        MeasurementError: not as many, an id twice, or settings that cannot be.
        UnknownNameError: a setting that no element has.
    """
    ids = tuple(int(i) for i in shots) or tuple(range(number))
    if len(ids) != number or len(set(ids)) != number:
        raise MeasurementError(f"{what} of {number} shots need {number} shot ids, each once")
    settings = tuple(settings)
    if settings and len(settings) != number:
        raise MeasurementError(f"{len(settings)} settings for {number} shots; one a shot")
    for shot, changed in zip(ids, settings, strict=False):
        check_settings(shot, changed)
    return ids, settings if any(settings) else ()


def shot_places(shots: Sequence[int], wanted: Sequence[int]) -> list[int]:
    """Where the wanted ids stand.

    Raises:
        MeasurementError: one that is not there.
    """
    index = {shot: i for i, shot in enumerate(shots)}
    missing = [shot for shot in wanted if shot not in index]
    if missing:
        raise MeasurementError(f"no shot {missing[0]}; there are {first_of(shots)}")
    return [index[shot] for shot in wanted]


def places_of(kind: str, known: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Where the wanted monitors, or correctors, stand among the known ones.

    Raises:
        UnknownNameError: one that is not there.
    """
    names = Names(kind, known)
    return [names[name] for name in wanted]


def spread(values: Values, places: Sequence[int], number: int) -> Values:
    """[..., monitor, 2] among `number` monitors: NaN where there was none; None stays None."""
    if values is None:
        return values
    full = np.full((*values.shape[:-2], number, 2), np.nan)
    full[..., places, :] = values
    return full
