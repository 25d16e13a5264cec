"""AT's elements of one element of a ring: thick, symplectic, with errors and settings."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import at
import numpy as np
from scipy.constants import physical_constants
from scipy.linalg import sqrtm

from tmlattice.arrays import Array
from tmlattice.effects.build import Build
from tmlattice.effects.radiation import expected_loss as loss_of
from tmlattice.errors import LatticeError
from tmlattice.lattice.combined import bend_matrix
from tmlattice.lattice.places import rotation
from tmlattice.lattice.ring import Element, Ring, Slopes

ELECTRON = physical_constants["electron mass energy equivalent in MeV"][0] * 1e6  # eV
RADIUS = physical_constants["classical electron radius"][0]  # m
C_GAMMA = 4 * np.pi / 3 * RADIUS / ELECTRON**3
"""Energy loss of a circle of radius rho: C_GAMMA E^4 / rho, 1/eV^3 m."""

SWAPPED = [0, 1, 2, 3, 5, 4]
"""OCELOT's coordinates in AT's order."""

NOTHING = Build()

_STRAIGHT = frozenset({"scale", "dx", "dy", "roll", "kick_x", "kick_y", "entrance", "middle"})
_CORRECTOR = frozenset({"scale", "ds", "roll", "kick_x", "kick_y", "entrance"})
_EMPTY = frozenset({"entrance", "middle"})
_TAKES: Mapping[str, frozenset[str]] = {
    "quadrupole": _STRAIGHT,
    "sextupole": _STRAIGHT,
    "octupole": _STRAIGHT,
    "multipole": _STRAIGHT,
    "bend": frozenset(
        {"scale", "dx", "dy", "roll", "kick_x", "kick_y", "k1", "loss", "entrance", "middle"}
    ),
    "hcorrector": _CORRECTOR,
    "vcorrector": _CORRECTOR,
    "wiggler": frozenset({"loss", "entrance", "middle"}),
    "matrix": frozenset({"entrance"}),
    "marker": _EMPTY,
    "drift": _EMPTY,
    "cavity": frozenset({"middle"}),  # the RF takes the place of its first piece
}
"""Possible errors of each kind of element."""


def wiggler_curvature(element: Element, energy: float) -> float:
    """Integral of 1 / rho^2 over a wiggler, 1/m, from the vertical focusing of its poles.

    A plane wiggler focuses vertically with the mean of 1 / rho^2, so R33 = cos(sqrt(k) L).
    """
    cosine = _matrix(element, energy)[2, 2]
    return float(np.arccos(cosine)) ** 2 / element.length if abs(cosine) < 1 else 0.0


def expected_loss(ring: Ring, bends: float, wigglers: float) -> float:
    """Energy loss of the design orbit in a turn, eV: C_gamma E^4 / 2 pi, integral of 1/rho^2."""
    if not ring.radiates:
        if bends or wigglers:
            raise LatticeError(f"the particles of '{ring.name}' are too heavy to radiate")
        return 0.0
    energy = ring.energy * 1e9
    bent = sum(e.angle**2 / e.length for e in ring.elements if e.kind == "bend")
    wiggled = sum(wiggler_curvature(e, energy) for e in ring.elements if e.kind == "wiggler")
    return float(C_GAMMA * energy**4 / (2 * np.pi) * (bends * bent + wigglers * wiggled))


def _kick(element: Element) -> dict[str, Array]:
    """Kick of a matrix element behind it, in AT's coordinates."""
    kick = np.ravel(getattr(element.source, "b", np.zeros(6))).astype(float)[SWAPPED]
    return {"T2": kick} if kick.any() else {}


def _matrix(element: Element, energy: float) -> Array:
    """The design's matrix of a matrix element or undulator in AT's coordinates, [6, 6].

    An undulator focuses by (sqrt(2) pi K / (period gamma))^2 in the plane of its field's direction;
    its slippage, of the order 1 / gamma^2, is ignored.
    """
    source, length = element.source, element.length
    if hasattr(source, "r"):
        if np.any(source.t) or source.delta_e:
            raise LatticeError(
                f"matrix '{element.name}' has a second order or an energy gain, which AT's matrix "
                "lacks; remove them from the lattice file"
            )
        return np.asarray(source.r, dtype=float)[np.ix_(SWAPPED, SWAPPED)]
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


