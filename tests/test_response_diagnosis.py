"""The ordered steps on simulated orbit responses whose errors are known, and the measured one."""

from dataclasses import replace

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from numpy.testing import assert_allclose
from shared import measured_data, parted, valid

from tmlattice import diagnose
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.hierarchical import fit_families
from tmlattice.diagnosis.response.missing_effects import HYPOTHESES, weigh
from tmlattice.diagnosis.response.validation import score
from tmlattice.effects import Cause, apply, with_labels
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Element, load_ring
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.response import simulate_response as simulated
from tmlattice.measurement import OrbitResponse, read_measurement, write_measurement
from tmlattice.network import TaylorNetwork
from tmlattice.observe.noise import estimated_noise
from tmlattice.observe.response_data import response_data, split_columns
from tmlattice.optics import ring_tunes, twiss
from tmlattice.report.plain import report_text
from tmlattice.report.response_text import family_rows, step_rows

CAUSES = [
    Cause("quadrupole_gradient", "QD::5", 0.01),
    Cause("quadrupole_gradient", "QF::9", -0.008),
    Cause("quadrupole_gradient", "QF::3", 0.006),
    Cause("quadrupole_gradient", "QD::12", 0.005),
    Cause("corrector_calibration", "v2", 0.1),
]
"""More than a few: the families are fitted."""
KNOWN = ["quadrupole_gradient", "corrector_calibration"]


def simulate_response(ring, causes=(), **options):
    """A step of the RF that is small in the small ring: other errors are what is tested here."""
    return simulated(ring, causes, **{"rf_step": -3000.0, **options})


def fitted(ring, measured, seed=1, steps=STEPS[:3]):
    return fit_families(*parted(ring, measured, seed), steps).state


def test_the_only_corrector_of_a_plane_is_fitted(small_ring, measured):
    data = response_data(small_ring, measured)
    alone = [p == "x" for p in measured.planes]
    assert sum(alone) == 1
    for seed in range(20):
        split = split_columns(data, 0.3, np.random.default_rng(seed))
        assert not split.held[:-1][alone].any()
        assert (split.half[:, :34:2] ^ split.half[:, 1:34:2]).all()  # one of each two neighbours


@pytest.fixture(scope="module")
def measured(small_ring):
    simulation = simulate_response(
        small_ring, CAUSES, kick=1e-5, noise=2e-8, engine="ocelot", progress=False, seed=3
    )
    return simulation.measured


@pytest.fixture(scope="module")
def result(small_ring, measured):
    return diagnose(small_ring, measured, seed=1, effects=KNOWN)


def test_gradients_close_the_held_out_gap(result):
    assert result.steps[0].effect == "design"
    first, last = result.steps[0], result.steps[-1]
    assert first.heldout_chi2_per_dof > 30
    assert last.heldout_chi2_per_dof < 1.3  # some 200 readings: 1 +- 0.1, and the fit's own error
    assert last.dispersion_rms < 0.5 * first.dispersion_rms
    strongest = sorted(
        (c for c in result.causes if c.effect == "quadrupole_gradient"),
        key=lambda c: -abs(c.amount),
    )[:4]
    assert {"QD::5", "QF::9"} <= {c.element for c in strongest}
    # five that are wrong alone, more than the search for a few takes, stand out of the families
    found = {(own.effect, own.element) for own in result.findings}
    assert found == {(cause.effect, cause.element) for cause in CAUSES}
    assert not result.bad_monitors


@pytest.mark.parametrize("noise", [2e-8, 5e-7])
def test_noise_that_nobody_states_is_learnt_from_neighbours(small_ring, rng, noise):
    """Also where every monitor stands twice, under two names."""
    exact = ResponseModel(small_ring)
    monitors = [m.name for m in small_ring.monitors]
    names = [f"v{i}" for i in range(16)]
    orbits = 1e-5 * exact.response(names)
    read = orbits + noise * rng.standard_normal(orbits.shape)
    measured = OrbitResponse(names, ["y"] * 16, np.full(16, 1e-5), monitors, read)
    found = estimated_noise(small_ring, measured)[0, 1]
    assert 0.6 < found / noise < 1.5  # of 16 columns
    elements: list[Element] = []
    for element in small_ring.elements:
        again = replace(element, name=f"{element.name} again")
        elements += [element, again] if element.kind == "monitor" else [element]
    ring = replace(small_ring, elements=tuple(elements))
    both = [name + own for name in monitors for own in ("", " again")]
    twice = OrbitResponse(names, ["y"] * 16, np.full(16, 1e-5), both, np.repeat(read, 2, axis=1))
    assert estimated_noise(ring, twice)[0, 1] == found


