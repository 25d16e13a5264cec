"""Orbits and turns at a finite amplitude: sextupole and octupole fields as kicks, the rest as maps.

A second-order map of a long sextupole lacks the effect of the field on its own kick, and is
symplectic to second order only; of an octupole it has nothing. Over many turns both change the
tunes as much as all sextupoles together do. Here the field of such a magnet is a kick at both ends
and one in the middle, symplectic and of fourth order in the magnet's length L. In a field
B_y + i B_x = k_n z^n / n!, z = x + i y, with f = k_n L z^n / n!, the kicks are 1/6, 2/3 and 1/6 of
px - i py = -f, and in the middle px + i py = L / 36 f conj(f') is added.

Source: S. A. Chin, Phys. Lett. A 226 (1997) 344, algorithm A.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tmlattice.arrays import Array, ComplexArray, Indices
from tmlattice.beam.readouts import APERTURE
from tmlattice.beam.rf import Cavities
from tmlattice.beam.sweeps import curved
from tmlattice.beam.threads import share
from tmlattice.compiled import jit
from tmlattice.lattice import Element
from tmlattice.maps import LayerMaps, RingMaps
from tmlattice.maps.quadratic import (
    Quadratic,
    composed,
    halves_without_sextupole,
    parts_of_errors,
)

THIN = 1e-3
"""m; for shorter sextupoles the second-order map is complete."""


@dataclass(frozen=True)
class NonlinearTurn:
    """One turn as steps, each a second-order map and then a kick.

    Attributes:
        W: W0 [step, n], W1 [step, n, n], W2 [step, n, n (n + 1) / 2].
        fields: integrated k2 / 2 (1/m2) and k3 / 6 (1/m3) behind each step, times
            exp(-i (order + 1) tilt), [step, 2].
        second: factor of f conj(f') of these fields, m, [step].
        exits: the step before which each exit of the layers is, [layer + 2].
    """

    W: tuple[Array, Array, Array]
    fields: ComplexArray
    second: Array
    exits: Indices


def nonlinear_turn(layers: LayerMaps) -> NonlinearTurn:
    """Return the steps of a ring."""
    n, ring = layers.dimension, layers.ring
    maps: list[Any] = []
    kicks: list[tuple[complex, complex, float]] = []
    exits = [0]
    known: dict[Any, list[Quadratic]] = {}
    nothing = (0j, 0j, 0.0)
    for k, magnet in enumerate(ring.magnets):
        k2, k3 = _fields(magnet)
        if magnet.length > THIN and (k2 or k3):
            key = layers.physics(magnet)
            if key not in known:
                entry, one, other, exit_ = halves_without_sextupole(magnet, ring.map_energy, n)
                before, inside, behind = parts_of_errors(magnet, ring.map_energy, n)
                known[key] = [
                    composed([*before, entry]), one, composed([*inside, other]),
                    composed([exit_, *behind]),
                ]  # fmt: skip
            first, *rest = known[key]
            maps += [one.reduced() for one in (first.after(layers.way(k)), *rest)]
            L = magnet.length
            end, middle = (L * k2 / 6, L * k3 / 6, 0.0), (L * k2 / 1.5, L * k3 / 1.5, L / 16)
            kicks += [end, middle, end, nothing]
        else:
            maps.append(layers.layer(k)[0])
            kicks.append((0j, k3 if magnet.length == 0 else 0j, 0.0))
        exits.append(len(maps))
    maps.append(layers.layer(len(ring.magnets))[0])
    kicks.append(nothing)
    W0, W1, W2 = (np.ascontiguousarray(np.stack(w)) for w in zip(*maps, strict=True))
    fields = np.array([own[:2] for own in kicks])
    second = np.array([own[2] for own in kicks])
    places = np.array([*exits, len(maps)], dtype=np.int64)
    return NonlinearTurn((W0, W1, W2), fields, second, places)


def _fields(element: Element) -> tuple[complex, complex]:
    """k2 / 2 and k3 / 6 of a magnet, in the ring's axes; integrated where it is thin."""
    source = element.source
    k2 = element.k2 + 1j * float(getattr(source, "k2s", 0.0))
    strengths: Sequence[float] = getattr(source, "kn", ())
    k3 = float(strengths[3]) if len(strengths) > 3 else float(getattr(source, "k3", 0.0) or 0.0)
    turned = np.exp(-1j * element.tilt)
    return complex(k2 / 2 * turned**3), complex(k3 / 6 * turned**4)


def track(
    states: Array, turns: int, way: NonlinearTurn, maps: RingMaps, cavities: Cavities
) -> Array:
    """Track to (x, y) at every monitor on every turn, [shot, turn, monitor, 2], m; NaN if lost.

    Args:
        states: at the start of the ring, [shot, n].
        turns: at least 1.
    """
    readings = np.full((len(states), turns, len(maps.at), 2), np.nan)
    share(
        _track, len(states), *way.W, curved(way.W[2]), way.fields, way.second, maps.R0, maps.R1,
        maps.R2, way.exits[maps.at], way.exits[cavities.exits], cavities.values, states, APERTURE,
        readings,
    )  # fmt: skip
    return readings


@jit
def kick(x, fields, second):  # type: ignore[no-untyped-def]
    """Add the kick of the fields behind a step to the state, see `NonlinearTurn`."""
    if fields[0] != 0 or fields[1] != 0:
        z = x[0] + 1j * x[2]
        own = (fields[0] + fields[1] * z) * z * z
        slope = (2 * fields[0] + 3 * fields[1] * z) * z
        further = second * own * slope.conjugate()
        x[1] += further.real - own.real
        x[3] += further.imag + own.imag


@jit
def _track(  # type: ignore[no-untyped-def]
    first,
    last,
    W0,
    W1,
    W2,
    curved,
    fields,
    second,
    R0,
    R1,
    R2,
    at,
    exits,
    rf,
    states,
    aperture,
    readings,
):
    n = states.shape[1]
    y = np.empty(n)
    for shot in range(first, last):
        x = states[shot].copy()
        for turn in range(readings.shape[1]):
            monitor = 0
            for k in range(len(W0) + 1):
                for c in range(len(exits)):
                    if exits[c] == k:
                        x[5] += rf[0] * np.sin(rf[1] - rf[2] * x[4])
                while monitor < len(at) and at[monitor] == k:
                    for a in range(2):
                        total = R0[monitor, a]
                        m = 0
                        for i in range(n):
                            slope = R1[monitor, a, i]
                            for j in range(i, n):
                                slope += R2[monitor, a, m] * x[j]
                                m += 1
                            total += slope * x[i]
                        readings[shot, turn, monitor, a] = total
                    monitor += 1
                if k == len(W0):
                    break
                for a in range(n):
                    total = W0[k, a]
                    m = 0
                    for i in range(n):
                        slope = W1[k, a, i]
                        if curved[k]:
                            for j in range(i, n):
                                slope += W2[k, a, m] * x[j]
                                m += 1
                        total += slope * x[i]
                    y[a] = total
                x[:] = y
                kick(x, fields[k], second[k])
            x[4] += rf[3]
            if not (abs(x[0]) < aperture and abs(x[2]) < aperture):
                readings[shot, turn] = np.nan
                break
