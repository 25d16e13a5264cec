"""The virtual machine's beam, tracked by AT: thick, symplectic elements in six coordinates.

It shares no map and no formula with the networks: a diagnosis that works on its data does not
owe it to its own model.

>>> engine = AtEngine(ring, [Cause("quadrupole_gradient", "qd::12", -0.2)])
>>> engine.track(launches)                              # [shot, 1, monitor, 2], m
>>> engine.track(launches, settings=[{"hcor_3": {"kick": 1e-4}}] * len(launches))

Launches are OCELOT's (x, px, y, py, tau, p); AT tracks (x, px, y, py, delta, ct). The first four
are the same: px = Px / p0, no angle. From p = dE / (p0 c) follows delta = P / p0 - 1 through
E^2 = (P c)^2 + (m c^2)^2. tau = c t - s / beta0 and ct have the same sign, positive for a late
particle; AT takes the speed of light for all particles, an error of 1 / gamma^2 in ct alone.
"""

import copy
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import at
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import c as SPEED_OF_LIGHT
from scipy.constants import physical_constants
from scipy.linalg import sqrtm

from tmlattice.beam.rf import rf_of
from tmlattice.effects.cause import Cause
from tmlattice.errors import LatticeError, UnstableRingError, unknown_name
from tmlattice.lattice.ring import Element, Ring

Array = NDArray[np.float64]
Settings = Mapping[str, Mapping[str, float]]
"""What is set on purpose, by element: {"kick": rad}, {"k1_relative": 1}, {"k2_relative": 1},
and {"rf": {"frequency_relative": 1}}."""

ELECTRON = physical_constants["electron mass energy equivalent in MeV"][0] * 1e6  # eV
RADIUS = physical_constants["classical electron radius"][0]  # m
C_GAMMA = 4 * np.pi / 3 * RADIUS / ELECTRON**3
"""Energy loss of a circle of radius rho: C_GAMMA E^4 / rho, 1/eV^3 m."""

TURNS_AT_ONCE = 2**22
"""AT's result is cut into blocks of so many states, so that many turns fit into memory."""

_STRAIGHT = frozenset({"quadrupole", "sextupole", "wiggler", "marker"})
_CORRECTOR = frozenset({"hcorrector", "vcorrector"})
SITS_ON: Mapping[str, frozenset[str]] = {
    "quadrupole_gradient": frozenset({"quadrupole"}),
    "gradient_absolute": _STRAIGHT,
    "skew_gradient": _STRAIGHT,
    "quadrupole_roll": frozenset({"quadrupole"}),
    "quadrupole_offset_x": frozenset({"quadrupole"}),
    "quadrupole_offset_y": frozenset({"quadrupole"}),
    "dipole_field": frozenset({"bend"}),
    "dipole_roll": frozenset({"bend"}),
    "corrector_kick_x": _CORRECTOR,
    "corrector_kick_y": _CORRECTOR,
    "corrector_calibration": _CORRECTOR,
    "corrector_roll": _CORRECTOR,
    "sextupole_strength": frozenset({"sextupole"}),
    "sextupole_offset_x": frozenset({"sextupole"}),
    "sextupole_offset_y": frozenset({"sextupole"}),
    "insertion_device_focusing": frozenset({"wiggler"}),
}
"""The effects on one element, and the kinds of element that AT is told to put them on."""

OF_ALL = ("family_gradient", "radiation_loss_bends", "radiation_loss_wigglers")
OF_THE_BEAM = ("energy_offset", "energy_spread")
"""The caller puts these into the launches."""

SET_ON: Mapping[str, frozenset[str]] = {
    "kick": _CORRECTOR,
    "k1_relative": frozenset({"quadrupole", "bend"}),
    "k2_relative": frozenset({"sextupole"}),
}
_SWAPPED = [0, 1, 2, 3, 5, 4]


_NO_ORBIT = (
    "no closed orbit: the search does not settle; the ring is at an integer resonance, or its "
    "kicks are too large"
)