def test_what_the_fit_may_not_mend_is_warned_about(small_ring):
    """The held-out correctors are noise; the fitted ones are not."""
    wrong = [Cause("corrector_calibration", "v5", -2.0)]
    measured = simulate_response(
        small_ring, wrong, engine="ocelot", progress=False, seed=1
    ).measured
    found = diagnose(small_ring, measured, seed=1, effects=["monitor_gain_x"])
    assert found.verdict == "distributed"
    assert {cause.effect for cause in found.causes} <= {"monitor_gain_x", "monitor_gain_y"}
    assert found.assessment.remainder == "effect_missing"
    assert "fitted, in-plane" in [block.name for block in found.assessment.significant]


def test_a_report_shows_families_by_their_labels(result):
    rows = [row[0] for row in (*step_rows(result.steps), *family_rows(result.families))]
    assert "without quadrupole gradient" in rows
    assert "quadrupole_gradient" in [own.effect for own in result.families]
    assert not any("_" in name for name in rows)
    assert with_labels("monitor_roll end_3, new_effect") == "BPM roll end_3, new_effect"


def test_options_act_and_are_told(small_ring, measured):
    """They were ignored, and the JSON said false_alarm 0."""
    found = diagnose(
        small_ring, measured, seed=1, max_effects=1, false_alarm=0.01,
        effects=["corrector_calibration", "monitor_gain_x", "quadrupole_gradient"],
    )  # fmt: skip
    (fault,) = found.findings
    design, family, alone = found.steps
    assert design.effect == "design"
    assert [own.effect for own in found.families if own.kept] == [family.effect]
    assert alone.effect == f"{fault.effect} {fault.element}"
    options = found.as_json()["provenance"]["options"]
    assert options["effects"] == ["corrector_calibration", "monitor_gain_x", "quadrupole_gradient"]
    assert options["max_effects"] == 1
    assert options["false_alarm"] == 0.01
    with pytest.raises(MeasurementError, match="not sensitive to monitor_offset_x"):
        diagnose(small_ring, measured, effects=["monitor_offset_x"])
    with pytest.raises(MeasurementError, match="'radiation' has no meaning for an orbit response"):
        diagnose(small_ring, measured, radiation=True)


def test_what_is_missing_is_said(small_ring, measured):
    sparse = measured.select(monitors=measured.monitors[:4])
    with pytest.raises(MeasurementError, match="too few columns or BPMs determine it: state"):
        diagnose(small_ring, replace(sparse, noise=None))
    with pytest.raises(MeasurementError, match="cannot be split"):
        diagnose(small_ring, measured.select(correctors=measured.correctors[:2]))


def test_no_hypothesis_is_wanted_where_nothing_is_missing(small_ring, measured):
    none, *rows = weigh(
        fitted(small_ring, measured), ["one_sided_steps", "corrector_energy", "third_order"]
    )
    assert none.effect == "none"
    assert len(rows) == 3
    assert all(row.judgement == "excluded" for row in rows)
    assert abs(rows[0].amount) < 4 * rows[0].amount_sigma  # the simulated steps are two-sided


# --- effects that the fit does not have: made without its patterns, withheld, named ---
STEP = 1e-4


def cubic(ring, rng):
    """A monitor reads x + x^3 times 8e-4 / mm^2."""
    model = ResponseModel(ring)
    kicks = np.full(len(model.correctors), STEP / 2)
    up, down = (model.closed_orbits(model.correctors, side * kicks) for side in (1, -1))
    return (up + 8e2 * up**3) - (down + 8e2 * down**3)


def wandering_gradients(ring, rng):
    """While each corrector is stepped all focusing, and all defocusing, gradients are elsewhere."""
    focusing, defocusing = (
        [e.name for e in ring.elements if e.kind == "quadrupole" and sign * e.k1 > 0]
        for sign in (1, -1)
    )
    rows = []
    for name in ResponseModel(ring).correctors:
        both = zip((focusing, defocusing), rng.normal(0, 5e-5, 2), strict=True)
        causes = [Cause("quadrupole_gradient", q, a) for names, a in both for q in names]
        rows.append(ResponseModel(apply(ring, causes)).response([name])[0] * STEP)
    return np.array(rows)


