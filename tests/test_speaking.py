"""Objects that speak: short in a line, whole in a report; names and paths where objects go."""

import importlib
import pkgutil
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import numpy as np
import pytest
from command import printed
from conftest import SMALL

import tmlattice
from tmlattice.effects import CATALOGUE
from tmlattice.errors import ChoiceError, MeasurementError, UnknownNameError
from tmlattice.late import Method
from tmlattice.maps import ring_matrix
from tmlattice.measurement import (
    ClosedOrbit,
    Dispersion,
    OrbitResponse,
    RfStep,
    TuneReading,
    TurnByTurn,
    write_measurement,
)
from tmlattice.optics import matrix_tunes
from tmlattice.report import tables
from tmlattice.speaks import micrometres

FAULT = tmlattice.Cause("quadrupole_gradient", "QD::5", -0.05)


@pytest.fixture(scope="module")
def measured(small_ring):
    return tmlattice.simulate(
        small_ring, [FAULT], shots=3, amplitude=1e-4, noise=1e-6, engine="ocelot", seed=2
    ).measurement()


@pytest.fixture(scope="module")
def diagnosis(small_ring, measured):
    return tmlattice.diagnose(small_ring, measured)


class Balanced(HTMLParser):
    """Every tag is closed."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def of_every_kind(monitors):
    orbit = 1e-4 * np.arange(2 * len(monitors), dtype=float).reshape(-1, 2)
    step = RfStep(5e8, 300, 100.0, orbit)
    return {
        "orbits": ClosedOrbit(np.stack([orbit, orbit]), monitors, (1e-6, 1e-6)),
        "dispersion": Dispersion((step,), monitors),
        "turns": TurnByTurn(np.stack([np.stack([orbit] * 20)]), monitors),
        "tunes": TuneReading(np.array([[0.1, 0.2]]), np.array([[1e-4, 1e-4]])),
        "response": OrbitResponse(("v1",), ("y",), np.ones(1), monitors, orbit[None]),
    }


def test_what_an_object_shows_is_a_line(small_ring, measured, diagnosis):
    every = [
        (small_ring, ("107.700 m", "monitors 35", "3 GeV")),
        (measured, ("shots 3", "1 µm", "stated")),
        (diagnosis, ("identified", "QD::5", "quadrupole_gradient")),
        (diagnosis.findings[0], ("QD::5", "relative")),
        (tmlattice.CATALOGUE, ("quadrupole_gradient",)),
        *((own, ()) for own in of_every_kind(measured.monitors).values()),
    ]
    for own, words in every:
        line, html = repr(own), own._repr_html_()
        assert len(line) < 1500
        assert "\n" not in line
        assert len(html) < 4000
        Balanced().feed(html)
        for word in words:
            assert word in line, line
            for part in word.rsplit(" ", 1) if word.startswith(("mon", "shots")) else [word]:
                assert part in html, html


def test_a_fit_shows_its_tunes_and_what_it_trusts(small_ring, measured):
    outcome = tmlattice.tune_fit(
        small_ring, "QD::5", -0.02, launch=(1e-4, 0, 1e-4, 0), noise=1e-6, methods=["sparse"]
    )
    assert "trusted sparse" in repr(outcome)
    assert f"{outcome.true_tunes[0]:.6f}" in repr(outcome)
    assert "QD::5" in repr(outcome.fit)
    assert "QD::5" in repr(outcome.best)
    assert max(map(len, map(repr, (outcome, outcome.fit, outcome.best)))) < 600


def test_names_of_a_file_do_not_become_tags(small_ring):
    assert "<script>" not in replace(small_ring, name="<script>")._repr_html_()


def test_objects_draw_themselves(small_ring, measured, diagnosis):
    before = len(plt.get_fignums())
    scan, gap, betas = diagnosis.plot(), diagnosis.plot("gap"), small_ring.plot(span=(0, 50))
    assert scan.axes[0].get_ylabel() != gap.axes[0].get_ylabel()
    assert betas.axes[0].get_ylabel() == "beta [m]"
    drawn = [measured.plot(), measured.plot(ring=small_ring)]
    drawn += [own.plot() for own in of_every_kind(measured.monitors).values()]
    x = drawn[1].axes[0].lines[0]
    first = [small_ring[name].s for name in measured.monitors]
    np.testing.assert_allclose(x.get_xdata(), np.sort(first))
    np.testing.assert_allclose(np.sort(x.get_ydata()), np.sort(1e3 * measured.readings[0, 0, :, 0]))
    with pytest.raises(ChoiceError, match=r"no figure 'moon'; there are .*readings, scan"):
        diagnosis.plot("moon")
    for figure in (scan, gap, betas, *drawn):
        plt.close(figure)
    assert len(plt.get_fignums()) == before  # what was not asked for is closed


def test_small_errors_that_are_not_small_are_told(diagnosis):
    usual = CATALOGUE["quadrupole_gradient"].background
    for times, error, told in ((8.0, 0.1, True), (8.0, 0.9, False), (1.5, 0.1, False)):
        found = replace(
            diagnosis, priors={"quadrupole_gradient": times * usual},
            prior_errors={"quadrupole_gradient": error},
        )  # fmt: skip
        assert ("(8 times)" in found.report()) == told
        notes = dict(tables.notes(found, found.provenance))
        assert ("large distributed errors" in notes) == told


def test_tunes_are_drawn_beside_those_of_the_ring(small_ring):
    tune = [[0.1, 0.2], [0.15, 0.25]]
    measured = TuneReading(tune, None, [[1.0, 2.0], [1.5, 2.5]], shots=(3, 7))
    figure = measured.plot(small_ring)
    read = [ax.lines[0].get_ydata().tolist() for ax in figure.axes]
    assert read == [[0.1, 0.15], [1.0, 1.5], [0.2, 0.25], [2.0, 2.5]]
    design = matrix_tunes(ring_matrix(small_ring))  # by the product of OCELOT's matrices
    for plane, ax in enumerate(figure.axes[::2]):
        assert ax.lines[-1].get_ydata()[0] == pytest.approx(design[plane], abs=1e-6)
    assert [label.get_text() for label in figure.axes[3].get_xticklabels()] == ["3", "7"]
    plt.close(figure)


def test_a_name_or_a_path_goes_where_a_ring_or_a_measurement_does(
    small_ring, measured, diagnosis, tmp_path
):
    write_measurement(tmp_path / "day", measured)
    found = tmlattice.diagnose(str(SMALL), tmp_path / "day", holdout=0.33)
    assert found.findings[0].amount == pytest.approx(diagnosis.findings[0].amount, rel=1e-9)
    rows = [f"{m} x [mm],{m} y [mm]" for m in measured.monitors]
    numbers = (",".join(repr(float(v)) for v in 1e3 * shot.ravel()) for shot in measured.readings)
    (tmp_path / "a.csv").write_text("\n".join([",".join(rows), *numbers]))
    found = tmlattice.diagnose(SMALL, {"a": str(tmp_path / "a.csv")})
    assert [f.element for f in found.findings] == ["QD::5"]
    assert tmlattice.TaylorNetwork.from_ring(SMALL).dimension == 4
    assert tmlattice.ring_maps(str(SMALL)).monitors == tmlattice.ring_maps(small_ring).monitors
    network = tmlattice.TaylorNetwork.from_ring(small_ring)
    fit = tmlattice.fine_tune(network, tmp_path / "day", method="sparse", launch_sigma=np.inf)
    assert set(fit.changes) == {"QD::5"}
    again = tmlattice.fine_tune(network, tmp_path / "a.csv", method="sparse", noise=1e-6)
    assert set(again.changes) == {"QD::5"}  # the names are those of the network's ring
    with pytest.raises(MeasurementError, match="give the ring with it"):
        tmlattice.fine_tune(tmlattice.TaylorNetwork(network.maps), tmp_path / "a.csv")
    with pytest.raises(tmlattice.TmlatticeError, match="no lattice 'petra4'; did you mean"):
        tmlattice.simulate("petra4")


def test_an_effect_that_is_not_there_is_answered_with_the_nearest():
    with pytest.raises(UnknownNameError, match="no effect 'quadrupole_gradent'; did you mean"):
        tmlattice.CATALOGUE["quadrupole_gradent"]
    assert "quadrupole_gradent" not in tmlattice.CATALOGUE


def test_every_room_is_there_after_import():
    """In a process of its own: others have imported them here."""
    code = (
        "import sys, tmlattice\n"
        "assert not {'torch', 'ocelot', 'matplotlib', 'numpy'} & set(sys.modules)\n"
        "tmlattice.plots.plot_loss, tmlattice.lattice.save_ring, tmlattice.report\n"
        "tmlattice.errors.TmlatticeError, tmlattice.importers.bring_in, tmlattice.optics.twiss\n"
        "import pydoc\n"
        "text = pydoc.plain(pydoc.render_doc(tmlattice))\n"
        "assert 'The tour' in text and 'diagnosis.report()' in text, text[:500]\n"
        "for name in tmlattice.__all__: getattr(tmlattice, name)\n"
        "assert {'plots', 'diagnose'} <= set(dir(tmlattice))\n"
    )
    printed("-c", code, cwd=".")


def test_what_a_room_names_above_itself_is_there():
    """A method in words, of every class of the package."""
    seen = set()
    for module in pkgutil.walk_packages(tmlattice.__path__, "tmlattice."):
        # sweeps on a card need Triton, and have no such classes
        if ".lattices" in module.name or module.name.endswith(("__main__", ".kernels", ".cuda")):
            continue
        for own in vars(importlib.import_module(module.name)).values():
            if isinstance(own, Method):
                seen.add(own)
            elif isinstance(own, type):
                seen |= {value for value in vars(own).values() if isinstance(value, Method)}
    assert len(seen) >= 7
    for method in seen:
        assert callable(method.function), (method.module, method.name)
        assert method.__doc__


@pytest.mark.parametrize(
    ("metres", "text"),
    [(1.234e-5, "12.3 µm"), (1e-6, "1.0 µm"), (2.78e-8, "0.028 µm"), (4e-7, "0.4 µm"),
     (0.0, "0 µm"), (np.nan, "nan µm")],
)  # fmt: skip
def test_sizes_below_a_micrometre_are_no_zeros(metres, text):
    assert micrometres(metres) == text
