"""Random causes of a case: effect, then place, uniformly; the amount by its signal to noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from tmlattice.effects import Cause, Effect, find
from tmlattice.errors import TmlatticeError

TRIES = 1000
HALVES = 6
"""Halvings of a largest amount that no beam survives."""
SUDDEN = 2.0
"""Ratio to the wanted signal to noise above which an amount does not determine it."""

Lost = tuple[str, str | None, float]
"""Effect, place, and the signal to noise that was reached instead of the wanted one."""


class Measures(Protocol):
    """Signal to noise of causes, NaN if no beam survives them."""

    def of(self, causes: Sequence[Cause]) -> float:
        """Return that of all causes together."""


@dataclass
class Draw:
    """Random draws, and rejected ones."""

    random: np.random.Generator
    signal: tuple[float, float]
    amount: float | None = None
    unreachable: list[Lost] = field(default_factory=list)

    def target(self) -> float:
        """Return a random signal to noise."""
        return float(np.exp(self.random.uniform(*np.log(self.signal))))

    def one(
        self,
        ruler: Measures,
        effects: Sequence[str],
        places_of: Callable[[Effect], Sequence[str | None]],
    ) -> Cause:
        """Return one cause, up to the largest amount of its effect; TmlatticeError: no effect is
        visible."""
        for _ in range(TRIES):
            name = effects[int(self.random.integers(len(effects)))]
            effect = find(name)
            places = places_of(effect)
            if not places:
                continue
            place = places[int(self.random.integers(len(places)))]
            sign = float(self.random.choice([-1.0, 1.0]))
            target = self.target()
            if effect.one_sign or effect.discrete:
                sign = 1.0
            if effect.discrete or effect.whole:
                most = int(effect.largest)
                return Cause(name, place, sign * float(self.random.integers(1, most + 1)))
            if self.amount is not None:
                return Cause(name, place, sign * self.amount)
            found = self.sized(ruler, [Cause(name, place, sign * effect.largest)], target)
            if found is not None:
                return found[0]
        raise TmlatticeError("no effect reaches the smallest signal to noise; take larger shots")

    def sized(
        self, ruler: Measures, caps: Sequence[Cause], target: float
    ) -> tuple[Cause, ...] | None:
        """Return causes in this proportion, and no larger, with this signal to noise; None: too
        small, or large for any amount (energy losses switch an RF on)."""
        share, size = 1.0, ruler.of(caps)
        for _ in range(HALVES):
            if np.isfinite(size):
                break
            share /= 2
            size = ruler.of(_scaled(caps, share))
        if not size >= self.signal[0]:
            self.unreachable.append((caps[0].effect, caps[0].element, size))
            return None
        most, power = share, find(caps[0].effect).power
        if target < size:
            for _ in range(6):  # readings change nearly as amount^power
                share = min(share * (target / max(size, 1e-12)) ** (1 / power), most)
                size = ruler.of(_scaled(caps, share))
                if abs(size / target - 1) < 1e-3:
                    break
            if not size < SUDDEN * target:
                self.unreachable.append((caps[0].effect, caps[0].element, size))
                return None
        return _scaled(caps, share)


def _scaled(causes: Sequence[Cause], share: float) -> tuple[Cause, ...]:
    return tuple(replace(cause, amount=share * cause.amount) for cause in causes)