def remembering(ring, rng):
    """A corrector is still 0.4 % of its step off when the next one is stepped."""
    rows = ResponseModel(ring).response() * STEP
    rows[1:] += 4e-3 * rows[:-1].copy()
    return rows


@pytest.mark.parametrize(
    ("made", "effect"),
    [
        (remembering, "hysteresis: a share of earlier steps"),
        (wandering_gradients, "drift of the gradients (focusing, defocusing)"),
        (cubic, "nonlinear BPMs (cubic)"),
    ],
)
def test_a_withheld_effect_is_named(small_ring, rng, made, effect):
    measured = simulate_response(
        small_ring, [], kick=STEP, noise=1e-9, engine="ocelot", progress=False, seed=4
    ).measured
    response = made(small_ring, rng) + rng.normal(0, 1e-9, measured.response.shape)
    state = fitted(small_ring, replace(measured, response=response))
    rows = {row.effect: row for row in weigh(state)}
    assert rows[effect].judgement == "helps"
    assert rows[effect] == max(rows.values(), key=lambda row: row.evidence)
    # calibrations, kept where single columns want them, take a part of what cubic monitors do
    expected = {
        "nonlinear BPMs (cubic)": (8e-4, 0.25),
        # rms of two, of which one is zero; what a corrector keeps of itself is its calibration
        "hysteresis: a share of earlier steps": (4e-3 / np.sqrt(2), 0.15),
    }  # fmt: skip
    if effect in expected:
        amount, share = expected[effect]
        assert rows[effect].amount == pytest.approx(amount, rel=share)
    if effect in expected:  # the same number in all columns
        assert rows[effect].heldout_rms_in_plane < 0.98 * rows["none"].heldout_rms_in_plane


def test_orbits_of_other_columns_explain_no_drift(small_ring, rng, monkeypatch):
    """They are as smooth and as many as those of a drift that is there."""
    measured = simulate_response(
        small_ring, [], kick=STEP, noise=1e-9, engine="ocelot", progress=False, seed=4
    ).measured
    response = wandering_gradients(small_ring, rng)
    response += rng.normal(0, 1e-9, response.shape)
    drift = HYPOTHESES["gradient_drift"]

    def scrambled(state):
        own, draw = drift.patterns(state), np.random.default_rng(17)
        by = draw.integers(8, 27, len(own))
        return np.array([np.roll(row, n, axis=1) for row, n in zip(own, by, strict=True)])

    monkeypatch.setitem(HYPOTHESES, "scrambled", replace(drift, patterns=scrambled))
    state = fitted(small_ring, replace(measured, response=response))
    _, own, other = weigh(state, ["gradient_drift", "scrambled"])
    assert [own.judgement, other.judgement] == ["helps", "excluded"]
    assert own.evidence > 100 + other.evidence


def test_two_effects_are_named_and_families_are_none_of_them(small_ring):
    """Fields of all correctors 2 cm downstream are a family of the fit: no hypothesis then."""
    places = [Cause("corrector_position", f"v{i}", 0.02) for i in range(16)]
    measured = simulate_response(
        small_ring, places, kick=STEP, noise=1e-9, engine="ocelot", progress=False, seed=4
    ).measured
    response = measured.response + 8e2 / 4 * measured.response**3
    response[1:] += 4e-3 * response[:-1].copy()
    steps = [*STEPS[:3], *(own for own in STEPS if own[0].name == "corrector_position")]
    state = fitted(small_ring, replace(measured, response=response), steps=steps)
    assert state.allows("corrector_position")
    wanted = ["hysteresis", "corrector_position", "monitor_nonlinearity"]
    none, *rows = weigh(state, wanted)
    assert [row.judgement for row in rows] == ["helps", "excluded", "helps"]
    assert none.evidence_on_top > max(row.evidence for row in rows)
    assert weigh(state, wanted[1:2])[0].heldout_rms_in_plane == pytest.approx(
        none.heldout_rms_in_plane, rel=1e-6
    )


def test_tunes_go_with_the_energy_as_ats(small_ring):
    h = 1e-4
    up, down = (np.array(ring_tunes(small_ring, side * h)) for side in (1, -1))
    lattice = AtEngine(small_ring).lattice()
    lattice.disable_6d()
    chromaticity = lattice.get_chrom()[:2]
    # AT's by energy about the orbit at that energy, in its own thick sextupoles
    assert_allclose((up - down) / (2 * h), chromaticity, rtol=0.02, atol=0.02)


