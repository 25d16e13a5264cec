"""Faults outside the catalogue, tracked by AT."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tmlattice.arrays import Array
from tmlattice.effects import Cause, Settings
from tmlattice.lattice import Element, Ring
from tmlattice.machine import Machine, Shots
from tmlattice.machine.at_engine import AtEngine

LARGEST: Mapping[str, float] = {
    "hysteresis": 0.3,
    "octupole": 1e4,
    "kick_jitter": 2e-4,
    "monitor_cubic": 1e5,
    "monitor_quadratic": 1e2,
    "exchanged_cables": 1.0,
}
"""Kinds, and the largest amount.

hysteresis: relative gradient error of a quadrupole, of either sign from shot to shot.
octupole: integrated k3 L of a quadrupole, 1/m^3. kick_jitter: rms kick of a corrector, drawn for
every shot, rad. monitor_cubic: x_read = x + a x^3, the same in y, 1/m^2. monitor_quadratic:
x_read = x + a (x^2 - y^2), y_read = y - 2 a x y, 1/m. exchanged_cables: the cables of a monitor and
of the next one are swapped, both planes; discrete.
"""

DISCRETE = ("exchanged_cables",)


class _WithOctupole(AtEngine):
    """A ring with an octupole field in one quadrupole."""

    def __init__(self, ring: Ring, element: str, strength: float) -> None:
        super().__init__(ring)
        place = self._places[ring.index(element)].start
        magnet = self._line[place] = copy.deepcopy(self._line[place])  # the ring remembers its own
        field = np.pad(magnet.PolynomB, (0, 4 - len(magnet.PolynomB)))
        magnet.PolynomA, magnet.PolynomB = np.zeros(4), field
        magnet.MaxOrder = 3  # before there is a field of that order, of which AT would warn
        magnet.PolynomB = field + np.array([0, 0, 0, strength / magnet.Length / 6])  # k_n / n!


class Unknown:
    """One fault of a kind at a place.

    Args:
        kind: see `LARGEST`.
        clean: their readings without a fault or noise, [shot, monitor, 2], m.
    """

    def __init__(
        self, ring: Ring, kind: str, shots: Shots, clean: Array, random: np.random.Generator
    ) -> None:
        self.ring, self.kind, self.shots, self.clean = ring, kind, shots, clean
        places: Sequence[Element]
        if kind in ("hysteresis", "octupole"):
            places = [e for e in ring.elements if e.kind == "quadrupole" and e.k1 != 0]
        elif kind == "kick_jitter":
            places = [e for e in ring.elements if e.is_corrector]
        else:
            places = ring.monitors[:-1] if kind == "exchanged_cables" else ring.monitors
        self.element = places[int(random.integers(len(places)))]
        self.sign = np.where(random.permutation(len(shots)) % 2, 1.0, -1.0)
        self.draw = random.standard_normal(len(shots))

    def readings(self, amount: float) -> Array:
        """Return readings without noise, [shot, monitor, 2], m."""
        out = self.clean.copy()
        match self.kind:
            case "hysteresis":
                for sign in (-1.0, 1.0):
                    cause = Cause("quadrupole_gradient", self.element.name, sign * amount)
                    chosen = np.flatnonzero(self.sign == sign)
                    out[chosen] = clean_readings(Machine(self.ring, [cause]), self.shots)[chosen]
                return out
            case "octupole":
                engine = _WithOctupole(self.ring, self.element.name, amount)
                return engine.track(self.shots.launches, 1, self.shots.settings)[:, 0]
            case "kick_jitter":
                settings: list[Settings] = []
                for setting, draw in zip(self.shots.settings, self.draw, strict=True):
                    own = dict(setting.get(self.element.name, {"kick": self.element.angle}))
                    own["kick"] += float(amount * draw)
                    settings.append({**setting, self.element.name: own})
                shots = replace(self.shots, settings=tuple(settings))
                return clean_readings(Machine(self.ring), shots)
        at = [monitor.name for monitor in self.ring.monitors].index(self.element.name)
        x, y = self.clean[:, at].T
        if self.kind == "monitor_cubic":
            out[:, at] += amount * self.clean[:, at] ** 3
        elif self.kind == "monitor_quadratic":
            out[:, at] += amount * np.stack([x**2 - y**2, -2 * x * y], axis=1)
        else:
            out[:, [at, at + 1]] = self.clean[:, [at + 1, at]]
        return out


def clean_readings(machine: Machine, shots: Shots) -> Array:
    """Return readings without noise of one turn, [shot, monitor, 2], m."""
    beam = machine.beam(shots.launches, 1, shots.settings)
    return machine.monitors.read(beam)[:, 0]
