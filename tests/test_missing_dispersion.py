"""Dispersion that no gradient makes: kicks of the closed orbit; AT displaces quadrupoles."""

from dataclasses import replace

import numpy as np
import pytest
from shared import gradients, parted

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.kicks import by_energy, dispersion_of_kicks, kicking
from tmlattice.beam.response_derivatives import ResponseSlopes
from tmlattice.diagnosis import diagnose
from tmlattice.diagnosis.families.dispersion import (
    HorizontalKicks,
    VerticalKicks,
    dispersion_by_kicks,
    fitted_orbit_kicks,
    patterns_of_kicks,
)
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.hierarchical import fit_families
from tmlattice.diagnosis.response.state import begin
from tmlattice.effects import Cause, apply
from tmlattice.errors import MeasurementError
from tmlattice.machine.response import simulate_response
from tmlattice.observe.calibration import (
    Calibration,
    calibrated_response,
    read_calibration,
    write_calibration,
)
from tmlattice.observe.orbit_response import Errors, Predicted, response_change
from tmlattice.observe.response_data import response_data

STEP = -2000.0
"""Hz."""
WITHOUT = STEPS[:3]
WITH = [*WITHOUT, *(step for step in STEPS if isinstance(step[0], HorizontalKicks))]


def simulated(ring, causes, **how):
    """A response with an RF step."""
    return simulate_response(ring, causes, rf_step=STEP, progress=False, **how).measured


def with_kicks(ring, measured, more):
    """Of kicks that add so much to the RF's orbit, in x: to the correctors' orbits too."""
    data, kicks = response_data(ring, measured), HorizontalKicks()
    none = Errors.none(data)
    values = np.linalg.lstsq(kicks.patterns(data).rf.T, more, rcond=None)[0]
    before, after = (Predicted(data, own).read for own in (none, kicks.put(none, values, data)))
    added = after - before
    return replace(
        measured,
        response=measured.response + added[:-1],
        rf=replace(measured.rf, orbit=measured.rf.orbit + added[-1]),
    )


@pytest.fixture(scope="module")
def plain(small_ring):
    """Without sextupoles, in which an orbit would make gradients."""
    places = [i for i, e in enumerate(small_ring.elements) if e.kind == "sextupole"]
    return small_ring.with_elements({i: small_ring.elements[i].changed(k2=0.0) for i in places})


@pytest.fixture(scope="module")
def design(plain):
    """Where a fit of its response begins."""
    measured = simulated(plain, [], kick=1e-5, noise=2e-8, engine="ocelot")
    return begin(*parted(plain, measured, 1))


def displaced(plain, plane):
    """What quadrupoles that are displaced by 0.2 mm rms add to the RF's orbit of AT, m."""
    rng = np.random.default_rng(7)
    quadrupoles = [e.name for e in plain.elements if e.kind == "quadrupole"]
    causes = [Cause(f"quadrupole_offset_{'xy'[plane]}", name, 2e-4 * rng.standard_normal())
              for name in quadrupoles]  # fmt: skip
    with_them, without = (
        simulated(plain, own, correctors=["v3"], noise=0.0).rf.orbit[:, plane]
        for own in (causes, [])
    )
    return with_them - without


@pytest.fixture(scope="module")
def beside(plain):
    """In x."""
    return displaced(plain, 0)


def test_patterns_of_kicks_make_what_displaced_quadrupoles_make_in_at(design, beside):
    family = HorizontalKicks()
    patterns = family.rows(design.at, np.zeros(family.size(design.data)))
    assert len(patterns) < len(beside) / 2
    amounts = np.linalg.lstsq(patterns[:, -1].T, beside, rcond=None)[0]
    left = beside - amounts @ patterns[:, -1]
    assert np.std(beside) > 2e-6
    assert np.std(left) < 0.02 * np.std(beside)  # to first order in the energy, kicks at the ends
    # gradients of 0.36 1/m and an orbit of 1.9 mm
    assert 1e-4 < np.sqrt(np.mean(amounts**2)) < 2e-3