def test_a_wiggler_that_focuses_is_fitted(small_ring):
    """Its vertical focusing is a step of the fit."""
    (wiggler,) = (e.name for e in small_ring.elements if e.kind == "wiggler")
    measured = simulate_response(
        small_ring, [Cause("insertion_device_focusing", wiggler, 2e-4)], kick=STEP, noise=1e-9,
        engine="ocelot", progress=False, seed=4,
    ).measured  # fmt: skip
    state = fitted(small_ring, measured, steps=[*STEPS[:3], STEPS[4], STEPS[5]])
    assert score(state, "fitted").heldout_rms_in_plane < 2e-9


def test_one_sided_steps_are_told_from_two_sided_ones(small_ring):
    measured = simulate_response(
        small_ring, [], kick=STEP, noise=1e-9, engine="ocelot", progress=False, seed=4,
        one_sided=True,
    ).measured  # fmt: skip
    row = weigh(fitted(small_ring, measured), ["one_sided_steps"])[1]
    assert row.amount_sigma < 0.15  # families that evidence keeps take up some of the curvature
    assert abs(row.amount - 1) < 4 * row.amount_sigma  # two-sided ones: 0


def test_report_and_json(small_ring, result):
    document = valid(result.as_json(), "diagnosis")
    for name in ("steps", "families"):
        own = getattr(result, name)
        assert [s["effect"] for s in document[name]] == [s.effect for s in own]
    text = report_text(result)
    assert "IDENTIFIED: 5 faults" in text  # and no small errors beside them
    assert "QD::5" in text
    (line,) = (line for line in text.splitlines() if line.startswith("beta beating, rms [%]"))
    told = [float(word) for word in line.split()[-3::2]]
    sick = apply(small_ring, [c for c in CAUSES if c.effect == "quadrupole_gradient"])
    expected, design = (twiss(TaylorNetwork.from_ring(ring)).beta for ring in (sick, small_ring))
    beat = 100 * np.sqrt(np.mean((expected / design - 1) ** 2, axis=0))
    assert np.allclose(told, beat, rtol=0.1, atol=0.02)  # the places are others


def test_more_energy_spread_than_a_beam_has_is_refused(small_ring):
    """ALS: 0.5 +- 0.08 % of it gained log evidence, where radiation makes 0.09 %."""
    spread = Cause("energy_spread", None, 4e-3)
    measured = simulate_response(
        small_ring, [spread], kick=2e-5, noise=5e-9, engine="ocelot", progress=False, seed=2
    ).measured
    found = diagnose(small_ring, measured, seed=1, effects=["energy_spread"])
    assert [step.effect for step in found.steps] == ["design"]
    assert [(own.effect, own.kept) for own in found.families] == [("energy_spread", False)]
    assert any("where radiation makes 0.11 %" in said for said in found.warnings)


def test_options_that_have_no_meaning(tmp_path, measured):
    write_measurement(tmp_path / "m", measured)
    done = tmlattice("diagnose", SMALL, "m", "--radiation", cwd=tmp_path, check=2)
    assert "--radiation has no meaning for an orbit response" in done.stderr


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("ring.mat", "names no format; end it in .json"),
        ("nowhere/ring.json", "cannot write"),
        ("D/nowhere/ring.json", "cannot write"),
        ("D/diagnosis.json", "is a file of --out"),
    ],
)
def test_the_lattice_s_place_is_checked_before_the_work(
    tmp_path, measured, monkeypatch, name, said
):
    write_measurement(tmp_path / "m", measured)
    monkeypatch.setattr("tmlattice.diagnosis.diagnose", None)  # the work would fail
    words = ("--lattice-out", name, "--out", "D")
    done = tmlattice("diagnose", SMALL, "m", *words, cwd=tmp_path, check=2)
    assert said in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"m"}


@pytest.mark.slow
def test_measured_petra3():
    """Held-out figures of the measured response; the design's are 164, 120 and 145 µm."""
    folder = measured_data("petra3_orbit_response")
    found = diagnose(load_ring(folder / "p3_low_beta.mat"), read_measurement(folder))
    last = found.steps[-1]
    assert last.heldout_rms_in_plane < 7e-6
    assert last.heldout_rms_position < 4.5e-6
    assert last.dispersion_rms < 50e-6
    assert {"bpm_nor_62", "bpm_nor_98", "bpm_ol_72", "bpm_swl_31"} <= set(found.bad_monitors)
