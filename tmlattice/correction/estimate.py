"""The estimated ring with its posterior: the start of a correction.

>>> estimate = estimate_of(diagnosis)
>>> estimate.draw(200, np.random.default_rng(0)).shape      # [draw, error]
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.stored import StoredBeam
from tmlattice.diagnosis import Diagnosis
from tmlattice.diagnosis.twin import knowledge_file, known_of, read_known
from tmlattice.effects import Cause, Hypothesis, apply, changes_beam, is_energy
from tmlattice.errors import LatticeError, UnstableRingError
from tmlattice.inference.distributed import DistributedErrors
from tmlattice.inference.newton import STEP_SHARES
from tmlattice.lattice import Ring
from tmlattice.observe.calibration import Dispersion, offset_of, read_calibration


@dataclass(frozen=True, eq=False)
class Estimate:
    """An estimated ring and its uncertainty.

    Attributes:
        found: the estimated ring, without the mean of its distributed errors.
        settings: the ring with the present settings.
        known: posterior of the distributed errors; none: no uncertainty.
        dispersion: measured beyond the ring's, m, [BPM, plane], or 0.
        energy, energy_error: of the stored beam relative to the ring's at its RF frequency.
    """

    found: Ring
    settings: Ring
    known: DistributedErrors = field(default=DistributedErrors.usual([], {}), repr=False)
    dispersion: Array | float = field(default=0.0, repr=False)
    energy: float = 0.0
    energy_error: float = 0.0

    @cached_property
    def kept(self) -> Indices:
        """Indices in `known` of the errors of a stored beam's ring."""
        own = zip(self.known.hypotheses, self.known.rms.tolist(), strict=True)
        return np.array([i for i, ((name, _), rms) in enumerate(own)
                         if rms > 0 and changes_beam(name)], dtype=np.int64)  # fmt: skip

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The errors `kept`, (effect, place)."""
        return tuple(self.known.hypotheses[i] for i in self.kept)

    @cached_property
    def ring(self) -> Ring:
        """The posterior mean."""
        mean = zip(self.hypotheses, self.known.amounts[self.kept].tolist(), strict=True)
        return apply(self.found, [Cause(*place, amount) for place, amount in mean if amount])

    @cached_property
    def calibrations(self) -> dict[str, float]:
        """Kick over setting of correctors, by name."""
        own = zip(self.known.hypotheses, self.known.amounts.tolist(), strict=True)
        scales: dict[str, float] = {}
        for cause in (*self.known.causes, *(Cause(*place, amount) for place, amount in own)):
            if cause.effect == "corrector_calibration" and cause.element is not None:
                scales[cause.element] = scales.get(cause.element, 1.0) * (1 + cause.amount)
        return scales

    def storing(self) -> "Estimate":
        """Return the estimate whose ring stores a beam: with the posterior mean, which is
        linearised, or a half of it, a quarter, ...; unchanged if it stores none."""
        for share in (*STEP_SHARES, 0.0) if len(self.kept) else ():
            amounts = self.known.amounts.copy()
            amounts[self.kept] *= share
            tried = replace(self, known=replace(self.known, amounts=amounts))
            try:
                StoredBeam(ResponseModel(tried.ring))
            except UnstableRingError:
                continue
            return tried
        return self

    def with_beam(
        self, dispersion: Dispersion, energy: float = 0.0, energy_error: float = 0.0
    ) -> "Estimate":
        """Return the estimate with a measured dispersion and energy beyond the ring's.

        The errors of a posterior with a covariance make the dispersion, and change it with the
        optics; else it stays.
        """
        if len(self.known.share):
            dispersion = {}
        names = [monitor.name for monitor in self.settings.monitors]
        more = np.array([dispersion.get(name, (0.0, 0.0)) for name in names]).reshape(-1, 2)
        return replace(self, dispersion=more, energy=energy, energy_error=energy_error)

    def draw(self, count: int, random: np.random.Generator) -> Array:
        """Return errors drawn from the posterior, less their mean, [draw, error]."""
        drawn = self.known.correlated(random.standard_normal((len(self.known.rms), count)))
        return np.asarray((self.known.rms[:, None] * drawn)[self.kept].T)

    def independent(self, slopes: Array) -> Array:
        """Return slopes by independent errors of size 1 from those by the errors, [error, ...]."""
        every = np.zeros((len(self.known.rms), *slopes.shape[1:]))
        every[self.kept] = self.known.rms[self.kept, None] * slopes
        return self.known.correlated(every)


def estimate_of(diagnosis: Diagnosis, known: DistributedErrors | None = None) -> Estimate:
    """Return the estimate of a diagnosis: the ring with the findings, and its posterior.

    Args:
        diagnosis: of any measurement.
        known: its `known_of`, if available.

    Of a change since a reference, and without a covariance of the distributed errors, each amount
    has its own standard deviation.
    """
    known = known or known_of(diagnosis) or _each_alone(diagnosis)
    found = Estimate(diagnosis.as_found, diagnosis.ring, known)
    if not diagnosis.by_families or diagnosis.since_reference:
        return found  # an energy that is a finding is matched by the RF, or the injector
    pairs = zip(diagnosis.causes, diagnosis.errors, strict=True)
    energies = [(c.amount, s) for c, s in pairs if is_energy(c.effect)]
    return found.with_beam(diagnosis.dispersion, *(energies[0] if energies else (0.0, 0.0)))


def _each_alone(diagnosis: Diagnosis) -> DistributedErrors:
    sigma = {(c.effect, c.element): s for c, s, _ in diagnosis.supported if np.isfinite(s)}
    known = DistributedErrors.usual(list(sigma), {name: 1.0 for name, _ in sigma})
    with_beam = tuple(c for c in diagnosis.causes if not changes_beam(c.effect))
    return replace(known, rms=np.array(list(sigma.values())), causes=with_beam)


def read_estimate(path: Path, settings: Ring, ring: Ring) -> tuple[Estimate, tuple[str, ...]]:
    """Return the estimate that `diagnose --lattice-out` wrote, and warnings.

    Args:
        path: of the lattice file; next to it are the posterior of its errors and its calibration.
        settings: the ring with the present settings.
        ring: of that file.

    Raises:
        MeasurementError: a damaged file next to it, or one of another ring.
        LatticeError: the two rings do not have the same elements.
    """
    if [e.name for e in ring.elements] != [e.name for e in settings.elements]:
        raise LatticeError(
            f"'{path}' and '{settings.name}' do not have the same elements; give the lattice that "
            "the diagnosis started from"
        )
    with_beam, calibration = knowledge_file(path), path.with_name(f"{path.name}.calibration.json")
    found, warnings = Estimate(ring, settings), tuple[str, ...]()
    if with_beam.is_file():
        found = replace(found, known=read_known(with_beam, ring))
    else:
        warnings = (
            f"there is no '{with_beam}', which a diagnosis with distributed errors writes: the "
            "estimated ring is taken as certain",
        )
    if calibration.is_file():
        own = read_calibration(calibration, ring)
        sigma = own.errors.get(("energy_offset", None), 0.0)
        found = found.with_beam(own.dispersion, offset_of(own.causes), sigma)
    return found, warnings
