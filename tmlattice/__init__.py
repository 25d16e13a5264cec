"""tmlattice: find the difference between a storage ring and its model.

The package determines from beam measurements which element of a ring is wrong, by how much, with
which standard error, and what the data leave open. It reads first turns, turn-by-turn data, closed
orbits, dispersion, tunes and orbit response matrices. It then computes the power supply settings
that correct the optics. Each magnet is a second-order Taylor map from OCELOT. The ring is also a
PyTorch network with one layer per magnet: fine-tuned on one first turn, it predicts the tunes.

The tour
--------
Load a ring: a built-in name, a lattice file (OCELOT, AT, MAD-X, elegant, Xsuite), an object of AT,
Xsuite, OCELOT or cpymad, or a `Ring`:

>>> import tmlattice
>>> ring = tmlattice.load_ring("petra3")
>>> ring["qd*"], ring.twiss().to_dataframe(), ring.to_at()
>>> figure = ring.plot()                                   # betas and magnets

Simulate a machine with a known fault, and diagnose its readings:

>>> weak = [tmlattice.Cause("quadrupole_gradient", "qd::12", -0.2)]
>>> measurement = tmlattice.simulate(ring, weak, shots=6, seed=1).measurement()
>>> diagnosis = tmlattice.diagnose(ring, measurement)
>>> print(diagnosis.report())                              # diagnosis.plot(), .save("folder")

Diagnose your own data: a measurement folder, or a file of a control room
(`tmlattice import --example --out x` writes templates):

>>> diagnosis = tmlattice.diagnose("machine.madx", "readings.csv")      # or a pandas DataFrame
>>> diagnosis.tables["errors"]                                          # and data frames back

Repeat the paper's experiment, the tunes from one orbit, by the paper's recipe and by the sparse
fit:

>>> print(tmlattice.tune_fit("petra3").advice)

Use the network itself:

>>> network = tmlattice.TaylorNetwork.from_ring(ring)
>>> readings = network([[1e-3, 0, 1e-3, 0]])               # [1, 246, 2], m
>>> states = network.track([[1e-5, 0, 1e-5, 0]], turns=500)
>>> tmlattice.tunes(states, tmlattice.one_turn_optics(network)).fraction

Where things are
----------------
- `lattice`: rings and their files; `maps`, `optics`, `harmonics`: Taylor maps, optics and tunes
- `effects`: the errors that a ring can have, with `CATALOGUE`
- `measurement`: kinds of measurement; `importers`: files of other programs
- `machine`: the simulated machine
- `diagnosis`, `correction`: the fault, and the settings that correct the optics
- `network`, `fitting`: the network, and its fine-tuning on readings
- `plots`, `report`: figures and pages

Each package is available after `import tmlattice`, and its `help` states what it holds. On the
command line, `tmlattice --help` lists the commands.

Names and packages are imported when they are first used: `import tmlattice` itself loads neither
torch nor OCELOT, which take seconds.
"""

import sys

if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:
    del sys.path[0]  # of `python -m tmlattice`: modules are never taken from the working directory

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tmlattice.version import __version__

if TYPE_CHECKING:
    from tmlattice import batch as batch
    from tmlattice import challenge as challenge
    from tmlattice import correction as correction
    from tmlattice import diagnosis as diagnosis
    from tmlattice import effects as effects
    from tmlattice import errors as errors
    from tmlattice import fitting as fitting
    from tmlattice import harmonics as harmonics
    from tmlattice import importers as importers
    from tmlattice import lattice as lattice
    from tmlattice import machine as machine
    from tmlattice import maps as maps
    from tmlattice import measurement as measurement
    from tmlattice import network as network
    from tmlattice import optics as optics
    from tmlattice import plots as plots
    from tmlattice import report as report
    from tmlattice import systems as systems
    from tmlattice.correction import Correction as Correction
    from tmlattice.correction import correct as correct
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
    from tmlattice.importers import import_data as import_data
    from tmlattice.importers import read_measurement as read_measurement
    from tmlattice.lattice import Element as Element
    from tmlattice.lattice import Ring as Ring
    from tmlattice.lattice import load_ring as load_ring
    from tmlattice.lattice import save_ring as save_ring
    from tmlattice.machine import Machine as Machine
    from tmlattice.machine.simulate import simulate as simulate
    from tmlattice.machine_file import MachineFile as MachineFile
    from tmlattice.machine_file import load_machine_file as load_machine_file
    from tmlattice.maps import TaylorMap as TaylorMap
    from tmlattice.maps import element_map as element_map
    from tmlattice.maps import ring_maps as ring_maps
    from tmlattice.measurement import ClosedOrbit as ClosedOrbit
    from tmlattice.measurement import Dispersion as Dispersion
    from tmlattice.measurement import Measurement as Measurement
    from tmlattice.measurement import OrbitResponse as OrbitResponse
    from tmlattice.measurement import RfStep as RfStep
    from tmlattice.measurement import TuneReading as TuneReading
    from tmlattice.measurement import TurnByTurn as TurnByTurn
    from tmlattice.measurement import write_measurement as write_measurement
    from tmlattice.network import TaylorNetwork as TaylorNetwork
    from tmlattice.network import symplectic_penalty as symplectic_penalty
    from tmlattice.optics import Optics as Optics
    from tmlattice.optics import off_momentum as off_momentum
    from tmlattice.optics import one_turn_optics as one_turn_optics
    from tmlattice.optics import twiss as twiss
    from tmlattice.report.compare import compare as compare

_HOME = {
    "correction": ["Correction", "correct"],
    "diagnosis": ["Diagnosis", "diagnose"],
    "effects": ["CATALOGUE", "Cause"],
    "errors": ["TmlatticeError"],
    "harmonics": ["Tunes", "tunes"],
    "fitting": ["FitResult", "TuneFit", "fine_tune", "tune_fit"],
    "importers": ["import_data", "read_measurement"],
    "lattice": ["Element", "Ring", "load_ring", "save_ring"],
    "machine": ["Machine", "simulate"],
    "machine_file": ["MachineFile", "load_machine_file"],
    "maps": ["TaylorMap", "element_map", "ring_maps"],
    "measurement": [
        "ClosedOrbit",
        "Dispersion",
        "Measurement",
        "OrbitResponse",
        "RfStep",
        "TuneReading",
        "TurnByTurn",
        "write_measurement",
    ],
    "network": ["TaylorNetwork", "symplectic_penalty"],
    "report.compare": ["compare"],
    "optics": ["Optics", "off_momentum", "one_turn_optics", "twiss"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

_ROOMS = (
    "lattice", "maps", "effects", "beam", "optics", "network", "harmonics", "measurement",
    "inference", "observe", "diagnosis", "correction", "importers", "fitting", "machine",
    "challenge", "systems", "plots", "report", "errors", "batch",
)  # fmt: skip

__all__ = ["__version__", *_MODULE_OF]  # noqa: PLE0604  (they are strings)


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"tmlattice.{name}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'tmlattice' has no attribute '{name}'")
    value = getattr(import_module(f"tmlattice.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, *_ROOMS]
