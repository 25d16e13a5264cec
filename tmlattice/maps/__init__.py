"""Truncated Taylor maps: their algebra, maps of polynomial equations, one per magnet from OCELOT.

>>> drift = TaylorMap.linear([[1, 2.0], [0, 1]])
>>> kick = TaylorMap([[0, 0], [[1, 0], [0, 1]], [[0, 0, 0], [-0.5, 0, 0]]])
>>> (kick @ drift)([1e-3, 0.0])                      # first the drift, then the kick
>>> fall = taylor_map_of_ode({(0,): [9.8], (2,): [-0.00392]}, order=2, time=0.1)
>>> maps = ring_maps(load_ring("petra3"))            # stacked weights of all layers
"""

from tmlattice.maps.magnets import (
    LayerMaps,
    RingMaps,
    changed_maps,
    element_map,
    part_maps,
    ring_maps,
    ring_matrix,
)
from tmlattice.maps.ode import (
    ode_of_taylor_map,
    recentred,
    right_hand_side,
    taylor_map_of_ode,
)
from tmlattice.maps.taylor import TaylorMap, kronecker_exponents, symplectic_form

__all__ = [
    "LayerMaps",
    "RingMaps",
    "TaylorMap",
    "changed_maps",
    "element_map",
    "kronecker_exponents",
    "ode_of_taylor_map",
    "part_maps",
    "recentred",
    "right_hand_side",
    "ring_maps",
    "ring_matrix",
    "symplectic_form",
    "taylor_map_of_ode",
]
