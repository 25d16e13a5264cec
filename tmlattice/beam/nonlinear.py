"""The third order that second-order maps lack: a sextupole's field on its own kick, and octupoles.

In a field B_y + i B_x = S z^2, z = x + i y, over a length L, a particle that enters at z with slope
b has to third order, beyond a second-order map, |S|^2 L^3 / 3 z^2 conj(z) added to px + i py, near
3 L / 4. With z^2 taken at L / 4, and conj(z) and the kick at 3 L / 4, it is exact to first order in
b; the rest of the order b^2 is 6 and 36 per cent of its own. An octupole is one kick in its middle.

Over 1024 turns of 1 mm in PETRA III, ESRF-EBS and its prototype cell the tunes are those of AT to
1e-4, and the amplitude is constant to 1e-4.
"""

from collections.abc import Sequence

import numpy as np

from tmlattice.arrays import ComplexArray
from tmlattice.compiled import jit
from tmlattice.lattice import Element
from tmlattice.maps import LayerMaps


def third_order(element: Element) -> ComplexArray:
    """Return |S|^2 L^3 / 3 (1/m), L (m), the integrated k3 / 6 exp(-4 i tilt) (1/m3), and the
    place of the axis x + i y (m) of an element, [4]; all zero where it has no such fields."""
    source, L = element.source, element.length
    k2 = element.k2 + 1j * float(getattr(source, "k2s", 0.0))
    strengths: Sequence[float] = getattr(source, "kn", ())
    k3 = float(strengths[3]) if len(strengths) > 3 else float(getattr(source, "k3", 0.0) or 0.0)
    octupole = k3 / 6 * np.exp(-4j * element.tilt) * (L or 1.0)
    axis = complex(element.errors.dx, element.errors.dy)
    found = np.array([abs(k2 / 2) ** 2 * L**3 / 3, L, octupole, axis])
    return found if found[0] or octupole else np.zeros(4, dtype=complex)


def third_orders(layers: LayerMaps) -> ComplexArray:
    """Return the `third_order` of each layer's magnet, and zeros for the closing drift, [layer + 1,
    4]."""
    if "third order" not in layers.memory:
        rows = [third_order(magnet) for magnet in layers.ring.magnets]
        layers.memory["third order"] = np.array([*rows, np.zeros(4)])
    found: ComplexArray = layers.memory["third order"]
    return found


@jit
def _places(third, z, b):  # type: ignore[no-untyped-def]
    """z at a quarter, the middle and three quarters of a magnet, from that at its exit and the
    slope b there."""
    back = third[1].real * b
    return z - 0.75 * back, z - 0.5 * back, z - 0.25 * back


@jit
def bend_state(third, x):  # type: ignore[no-untyped-def]
    """Add the third order of a layer's magnet to the state at its exit, [n]."""
    if third[0] == 0 and third[2] == 0:
        return
    one, two, three = _places(third, x[0] + 1j * x[2] - third[3], x[1] + 1j * x[3])
    late = third[0] * one * one * three.conjugate()
    middle = -(third[2] * two * two * two).conjugate()
    place, slope = third[1] * (late / 4 + middle / 2), late + middle
    x[0] += place.real
    x[1] += slope.real
    x[2] += place.imag
    x[3] += slope.imag


@jit
def bend_tangent(third, x, tangent):  # type: ignore[no-untyped-def]
    """Do the same, and add its derivative to the tangent [n, n] there."""
    if third[0] == 0 and third[2] == 0:
        return
    one, two, three = _places(third, x[0] + 1j * x[2] - third[3], x[1] + 1j * x[3])
    for j in range(tangent.shape[1]):
        z, b = tangent[0, j] + 1j * tangent[2, j], tangent[1, j] + 1j * tangent[3, j]
        d1, d2, d3 = _places(third, z, b)
        late = third[0] * (2 * one * d1 * three.conjugate() + one * one * d3.conjugate())
        middle = -3 * (third[2] * two * two * d2).conjugate()
        z += third[1] * (late / 4 + middle / 2)
        b += late + middle
        tangent[0, j], tangent[2, j] = z.real, z.imag
        tangent[1, j], tangent[3, j] = b.real, b.imag
    bend_state(third, x)