def _turned(x: float, y: float, angle: float) -> list[float]:
    """The kick (x, y) turned from x towards y."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return [float(cosine * x - sine * y), float(sine * x + cosine * y)]


def _frame(wrong: Build, angle: float) -> dict[str, Array]:
    """The displacement and the rotation of an element, as AT has them."""
    frame: dict[str, Array] = {}
    if wrong.dx or wrong.dy:
        shift = np.array([wrong.dx, 0, wrong.dy, 0, 0, 0])
        frame |= {"T1": -shift, "T2": shift}
    if angle:
        frame |= {"R1": rotation(angle), "R2": rotation(-angle)}
    return frame


def errors_of(element: Element, energy: float) -> Build:
    """Return the errors of an element in the ring itself; energy in GeV; LatticeError: a rolled
    bend: the maps roll its design plane, and no effect does."""
    errors = element.errors
    if element.kind == "bend" and errors.roll:
        raise LatticeError(f"AT cannot build the bend '{element.name}' with a roll of its own")
    loss = errors.loss / loss_of(element, energy) if errors.loss else 0.0
    return Build(**{**vars(errors), "loss": loss})


def _check(element: Element, wrong: Build) -> None:
    """Raise for errors that AT cannot build in an element of this kind."""
    places = {"k1l": "middle", "k1sl": "middle", "entrance_k1l": "entrance"}
    asked = [name for name, value in vars(wrong).items() if value != getattr(NOTHING, name)]
    more = sorted({places.get(name, name) for name in asked}
                  - _TAKES.get(element.kind, frozenset()))  # fmt: skip
    if more:
        raise LatticeError(
            f"AT cannot build the {element.kind} '{element.name}' with another {', '.join(more)}"
        )


class Builder:
    """AT elements of one element of a ring with its errors and settings."""

    def __init__(
        self, energy: float, steps: int, aperture: float, bends_radiate: bool, wigglers: float
    ) -> None:
        self.energy = energy
        self.steps = steps
        self.aperture = aperture
        self.wigglers = wigglers
        # The usual BndMPoleSymplectic4Pass lacks the curvature's h x (px^2 + py^2) / 2, and its Rad
        # twin applies the loss too late in every step (a third of the orbit is missing at 20
        # steps); the E2 pass has no vertical field. The exact pass has all three.
        self.bend_pass = f"ExactSectorBend{'Rad' if bends_radiate else ''}Pass"
        self.walls = {"RApertures": np.array([-aperture, aperture, -aperture, aperture])}

    def pieces(self, element: Element, wrong: Build, setting: Mapping[str, float]) -> list[Any]:
        """Return the pieces; their number is the same for every setting; LatticeError: an element,
        or an error of it, that AT cannot build."""
        build: Callable[..., list[Any]] | None = getattr(self, f"_{element.kind}", None)
        if build is None:
            raise LatticeError(f"AT cannot build the {element.kind} '{element.name}'")
        _check(element, wrong)
        entrance = self._thin(element, wrong.entrance_k1l, 0.0, wrong.entrance)
        made = [*entrance, *build(element, wrong, defaultdict(float, setting))]
        if not wrong.ds:
            return made
        there, back = (at.Drift(element.name, way) for way in (wrong.ds, -wrong.ds))
        return [there, *made, back]

    @staticmethod
    def _thin(element: Element, normal: float, skew: float, slopes: Slopes) -> list[Any]:
        """Thin gradients, px -= normal x - skew y, py += normal y + skew x, and linear kicks
        (px, py) += slopes (x, y)."""
        made: list[Any] = []
        if normal or skew:
            made.append(at.ThinMultipole(element.name, [0.0, skew], [0.0, normal]))
        if any(slopes):
            matrix = np.eye(6, order="F")
            matrix[np.ix_([1, 3], [0, 2])] = np.reshape(slopes, (2, 2))
            made.append(at.M66(element.name, matrix))
        return made

    def _with_middle(
        self, element: Element, wrong: Build, body: Callable[[float], list[Any]]
    ) -> list[Any]:
        """Return the body, or its two halves (`body` of a share of the length) and thin kicks."""
        thin = self._thin(element, wrong.k1l, wrong.k1sl, wrong.middle)
        if wrong.kick_x or wrong.kick_y:
            thin.append(
                at.Corrector(element.name, 0.0, _turned(wrong.kick_x, wrong.kick_y, wrong.roll))
            )
        return [*body(0.5), *thin, *body(0.5)] if thin else body(1.0)

    def _marker(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        return self._with_middle(element, wrong, lambda share: [at.Marker(element.name)])

    def _drift(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        return self._with_middle(
            element, wrong, lambda share: [at.Drift(element.name, share * element.length)]
        )

    def _cavity(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        if type(element.source).__name__ not in ("Cavity", "Drift", "Marker"):
            raise LatticeError(
                f"AT cannot build '{element.name}', a {type(element.source).__name__}; only "
                "standing-wave cavities (Cavity)"
            )
        return self._drift(element, wrong, setting)

    def _monitor(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        monitor = at.Monitor(element.name, **self.walls)
        if element.length == 0:
            return [monitor]
        half = at.Drift(element.name, element.length / 2)
        return [half, monitor, half]

    def _straight(
        self, element: Element, normal: list[float], wrong: Build, walls: bool = False
    ) -> list[Any]:
        """Return a straight multipole of strengths k_n, rolled about its own centre."""
        more: dict[str, Any] = dict(self.walls) if walls else {}
        more |= _frame(wrong, element.tilt + wrong.roll)
        source = element.source
        skew = [0.0] * len(normal)
        combined = type(source).__name__ == "CombinedMultipole"
        if combined:
            normal = [float(source.k0), *normal[1:]]
            skew = [float(source.k0s), float(source.k1s), float(source.k2s)]
        factorial = [1.0, 1.0, 2.0, 6.0]
        B, A = ([k / n for k, n in zip(f, factorial, strict=False)] for f in (normal, skew))

        def body(share: float) -> list[Any]:
            if element.length == 0:  # a combined multipole's fields are then integrated
                thin = share if combined else 0.0
                parts = [[thin * k for k in field] for field in (A, B)]
                return [at.ThinMultipole(element.name, *parts, **more)]
            length = share * element.length
            return [at.Multipole(element.name, length, A, B, NumIntSteps=self.steps, **more)]

        return self._with_middle(element, wrong, body)

    def _quadrupole(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        source = element.source
        if getattr(source, "x_offs", 0) or getattr(source, "y_offs", 0):
            raise LatticeError(f"AT cannot build '{element.name}', a quadrupole passed off axis")
        k1 = element.k1 * (1 + setting["k1_relative"]) * wrong.scale
        return self._straight(element, [0.0, k1, element.k2], wrong, True)

    def _sextupole(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        k2 = element.k2 * (1 + setting["k2_relative"]) * wrong.scale
        return self._straight(element, [0.0, element.k1, k2], wrong)

    def _octupole(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        return self._straight(element, [0.0, 0.0, 0.0, float(element.source.k3)], wrong)

    def _multipole(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        if not hasattr(element.source, "kn"):
            made = self._straight(element, [0.0, element.k1, element.k2], wrong)
            if element.bending:
                # AT's (delta, ct) are OCELOT's (p, tau) of a beam as fast as light
                bend = bend_matrix(element.source, np.inf)[np.ix_(SWAPPED, SWAPPED)]
                made.insert(0, at.M66(element.name, np.asfortranarray(bend)))
            return made
        strengths = np.asarray(element.source.kn, dtype=float)
        if strengths[0]:
            raise LatticeError(f"AT cannot build '{element.name}', a thin multipole that bends")
        factorials = np.cumprod([1, *range(1, len(strengths))])
        more = _frame(NOTHING, element.tilt)
        zero = np.zeros(len(strengths))
        return [at.ThinMultipole(element.name, zero, strengths / factorials, **more)]

    def _solenoid(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        return [  # AT has the pass but no class; its K is B / (B rho), OCELOT's k half of it
            at.Element(
                element.name,
                Length=element.length,
                K=2 * float(element.source.k),
                PassMethod="SolenoidLinearPass",
            )
        ]

    def _bend(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        source, length, angle = element.source, element.length, element.angle
        if length <= 0 or source.h_pole1 or source.h_pole2:
            raise LatticeError(f"AT cannot build '{element.name}', a thin bend or curved poles")
        roll = wrong.roll
        kick_x, kick_y = _turned(wrong.kick_x, wrong.kick_y, -element.tilt)
        horizontal = angle * (wrong.scale - 1) - roll**2 * angle / 2 - kick_x  # minus px
        vertical = kick_y - roll * angle
        # The body is exact in one step; only its errors, losses and gradients are distributed.
        k1 = element.k1 * (1 + setting["k1_relative"]) + wrong.k1
        steps = self.steps if k1 or element.k2 else 4
        more: dict[str, Any] = _frame(NOTHING, element.tilt)

        def body(share: float, **edges: float) -> Any:
            return at.Dipole(
                element.name,
                share * length,
                share * angle,
                PolynomB=[horizontal / length, k1, element.k2 / 2, 0.0],
                PolynomA=[vertical / length, 0.0, 0.0, 0.0],
                NumIntSteps=steps,
                PassMethod=self.bend_pass,
                **edges,
                **more,
            )

        entrance, exit_ = source.fint * source.gap, source.fintx * source.gap
        thin = self._thin(element, wrong.k1l, wrong.k1sl, wrong.middle)
        if entrance == exit_ and not thin:
            made = [body(1.0, EntranceAngle=source.e1, ExitAngle=source.e2, gK=entrance)]
        else:  # AT's exact bend has one fringe integral for both edges
            made = [
                body(0.5, EntranceAngle=source.e1, gK=entrance, FringeBendExit=0),
                *thin,
                body(0.5, ExitAngle=source.e2, gK=exit_, FringeBendEntrance=0),
            ]
        if wrong.dx or wrong.dy:
            shift = np.array([wrong.dx, 0, wrong.dy, 0, 0, 0])
            made[0].T1, made[-1].T2 = -shift, shift
        return made

    def _hcorrector(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        kick = setting.get("kick", element.angle) * wrong.scale
        x = kick * np.cos(element.tilt) + wrong.kick_x
        y = kick * np.sin(element.tilt) + wrong.kick_y
        return [at.Corrector(element.name, element.length, _turned(x, y, wrong.roll))]

    _vcorrector = _hcorrector  # OCELOT tilts a vertical corrector by a right angle

    def _matrix(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        matrix = np.asfortranarray(_matrix(element, self.energy))
        return [at.M66(element.name, matrix, Length=element.length, **_kick(element))]

    def _wiggler(self, element: Element, wrong: Build, setting: Any) -> list[Any]:
        middle = self._thin(element, wrong.k1l, wrong.k1sl, wrong.middle)
        if self.wigglers:
            middle += self._loss(element)
        if not middle:
            return self._matrix(element, wrong, setting)
        root = np.asfortranarray(np.real(sqrtm(_matrix(element, self.energy))))
        half = {"m66": root, "Length": element.length / 2}
        first, last = at.M66(element.name, **half), at.M66(element.name, **half, **_kick(element))
        return [first, *middle, last]

    def _loss(self, element: Element) -> list[Any]:
        """Return delta -> delta - u (1 + 2 delta), and px, py in proportion to the momentum.

        AT's change of the reference momentum by 1 / (1 - u) removes the share u from px, py and
        1 + delta; a matrix before it adds the second u delta.
        """
        curvature = wiggler_curvature(element, self.energy)
        share = self.wigglers * C_GAMMA * self.energy**3 / (2 * np.pi) * curvature
        matrix = np.eye(6, order="F")
        matrix[4, 4] = 1 - share
        change = at.Element(element.name, PassMethod="ChangePRefPass", FieldScaling=1 / (1 - share))
        return [at.M66(element.name, matrix), change]
