"""The pictures of README and documentation, from real results: `python docs/pictures.py`.

`python docs/pictures.py tunes response` makes some. Each is a PNG below 150 kB in `docs/pictures/`.
`real_ring` needs `TMLATTICE_DATA`: of the data it shows what is left of them, as a picture.
"""

import os
import sys
from functools import cache
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import tmlattice
from tmlattice import Cause
from tmlattice.machine.response import simulate_response
from tmlattice.report.page import shrink

FOLDER = Path(__file__).parent / "pictures"
SMALL = Path(__file__).parent.parent / "tests" / "lattices" / "small_ring.py"
WEAK = Cause("quadrupole_gradient", "qd::12", -0.2)


@cache
def petra3():
    """The built-in ring, loaded once."""
    return tmlattice.load_ring("petra3")


def diagnosis():
    """The README's example, six shots and a quadrupole 20 % weak: every figure of the report."""
    from tmlattice.plots.diagnosis import figures

    result = tmlattice.diagnose(petra3(), tmlattice.simulate(petra3(), [WEAK]).measurement())
    yield "diagnosis", where_and_what(result)
    for name, _, figure in figures(result):
        yield name, figure


def where_and_what(result):
    """Where the gap begins, and the scan about the culprit."""
    from tmlattice.plots.diagnosis import plot_scan_near
    from tmlattice.plots.readings import AFTER, BEFORE, design_readings, mark

    figure = plt.figure(figsize=(11, 7), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[2, 5])
    ax, data = above.subplots(), result.trajectories.data
    s = [monitor.s for monitor in result.ring.monitors]
    before = data.readings - design_readings(result)
    after = data.readings - result.explanation.fit.point.view.readings
    shot = int(np.square(before).sum(axis=(1, 2)).argmax())
    ax.plot(s, 1e3 * before[shot, :, 1], color=BEFORE, linewidth=1, label="the design leaves")
    ax.plot(s, 1e3 * after[shot, :, 1], color=AFTER, linewidth=1, label="the ring as found leaves")
    mark(ax, result)
    ax.set(xlabel="s [m]", ylabel="y [mm]", xlim=(0, result.ring.length))
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize="small", frameon=False)
    ax.set_title("One first turn: the gap begins at the culprit", loc="left", fontsize="medium")
    ax.grid(alpha=0.25)
    plot_scan_near(result, result.findings[0], below)
    return figure


def credible():
    """A faint fault, which its neighbours explain nearly as well."""
    from tmlattice.plots.diagnosis import figures

    ring = tmlattice.load_ring(SMALL)
    faint = [Cause("quadrupole_gradient", "QD::5", -0.0025)]
    data = tmlattice.simulate(
        ring, faint, shots=4, seed=1, engine="ocelot", amplitude=3e-4, noise=2e-6
    ).measurement()
    for name, _, figure in figures(tmlattice.diagnose(ring, data)):
        if name.startswith("credible"):
            yield "credible-set", figure


def tunes():
    """|dQ| of three methods, magnet after magnet."""
    from tmlattice.fitting.study import study_tune_fit
    from tmlattice.plots import plot_study

    cases = study_tune_fit("petra3", magnets=57, workers=1, progress=False)
    yield "tunes", plot_study(petra3(), cases, plt.figure(figsize=(11, 5.5), layout="constrained"))


def optics():
    """Betas and dispersion of an octant; motion in phase space."""
    from tmlattice.optics import off_momentum, twiss
    from tmlattice.plots import plot_betas, plot_phase_space

    network = tmlattice.TaylorNetwork.from_ring(petra3())
    energy = tmlattice.TaylorNetwork.from_ring(petra3(), 6)
    dispersion = off_momentum(energy, petra3().length)
    yield "betas", plot_betas(petra3(), twiss(network), dispersion, (0, 288))
    launches = [[1e-3 * a, 0, 1e-3 * a, 0] for a in (0.5, 1, 2, 3)]
    states = network.track(launches, turns=300)
    figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    for plane, ax in enumerate(axes):
        plot_phase_space(states, plane, ax, tmlattice.one_turn_optics(network))
    yield "phase-space", figure


def response():
    """A simulated orbit response of the small ring, gradients and gains wrong everywhere."""
    from tmlattice.plots.response import response_figures

    ring = tmlattice.load_ring(SMALL)
    weak = {"quadrupole_gradient": 2e-3, "monitor_gain_x": 0.02}
    data = simulate_response(ring, background=weak, progress=False).measured
    for name, _, figure in response_figures(tmlattice.diagnose(ring, data)):
        yield f"response-{name}", figure


def real_ring():
    """SOLEIL, 2012: its response less the lattice of the file, and less the ring as found."""
    from tmlattice.importers import bring_in

    path = Path(os.environ["TMLATTICE_DATA"]) / "real_rings" / "soleil_2012-01-20.loco.mat"
    brought = bring_in([path])
    yield "real_ring", before_and_after(tmlattice.diagnose(brought.ring, brought.measurement))


def before_and_after(result):
    """What is left of each fitted corrector in its own plane, in one scale of colours."""
    view = result.response
    plane = np.array([int(p == "y") for p in view.measured.planes])
    shown = [k for k in np.argsort(plane, kind="stable") if not view.held[k]]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    limit = 0.0
    for ax, name, model in zip(axes, ("before", "after"), (view.design, view.model), strict=True):
        left = 1e6 * (view.data - model)[shown][:, view.good]
        left = left[np.arange(len(shown)), :, plane[shown]]
        limit = limit or float(np.percentile(abs(left), 98))
        image = ax.imshow(left.T, aspect="auto", cmap="RdBu_r", vmin=-limit, vmax=limit)
        ax.set_title(f"{name}: {np.sqrt(np.mean(left**2)):.2g} µm rms", loc="left")
        ax.set_xlabel("corrector: horizontal, then vertical")
    axes[0].set_ylabel("monitor, along the ring")
    figure.colorbar(image, ax=axes, label="measured less model [µm]")
    return figure


MAKERS = (diagnosis, credible, tunes, optics, response, real_ring)


def main(names):
    """Make those of these makers, or all."""
    FOLDER.mkdir(exist_ok=True)
    for maker in MAKERS:
        if names and maker.__name__ not in names:
            continue
        for name, figure in maker():
            path = FOLDER / f"{name}.png"
            figure.savefig(path, dpi=100)
            plt.close(figure)
            shrink(path)
            print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
