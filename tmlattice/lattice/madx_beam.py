"""MAD-X's BEAM: particle, mass, charge and energy from whichever of its attributes are given."""

import math
from collections.abc import Mapping

from tmlattice.errors import LatticeError
from tmlattice.lattice.madx_language import CONSTANTS

PARTICLES: dict[str, tuple[str, float]] = {
    "positron": ("emass", 1.0), "electron": ("emass", -1.0),
    "proton": ("pmass", 1.0), "antiproton": ("pmass", -1.0),
    "posmuon": ("mumass", 1.0), "negmuon": ("mumass", -1.0), "ion": ("nmass", 1.0),
}  # fmt: skip
"""Rest mass (a constant of MAD-X) and charge, of the particles that MAD-X knows."""
ENERGIES = ("energy", "pc", "gamma", "beta", "brho")
"""The first that is given counts, as in MAD-X."""


class Beam:
    """The beam of a sequence, or the default one, as BEAM statements build it up."""

    def __init__(self, given: Mapping[str, float | str] | None = None) -> None:
        self.given: dict[str, float | str] = dict(given or {})

    def update(self, given: Mapping[str, float | str]) -> list[str]:
        """Apply another BEAM statement; return those of its attributes that MAD-X passes over.

        The energy stays what it is unless another one is given. A particle that MAD-X knows has its
        own mass and charge; a later MASS alone makes it one without a name.
        """
        own = dict(given)
        if not own.keys() & set(ENERGIES) and self.has_energy:
            own["energy"] = self.energy
        if own.keys() & set(ENERGIES):
            self.given = {k: v for k, v in self.given.items() if k not in ENERGIES}
        named = "particle" in own
        if named:
            self.given = {k: v for k, v in self.given.items() if k not in ("mass", "charge")}
        self.given |= {k: v for k, v in own.items() if k not in ("mass", "charge")}
        stated: dict[str, float] = {k: float(own[k]) for k in ("mass", "charge") if k in own}
        known = self._particle in PARTICLES.keys() - {"ion"} and "particle" in self.given
        if known and (named or "mass" not in stated):
            ours = {"mass": self.mass, "charge": self.charge}
            return [k for k, v in stated.items() if not math.isclose(v, ours[k], rel_tol=1e-3)]
        if known:
            stated = {"charge": self.charge, **stated}
            self.given["particle"] = "default"
        self.given |= stated
        return []

    @property
    def has_energy(self) -> bool:
        """Whether an energy is given; MAD-X's default of 1 GeV is that of no ring."""
        return any(name in self.given for name in ENERGIES)

    @property
    def mass(self) -> float:
        """Rest energy, GeV.

        Raises:
            LatticeError: a particle that MAD-X does not know, without a mass.
        """
        if "mass" in self.given:
            return float(self.given["mass"])
        particle = self._particle
        if particle not in PARTICLES:
            raise LatticeError(
                f"BEAM has the particle '{particle}' without a MASS; state MASS (GeV) and CHARGE"
            )
        return CONSTANTS[PARTICLES[particle][0]]

    @property
    def charge(self) -> float:
        """In elementary charges."""
        if "charge" in self.given:
            return float(self.given["charge"])
        return PARTICLES.get(self._particle, ("", 1.0))[1]

    @property
    def _particle(self) -> str:
        return str(self.given.get("particle", "positron")).lower()

    @property
    def energy(self) -> float:
        """Of a particle, rest energy included, GeV."""
        name = next((n for n in ENERGIES if n in self.given), "energy")
        value, mass = float(self.given.get(name, 1.0)), self.mass
        if value <= 0:
            raise LatticeError(f"BEAM has {name.upper()}={value:g}; give one above 0")
        match name:
            case "energy":
                return value
            case "gamma":
                return value * mass
            case "beta":
                if value >= 1:
                    raise LatticeError(f"BEAM has BETA={value:g}; give one below 1")
                return mass / math.sqrt(1 - value**2)
            case "brho":
                value *= abs(self.charge) * 1e-9 * CONSTANTS["clight"]
        return math.hypot(value, mass)

    def attribute(self, name: str) -> float:
        """What an expression reads as BEAM->NAME.

        Raises:
            LatticeError: no such attribute.
        """
        gamma = self.energy / self.mass
        pc = math.sqrt(max(self.energy**2 - self.mass**2, 0.0))
        own = {
            "mass": self.mass, "charge": self.charge, "energy": self.energy, "pc": pc,
            "gamma": gamma, "beta": pc / self.energy,
            "brho": pc / (abs(self.charge) or 1.0) / (1e-9 * CONSTANTS["clight"]),
        }  # fmt: skip
        if name in own:
            return own[name]
        if name in self.given:
            return float(self.given[name])
        if name in ("bv", "kbunch", "npart"):
            return 1.0
        if name in ("ex", "ey", "et", "sigt", "sige", "exn", "eyn", "bcurrent", "freq0", "u0"):
            return 0.0
        raise LatticeError(f"BEAM has no attribute {name.upper()}")
