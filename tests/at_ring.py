"""An AT lattice built element by element from a ring: a referee that shares no map with OCELOT."""

import at
import numpy as np


def at_lattice(ring, steps=20):
    """Thick, symplectic AT elements with the ring's lengths, strengths and edges."""
    made = []
    for element in ring.elements:
        source = element.source
        name, length = element.name, element.length
        match element.kind:
            case "drift":
                made.append(at.Drift(name, length))
            case "monitor":
                made.append(at.Monitor(name))
            case "marker":
                made.append(at.Marker(name))
            case "quadrupole" if element.k1 != 0:
                made.append(at.Quadrupole(name, length, element.k1, NumIntSteps=steps))
            case "sextupole":
                made.append(at.Sextupole(name, length, element.k2 / 2, NumIntSteps=steps))
            case "bend":
                made.append(
                    at.Dipole(
                        name,
                        length,
                        element.angle,
                        0.0,
                        EntranceAngle=source.e1,
                        ExitAngle=source.e2,
                        NumIntSteps=steps,
                    )
                )
            case "wiggler":
                matrix = np.eye(6)
                matrix[:4, :4] = source.r[:4, :4]
                made.append(at.M66(name, matrix, Length=length))
            case _:  # correctors and skew quadrupoles at zero strength
                made.append(at.Drift(name, length) if length else at.Marker(name))
    return at.Lattice(made, energy=ring.energy * 1e9, periodicity=1)
