"""The virtual machine's beam, tracked by AT: thick, symplectic elements in six coordinates.

It shares no map and no formula with the networks, so that a diagnosis is tested independently of
its own model.

>>> engine = AtEngine(ring, [Cause("quadrupole_gradient", "qd::12", -0.2)])
>>> engine.track(launches)                              # [shot, 1, monitor, 2], m
>>> engine.track(launches, settings=[{"hcor_3": {"kick": 1e-4}}] * len(launches))

Launches are OCELOT's (x, px, y, py, tau, p); AT tracks (x, px, y, py, delta, ct). The first four
are the same: px = Px / p0, no angle. From p = dE / (p0 c) follows delta = P / p0 - 1 through
E^2 = (P c)^2 + (m c^2)^2. tau = c t - s / beta0 and ct have the same sign, positive for a late
particle. AT takes the speed of light for all particles: its ct is the path length, beta0 c t. The
velocity's contribution is added before the cavities and at the end, where it counts (protons).
"""

import copy
import functools
import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import at
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import c as SPEED_OF_LIGHT

from tmlattice.arrays import Array
from tmlattice.beam.rf import RELATIVISTIC, rf_of, stable_phase
from tmlattice.effects import Cause, RingEffect, check, find
from tmlattice.effects.apply import groups
from tmlattice.effects.build import Build
from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import NO_ERRORS, Ring
from tmlattice.machine import at_orbit
from tmlattice.machine.at_elements import (
    ELECTRON,
    NOTHING,
    SWAPPED,
    Builder,
    errors_of,
    expected_loss,
)

Settings = Mapping[str, Mapping[str, float]]
"""Settings by element: {"kick": rad}, {"k1_relative": 1}, {"k2_relative": 1}, and
{"rf": {"frequency_relative": 1}}."""

TURNS_AT_ONCE = 2**22
"""States of one block of AT's results, so that many turns fit into memory."""

SET_ON: Mapping[str, frozenset[str]] = {
    "kick": frozenset({"hcorrector", "vcorrector"}),
    "k1_relative": frozenset({"quadrupole", "bend"}),
    "k2_relative": frozenset({"sextupole"}),
}


