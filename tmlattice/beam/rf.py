"""The RF of a ring: places, voltage, phase and frequency of its cavities.

A cavity gives a particle p += V / (p0 c) sin(phase - 2 pi f tau / c). Above transition a late
particle (tau > 0) has too much energy and must gain less; below, it must gain more, at the phase
pi - phase. The gain at the phase equals the loss of the design orbit. A frequency other than the
ring's own slips against the turns by L df / (f + df) each; on the first turn it meets the beam at
the design's phase.

Defaults replace what a lattice does not state. The harmonic number is the one nearest to
499.65 MHz, the frequency of most light sources (a circumference that fits 500 MHz fits it too,
unless it is long). The voltage is four times the radiation loss of bends and wigglers, a usual
over-voltage of storage rings.

Source: M. Sands, SLAC-121 (1970), 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Settings, expected_loss
from tmlattice.errors import LatticeError
from tmlattice.lattice import Ring, stated

SPEED_OF_LIGHT = 299_792_458.0  # m/s
FREQUENCY = 499.65e6
"""Hz; default without a cavity or an argument."""
RELATIVISTIC = 1e3
"""gamma above which the velocity is independent of the energy, to a millionth."""
OVERVOLTAGE = 4.0
"""Default voltage of the RF over the loss of a turn."""


@dataclass(frozen=True)
class Rf:
    """The cavities of a ring.

    Attributes:
        places: indices of the cavities in `ring.elements`; their number means the ring's end.
        harmonic: RF periods in a turn.
        voltage: of all cavities together, V.
        own: the ring has cavities, which are on without a loss too.
    """

    places: tuple[int, ...]
    harmonic: int
    voltage: float
    own: bool

    def on(self, loss: float, frequency: float) -> bool:
        """Whether it acts within a few turns: the beam loses energy, or the frequency was set."""
        return self.own or loss > 0 or frequency != 0

    def frequency(self, ring: Ring) -> float:
        """Frequency for the design orbit, Hz; electrons move at the speed of light."""
        return float(self.harmonic * speed_of(ring) / ring.length)


def rf_of(ring: Ring, harmonic: int | None = None, voltage: float | None = None) -> Rf:
    """Return the RF of a ring: its cavities, else its marker or drift named `rf`, else its end.

    Args:
        harmonic: else that of the ring's first cavity, else the one nearest to 499.65 MHz.
        voltage: of all cavities, V; else that of the ring's, else four times the expected loss.
    """
    elements = ring.elements
    cavities = [i for i, e in enumerate(elements) if e.kind == "cavity"]
    passive = ("marker", "drift")
    named = [i for i, e in enumerate(elements) if e.name.casefold() == "rf" and e.kind in passive]
    sources = [elements[i].source for i in cavities]
    if harmonic is None:
        known = [f for f in (float(getattr(s, "freq", 0.0)) for s in sources) if f]
        harmonic = round((known[0] if known else FREQUENCY) * ring.length / speed_of(ring))
    if voltage is None:
        voltage = 1e9 * sum(float(getattr(s, "v", 0.0)) for s in sources)  # OCELOT's are GV
        if not voltage:
            loss = sum(expected_loss(e, ring.energy) for e in elements) if ring.radiates else 0.0
            voltage = OVERVOLTAGE * loss * ring.energy * 1e9
    places = tuple(cavities or named[:1] or [len(elements)])
    return Rf(places, max(harmonic, 1), voltage, bool(cavities))


def stable_phase(ring: Ring, phase: float) -> float:
    """Return the phase, or below transition the other one of the same gain.

    The time of a turn grows with the energy by R_tau,p and the dispersion, to first order.
    Electrons are above transition in every ring.
    """
    if ring.gamma > RELATIVISTIC:
        return phase
    slip = ring.remembered("slip", lambda: stated.slip(ring))
    return phase if slip > 0 else float(np.pi) - phase


def speed_of(ring: Ring) -> float:
    """Speed of the beam, m/s; that of light within 1e-6 of it, as in electron lattices."""
    return SPEED_OF_LIGHT * (ring.beta if ring.beta < 1 - 1e-6 else 1.0)


def frequency_of(settings: Settings) -> float:
    """Relative change of the RF frequency in a shot's settings."""
    for name, setting in settings.items():
        if name.casefold() == "rf":
            return float(setting.get("frequency_relative", 0.0))
    return 0.0


@dataclass(frozen=True)
class Cavities:
    """Parameters of the RF for the compiled loops.

    Attributes:
        exits: positions of the cavities: k is the exit of layer k - 1, and the number of layers + 1
            the ring's end; none: the RF is off, [cavity].
        values: gain of one cavity at its crest (relative), phase (rad), wave number (rad/m), and
            excess of a turn over the RF's (m), [4].
    """

    exits: NDArray[np.int64]
    values: NDArray[np.float64]


NO_RF = Cavities(np.empty(0, dtype=np.int64), np.zeros(4))


def cavities(
    ring: Ring, rf: Rf, layer_of: Sequence[int] | NDArray[np.intp], loss: float, frequency: float
) -> Cavities:
    """Return thin cavities behind the magnets before them; the drift between commutes with a gain
    of energy to second order; LatticeError: a voltage below the loss."""
    if not rf.on(loss, frequency) or rf.voltage == 0:
        return NO_RF
    crest = rf.voltage / (ring.energy * 1e9 * ring.beta)
    if loss >= crest:
        raise LatticeError(
            f"an RF of {rf.voltage / 1e6:.3g} MV cannot replace a loss of "
            f"{loss * ring.energy * 1e3:.3g} MeV a turn; give the ring's cavities their voltage"
        )
    wave = 2 * np.pi * rf.harmonic / ring.length * ring.beta * (1 + frequency)
    slip = ring.length / ring.beta * frequency / (1 + frequency)
    end = len(ring.magnets) + 1
    exits = [int(layer_of[i]) if i < len(ring.elements) else end for i in rf.places]
    phase = stable_phase(ring, float(np.arcsin(max(loss, 0.0) / crest)))
    values = np.array([crest / len(exits), phase, wave, slip])
    return Cavities(np.array(exits, dtype=np.int64), values)
