"""tmlattice: the gap between the model of a storage ring and the ring itself.

Magnets as second-order Taylor maps from OCELOT, the ring as a torch network of one unshared layer
per magnet, fine-tuned on one perturbed first-turn orbit, tracked for its tunes.

>>> import tmlattice
>>> ring = tmlattice.load_ring("petra3")
>>> network = tmlattice.TaylorNetwork.from_ring(ring)
>>> readings = network([[1e-3, 0, 1e-3, 0]])              # [1, 246, 2], m
>>> states = network.track([[1e-5, 0, 1e-5, 0]], turns=500)
>>> tmlattice.tunes(states, tmlattice.one_turn_optics(network)).fraction
>>> weak = [tmlattice.Cause("quadrupole_gradient", "qd::12", -0.2)]
>>> measurement = tmlattice.simulate(ring, weak, shots=6, seed=1).measurement()

Names are imported when they are first used: `import tmlattice` itself loads neither torch nor
OCELOT, which take seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from tmlattice.diagnosis import Diagnosis as Diagnosis
    from tmlattice.diagnosis import diagnose as diagnose
    from tmlattice.effects import CATALOGUE as CATALOGUE
    from tmlattice.effects import Cause as Cause
    from tmlattice.errors import TmlatticeError as TmlatticeError
    from tmlattice.fitting import FitResult as FitResult
    from tmlattice.fitting import TuneFit as TuneFit
    from tmlattice.fitting import fine_tune as fine_tune
    from tmlattice.fitting import tune_fit as tune_fit
    from tmlattice.harmonics import Tunes as Tunes
    from tmlattice.harmonics import tunes as tunes
    from tmlattice.lattice import Element as Element
    from tmlattice.lattice import Ring as Ring
    from tmlattice.lattice import load_ring as load_ring
    from tmlattice.machine import Machine as Machine
    from tmlattice.machine.simulate import simulate as simulate
    from tmlattice.maps import TaylorMap as TaylorMap
    from tmlattice.maps import element_map as element_map
    from tmlattice.maps import ring_maps as ring_maps
    from tmlattice.measurement import Measurement as Measurement
    from tmlattice.measurement import OrbitResponse as OrbitResponse
    from tmlattice.measurement import read_measurement as read_measurement
    from tmlattice.measurement import write_measurement as write_measurement
    from tmlattice.network import TaylorNetwork as TaylorNetwork
    from tmlattice.network import symplectic_penalty as symplectic_penalty
    from tmlattice.optics import Optics as Optics
    from tmlattice.optics import off_momentum as off_momentum
    from tmlattice.optics import one_turn_optics as one_turn_optics
    from tmlattice.optics import twiss as twiss

_HOME = {
    "diagnosis": ["Diagnosis", "diagnose"],
    "effects": ["CATALOGUE", "Cause"],
    "errors": ["TmlatticeError"],
    "harmonics": ["Tunes", "tunes"],
    "fitting": ["FitResult", "TuneFit", "fine_tune", "tune_fit"],
    "lattice": ["Element", "Ring", "load_ring"],
    "machine": ["Machine", "simulate"],
    "maps": ["TaylorMap", "element_map", "ring_maps"],
    "measurement": ["Measurement", "OrbitResponse", "read_measurement", "write_measurement"],
    "network": ["TaylorNetwork", "symplectic_penalty"],
    "optics": ["Optics", "off_momentum", "one_turn_optics", "twiss"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = ["__version__", *_MODULE_OF]  # noqa: PLE0604  (they are strings)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'tmlattice' has no attribute '{name}'")
    value = getattr(import_module(f"tmlattice.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
