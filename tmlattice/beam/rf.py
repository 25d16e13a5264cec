"""The RF of a ring: where its cavities are, their voltage and frequency, and what they give.

A cavity gives a particle p += V / (p0 c) sin(phase - 2 pi f tau / c): above transition, where a
late particle (tau > 0) has too much energy, it must be given less; below, where it has too little,
pi - phase gives it more. The phase makes good what the design orbit loses. A frequency other than
the ring's own slips against the turns by L df / (f + df) each: on the first one it meets the beam
at the design's phase.

What a lattice does not say comes from a rule. The harmonic number is the one nearest to 499.65 MHz,
the frequency of most light sources (a circumference that fits 500 MHz fits it too, unless it is
long); the voltage is four times what the ring loses when its bends and wigglers radiate, an
over-voltage with which storage rings run.

Source: M. Sands, SLAC-121 (1970), 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Settings, expected_loss
from tmlattice.errors import LatticeError
from tmlattice.lattice import Ring
from tmlattice.maps import ring_maps

SPEED_OF_LIGHT = 299_792_458.0  # m/s
FREQUENCY = 499.65e6
"""Hz; where neither a cavity nor the caller says otherwise."""
RELATIVISTIC = 1e3
"""Above this gamma particles of other energies are as fast, to a millionth."""
OVERVOLTAGE = 4.0
"""Voltage of the RF over the loss of a turn, where no cavity says otherwise."""


@dataclass(frozen=True)
class Rf:
    """The cavities of a ring.

    Attributes:
        places: of the cavities, in `ring.elements`; their number stands for the ring's end.
        harmonic: RF periods in a turn.
        voltage: of all cavities together, V.
        own: the ring has cavities: they are on although nothing is lost.
    """

    places: tuple[int, ...]
    harmonic: int
    voltage: float
    own: bool

    def on(self, loss: float, frequency: float) -> bool:
        """Whether a few turns feel it: the beam loses energy, or the operator set its frequency."""
        return self.own or loss > 0 or frequency != 0

    def frequency(self, ring: Ring) -> float:
        """Hz, of a beam on the design orbit; that of light for electrons, at their energies."""
        return float(self.harmonic * speed_of(ring) / ring.length)


def rf_of(ring: Ring, harmonic: int | None = None, voltage: float | None = None) -> Rf:
    """The RF of a ring: its own cavities, else the marker or drift named `rf`, else its end.

    Args:
        ring: the design.
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
    """The phase, or below transition the other one of the same gain.

    A turn's time grows with the energy by R_tau,p and by what the dispersion does, to first order.
    Electrons are above transition in every ring.
    """
    if ring.gamma > RELATIVISTIC:
        return phase
    maps = ring_maps(ring, 6)
    turn = np.eye(6)
    for own in (*maps.W1, maps.closing.coefficients[1]):
        turn = own @ turn
    dispersion = np.linalg.solve(np.eye(4) - turn[:4, :4], turn[:4, 5])
    late = turn[4, :4] @ dispersion + turn[4, 5]
    return phase if late > 0 else float(np.pi) - phase


def speed_of(ring: Ring) -> float:
    """m/s; that of light where particles are as fast to 1e-6, as the lattices of electrons say."""
    return SPEED_OF_LIGHT * (ring.beta if ring.beta < 1 - 1e-6 else 1.0)


def frequency_of(settings: Settings) -> float:
    """The relative change of the RF frequency that a shot sets."""
    for name, setting in settings.items():
        if name.casefold() == "rf":
            return float(setting.get("frequency_relative", 0.0))
    return 0.0


@dataclass(frozen=True)
class Cavities:
    """What the compiled loops need of the RF.

    Attributes:
        exits: that the cavities stand behind: k is the exit of layer k - 1, and the number of
            layers + 1 the ring's end; none: the RF is off, [cavity].
        values: gain of one cavity at its crest (relative), phase (rad), wave number (rad/m), and
            what a turn is longer than the RF's (m), [4].
    """

    exits: NDArray[np.int64]
    values: NDArray[np.float64]


NO_RF = Cavities(np.empty(0, dtype=np.int64), np.zeros(4))


def cavities(
    ring: Ring, rf: Rf, layer_of: Sequence[int] | NDArray[np.intp], loss: float, frequency: float
) -> Cavities:
    """Thin cavities behind the magnets before them; what lies between is a drift, and commutes
    with a gain of energy to its own second order.

    Args:
        ring: it stands in.
        rf: of the ring.
        layer_of: the layer of each element.
        loss: relative energy loss of a turn on the design orbit.
        frequency: relative change of the frequency.

    Raises:
        LatticeError: a voltage that cannot make good the loss.
    """
    if not rf.on(loss, frequency) or rf.voltage == 0:
        return NO_RF
    crest = rf.voltage / (ring.energy * 1e9 * ring.beta)
    if loss >= crest:
        raise LatticeError(
            f"an RF of {rf.voltage / 1e6:.3g} MV cannot make good a loss of "
            f"{loss * ring.energy * 1e3:.3g} MeV a turn; give the ring's cavities their voltage"
        )
    wave = 2 * np.pi * rf.harmonic / ring.length * ring.beta * (1 + frequency)
    slip = ring.length / ring.beta * frequency / (1 + frequency)
    end = len(ring.magnets) + 1
    exits = [int(layer_of[i]) if i < len(ring.elements) else end for i in rf.places]
    phase = stable_phase(ring, float(np.arcsin(max(loss, 0.0) / crest)))
    values = np.array([crest / len(exits), phase, wave, slip])
    return Cavities(np.array(exits, dtype=np.int64), values)
