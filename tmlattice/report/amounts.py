"""Amounts, probabilities and effects in words."""

from collections.abc import Mapping, Sequence

import numpy as np

from tmlattice.diagnosis.support import Support
from tmlattice.effects import CATALOGUE, find

_SCALES = {
    "relative": ((0.0, 100.0, "%"),),
    "m": ((0.0, 1e6, "µm"), (1e-3, 1e3, "mm")),
    "rad": ((0.0, 1e6, "µrad"), (1e-3, 1e3, "mrad")),
    "1/m": ((0.0, 1.0, "1/m"),),
    "scale": ((0.0, 1.0, "x expected"),),
}
"""By unit of the catalogue: least modulus, factor, readable unit."""


def words(effect: str) -> str:
    """An effect of the catalogue in plain words."""
    return CATALOGUE[effect].words if effect in CATALOGUE else effect.replace("_", " ")


def scaled(effect: str, amount: float) -> tuple[float, str]:
    """The factor and the readable unit for an amount of this size."""
    unit = find(effect).unit
    steps = _SCALES.get(unit, ((0.0, 1.0, unit),))
    _, factor, name = [step for step in steps if abs(amount) >= step[0] or step[0] == 0][-1]
    return factor, name


def amount_text(effect: str, amount: float, sigma: float | None = None) -> str:
    """An amount in a readable unit, with its error to two digits."""
    if find(effect).discrete:
        return find(effect).forms.get(amount, "")
    factor, unit = scaled(effect, amount)
    value = factor * amount
    if sigma is None or not 0 < sigma < np.inf:
        return f"{value:.3g} {unit}"
    error = factor * sigma
    digits = digits_of(error)
    return f"{value:+.{digits}f} ± {error:.{digits}f} {unit}"


def digits_of(error: float) -> int:
    """Decimals that show an error with two significant digits."""
    return int(np.clip(1 - np.floor(np.log10(error)), 0, 8))


def least_text(effect: str, amount: float) -> str:
    """The detection limit, or the largest fault where that is less."""
    kind = find(effect)
    if not amount <= kind.largest:
        return f"not even the largest fault, {amount_text(effect, kind.largest)}"
    return amount_text(effect, amount)


def probability_text(probability: float) -> str:
    """A probability in per cent, between "< 0.1 %" and "> 99.9 %"."""
    if probability > 0.9995:
        return "> 99.9 %"
    return f"{100 * probability:.1f} %" if probability > 0.001 else "< 0.1 %"


def labelled(name: str, devices: Mapping[str, str]) -> str:
    """An element with its name in the control system, where that is known."""
    return f"{name} [{devices[name]}]" if name in devices else name


def degenerate_text(effect: str, support: Support) -> str:
    """What an undetermined amount of an effect is degenerate with."""
    if not support.degenerate_with:
        return "the data hardly depend on it"
    return "degenerate with " + ", ".join(
        f"{'' if other == effect else find(other).label + ' '}{element or 'of the beam'} "
        f"({correlation:+.2f})"
        for other, element, correlation in support.degenerate_with
    )


def all_of(places: Sequence[str | None], devices: Mapping[str, str]) -> str:
    """The elements that share an amount (places: their names; None: the beam)."""
    first = labelled(places[0] or "the beam", devices)
    return first if len(places) == 1 else f"{first} and {len(places) - 1} alike"
