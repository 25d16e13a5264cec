"""The virtual machine: an engine tracks a ring with known causes, monitors read it.

>>> simulation = simulate(ring, [Cause("quadrupole_gradient", "qd::12", -0.2)], shots=6, seed=1)
>>> measurement = simulation.measurement()
>>> simulation.write("day_1")                                   # the measurement folder
>>> stored_beam.simulate_turns(ring, shots=4).measured          # of a stored beam
>>> Machine(ring, engine="ocelot").beam(launches)               # [shot, turn, monitor, 2], m
"""

from tmlattice.machine.machine import ENGINES, Machine
from tmlattice.machine.shots import Shots, draw_background, draw_shots
from tmlattice.machine.simulate import Simulation, simulate

__all__ = [
    "ENGINES",
    "Machine",
    "Shots",
    "Simulation",
    "draw_background",
    "draw_shots",
    "simulate",
]
