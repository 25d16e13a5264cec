"""Faults outside the catalogue, tracked by AT."""

from collections.abc import Callable, Mapping, Sequence

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
        magnet = self._line[self._places[ring.index(element)].start]
        field = list(magnet.PolynomB) + [0.0] * (4 - len(magnet.PolynomB))
        field[3] += strength / magnet.Length / 6  # AT: k_n / n!
        magnet.PolynomA = np.zeros(4)
        magnet.PolynomB = np.array(field)
        magnet.MaxOrder = 3


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
        by_kind: dict[str, Callable[[float], Array]] = {
            "hysteresis": self._hysteresis,
            "octupole": self._octupole,
            "kick_jitter": self._jitter,
        }
        return by_kind.get(self.kind, self._misread)(amount)

    def _hysteresis(self, amount: float) -> Array:
        out = np.empty_like(self.clean)
        for sign in (-1.0, 1.0):
            cause = Cause("quadrupole_gradient", self.element.name, sign * amount)
            chosen = np.flatnonzero(self.sign == sign)
            out[chosen] = clean_readings(Machine(self.ring, [cause]), self.shots)[chosen]
        return out

    def _octupole(self, amount: float) -> Array:
        engine = _WithOctupole(self.ring, self.element.name, amount)
        return engine.track(self.shots.launches, 1, self.shots.settings)[:, 0]

    def _jitter(self, amount: float) -> Array:
        settings: list[Settings] = []
        for setting, draw in zip(self.shots.settings, self.draw, strict=True):
            own = dict(setting.get(self.element.name, {"kick": self.element.angle}))
            own["kick"] += float(amount * draw)
            settings.append({**setting, self.element.name: own})
        shots = Shots(self.shots.nominal, self.shots.launches, self.shots.sigma, tuple(settings))
        return clean_readings(Machine(self.ring), shots)

    def _misread(self, amount: float) -> Array:
        out = self.clean.copy()
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
