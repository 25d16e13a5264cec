"""Causes drawn for a case: effect, then place, evenly; the amount for a signal to noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from tmlattice.effects import Cause, Effect, find
from tmlattice.errors import TmlatticeError

TRIES = 1000
SUDDEN = 2.0
"""Times the signal to noise that was asked for, from which on an amount does not set it."""

Lost = tuple[str, str | None, float]
"""What was asked for and could not be reached: effect, place, the signal to noise that came."""


class Measures(Protocol):
    """What knows the signal to noise of causes, NaN where no beam survives them."""

    def of(self, causes: Sequence[Cause]) -> float:
        """Of all of them together."""


@dataclass
class Draw:
    """What is drawn, and what was drawn in vain.

    Attributes:
        random: where from.
        signal: smallest and largest signal to noise, log-uniform.
        amount: of every effect instead, of random sign.
        halves: how often a largest amount that no beam survives is halved.
        unreachable: what has no amount with the signal to noise that was asked for.
    """

    random: np.random.Generator
    signal: tuple[float, float]
    amount: float | None = None
    halves: int = 0
    unreachable: list[Lost] = field(default_factory=list)

    def target(self) -> float:
        """A signal to noise."""
        return float(np.exp(self.random.uniform(*np.log(self.signal))))

    def one(
        self,
        ruler: Measures,
        effects: Sequence[str],
        places_of: Callable[[Effect], Sequence[str | None]],
    ) -> Cause:
        """One cause, up to the largest of its effect.

        Raises:
            TmlatticeError: none can be seen.
        """
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
        """Causes in this proportion, and no larger, with this signal to noise; None: too small,
        or as large as that however little there is of it (energy losses turn an RF on)."""
        share, size = 1.0, ruler.of(caps)
        for _ in range(self.halves):
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
