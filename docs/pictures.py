"""The pictures of README and documentation, from real results: `python docs/pictures.py`.

`python docs/pictures.py tunes response` makes some. Each is a PNG below 150 kB in `docs/pictures/`.
`real_ring` needs `TMLATTICE_DATA`; it shows residuals of the data, as a picture.
"""

import os
import sys
from functools import cache
from pathlib import Path
from textwrap import wrap

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import tmlattice
from tmlattice import Cause
from tmlattice.machine.response import simulate_response
from tmlattice.report.page import shrink

FOLDER = Path(__file__).parent / "pictures"
RESULTS = Path(__file__).parent / "results"
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
    """Where the gap begins, and the scan near the faulty element."""
    from tmlattice.plots.diagnosis import plot_scan_near
    from tmlattice.plots.readings import AFTER, BEFORE, design_readings, mark

    figure = plt.figure(figsize=(11, 7), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[2, 5])
    ax, data = above.subplots(), result.trajectories.data
    s = [monitor.s for monitor in result.ring.monitors]
    before = data.readings - design_readings(result)
    after = data.readings - result.trajectories.after
    shot = int(np.square(before).sum(axis=(1, 2)).argmax())
    ax.plot(s, 1e3 * before[shot, :, 1], color=BEFORE, linewidth=1, label="readings less design")
    ax.plot(
        s, 1e3 * after[shot, :, 1], color=AFTER, linewidth=1, label="readings less estimated ring"
    )
    mark(ax, result)
    ax.set(xlabel="s [m]", ylabel="y [mm]", xlim=(0, result.ring.length))
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize="small", frameon=False)
    ax.set_title(
        "One first turn: the gap begins at the faulty magnet", loc="left", fontsize="medium"
    )
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

    cases = study_tune_fit("petra3", magnets=57, jobs=1, progress=False)
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
    from tmlattice.plots.diagnosis import drawn
    from tmlattice.plots.response import response_figures

    ring = tmlattice.load_ring(SMALL)
    fault = [Cause("quadrupole_gradient", "QD::5", -0.03)]
    errors = {"quadrupole_gradient": 2e-3, "monitor_gain_x": 0.02, "monitor_gain_y": 0.02}
    data = simulate_response(ring, fault, background=errors, noise=3e-7, progress=False).measured
    for name, _, draw in response_figures(tmlattice.diagnose(ring, data)):
        yield f"response-{name}", drawn(draw)


def together():
    """Turns, dispersion and tunes of one machine: readings, and the residuals of each."""
    from tmlattice.machine.stored_beam import simulate_dispersion, simulate_tunes, simulate_turns
    from tmlattice.plots.readings import plot_parts

    ring, weak = tmlattice.load_ring(SMALL), [Cause("quadrupole_gradient", "QD::5", -0.02)]
    read = {
        "turns": simulate_turns(ring, weak).measured,
        "dispersion": simulate_dispersion(ring, weak).measured,
        "tunes": simulate_tunes(ring, weak).measured,
    }
    yield "read-dispersion", read["dispersion"].plot(ring)
    yield "read-tunes", read["tunes"].plot(ring)
    yield "parts", plot_parts(tmlattice.diagnose(ring, read))


def real_ring():
    """SOLEIL, 2012: its response less the lattice of the file, and less the estimated ring."""
    from tmlattice.importers import bring_in
    from tmlattice.plots.response import plot_left

    path = Path(os.environ["TMLATTICE_DATA"]) / "real_rings" / "soleil_2012-01-20.loco.mat"
    brought = bring_in([path])
    figure = plt.figure(figsize=(9, 3.5), layout="constrained")
    yield "real_ring", plot_left(tmlattice.diagnose(brought.ring, brought.measurement), figure)


def report():
    """The top of the page of a diagnosis, as Chromium shows it."""
    import subprocess
    from tempfile import TemporaryDirectory

    from tmlattice.report.page import draw, page

    faults = [
        Cause("quadrupole_gradient", "qd::12", -0.05),
        Cause("corrector_kick_x", "hcor_a4_3", 1e-4),
        Cause("monitor_gain_x", "bpm_a6_u1_6", 0.2),
    ]
    result = tmlattice.diagnose(petra3(), tmlattice.simulate(petra3(), faults).measurement())
    with TemporaryDirectory() as place:
        file = Path(place) / "report.html"
        shown = {**result.provenance, "measurement": "day_1"}
        file.write_text(page(result, draw(result, file.parent), shown), encoding="utf-8")
        shot = file.with_suffix(".png")
        subprocess.run(
            ["chromium", "--headless", "--no-sandbox", "--hide-scrollbars",
             "--window-size=1100,760", f"--screenshot={shot}", file.as_uri()],
            check=True, capture_output=True,
        )  # fmt: skip
        figure = plt.figure(figsize=(11, 7.6))
        figure.figimage(plt.imread(shot))
        yield "report", figure


def table(page, first):
    """The rows of the table of a results page whose head begins so: lists of texts, head first."""
    text = (RESULTS / page).read_text(encoding="utf-8")
    lines = text[text.index(f"| {first} |") :].split("\n\n")[0].splitlines()
    return [
        [cell.strip().strip("*`") for cell in line.strip("|").split("|")]
        for line in lines
        if not line.startswith("|---")
    ]


def tables():
    """The table of blind cases as a plot."""
    head, *rows = table("blind_challenge.md", "single faults (tier A)")
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), sharey=True, layout="constrained")
    blocks = [i for i, row in enumerate(rows) if row[0].startswith("signal to noise")]
    for ax, start in zip(axes, blocks, strict=True):
        own = [row for row in rows[start + 1 : start + 7] if row[0] != "detected"]
        for k, method in enumerate(head[1:]):
            rates = [float(row[1 + k].rstrip(" %")) for row in own]
            ax.bar(np.arange(len(own)) + 0.16 * (k - 2), rates, 0.15, label=method)
        ax.set_xticks(range(len(own)), ["\n".join(wrap(row[0], 10)) for row in own], fontsize=7)
        ax.set_title(rows[start][0], fontsize="medium")
        ax.grid(axis="y", alpha=0.25)
        ax.set_axisbelow(True)
    axes[0].set_ylabel("share of cases [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=5, loc="outside upper center",
                  fontsize="small", frameon=False)  # fmt: skip
    yield "blind-rates", figure


MAKERS = (diagnosis, credible, tunes, optics, response, together, report, real_ring, tables)


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
            shrink(path, name)
            print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
