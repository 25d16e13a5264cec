"""The virtual machine: an engine tracks a ring with known causes, monitors read it.

>>> machine = Machine(ring, [Cause("quadrupole_gradient", "qd::12", -0.2)], engine="at")
>>> shots = draw_shots(ring, 6, amplitude=1e-3, seed=1)
>>> for shot, readings in machine.measure(shots): ...          # [turn, monitor, 2], m
>>> measurement, truth = simulate(ring, [cause], background={"quadrupole_gradient": 1e-3})
"""

from tmlattice.machine.machine import Machine
from tmlattice.machine.shots import Shots, background_rms, draw_background, draw_shots

__all__ = ["Machine", "Shots", "background_rms", "draw_background", "draw_shots"]