def test_vertical_patterns_make_what_is_displaced_in_y_in_at(plain, design):
    across, along = (patterns_of_kicks(design.at, plane).rf for plane in (1, 0))
    more = displaced(plain, 1)
    left = [
        np.std(more - np.linalg.lstsq(own.T, more, rcond=None)[0] @ own)
        for own in (across, along[: len(across)])
    ]
    assert np.std(more) > 1e-7
    assert left[0] < 0.02 * np.std(more) < 0.3 * left[1]  # the other plane's leave more


@pytest.fixture(scope="module")
def measured(small_ring, beside):
    """Gradients that scatter, without kicks and with them."""
    rng = np.random.default_rng(5)
    causes = gradients(small_ring, 5e-3, rng)
    plain = simulated(small_ring, causes, kick=1e-5, noise=2e-8, engine="ocelot", seed=3)
    return causes, plain, with_kicks(small_ring, plain, beside)


def test_gradients_are_not_drawn_astray_by_what_they_do_not_make(small_ring, measured):
    causes, plain, kicked = measured
    amounts = {cause.element: cause.amount for cause in causes}
    missed, said = [], []
    for own, steps in ((plain, WITH), (kicked, WITH), (kicked, WITHOUT)):
        data, split = parted(small_ring, own, 1)
        fit = fit_families(data, split, steps)
        true = [amounts[name] for name in QuadrupoleGradient().places(data)]
        missed.append(np.std(fit.state.values["gradient"] - true))
        said.append(len(list(dispersion_by_kicks(fit.state.values, data))))
    assert said == [0, 1, 0]
    assert missed[1] < 2 * missed[0]
    assert missed[2] > 2 * missed[1]


def test_patterns_are_read_as_they_were_put(ring_kicking_x, rng):
    """Linear about other kicks of both planes, and together with an energy spread."""
    ring = ring_kicking_x("i % 2")
    data = response_data(ring, simulated(ring, [], kick=1e-5, noise=2e-8, engine="ocelot"))
    families = HorizontalKicks(), VerticalKicks()
    errors = replace(Errors.none(data), spread=1.0)
    errors = replace(errors, calibration=np.append(0.1 * rng.standard_normal(17), 0.0))
    for family in families:
        errors = family.put(errors, 1e-4 * rng.standard_normal(family.size(data)), data)
    for family in families:
        values = 1e-8 * rng.standard_normal(family.size(data))
        before, after = (Predicted(data, own) for own in (errors, family.put(errors, values, data)))
        rows = np.tensordot(values, family.rows(before, values), 1)
        moved = data.pick(after.read - before.read, family.block)
        # what the spread adds to the energy's part is of second order in both
        for part in (np.s_[:-1], np.s_[-1:]):
            assert np.abs(rows[part]).max() > 1e-14
            assert moved[part] == pytest.approx(rows[part], abs=1e-2 * np.abs(rows[part]).max())


