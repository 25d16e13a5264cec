"""Energy loss by radiation: known physics that a first model may omit.

The expected loss of an element is U = C_gamma E^4 / (2 pi) x the integral of h^2 ds. A bend's
curvature is h = angle / length. A wiggler's matrix lacks its field, but its vertical focusing gives
k = mean of h^2 by R33 = cos(sqrt(k) L).
"""

import numpy as np

from tmlattice.effects.build import Build
from tmlattice.effects.effect import CATALOGUE, Cause, RingEffect, register
from tmlattice.lattice import Element, Ring

C_GAMMA = 8.846e-5
"""m / GeV^3, of electrons. Source: M. Sands, SLAC-121 (1970)."""
C_QUANTUM = 3.832e-13
"""m, of electrons. Source: the same."""


def expected_loss(element: Element, energy: float) -> float:
    """Relative energy loss of one pass; energy in GeV; 0 without radiation."""
    return C_GAMMA * energy**3 / (2 * np.pi) * _integrals(element)[0]


def _integrals(element: Element) -> tuple[float, float]:
    """Integrals of h^2, 1/m, and of |h|^3, 1/m^2, along an element."""
    if element.kind == "bend" and element.length > 0:
        curvature = abs(element.angle) / element.length
        return curvature**2 * element.length, curvature**3 * element.length
    if element.kind == "wiggler" and hasattr(element.source, "r"):
        cosine = float(element.source.r[2, 2])
        focusing = float(np.arccos(cosine)) / element.length if abs(cosine) < 1 else 0.0
        of_a_sine = (2 * focusing**2) ** 1.5 * 4 / (3 * np.pi)  # mean cube from mean square
        return focusing**2 * element.length, of_a_sine * element.length
    return 0.0, 0.0


def expected_spread(ring: Ring) -> float:
    """Relative rms energy of a stored electron beam by radiation, with a damping partition of 2
    (bends with a gradient differ by a tenth); 0 without radiation, or for other particles."""
    squares, cubes = np.sum([_integrals(element) for element in ring.elements], axis=0)
    if not squares > 0 or not ring.radiates:
        return 0.0
    return float(np.sqrt(C_QUANTUM * ring.gamma**2 * cubes / (2 * squares)))


class _Loss(RingEffect):
    group = "beam"
    energy = True
    one_sign = True
    curved = True  # a ring without cavities has its RF on if it loses energy
    unit = "scale"
    sign = "0: no loss, 1: the expected loss; adds to what the model has"
    largest = 1.2
    recommended_action = "include radiation in the model"
    to_check = "Nothing at the machine: diagnose again with --radiation."
    natural = True
    kind: str

    def sits_on(self, element: Element) -> bool:
        """Whether an element is of the radiating kind."""
        return element.kind == self.kind and expected_loss(element, 1.0) > 0

    def places(self, ring: Ring) -> list[str | None]:
        """Return all of them as one place; none in a ring without any."""
        return [None] if any(self.sits_on(e) for e in ring.elements) else []

    def members(self, ring: Ring, place: str | None) -> list[int]:
        """Indices of all elements of the kind."""
        return [i for i, element in enumerate(ring.elements) if self.sits_on(element)]

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Return the element with a share of the expected loss."""
        return element.with_errors(loss=amount * expected_loss(element, energy))

    def build(self, it: Build, amount: float) -> None:
        """Set a share of the loss that the engine expects."""
        it.loss += amount

    @property
    def label(self) -> str:
        """Short name: loss in bends, or in wigglers."""
        return f"loss in {self.kind}s"


@register
class RadiationLossBends(_Loss):
    """Radiation in all bends."""

    name = "radiation_loss_bends"
    words = "energy loss by radiation in the bends"
    quantity = "energy loss in the bends"
    kind = "bend"
    sits_on_text = "all bends at once"


@register
class RadiationLossWigglers(_Loss):
    """Radiation in all wigglers."""

    name = "radiation_loss_wigglers"
    words = "energy loss by radiation in the wigglers"
    quantity = "energy loss in the wigglers"
    kind = "wiggler"
    sits_on_text = "all wigglers at once"


def expected_radiation(ring: Ring) -> list[Cause]:
    """Return the expected radiation losses of a ring as causes."""
    losses = [effect for effect in CATALOGUE.values() if isinstance(effect, _Loss)]
    return [Cause(effect.name, None, 1.0) for effect in losses if effect.places(ring)]