class AtEngine:
    """A ring with its causes as a line of AT elements.

    Causes of the same effect on the same element add up, and to the element's own errors
    (`Element.errors`). A thin kick is on the design axis, whatever the offset and roll of its
    magnet.

    Args:
        causes: errors; those on readings (`monitor_*`) and on the beam are ignored here.
        radiation_bends, radiation_wigglers: scale of the expected energy loss, 0: none, 1: as
            expected; causes add to it.
        steps: fourth-order integration steps per magnet. With 30 the first turn of a
            PETRA-III-style ring is converged to 0.002 micrometres rms at 1 mm (0.01 with 20).
        aperture: half width in m of quadrupoles and monitors, in both planes.
        harmonic, voltage: of the RF, see `rf_of`.

    Attributes:
        expected_loss: energy that the design orbit loses in a turn at these scales, eV.

    Raises:
        LatticeError: an element that AT cannot build, a negative radiation loss, or an RF too
            weak for the loss.
        EffectError, UnknownNameError: an effect, element or family that cannot be.
    """

    def __init__(
        self,
        ring: Ring,
        causes: Sequence[Cause] = (),
        *,
        radiation_bends: float = 0.0,
        radiation_wigglers: float = 0.0,
        steps: int = 30,
        aperture: float = 0.05,
        harmonic: int | None = None,
        voltage: float | None = None,
    ) -> None:
        self.ring = ring
        self._wrong = _wrong(ring, causes)
        self._bends = radiation_bends + self._loss("bend")
        self._wigglers = radiation_wigglers + self._loss("wiggler")
        if min(self._bends, self._wigglers) < 0:
            raise LatticeError(
                f"the radiation loss is {self._bends:g} (bends) and {self._wigglers:g} (wigglers) "
                "of the expected; it cannot be negative"
            )
        self._builder = Builder(ring.energy * 1e9, steps, aperture, self._bends > 0, self._wigglers)
        self._line: list[Any] = []
        self._places: list[slice] = []  # of each element of the ring, in the line
        rf = rf_of(ring, harmonic, voltage)
        self._build(rf.places)
        self._monitors = np.array(
            [i for i, e in enumerate(self._line) if isinstance(e, at.Monitor)], dtype=np.uint32
        )
        self.expected_loss = expected_loss(ring, self._bends, self._wigglers)
        behind = len(self._line) - 1  # the marker at the end
        self._cavities = [
            self._places[i].start if i < len(self._places) else behind for i in rf.places
        ]
        self._has_rf, self._harmonic, self._voltage = rf.own, rf.harmonic, rf.voltage
        if self.expected_loss and self.expected_loss >= rf.voltage:
            raise LatticeError(
                f"an RF of {rf.voltage / 1e6:.3g} MV cannot replace a loss of "
                f"{self.expected_loss / 1e6:.3g} MeV a turn; give voltage="
            )

    def _build(self, cavities: Sequence[int]) -> None:
        """Build the line. AT's ct is the path length: the velocity's contribution of slower
        particles is added before the cavities."""
        builder = self._builder
        key = "AT", builder.steps, builder.aperture, builder.bend_pass
        known: dict[int, list[Any]] = self.ring.remembered(key, dict)
        way = 0.0

        def velocity() -> list[Any]:
            if self.ring.gamma > RELATIVISTIC:
                return []
            matrix = np.eye(6, order="F")
            matrix[5, 4] = -way / self.ring.gamma**2
            return [at.M66("velocity", matrix)]

        for i, element in enumerate(self.ring.elements):
            if i in cavities:
                self._line += velocity()
                way = 0.0
            pieces = known.get(i)
            if pieces is None or i in self._wrong:
                pieces = builder.pieces(element, self._wrong.get(i, NOTHING), {})
                # those of the design, which no tracking changes; a wiggler's have a loss of theirs
                if i not in self._wrong and element.kind != "wiggler":
                    known[i] = pieces
            self._places.append(slice(len(self._line), len(self._line) + len(pieces)))
            self._line += pieces
            way += element.length
        self._line += [*velocity(), at.Marker("rf_at_the_end")]

    def _loss(self, kind: str) -> float:
        """Scale of the loss in all elements of a kind."""
        elements = self.ring.elements
        scales = {w.loss for i, w in self._wrong.items() if elements[i].kind == kind and w.loss}
        if len(scales) > 1:
            raise LatticeError(f"AT gives every {kind} the same share of its expected loss")
        return scales.pop() if scales else 0.0

    def track(
        self, launches: ArrayLike, turns: int = 1, settings: Sequence[Settings] | None = None
    ) -> Array:
        """Return the beam at every monitor, (x, y) in m, [shot, turn, monitor, 2]; NaN once lost.

        Over more than one turn the RF is on if the ring radiates, has cavities of its own, or
        its frequency is set: in the ring's cavities, else at the marker or drift named `rf`, else
        at the end. Its phase replaces the loss on the design orbit. On one turn cavities are
        drifts. Shots with equal settings are tracked together.

        Args:
            launches: (x, px, y, py, tau, p) at the start of the sequence, [shot, 6].
            settings: of each shot, by element name: `kick` of a corrector in rad (the total: the
                design's kick is replaced), `k1_relative` of a quadrupole or a bend, `k2_relative`
                of a sextupole, and under "rf" `frequency_relative`.

        Raises:
            LatticeError, UnknownNameError: a setting that its element does not have; no such
                element.
            ValueError: launches or settings of another shape, or no turn.
        """
        start = np.asarray(launches, dtype=float)
        if start.ndim != 2 or start.shape[1] != 6:
            raise ValueError(f"launches have the shape {start.shape}; it should be [shot, 6]")
        if turns < 1:
            raise ValueError(f"{turns} turns cannot be tracked; give at least one")
        if settings is not None and len(settings) != len(start):
            raise ValueError(f"{len(settings)} settings for {len(start)} shots; give one a shot")
        state = to_at(start, self.ring.energy, self.ring.mass)
        readings = np.empty((len(start), turns, len(self._monitors), 2))
        for shots, changed, frequency in self._groups(settings or [{}] * len(start)):
            line = self._set(changed)
            if turns > 1:
                self._switch_on(line, frequency)
            readings[shots] = self.run(line, np.asfortranarray(state[shots].T), turns)
        return readings

    def closed_orbits(self, settings: Sequence[Settings]) -> Array:
        """Return the stored beam at every monitor, the RF frequency fixed or set.

        A turn lasts a harmonic number of the RF's periods, which determines the energy: a corrector
        at non-zero dispersion shifts it. The ring's loss is replaced at its end. Broyden's method
        starts from the unset ring's Jacobian.

        Returns:
            (x, y) in m, [orbit, monitor, 2].
        """
        start, solve = self._stored
        readings = np.empty((len(settings), len(self._monitors), 2))
        for orbits, changed, frequency in self._groups(settings):
            line = self._set(changed)
            turn = self._again(line)
            readings[orbits] = at_orbit.settle(turn, start, solve, self._late(frequency))[1]
        return readings

    @functools.cached_property
    def _stored(self) -> tuple[Array, Array]:
        """The unset ring's closed orbit, and its Jacobian, for every setting."""
        return at_orbit.stored(self._again(self._line))

    def stored_line(self, settings: Settings) -> tuple[list[Any], list[Any], float]:
        """Return the line with the settings of one shot, without RF; with the RF that acts on a
        stored beam; and the excess of a turn over the RF's, m."""
        ((_, changed, frequency),) = self._groups([settings])
        line = self._set(changed)
        with_rf = line.copy()
        self._switch_on(with_rf, frequency)
        return line, with_rf, self._late(frequency)

    def _late(self, frequency: float) -> float:
        """Excess of a turn over that of the RF at a relative change of its frequency, m."""
        return -self.ring.length * frequency / (1 + frequency)

    def _set(self, changed: Mapping[int, Mapping[str, float]]) -> list[Any]:
        """Return the line with settings, by index in the ring."""
        line = self._line.copy()
        for i, setting in changed.items():
            wrong = self._wrong.get(i, NOTHING)
            line[self._places[i]] = self._builder.pieces(self.ring.elements[i], wrong, setting)
        return line

    def _switch_on(self, line: list[Any], frequency: float) -> None:
        """Switch the RF on, if the ring radiates, has cavities, or its frequency is set."""
        if (self.expected_loss > 0 or self._has_rf or frequency) and self._voltage:
            for place in self._cavities:
                line[place] = self._cavity(line[place], frequency)

    def one_pass(self, line: list[Any], beam: Array, known: bool = False) -> Array:
        """Return readings of the first state of [6, shot]; all are moved to the line's end.

        `known`: the line is that of AT's latest tracking, which takes most of the time to read it.
        """
        return np.asarray(self.run(line, beam, 1, known=known)[0, 0])

    def _again(self, line: list[Any]) -> at_orbit.Turn:
        """Passes through one line, with no other tracking between them."""
        known = itertools.chain([False], itertools.repeat(True))
        return lambda beam: self.one_pass(line, beam, next(known))

    def centroids(self, line: list[Any], beam: Array, turns: int) -> Iterator[tuple[Array, Array]]:
        """Yield of each turn the mean of the particles, [monitor, 2], and their part that is not
        lost, [monitor] (beam: the particles, [6, particle]; they are moved)."""
        block = max(TURNS_AT_ONCE // (beam.shape[1] * len(self._monitors)), 1)
        for turn in range(0, turns, block):
            seen = self.run(line, beam, min(block, turns - turn), turn)
            alive = np.isfinite(seen[..., 0]).mean(axis=0)
            mean = np.nansum(seen, axis=0) / np.maximum(alive * len(seen), 1)[..., None]
            yield from zip(mean, alive, strict=True)

    def lattice(self) -> Any:
        """Return the line as an AT lattice, without RF, for AT's tools (`at.get_optics`).

        Exact bends round x to the rounding of their radius, 3e-14 m: derivatives need steps of
        3e-6 (`XYStep`) and 1e-3 (`DPStep`). The lattice's energy is the ring's, times the third
        root of the scale of a loss in the bends other than 1: so AT's loss is scaled.
        """
        return at.Lattice(copy.deepcopy(self._line), energy=self._energy, periodicity=1)

    def _groups(
        self, settings: Sequence[Settings]
    ) -> Iterable[tuple[NDArray[np.intp], dict[int, Mapping[str, float]], float]]:
        """(shots, settings by index in the ring, relative RF frequency) of equal shots."""
        for shots, setting in groups(settings, len(settings)):
            changed: dict[int, Mapping[str, float]] = {}
            frequency = 0.0
            for name, what in setting.items():
                if name.casefold() == "rf":
                    _check_setting("rf", what, ("frequency_relative",))
                    frequency = what.get("frequency_relative", 0.0)
                    continue
                i = self.ring.index(name)
                kind = self.ring.elements[i].kind
                _check_setting(name, what, [k for k, kinds in SET_ON.items() if kind in kinds])
                changed[i] = what
            yield shots, changed, frequency

    def _cavity(self, there: Any, frequency_relative: float) -> Any:
        length = getattr(there, "Length", 0.0)
        frequency = self._harmonic * SPEED_OF_LIGHT / self.ring.length * (1 + frequency_relative)
        # Above transition a late particle has too much energy: the field falls with ct.
        phase = stable_phase(self.ring, float(np.arcsin(self.expected_loss / self._voltage)))
        energy = self.ring.energy * 1e9 * self.ring.beta**2  # dP / P = dE / (beta^2 E)
        return at.RFCavity(
            "rf",
            length,
            self._voltage / len(self._cavities) * self._energy / energy,
            frequency,
            self._harmonic,
            self._energy,
            TimeLag=phase * SPEED_OF_LIGHT / (2 * np.pi * frequency),
        )

    @property
    def _energy(self) -> float:
        """Energy given to AT, eV.

        AT's loss is proportional to its cube. Nothing else depends on it but the cavities, whose
        voltage is scaled.
        """
        scale = self._bends if self._bends > 0 else 1.0
        return self.ring.energy * 1e9 * float(np.cbrt(scale))

    def run(
        self, line: list[Any], beam: Array, turns: int, first: int = 0, known: bool = False
    ) -> Array:
        """Return readings [shot, turn, monitor, 2] of states in AT's coordinates, [6, shot], which
        are moved to the line's end; `first` is the number of the first turn, for the RF; `known`:
        see `one_pass`."""
        shots = beam.shape[1]
        readings = np.empty((shots, turns, len(self._monitors), 2))
        block = max(TURNS_AT_ONCE // max(shots * len(self._monitors), 1), 1)
        for turn in range(0, turns, block):
            seen = at.internal_lpass(  # leaves the next block's start in `beam`
                line,
                beam,
                min(block, turns - turn),
                refpts=self._monitors,
                energy=self._energy,
                turn=first + turn,
                keep_lattice=known or turn > 0,
            )
            readings[:, turn : turn + block] = np.moveaxis(seen[[0, 2]], [0, 2, 3], [3, 2, 1])
        # AT sets x alone of a lost particle to NaN; beyond the aperture it is lost later.
        readings[~np.all(np.abs(readings) <= self._builder.aperture, axis=3)] = np.nan
        return readings


def to_at(launches: ArrayLike, energy: float, mass: float = 1e-9 * ELECTRON) -> Array:
    """Return AT's (x, px, y, py, delta, ct) of OCELOT's (x, px, y, py, tau, p), [..., 6] (launches:
    [..., 6])."""
    launches = np.asarray(launches, dtype=float)
    rest = 1e9 * mass
    reference = np.sqrt((energy * 1e9) ** 2 - rest**2)
    total = energy * 1e9 + launches[..., 5] * reference
    converted = launches[..., SWAPPED].copy()
    converted[..., 4] = np.sqrt(total**2 - rest**2) / reference - 1
    converted[..., 5] *= reference / (energy * 1e9)
    return converted


def from_at(states: ArrayLike, energy: float, mass: float = 1e-9 * ELECTRON) -> Array:
    """Return OCELOT's coordinates of AT's: the inverse of `to_at`."""
    states = np.asarray(states, dtype=float)
    rest = 1e9 * mass
    reference = np.sqrt((energy * 1e9) ** 2 - rest**2)
    converted = states[..., SWAPPED].copy()
    converted[..., 4] *= energy * 1e9 / reference
    converted[..., 5] = (
        np.hypot(reference * (1 + states[..., 4]), rest) - energy * 1e9
    ) / reference
    return converted


def _check_setting(name: str, what: Iterable[str], known: Iterable[str]) -> None:
    for key in what:
        if key not in known:
            offer = ", ".join(f"'{k}'" for k in known) or "nothing"
            raise LatticeError(f"'{key}' of '{name}' cannot be set; {offer} can")


def _wrong(ring: Ring, causes: Iterable[Cause]) -> dict[int, Build]:
    """Errors of the elements, of the ring and by causes, by index in the ring."""
    causes = list(causes)
    check(ring, causes)
    amounts: dict[int, dict[str, float]] = defaultdict(dict)
    for cause in causes:
        effect = find(cause.effect)
        if isinstance(effect, RingEffect):
            for i in effect.members(ring, cause.element):
                own = amounts[i]
                own[effect.name] = effect.joined(own.get(effect.name, 0.0), cause.amount)
    wrong = {
        i: errors_of(e, ring.energy) for i, e in enumerate(ring.elements) if e.errors != NO_ERRORS
    }
    for i, own in amounts.items():
        for name, amount in own.items():
            effect = find(name)
            assert isinstance(effect, RingEffect)
            effect.build(wrong.setdefault(i, Build()), amount)
    return wrong