class AtEngine:
    """A ring with its causes as a line of AT elements.

    Causes of the same effect on the same element add up. A thin gradient sits on the design
    axis, whatever the offset and roll of its magnet.

    Args:
        ring: the design.
        causes: what is wrong with it; effects on readings (`monitor_*`) and on the beam
            (`energy_offset`, `energy_spread`) are the caller's and are passed over.
        radiation_bends, radiation_wigglers: scale of the expected energy loss, 0 none and 1 as
            expected; causes add to it.
        steps: fourth-order integration steps per magnet. With 30 the first turn of a
            PETRA-III-style ring is converged to 0.002 micrometres rms at 1 mm (0.01 with 20).
        aperture: half width in m of quadrupoles and monitors, in both planes.
        harmonic: of the RF; else that of the ring's first cavity, else the one of `rf_of`.
        voltage: of the RF in V, all cavities together; else that of the ring's cavities, else
            four times what the design loses when it radiates as expected.

    Attributes:
        ring: the design.
        expected_loss: energy that the design orbit loses in a turn at these scales, eV.

    Raises:
        LatticeError: an element that AT cannot build, an effect that is unknown or cannot sit
            on its element, a negative radiation loss, or an RF too weak for the loss.
        UnknownNameError: a cause on an element or family that the ring does not have.
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
        self._errors, scale = _sorted(ring, causes)
        self._bends = radiation_bends + scale["radiation_loss_bends"]
        self._wigglers = radiation_wigglers + scale["radiation_loss_wigglers"]
        if min(self._bends, self._wigglers) < 0:
            raise LatticeError(
                f"the radiation loss is {self._bends:g} (bends) and {self._wigglers:g} (wigglers) "
                "of the expected; it cannot be negative"
            )
        self._builder = _Builder(
            ring.energy * 1e9, steps, aperture, self._bends > 0, self._wigglers
        )
        self._line: list[Any] = []
        self._places: list[slice] = []  # of each element of the ring, in the line
        nothing: Mapping[str, float] = {}
        for i, element in enumerate(ring.elements):
            pieces = self._builder.pieces(element, self._errors.get(i, nothing), nothing)
            self._places.append(slice(len(self._line), len(self._line) + len(pieces)))
            self._line += pieces
        self._line.append(at.Marker("rf_at_the_end"))
        self._monitors = np.array(
            [i for i, e in enumerate(self._line) if isinstance(e, at.Monitor)], dtype=np.uint32
        )
        self.expected_loss = _expected_loss(ring, self._bends, self._wigglers)
        self._set_rf(harmonic, voltage)

    def _set_rf(self, harmonic: int | None, voltage: float | None) -> None:
        rf = rf_of(self.ring, harmonic, voltage)
        behind = len(self._line) - 1  # the marker at the end
        self._cavities = [
            self._places[i].start if i < len(self._places) else behind for i in rf.places
        ]
        self._has_rf, self._harmonic, self._voltage = rf.own, rf.harmonic, rf.voltage
        if self.expected_loss and self.expected_loss >= rf.voltage:
            raise LatticeError(
                f"an RF of {rf.voltage / 1e6:.3g} MV cannot make good a loss of "
                f"{self.expected_loss / 1e6:.3g} MeV a turn; give voltage="
            )

    def track(
        self, launches: ArrayLike, turns: int = 1, settings: Sequence[Settings] | None = None
    ) -> Array:
        """The beam at every monitor.

        Over more than one turn the RF is on if the ring radiates, has cavities of its own, or
        its frequency is set: in the ring's cavities, else at the marker or drift named `rf`, else
        at the end. Its phase makes good the loss on the design orbit. On one turn cavities are
        drifts. Shots with equal settings are tracked together.

        Args:
            launches: (x, px, y, py, tau, p) at the start of the sequence, [shot, 6].
            turns: at least 1.
            settings: one mapping a shot, of element name to what is set: `kick` of a corrector
                in rad (all of it: the design's kick is replaced), `k1_relative` of a quadrupole
                or a bend, `k2_relative` of a sextupole, and under "rf" `frequency_relative`.

        Returns:
            (x, y) in m, [shot, turn, monitor, 2]; NaN from where a particle is lost.

        Raises:
            LatticeError: a setting that its element does not have.
            UnknownNameError: a setting for an element that the ring does not have.
            ValueError: launches or settings of another shape, or no turn.
        """
        start = np.asarray(launches, dtype=float)
        if start.ndim != 2 or start.shape[1] != 6:
            raise ValueError(f"launches have the shape {start.shape}; it should be [shot, 6]")
        if turns < 1:
            raise ValueError(f"{turns} turns cannot be tracked; one at least can")
        if settings is not None and len(settings) != len(start):
            raise ValueError(f"{len(settings)} settings for {len(start)} shots; give one a shot")
        state = to_at(start, self.ring.energy)
        readings = np.empty((len(start), turns, len(self._monitors), 2))
        for shots, changed, frequency in self._groups(settings or [{}] * len(start)):
            line = self._line.copy()
            for i, setting in changed.items():
                errors = self._errors.get(i, {})
                line[self._places[i]] = self._builder.pieces(self.ring.elements[i], errors, setting)
            on = self.expected_loss > 0 or self._has_rf or frequency
            if turns > 1 and on and self._voltage:
                for place in self._cavities:
                    line[place] = self._cavity(line[place], frequency)
            readings[shots] = self._track_line(line, state[shots], turns)
        return readings

    def closed_orbits(self, settings: Sequence[Settings]) -> Array:
        """The stored beam at every monitor, the RF frequency fixed or set.

        The turn lasts a harmonic number of the RF's periods, and the energy is what makes it so:
        a corrector where the dispersion is not zero shifts it. What the ring loses is given back
        at its end. Broyden's method starts from the unset ring's Jacobian.

        Args:
            settings: one mapping an orbit, as in `track`.

        Returns:
            (x, y) in m, [orbit, monitor, 2].

        Raises:
            LatticeError, UnknownNameError: see `track`.
            UnstableRingError: no closed orbit within reach.
        """
        start, solve = self._stored()
        readings = np.empty((len(settings), len(self._monitors), 2))
        for orbits, changed, frequency in self._groups(settings):
            line = self._line.copy()
            for i, setting in changed.items():
                errors = self._errors.get(i, {})
                line[self._places[i]] = self._builder.pieces(self.ring.elements[i], errors, setting)
            late = -self.ring.length * frequency / (1 + frequency)
            readings[orbits] = self._settle(line, start, solve, late)[1]
        return readings

    def _stored(self) -> tuple[Array, Array]:
        """The unset ring's closed orbit [6] and what makes good a miss of the turn, [6, 6]."""
        steps = np.diag([3e-6, 3e-6, 3e-6, 3e-6, 1e-5, 1.0])[:5]  # bends round x to 3e-14 m
        start = np.zeros(6)
        for _ in range(3):
            beam = np.asfortranarray(np.vstack([start + steps, start - steps]).T)
            self._pass(self._line, beam)
            ends = beam.T
            slopes = (ends[:5] - ends[5:]).T / (2 * steps[range(5), range(5)])
            rows = [0, 1, 2, 3, 5]
            solve = np.zeros((6, 6))
            try:
                solve[:5, rows] = np.linalg.inv((np.eye(6)[:, :5] - slopes)[rows])
            except np.linalg.LinAlgError:
                raise UnstableRingError(_NO_ORBIT) from None
            start = self._settle(self._line, start, solve, 0.0, 1e-6)[0]
        return self._settle(self._line, start, solve, 0.0)[0], solve

    def _settle(
        self, line: list[Any], start: Array, solve: Array, late: float, tolerance: float = 2e-12
    ) -> tuple[Array, Array]:
        """Broyden's method from a given Jacobian: the state [6] and its readings [monitor, 2]."""
        state, change, before = start.copy(), np.zeros(6), np.zeros(6)
        for step in range(60):
            beam = np.array(state[:, None], order="F")
            readings = self._pass(line, beam)
            miss = beam[:, 0] - state
            miss[5] -= late
            if not np.isfinite(readings).all() or not np.isfinite(miss).all():
                break
            if step:  # Broyden: the Jacobian's inverse learns from what the last change did
                learned = solve @ (before - miss)
                weight = change @ solve
                below = weight @ (before - miss)
                if below:
                    solve = solve + np.outer(change - learned, weight) / below
            change, before = solve @ miss, miss
            if np.abs(change).max() < tolerance:
                return state, readings
            state += change
        raise UnstableRingError(_NO_ORBIT)

    def _pass(self, line: list[Any], beam: Array) -> Array:
        """Readings of the first of the states [6, shot], which move to the line's end."""
        return np.asarray(self._track_line(line, beam.T, 1, beam)[0, 0])

    def lattice(self) -> Any:
        """The line as an AT lattice of its own, without RF, for AT's tools (`at.get_optics`).

        Exact bends round x to the rounding of their radius, 3e-14 m: derivatives need steps of
        3e-6 (`XYStep`) and 1e-3 (`DPStep`). The lattice's energy is the ring's, times the third
        root of the scale of a loss in the bends other than 1: so AT's loss comes out scaled.
        """
        return at.Lattice(copy.deepcopy(self._line), energy=self._energy, periodicity=1)

    def _groups(
        self, settings: Sequence[Settings]
    ) -> Iterable[tuple[list[int], dict[int, Mapping[str, float]], float]]:
        """(shots, settings by place in the ring, relative RF frequency) of equal shots."""
        groups: dict[Any, list[int]] = defaultdict(list)
        for shot, setting in enumerate(settings):
            groups[
                frozenset((name, frozenset(what.items())) for name, what in setting.items())
            ].append(shot)
        for shots in groups.values():
            changed: dict[int, Mapping[str, float]] = {}
            frequency = 0.0
            for name, what in settings[shots[0]].items():
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
        phase = np.arcsin(self.expected_loss / self._voltage)
        return at.RFCavity(
            "rf",
            length,
            self._voltage / len(self._cavities) * self._energy / (self.ring.energy * 1e9),
            frequency,
            self._harmonic,
            self._energy,
            TimeLag=phase * SPEED_OF_LIGHT / (2 * np.pi * frequency),
        )

    @property
    def _energy(self) -> float:
        """The energy that AT is told, eV.

        AT's loss is proportional to its cube and nothing else depends on it but the cavities,
        whose voltage goes with it.
        """
        scale = self._bends if self._bends > 0 else 1.0
        return self.ring.energy * 1e9 * float(np.cbrt(scale))

    def _track_line(
        self, line: list[Any], state: Array, turns: int, beam: Array | None = None
    ) -> Array:
        """Readings of the states [shot, 6], in AT's coordinates, [shot, turn, monitor, 2].

        A given `beam`, the states as AT wants them, [6, shot], is left at the line's end.
        """
        beam = np.asfortranarray(state.T) if beam is None else beam
        readings = np.empty((len(state), turns, len(self._monitors), 2))
        block = max(TURNS_AT_ONCE // max(len(state) * len(self._monitors), 1), 1)
        for turn in range(0, turns, block):
            seen = at.internal_lpass(  # it leaves in `beam` where the next block begins
                line,
                beam,
                min(block, turns - turn),
                refpts=self._monitors,
                energy=self._energy,
                turn=turn,
            )
            readings[:, turn : turn + block] = np.moveaxis(seen[[0, 2]], [0, 2, 3], [3, 2, 1])
        # AT sets x alone of a lost particle to NaN, and that behind the wall it is lost on.
        readings[~np.all(np.abs(readings) <= self._builder.aperture, axis=3)] = np.nan
        return readings


def to_at(launches: ArrayLike, energy: float) -> Array:
    """AT's (x, px, y, py, delta, ct) of OCELOT's (x, px, y, py, tau, p), [..., 6].

    Args:
        launches: [..., 6].
        energy: of the reference particle, GeV.
    """
    launches = np.asarray(launches, dtype=float)
    reference = np.sqrt((energy * 1e9) ** 2 - ELECTRON**2)
    total = energy * 1e9 + launches[..., 5] * reference
    converted = launches[..., _SWAPPED].copy()
    converted[..., 4] = np.sqrt(total**2 - ELECTRON**2) / reference - 1
    return converted


def _check_setting(name: str, what: Iterable[str], known: Iterable[str]) -> None:
    for key in what:
        if key not in known:
            offer = ", ".join(f"'{k}'" for k in known) or "nothing"
            raise LatticeError(f"'{key}' of '{name}' cannot be set; {offer} can")


def _sorted(
    ring: Ring, causes: Iterable[Cause]
) -> tuple[dict[int, dict[str, float]], dict[str, float]]:
    """Amounts by place in the ring and effect, and the scales of the radiation."""
    errors: dict[int, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    scale = dict.fromkeys(("radiation_loss_bends", "radiation_loss_wigglers"), 0.0)
    families: dict[str, list[int]] = defaultdict(list)
    for i, element in enumerate(ring.elements):
        if element.kind == "quadrupole":
            families[element.family.casefold()].append(i)
    for cause in causes:
        effect, amount = cause.effect, float(cause.amount)
        if effect.startswith("monitor_") or effect in OF_THE_BEAM:
            continue
        if effect in scale:
            if cause.element is not None:
                raise LatticeError(f"'{effect}' is of all elements; its element should be None")
            scale[effect] += amount
            continue
        if effect != "family_gradient" and effect not in SITS_ON:
            raise unknown_name("effect", effect, [*SITS_ON, *OF_ALL, *OF_THE_BEAM])
        if cause.element is None:
            raise LatticeError(f"'{effect}' sits on an element; name it")
        if effect == "family_gradient":
            members = families.get(cause.element.casefold())
            if members is None:
                known = dict.fromkeys(ring.elements[m[0]].family for m in families.values())
                raise unknown_name("family of quadrupoles", cause.element, known)
            for i in members:
                errors[i][effect] += amount
            continue
        i = ring.index(cause.element)
        if ring.elements[i].kind not in SITS_ON[effect]:
            raise LatticeError(
                f"'{effect}' cannot sit on the {ring.elements[i].kind} '{cause.element}', only on "
                f"a {' or '.join(sorted(SITS_ON[effect]))}"
            )
        errors[i][effect] += amount
    return {i: dict(amounts) for i, amounts in errors.items()}, scale


def _wiggler_curvature(element: Element, energy: float) -> float:
    """Integral of 1 / rho^2 over a wiggler, 1/m, from the vertical focusing that its poles have.

    A plane wiggler focuses vertically with the mean of 1 / rho^2, so R33 = cos(sqrt(k) L).
    """
    cosine = _matrix(element, energy)[2, 2]
    return float(np.arccos(cosine)) ** 2 / element.length if abs(cosine) < 1 else 0.0


def _expected_loss(ring: Ring, bends: float, wigglers: float) -> float:
    """Energy loss of the design orbit in a turn, eV: C_gamma E^4 / 2 pi, integral of 1/rho^2."""
    energy = ring.energy * 1e9
    bent = sum(e.angle**2 / e.length for e in ring.elements if e.kind == "bend")
    wiggled = sum(_wiggler_curvature(e, energy) for e in ring.elements if e.kind == "wiggler")
    return float(C_GAMMA * energy**4 / (2 * np.pi) * (bends * bent + wigglers * wiggled))


def _matrix(element: Element, energy: float) -> Array:
    """The design's matrix of a matrix element or undulator in AT's coordinates, [6, 6].

    An undulator focuses by (sqrt(2) pi K / (period gamma))^2 in the plane that its field's
    direction stands for; its slippage, of the order 1 / gamma^2, is left out.
    """
    source, length = element.source, element.length
    if hasattr(source, "r"):
        if np.any(source.t) or np.any(source.b) or source.delta_e:
            raise LatticeError(
                f"matrix '{element.name}' has a kick, a second order or an energy gain, which AT's "
                "matrix has not; take them out of the lattice file"
            )
        return np.asarray(source.r, dtype=float)[np.ix_(_SWAPPED, _SWAPPED)]
    matrix = np.eye(6)
    for plane, strength in ((0, source.Ky), (2, source.Kx)):
        root = 0.0
        if strength:
            root = np.sqrt(2.0) * np.pi * float(strength) / (source.lperiod * energy / ELECTRON)
        phase = root * length
        matrix[plane : plane + 2, plane : plane + 2] = [
            [np.cos(phase), length * np.sinc(phase / np.pi)],
            [-root * np.sin(phase), np.cos(phase)],
        ]
    return matrix


def _rotation(angle: float) -> Array:
    """Coordinates seen by a magnet turned by `angle` from x towards y, [6, 6]."""
    matrix = np.eye(6)
    matrix[:4, :4] = np.kron(
        [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], np.eye(2)
    )
    return matrix


class _Builder:
    """AT elements of one element of a ring with its errors and settings."""

    def __init__(
        self, energy: float, steps: int, aperture: float, bends_radiate: bool, wigglers: float
    ) -> None:
        self.energy = energy
        self.steps = steps
        self.aperture = aperture
        self.wigglers = wigglers
        # The usual BndMPoleSymplectic4Pass leaves out the curvature's h x (px^2 + py^2) / 2, and
        # its Rad twin takes the loss too late in every step (a third of the orbit is missing at
        # 20 steps); the E2 pass has no vertical field. The exact pass has all three right.
        self.bend_pass = f"ExactSectorBend{'Rad' if bends_radiate else ''}Pass"
        self.walls = {"RApertures": np.array([-aperture, aperture, -aperture, aperture])}

    def pieces(
        self, element: Element, errors: Mapping[str, float], setting: Mapping[str, float]
    ) -> list[Any]:
        """As many for every setting: settings change strengths alone."""
        build: Callable[..., list[Any]] | None = getattr(self, f"_{element.kind}", None)
        if build is None:
            raise LatticeError(f"AT cannot build the {element.kind} '{element.name}'")
        return build(element, defaultdict(float, errors), defaultdict(float, setting))

    def _thin(self, name: str, normal: float, skew: float) -> Any:
        """Thin gradients: px -= normal x - skew y, py += normal y + skew x."""
        return at.ThinMultipole(name, [0.0, skew], [0.0, normal])

    def _with_middle(
        self, element: Element, errors: Mapping[str, float], body: Callable[[float], list[Any]]
    ) -> list[Any]:
        """The body, or its two halves (`body` of a share of the length) and the thin gradients."""
        if "gradient_absolute" not in errors and "skew_gradient" not in errors:
            return body(1.0)
        thin = self._thin(element.name, errors["gradient_absolute"], errors["skew_gradient"])
        return [*body(0.5), thin, *body(0.5)]

    def _marker(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        return self._with_middle(element, errors, lambda share: [at.Marker(element.name)])

    def _drift(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        return [at.Drift(element.name, element.length)]

    def _cavity(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        if type(element.source).__name__ not in ("Cavity", "Drift", "Marker"):
            raise LatticeError(
                f"AT cannot build '{element.name}', a {type(element.source).__name__}; only "
                "standing-wave cavities (Cavity)"
            )
        return self._drift(element, errors, setting)

    def _monitor(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        monitor = at.Monitor(element.name, **self.walls)
        if element.length == 0:
            return [monitor]
        half = at.Drift(element.name, element.length / 2)
        return [half, monitor, half]

    def _straight(
        self,
        element: Element,
        normal: list[float],
        roll: float,
        offset: tuple[float, float],
        walls: bool,
    ) -> Callable[[float], list[Any]]:
        """A straight multipole of strengths k_n, rolled about its own centre."""
        more: dict[str, Any] = dict(self.walls) if walls else {}
        angle = element.tilt + roll
        if any(offset):
            shift = np.array([offset[0], 0, offset[1], 0, 0, 0])
            more |= {"T1": -shift, "T2": shift}
        if angle:
            more |= {"R1": _rotation(angle), "R2": _rotation(-angle)}
        factorial = [1.0, 1.0, 2.0, 6.0]
        strengths = [k / n for k, n in zip(normal, factorial, strict=False)]

        def body(share: float) -> list[Any]:
            return [
                at.Multipole(
                    element.name,
                    share * element.length,
                    [0.0] * len(strengths),
                    strengths,
                    NumIntSteps=self.steps,
                    **more,
                )
            ]

        return body

    def _quadrupole(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        source = element.source
        if getattr(source, "x_offs", 0) or getattr(source, "y_offs", 0):
            raise LatticeError(f"AT cannot build '{element.name}', a quadrupole passed off axis")
        k1 = (
            element.k1
            * (1 + setting["k1_relative"])
            * (1 + errors["family_gradient"])
            * (1 + errors["quadrupole_gradient"])
        )
        offset = errors["quadrupole_offset_x"], errors["quadrupole_offset_y"]
        strengths = [0.0, k1, element.k2]
        body = self._straight(element, strengths, errors["quadrupole_roll"], offset, True)
        return self._with_middle(element, errors, body)

    def _sextupole(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        k2 = element.k2 * (1 + setting["k2_relative"]) * (1 + errors["sextupole_strength"])
        offset = errors["sextupole_offset_x"], errors["sextupole_offset_y"]
        body = self._straight(element, [0.0, element.k1, k2], 0.0, offset, False)
        return self._with_middle(element, errors, body)

    def _octupole(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        k3 = float(element.source.k3)
        return self._straight(element, [0.0, 0.0, 0.0, k3], 0.0, (0.0, 0.0), False)(1.0)

    def _multipole(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        strengths = np.asarray(element.source.kn, dtype=float)
        if strengths[0]:
            raise LatticeError(f"AT cannot build '{element.name}', a thin multipole that bends")
        factorials = np.cumprod([1, *range(1, len(strengths))])
        more = {}
        if element.tilt:
            more = {"R1": _rotation(element.tilt), "R2": _rotation(-element.tilt)}
        zero = np.zeros(len(strengths))
        return [at.ThinMultipole(element.name, zero, strengths / factorials, **more)]

    def _solenoid(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        return [  # AT has the pass and no class; its K is B / (B rho), OCELOT's k half of it
            at.Element(
                element.name,
                Length=element.length,
                K=2 * float(element.source.k),
                PassMethod="SolenoidLinearPass",
            )
        ]

    def _bend(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        source, length, angle = element.source, element.length, element.angle
        if length <= 0 or source.h_pole1 or source.h_pole2:
            raise LatticeError(f"AT cannot build '{element.name}', a thin bend or curved poles")
        roll = errors["dipole_roll"]
        horizontal = angle * errors["dipole_field"] - roll**2 * angle / 2  # what px loses
        k1 = element.k1 * (1 + setting["k1_relative"])
        # The body is exact in a step; only its errors, losses and gradients are spread.
        steps = self.steps if element.k1 or element.k2 else 4
        more: dict[str, Any] = {}
        if element.tilt:
            more = {"R1": _rotation(element.tilt), "R2": _rotation(-element.tilt)}

        def body(share: float, **edges: float) -> Any:
            return at.Dipole(
                element.name,
                share * length,
                share * angle,
                PolynomB=[horizontal / length, k1, element.k2 / 2, 0.0],
                PolynomA=[-roll * angle / length, 0.0, 0.0, 0.0],
                NumIntSteps=steps,
                PassMethod=self.bend_pass,
                **edges,
                **more,
            )

        entrance, exit_ = source.fint * source.gap, source.fintx * source.gap
        if entrance == exit_:
            return [body(1.0, EntranceAngle=source.e1, ExitAngle=source.e2, gK=entrance)]
        return [  # AT's exact bend has one fringe integral for both edges
            body(0.5, EntranceAngle=source.e1, gK=entrance, FringeBendExit=0),
            body(0.5, ExitAngle=source.e2, gK=exit_, FringeBendEntrance=0),
        ]

    def _hcorrector(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        kick = setting.get("kick", element.angle) * (1 + errors["corrector_calibration"])
        x = kick * np.cos(element.tilt) + errors["corrector_kick_x"]
        y = kick * np.sin(element.tilt) + errors["corrector_kick_y"]
        cosine, sine = np.cos(errors["corrector_roll"]), np.sin(errors["corrector_roll"])
        turned = [cosine * x - sine * y, sine * x + cosine * y]
        return [at.Corrector(element.name, element.length, turned)]

    _vcorrector = _hcorrector  # OCELOT tilts a vertical corrector by a right angle

    def _matrix(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        matrix = np.asfortranarray(_matrix(element, self.energy))
        return [at.M66(element.name, matrix, Length=element.length)]

    def _wiggler(self, element: Element, errors: Any, setting: Any) -> list[Any]:
        name, whole = element.name, _matrix(element, self.energy)
        thin = "gradient_absolute" in errors or "skew_gradient" in errors
        pieces = []
        if "insertion_device_focusing" in errors:
            pieces.append(self._thin(name, errors["insertion_device_focusing"], 0.0))
        if not thin and not self.wigglers:
            return [*pieces, *self._matrix(element, errors, setting)]
        half = at.M66(name, np.asfortranarray(np.real(sqrtm(whole))), Length=element.length / 2)
        middle = []
        if thin:
            middle.append(self._thin(name, errors["gradient_absolute"], errors["skew_gradient"]))
        if self.wigglers:
            middle += self._loss(element)
        return [*pieces, half, *middle, half]

    def _loss(self, element: Element) -> list[Any]:
        """delta -> delta - u (1 + 2 delta), and px, py in proportion to the momentum.

        AT's change of the reference momentum by 1 / (1 - u) takes the share u from px, py and
        1 + delta; a matrix before it adds the second u delta.
        """
        curvature = _wiggler_curvature(element, self.energy)
        share = self.wigglers * C_GAMMA * self.energy**3 / (2 * np.pi) * curvature
        matrix = np.eye(6, order="F")
        matrix[4, 4] = 1 - share
        change = at.Element(element.name, PassMethod="ChangePRefPass", FieldScaling=1 / (1 - share))
        return [at.M66(element.name, matrix), change]
