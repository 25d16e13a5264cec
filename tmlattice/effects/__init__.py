"""The catalogue of imperfections, in one registry.

>>> CATALOGUE["quadrupole_gradient"].places(ring)            # where it can sit
>>> weaker = apply(ring, [Cause("quadrupole_gradient", "qd::12", -0.2)])
>>> monitors = monitors_with(ring, [Cause("monitor_gain_x", "bpm_w_1", 0.1)])
>>> weights, launches = beams(launches, [Cause("energy_offset", None, 1e-3)])
"""

# Each module registers its effects, in the order of the catalogue.
# isort: off
from tmlattice.effects import quadrupoles as quadrupoles
from tmlattice.effects import bends as bends
from tmlattice.effects import correctors as correctors
from tmlattice.effects import sextupoles as sextupoles
from tmlattice.effects import insertion_devices as insertion_devices
from tmlattice.effects import monitors as monitors
from tmlattice.effects import beam as beam
from tmlattice.effects import radiation as radiation
from tmlattice.effects import wakes as wakes

# isort: on
from tmlattice.effects.apply import (
    Settings,
    apply,
    beams,
    changed_elements,
    check,
    monitors_with,
    set_elements,
)
from tmlattice.effects.directions import Directions, directions
from tmlattice.effects.effect import (
    CATALOGUE,
    Cause,
    Effect,
    Hypothesis,
    LaunchEffect,
    ReadingEffect,
    RingEffect,
    changes_beam,
    find,
    is_energy,
    modelled,
    names,
    register,
    with_labels,
)
from tmlattice.effects.priors import background_rms, rare
from tmlattice.effects.radiation import expected_loss, expected_radiation, expected_spread
from tmlattice.effects.reading import Monitors

__all__ = [
    "CATALOGUE",
    "Cause",
    "Directions",
    "Effect",
    "Hypothesis",
    "LaunchEffect",
    "Monitors",
    "ReadingEffect",
    "RingEffect",
    "Settings",
    "apply",
    "background_rms",
    "beams",
    "changed_elements",
    "changes_beam",
    "check",
    "directions",
    "expected_loss",
    "expected_radiation",
    "expected_spread",
    "find",
    "is_energy",
    "modelled",
    "monitors_with",
    "names",
    "rare",
    "register",
    "set_elements",
    "with_labels",
]
