"""Truncated Taylor maps: their algebra, and one map per magnet from OCELOT.

>>> drift = TaylorMap.linear([[1, 2.0], [0, 1]])
>>> kick = TaylorMap([[0, 0], [[1, 0], [0, 1]], [[0, 0, 0], [-0.5, 0, 0]]])
>>> (kick @ drift)([1e-3, 0.0])                      # first the drift, then the kick
>>> maps = ring_maps(load_ring("petra3"))            # stacked weights of all layers
"""

from tmlattice.maps.magnets import LayerMaps, RingMaps, element_map, ring_maps, ring_matrix
from tmlattice.maps.taylor import TaylorMap, kronecker_exponents, symplectic_form

__all__ = [
    "LayerMaps",
    "RingMaps",
    "TaylorMap",
    "element_map",
    "kronecker_exponents",
    "ring_maps",
    "ring_matrix",
    "symplectic_form",
]