@pytest.mark.parametrize("plane", [0, 1])
def test_dispersion_at_correctors_counts_as_that_at_monitors_does(ring_kicking_x, plane):
    """Against closed orbits, six coordinates, of a ring whose correctors are powered."""
    ring = ring_kicking_x("i % 2")
    rng = np.random.default_rng(0)
    plain = ring.with_elements({
        i: e.changed(k2=0.0) for i, e in enumerate(ring.elements) if e.kind == "sextupole"
    })  # fmt: skip
    bent = plain.with_elements({
        i: e.changed(angle=1e-6 * rng.standard_normal())
        for i, e in enumerate(plain.elements)
        if e.kind == ("hcorrector", "vcorrector")[plane]
    })  # fmt: skip
    models = [ResponseModel(own) for own in (plain, bent)]
    rf, at_correctors, parts = [], [], []
    for model in models:
        columns = model.columns()
        own = np.array(["xy".index(p) for p in columns.planes])
        there = model.tangents[columns.layer + 1] @ model.rf_start / model.rf_start[5]
        at_correctors.append(np.where(own == 0, there[:, 0], there[:, 2]))
        rf.append(model.rf_response())
        energy = columns.start[:, 5, None, None]
        parts.append(energy * model.rf_response() / model.rf_start[5])
    more = (rf[1] - rf[0]) / models[0].rf_start[5]
    found = by_energy(
        models[0], columns.names, np.arange(len(more)), more, at_correctors[1] - at_correctors[0]
    )
    for kicked, read in ((0, 0),) if plane == 0 else ((0, 1), (1, 0)):
        actual = (parts[1] - parts[0])[own == kicked][..., read]
        missed = found[own == kicked][..., read] - actual
        assert np.std(actual) > 1e-7
        assert np.std(missed) < 1e-3 * np.std(actual)
    if plane == 1:  # the energy's part is what four coordinates lack
        lacked = [a.response() - ResponseModel(b, 4).response()
                  for a, b in zip(models, (plain, bent), strict=True)]  # fmt: skip
        for kicked, read in ((0, 1), (1, 0)):
            actual = (lacked[1] - lacked[0])[own == kicked][..., read]
            missed = found[own == kicked][..., read] - actual
            assert np.std(missed) < 1e-3 * np.std(actual)


def test_predict_has_the_dispersion_that_was_found(tmp_path, ring_kicking_x, beside):
    ring = ring_kicking_x("i % 2")
    plain = simulated(ring, [], kick=1e-5, noise=2e-8, engine="ocelot", seed=3)
    known = ["quadrupole_gradient", "dipole_field"]
    found = diagnose(ring, with_kicks(ring, plain, 10 * beside), effects=known)
    (text,) = (one for one in found.warnings if "RF's orbit" in one)
    assert "RF's orbit in x are not from a gradient" in text  # the added kicks are horizontal
    path = tmp_path / "ring.calibration.json"
    write_calibration(path, Calibration(found.calibration, found.dispersion))
    own = read_calibration(path, ring)
    assert own.dispersion == found.dispersion
    measured = found.view.measured
    for row, said in (
        ('{"element": "QF::1", "x": 0, "y": 0}', "is a quadrupole"),
        ('{"element": "v1", "x": 1e999, "y": 0}', "is no number"),
        ('{"element": "v1", "x": 0, "y": 0}, {"element": "v1", "x": 0, "y": 0}', "occurs twice"),
    ):
        other = tmp_path / "other.json"
        other.write_text(
            f'{{"format": "tmlattice-calibration", "version": 1, "effects": [], '
            f'"dispersion": [{row}]}}'
        )
        with pytest.raises(MeasurementError, match=said):
            read_calibration(other, ring)
    at = [found.as_found.monitors.index(found.as_found[name]) for name in measured.monitors]
    missed = []
    for more in (own.dispersion, None):
        _, response = calibrated_response(found.as_found, own.causes, measured.correctors, more)
        read = np.array(measured.kicks)[:, None, None] * response[:, at]
        missed.append(np.nanstd(read - found.view.model[:-1]))
    assert missed[0] < 2e-9 < 0.1 * missed[1]  # the steps' third order


