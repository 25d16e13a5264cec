"""A small ring for tests: 16 FODO cells with everything that a lattice file may do to a reader."""

from math import cos, pi, sqrt

from ocelot import *  # noqa: F403

energy = 3.0
cells = 16
k = 0.9

qf = Quadrupole(l=0.4, k1=k, eid="QF")  # noqa: F405
qd = Quadrupole(l=0.4, k1=-k, eid="QD")  # noqa: F405
bend = SBend(l=1.2, angle=pi / cells, e1=pi / cells / 2, e2=pi / cells / 2, eid="bend")  # noqa: F405
sf = Sextupole(l=0.2, k2=6.0, eid="sf")  # noqa: F405
sd = Sextupole(l=0.2, k2=-9.0, eid="sd")  # noqa: F405
d = Drift(l=0.5)  # noqa: F405
generated_b = generated_a = Hcor(l=0.1)  # noqa: F405
back = Drift(l=-5e-9, eid="back")  # noqa: F405
wiggler = Matrix(l=0.5, eid="wig_1")  # noqa: F405
wiggler.r[:4, :4] = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, cos(0.1), 0.5], [0, 0, -0.02, 1]]
root = sqrt(0.02 * 0.5)
wiggler.r[2:4, 2:4] = [[1 - root**2, 0.5], [-0.02, 1]]

one_cell = [qf, d, sf, d, bend, d, qd, d, sd, d, bend, d]
ring = [
    Monitor(eid="bpm_start"),  # noqa: F405
    *[
        [Monitor(eid="bpm"), Vcor(eid=f"v{i}"), one_cell, Monitor(eid=f"end_{i}")]  # noqa: F405
        for i in range(cells)
        if energy > 0  # a comprehension over the file's own names
    ],
    [d, generated_b, back, wiggler, Monitor(eid="last_a"), d, Monitor(eid="last_b"), d],  # noqa: F405
]