@pytest.mark.parametrize("plane", [0, 1])
def test_a_model_with_kicks_astray_has_their_dispersion_and_its_slopes(small_ring, plane):
    """In a ring that is changed, too; slopes against differences."""
    design = ResponseModel(small_ring)
    where = kicking(small_ring, plane)
    orbit_kicks = np.zeros((len(small_ring.magnets), 2))
    orbit_kicks[where, plane] = 1e-4 * np.random.default_rng(0).standard_normal(len(where))
    model = ResponseModel(small_ring, orbit_kicks=orbit_kicks)
    more = (model.rf_response() - design.rf_response())[:, plane]
    made = dispersion_of_kicks(design, 1.0, plane) @ orbit_kicks[where, plane]
    assert np.std(made) > 1e-3
    assert more == pytest.approx(made, abs=2e-3 * np.abs(made).max())  # first order in the kicks
    assert model.path == pytest.approx(design.path, abs=1e-12)  # no orbit
    correctors, step = ["v1", "v4", "v11"], 1e-6  # which have kicks astray of their own
    up, down = (model.closed_orbits(correctors, np.full(3, side * step / 2)) for side in (1, -1))
    response = model.response(correctors)
    assert (up - down) / step == pytest.approx(response, abs=1e-7 * np.abs(response).max())

    name, step = "QF::3", 1e-5
    ends = [
        model.changed_to(apply(small_ring, [Cause("quadrupole_gradient", name, side * step)]))
        for side in (1, -1)
    ]
    actual = (ends[0].rf_response() - ends[1].rf_response()) / (2 * step)
    both = [ResponseSlopes(own) for own in (model, design)]
    slope, without = (
        own.whole(own.factors([("quadrupole_gradient", name)]))[0, -1] for own in both
    )
    assert np.abs(without - actual).max() > 1e-4 * np.abs(actual).max()
    assert slope == pytest.approx(actual, abs=5e-6 * np.abs(actual).max())


@pytest.mark.parametrize("family", [HorizontalKicks(), VerticalKicks()])
def test_the_ring_of_a_change_has_the_dispersion_that_was_fitted(small_ring, family):
    """In its own optics: kicks of the design's optics make two fifths too much or too little."""
    wrong = np.random.default_rng(2)
    causes = [*gradients(small_ring, 1e-2, wrong), Cause("energy_offset", None, 1e-3)]
    data = response_data(small_ring, simulated(small_ring, [], kick=1e-5, noise=2e-8))
    ring = Errors.none(data).with_causes(data, causes)
    values = 1e-3 * wrong.standard_normal(family.size(data))
    errors = family.put(ring, values, data)
    fitted, without = (Predicted(data, own).kicked for own in (errors, ring))
    design = np.zeros((len(small_ring.magnets), 2))
    where = kicking(small_ring, family.plane)
    design[where, family.plane] = values @ family.patterns(data).kicks
    left = {}
    for name, orbit_kicks in (
        ("own", fitted_orbit_kicks(Predicted(data, errors))),
        ("design", design),
    ):
        orbits = response_change(data, errors, data, orbit_kicks).orbits
        left[name] = np.std((orbits - fitted)[-1, :, family.plane])
    made = np.std((fitted - without)[-1, :, family.plane])
    assert made > 1e-7
    assert left["own"] < 0.1 * made
    assert left["own"] < 0.8 * left["design"]


@pytest.mark.slow
def test_a_change_acts_on_the_dispersion_that_kicks_make(plain):
    """Quadrupoles displaced by a millimetre on both days: 13 % of the RF's orbit."""
    rng = np.random.default_rng(7)
    both = [Cause("quadrupole_offset_x", e.name, 1e-3 * rng.standard_normal())
            for e in plain.elements if e.kind == "quadrupole"]  # fmt: skip
    true = {("family_gradient", "qf"): 3e-3, ("quadrupole_gradient", "qd::5"): -8e-3}
    before, after = (
        simulated(plain, [*both, *own], kick=1e-5, noise=2e-8, seed=day)
        for day, own in enumerate([[], [Cause(*where, size) for where, size in true.items()]])
    )
    found = diagnose(plain, after, reference=before).findings
    assert {(own.effect, own.element.casefold()) for own in found} == set(true)
    for own in found:
        error = own.amount - true[own.effect, own.element.casefold()]
        assert abs(error) < 4 * own.amount_sigma
        assert own.amount_sigma < 3e-4
