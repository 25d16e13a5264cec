"""Settings of power supplies: AT is the machine that they are put into."""

import csv
import json
import re
from dataclasses import replace

import at
import numpy as np
import pytest
from command import refused
from command import tmlattice as run
from scipy.optimize import lsq_linear
from shared import valid

from tmlattice import OrbitResponse, correct, diagnose, simulate, write_measurement
from tmlattice.correction import Knob, default_knobs, read_knobs
from tmlattice.correction.applied import applied, sentence
from tmlattice.correction.estimate import Estimate, read_estimate
from tmlattice.correction.first_turn import estimate_of_turns
from tmlattice.correction.knobs import read_settings, write_knobs
from tmlattice.correction.result import read_correction
from tmlattice.correction.solve import bounded, normal
from tmlattice.correction.targets import Targets, rms_of
from tmlattice.diagnosis.twin import known_document
from tmlattice.effects import Cause, apply, find
from tmlattice.errors import (
    ChoiceError,
    MeasurementError,
    TmlatticeError,
    UnknownNameError,
    UnstableRingError,
)
from tmlattice.files import write_json
from tmlattice.inference.distributed import DistributedErrors
from tmlattice.lattice import save_ring
from tmlattice.lattice.at_file import quiet_at
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.response import simulate_response
from tmlattice.machine.shots import draw_background
from tmlattice.observe.calibration import Calibration, write_calibration

NO_ORBIT = ("beta_beating", "phase_advance", "dispersion", "tunes")


def optics(ring, causes=()):
    """By AT: beta [BPM, 2], m; dispersion [BPM, 2], m; tunes [2]."""
    lattice = AtEngine(ring, causes).lattice()
    monitors = [i for i, e in enumerate(lattice) if isinstance(e, at.Monitor)]
    _, data, found = at.get_optics(lattice, monitors, get_chrom=False, XYStep=3e-6, DPStep=1e-3)
    return found.beta, found.dispersion[:, [0, 2]], data.tune


def beating(ring, design):
    return np.sqrt(np.mean((optics(ring)[0] / optics(design)[0] - 1) ** 2, axis=0))


def set_to(ring, correction):
    """The machine with new settings: its errors stay."""
    causes = [c for s in correction.settings for c in s.knob.causes(s.amount)]
    return apply(ring, causes)


def settings_in(folder):
    """Rows of the table of settings, by device."""
    with (folder / "settings.csv").open() as file:
        return {row["device"]: row for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def quadrupoles(small_ring):
    return [e.name for e in small_ring.elements if e.kind == "quadrupole"]


@pytest.fixture(scope="module")
def wrong(small_ring, quadrupoles):
    """Errors of four magnets, so that AT's beta beating is some ten percent."""
    amounts = (0.02, -0.015, 0.01, -0.02)
    return [Cause("quadrupole_gradient", quadrupoles[3 + 7 * i], a) for i, a in enumerate(amounts)]


def test_single_quadrupoles_correct_their_own_errors(small_ring, wrong):
    machine = apply(small_ring, wrong)
    found = correct(machine, goal=small_ring, knobs=["quadrupoles"], targets=NO_ORBIT)
    assert {s.knob.name for s in found.settings[:4]} == {cause.element for cause in wrong}
    by_name = {s.knob.name: s for s in found.settings}
    for cause in wrong:
        expected = 1 / (1 + cause.amount) - 1
        assert by_name[cause.element].amount == pytest.approx(expected, rel=0.02)
        k1 = small_ring[cause.element].k1
        assert by_name[cause.element].new == pytest.approx(k1 / (1 + cause.amount), rel=5e-4)
    before, after = beating(machine, small_ring), beating(set_to(machine, found), small_ring)
    assert (before > 0.01).all()
    assert (after < 0.05 * before).all()
    predicted = [interval[0] for interval in found.before["beta_beating"]]
    np.testing.assert_allclose(predicted, before, rtol=0.01)
    for width in (80, 120):  # what fits on a terminal has the best device and every target
        lines = found.report(width, 36).splitlines()
        assert len(lines) <= 36 < len(found.report(width).splitlines())
        assert any(line.startswith(found.settings[0].knob.name) for line in lines)
        assert sum(line.startswith("beta beating") for line in lines) == 2
    one = correct(apply(small_ring, wrong[:1]), goal=small_ring, knobs=["quadrupoles"],
                  targets=NO_ORBIT)  # fmt: skip
    assert [s.knob.name for s in one.settings] == [wrong[0].element]  # few where few are enough
    assert [n for n, _ in one.gains] == [1]


def test_supplies_gain_as_in_at(small_ring, wrong, quadrupoles):
    """Two supplies that are wrong by themselves, and errors of magnets that they cannot undo."""
    supplies = [Cause("family_gradient", "QF", 0.01), Cause("family_gradient", "QD", -0.006)]
    machine = apply(small_ring, [*wrong, *supplies])
    found = correct(machine, goal=small_ring, targets=["tunes"])
    assert {s.knob.name for s in found.settings} == {"QF", "QD"}
    tunes = optics(set_to(machine, found))[2]
    np.testing.assert_allclose(tunes, optics(small_ring)[2], atol=2e-4)
    np.testing.assert_allclose(found.tunes["expected"], tunes, atol=2e-4)
    reached, _ = found.stays["beta_beating"]
    after = beating(set_to(machine, found), small_ring)
    np.testing.assert_allclose(reached, after, rtol=0.02)


def test_a_resonance_between_the_tunes_is_crossed(small_ring, quadrupoles):
    """Two supplies hold the tunes below an integer, which is above it in the design."""
    supplies = [Cause("family_gradient", "QF", -0.05), Cause("family_gradient", "QD", 0.05)]
    skew = [Cause("skew_gradient", q, 2e-3 * (-1) ** i) for i, q in enumerate(quadrupoles[::5])]
    machine, design = apply(small_ring, [*skew, *supplies]), optics(small_ring)[2]
    assert optics(machine)[2][0] - design[0] > 0.5  # of fractions: 0.82 for 1.13
    found = correct(machine, goal=small_ring, targets=NO_ORBIT)
    after = set_to(machine, found)
    np.testing.assert_allclose(optics(after)[2], design, atol=5e-4)
    assert (beating(after, small_ring) < 2e-3).all()


def test_orbit_and_coupling_in_their_units_and_signs(small_ring, quadrupoles):
    """Kicks by displaced magnets, and a skew field: by correctors and a skew quadrupole."""
    causes = [Cause("quadrupole_offset_y", quadrupoles[5], 4e-4),
              Cause("quadrupole_offset_y", quadrupoles[12], -2e-4),
              Cause("skew_gradient", "sf::4", 4e-3)]  # fmt: skip
    machine = apply(small_ring, causes)
    skew = Knob("skew", "skew_quadrupole", ("sf::4",), "A", 0.0, curve=((-10, -0.02), (10, 0.02)))
    knobs = [*default_knobs(small_ring, ["correctors"]), skew]
    found = correct(machine, goal=small_ring, knobs=knobs, targets=["closed_orbit", "coupling"])
    own = next(s for s in found.settings if s.knob.name == "skew")
    assert own.new == pytest.approx(-2.0, rel=0.05)  # A: 0.002 1/m each
    orbits = [AtEngine(r).closed_orbits([{}])[0] for r in (machine, set_to(machine, found))]
    before, after = (np.sqrt(np.mean(orbit[:, 1] ** 2)) for orbit in orbits)
    assert before > 2e-4
    assert after < 0.35 * before
    assert found.stays["closed_orbit"][0][1] == pytest.approx(after, rel=0.05)


def test_a_target_that_rises_is_named(small_ring, quadrupoles):
    """One magnet brings the tunes back, at the price of beta beating: the summary states both."""
    machine = apply(small_ring, [Cause("family_gradient", "QF", 0.01)])
    found = correct(
        machine, goal=small_ring, targets={"tunes": 1e-3, "beta_beating": 0.03},
        knobs=[replace(k, error=0.0) for k in default_knobs(small_ring, ["quadrupoles"])
               if k.name == quadrupoles[0]],
    )  # fmt: skip
    before, after = (np.array([p[0] for p in part["beta_beating"]])
                     for part in (found.before, found.after))  # fmt: skip
    assert (beating(set_to(machine, found), small_ring) > beating(machine, small_ring)).all()
    assert (after > before).all()
    for plane in np.flatnonzero(after > before):
        words = f"the beta beating in {'xy'[plane]} from {100 * before[plane]:.3g} to "
        assert words in found.words.split("It raises ")[1]
        assert words in " ".join(found.report().split())
    assert "It raises" not in correct(machine, goal=small_ring).words


def test_a_target_out_of_reach_outweighs_no_other(small_ring, wrong):
    """A dispersion of 37 tolerances that no quadrupole makes: two of them are no reason to raise
    the beta beating."""
    machine = apply(small_ring, [replace(cause, amount=cause.amount / 2) for cause in wrong])
    names = ["beta_beating", "dispersion"]
    size = 40 * Targets(small_ring, names).tolerance["dispersion"]
    rng, count = np.random.default_rng(1), len(small_ring.monitors)
    beyond = size * rng.standard_normal((count, 1)) * [1, 0]
    found = correct(Estimate(machine, small_ring, dispersion=beyond), knobs=["quadrupoles"],
                    targets=names)  # fmt: skip
    before, after = beating(machine, small_ring), beating(set_to(machine, found), small_ring)
    assert (after < before).all()
    assert after[0] < 0.4 * before[0]
    assert found.after["dispersion"][0][0] < found.before["dispersion"][0][0]


def test_the_minimum_within_limits():
    """As by scipy's least squares within bounds: many knobs are at a limit, and alike."""
    rng = np.random.default_rng(0)
    for count in (2, 6, 20, 60):
        for _ in range(10):
            slopes = rng.standard_normal((count + 5, count)) * np.exp(rng.normal(0, 1.5, count))
            slopes[:, : count // 2] += 5 * slopes[:, :1]
            slopes /= np.linalg.norm(slopes, axis=0)
            rows = 3 * rng.standard_normal(count + 5)
            low, high = -rng.uniform(0.1, 2, count), rng.uniform(0.1, 2, count)
            sigma = np.full(count, 1e-2)
            matrix, right = normal(-rows, slopes, sigma)
            found, rooted = bounded(matrix, right, low, high), np.linalg.cholesky(matrix)
            best = lsq_linear(rooted.T, np.linalg.solve(rooted, right), (low, high), "bvls").x
            values = [x @ matrix @ x / 2 - right @ x for x in (found, best)]
            assert values[0] == pytest.approx(values[1], rel=1e-6)
            assert (low <= found).all()
            assert (found <= high).all()


def test_limits_steps_and_excitation_curves(small_ring, wrong):
    machine = apply(small_ring, wrong)
    name = wrong[0].element
    k1 = small_ring[name].k1
    # 100 A make the design's strength, and half as much per ampere beyond
    curve = ((0.0, 0.0), (100.0, k1), (200.0, 1.5 * k1))
    knob = Knob(name, "quadrupole", (name,), "A", 100.0, 98.5, 120.0, 0.25, curve)
    free = replace(knob, low=-np.inf, high=np.inf, step=0.0)
    (own,) = correct(machine, goal=small_ring, knobs=[free], targets=NO_ORBIT).settings
    assert own.new < 100
    assert own.new == pytest.approx(100 * (1 + own.amount), abs=1e-9)
    (held,) = correct(machine, goal=small_ring, knobs=[knob], targets=NO_ORBIT).settings
    assert held.at_limit == (own.new <= 98.5)
    assert 98.5 <= held.new <= 120
    assert (held.new - 100) / 0.25 == pytest.approx(round((held.new - 100) / 0.25), abs=1e-6)
    tight = replace(knob, low=99.5)
    (stopped,) = correct(machine, goal=small_ring, knobs=[tight], targets=NO_ORBIT).settings
    assert stopped.new == 99.5
    assert stopped.at_limit
    rising = replace(knob, curve=((0.0, 0.0), (100.0, -k1), (200.0, -1.5 * k1)))
    assert rising.amount(rising.setting(0.2)) == pytest.approx(0.2)
    assert rising.setting(0.2) == pytest.approx(140.0)


def test_a_strength_without_limits_has_a_range(small_ring):
    """As far as undoes the largest plausible fault: 7.5 % of a family, 45 % of one magnet."""
    magnet = small_ring["QF::3"]
    machine = apply(small_ring, [Cause("quadrupole_gradient", magnet.name, -0.35)])
    family = correct(machine, goal=small_ring).settings[0].knob
    assert sorted((family.low / family.present, family.high / family.present)) == pytest.approx(
        [0.925, 1.075]
    )
    (knob,) = (k for k in default_knobs(small_ring, ["quadrupoles"]) if k.name == magnet.name)
    found = correct(machine, goal=small_ring, knobs=[knob], targets=NO_ORBIT)
    (held,) = found.settings
    assert held.at_limit
    assert held.amount == pytest.approx(0.45)
    assert f"held by their limits: {magnet.name}" in found.report()
    stated = replace(knob, low=0.0, high=2 * knob.present)
    (wide,) = correct(machine, goal=small_ring, knobs=[stated], targets=NO_ORBIT).settings
    assert 0.5 < wide.amount <= 1 / 0.65 - 1


def test_the_rf_frequency_moves_the_energy(small_ring):
    """An orbit of another energy: the RF brings it back."""
    shifted = Estimate(small_ring, small_ring)
    found = correct(replace(shifted, energy=2e-4), knobs=["rf"], targets=["closed_orbit"])
    (rf,) = found.settings
    assert rf.knob.unit == "Hz"
    back = AtEngine(small_ring).closed_orbits([{"rf": {"frequency_relative": -rf.amount}}])[0]
    dispersion = optics(small_ring)[1][:, 0]
    np.testing.assert_allclose(back[:, 0], 2e-4 * dispersion, atol=0.02 * np.ptp(back[:, 0]))


# --- uncertain rings ------------------------------------------------------------------------------
def posterior(names, rms, mean=None):
    amounts = np.zeros(len(names)) if mean is None else np.asarray(mean)
    known = DistributedErrors.usual(
        [("quadrupole_gradient", n) for n in names], {"quadrupole_gradient": rms}
    )
    return replace(known, amounts=amounts)


@pytest.mark.slow
def test_intervals_hold_what_they_state(small_ring, quadrupoles):
    """Machines drawn from the posterior, corrected alike: 68 % of their beta beating within."""
    rng = np.random.default_rng(7)
    mean = 0.01 * rng.standard_normal(len(quadrupoles))
    known = posterior(quadrupoles, 2e-3, mean)
    estimate = Estimate(small_ring, small_ring, known)
    found = correct(estimate, knobs=["quadrupoles"], targets=NO_ORBIT)
    inside = []
    for _ in range(60):
        true = mean + 2e-3 * rng.standard_normal(len(mean))
        causes = [
            Cause("quadrupole_gradient", n, a) for n, a in zip(quadrupoles, true, strict=True)
        ]
        after = beating(set_to(apply(small_ring, causes), found), small_ring)
        for (_, low, high), own in zip(found.after["beta_beating"], after, strict=True):
            inside.append(low <= own <= high)
    assert 0.55 < np.mean(inside) < 0.8
    reach, data = found.stays["beta_beating"]
    assert (np.array(data) > np.array(reach)).all()


def test_first_turns_alone_are_corrected(small_ring):
    """Without an orbit response: the estimate has an uncertainty, and supplies are set."""
    causes = [Cause("family_gradient", "QD", 0.01), Cause("family_gradient", "QF", -0.008)]
    data = simulate(small_ring, causes, shots=12, seed=3, background={"quadrupole_gradient": 1e-3})
    found = correct(diagnose(small_ring, data.measurement()), targets=["tunes"])
    machine = apply(small_ring, [*causes, *draw_background(
        small_ring, {"quadrupole_gradient": 1e-3}, 3)])  # fmt: skip
    goal = optics(small_ring)[2]
    before, after = (np.abs(optics(r)[2] - goal) for r in (machine, set_to(machine, found)))
    assert (after < 0.2 * before).all()
    for (_, low, high), true in zip(found.after["tunes"], after, strict=True):
        assert high > low
        assert true < 3 * high


def test_what_the_data_leave_undetermined_is_not_corrected(small_ring, quadrupoles):
    """No error is known, all are possible: nothing is gained, and nothing is set."""
    found = correct(
        Estimate(small_ring, small_ring, posterior(quadrupoles, 5e-3)),
        knobs=["quadrupoles"], targets=NO_ORBIT,
    )  # fmt: skip
    assert found.settings == ()
    assert "No setting is changed" in found.refused
    (head,) = found.table().splitlines()
    assert head.startswith("device,present,new,change,unit,low,high,gain")
    assert found.before == found.after
    rng = np.random.default_rng(3)
    small = posterior(quadrupoles, 5e-3, 1e-4 * rng.standard_normal(len(quadrupoles)))
    hardly = correct(Estimate(small_ring, small_ring, small), targets=["beta_beating"])
    assert not hardly.settings or hardly.gain > 2 * hardly.gain_error


def test_what_is_sure_to_gain_is_set(small_ring, quadrupoles):
    """A skew field is known, a supply's error is a tenth of its uncertainty."""
    defocusing = [name for name in quadrupoles if name.startswith("QD")]
    mean, rms = np.full(len(defocusing), 2e-3), 2e-2
    skew = Knob("skew", "skew_quadrupole", ("sf::4",), "A", 0.0, curve=((-10, -0.02), (10, 0.02)))
    knobs = [skew, *(k for k in default_knobs(small_ring, ["supplies"]) if k.name == "QD")]
    found_ring = apply(small_ring, [Cause("skew_gradient", "sf::4", 4e-3)])
    names = ["tunes", "coupling"]
    found = correct(Estimate(found_ring, small_ring, posterior(defocusing, rms, mean)),
                    knobs=knobs, targets=names)  # fmt: skip
    amounts = {s.knob.name: s.amount for s in found.settings}
    assert amounts["skew"] == pytest.approx(-4e-3, rel=0.15)
    assert abs(amounts.get("QD", 0.0)) < 1.3e-3
    assert "measure again" in found.report()
    targets, rng, worse = Targets(small_ring, names), np.random.default_rng(1), 0
    for _ in range(30):
        drawn = zip(defocusing, mean + rms * rng.standard_normal(len(mean)), strict=True)
        machine = apply(found_ring, [Cause("quadrupole_gradient", n, float(a)) for n, a in drawn])
        before, after = (
            sum(float(np.sum(own / targets.tolerance[name])) for name, own in rms_of(
                targets.errors(targets.begin(ring, 0.0).values)).items() if name in names)
            for ring in (machine, set_to(machine, found))
        )  # fmt: skip
        worse += after > before
    assert worse <= 1


def test_a_mean_that_stores_no_beam_is_shortened(small_ring, quadrupoles):
    """The linear estimate of a ring that stores a beam goes too far."""
    signs = [0.6 if name.startswith("QF") else -0.6 for name in quadrupoles]
    with pytest.raises(UnstableRingError):
        correct(apply(small_ring, [Cause("quadrupole_gradient", name, amount)
                                   for name, amount in zip(quadrupoles, signs, strict=True)]),
                goal=small_ring)  # fmt: skip
    known = posterior(quadrupoles, 1e-3, np.array(signs))
    found = correct(Estimate(small_ring, small_ring, known), targets=["tunes"])
    assert found.settings


def test_a_dispersion_that_the_errors_make_is_counted_once(small_ring):
    """A rolled bend in the posterior, and its dispersion in the calibration."""
    bend = next(e.name for e in small_ring.elements if e.kind == "bend")
    known = replace(
        posterior([], 1.0), hypotheses=(("dipole_roll", bend),), amounts=np.array([1e-3]),
        rms=np.array([1e-4]), seen=np.ones((1, 1)), share=np.array([0.9999]),
    )  # fmt: skip
    rolled = optics(apply(small_ring, [Cause("dipole_roll", bend, 1e-3)]))[1]
    names = [monitor.name for monitor in small_ring.monitors]
    beyond = dict(zip(names, (rolled - optics(small_ring)[1]).tolist(), strict=True))
    estimate = Estimate(small_ring, small_ring, known).with_beam(beyond)
    found = correct(estimate, knobs=["supplies"], targets=NO_ORBIT)
    size = np.sqrt(np.mean(rolled[:, 1] ** 2))
    assert found.before["dispersion"][1][0] == pytest.approx(size, rel=0.05)


def test_a_calibration_of_a_corrector_is_in_its_change(small_ring, quadrupoles):
    known = replace(
        posterior([], 1.0),
        hypotheses=(("corrector_calibration", "v3"),), amounts=np.array([0.25]),
        rms=np.array([0.01]), seen=np.zeros((0, 1)),
    )  # fmt: skip
    ring = apply(small_ring, [Cause("corrector_kick_y", "v3", 1e-4)])
    knobs = [k for k in default_knobs(small_ring, ["correctors"]) if k.name == "v3"]
    found = correct(Estimate(ring, small_ring, known), knobs=knobs, targets=["closed_orbit"])
    (own,) = found.settings
    assert own.new == pytest.approx(-1e-4 / 1.25, rel=0.01)


# --- tables and files -----------------------------------------------------------------------------
def test_a_table_of_knobs_comes_back(small_ring, tmp_path):
    path = tmp_path / "knobs.csv"
    knobs = default_knobs(small_ring, ["supplies", "correctors", "sextupoles", "rf"])
    write_knobs(path, knobs)
    assert read_knobs(path, small_ring) == [
        replace(k, present=pytest.approx(k.present), error=pytest.approx(k.error)) for k in knobs
    ]
    assert find("family_gradient").places(small_ring) == ["QF", "QD"]
    yaml = tmp_path / "knobs.yaml"
    yaml.write_text(
        "- {knob: QF, unit: A, present: 50, low: 45, high: 55, curve: '0:0 100:1.8'}\n"
        "- {knob: pair, kind: quadrupole, members: [QD::1, QD::3]}\n"
    )
    first, second = read_knobs(yaml, small_ring)
    assert (first.low, first.high, first.unit) == (45.0, 55.0, "A")
    assert len(first.members) == 16
    assert second.members == ("QD::1", "QD::3")
    assert first.bounds == pytest.approx((-0.1, 0.1))


@pytest.mark.parametrize(("row", "said"), [
    ("- {knob: nothing}", "state its members"),
    ("- {knob: QF, present: 0}", "present strength is 0"),
    ("- {knob: QF, low: 2, high: 1}", "limits are 2 and 1"),
    ("- {knob: QF, curve: '0:0 1:1 2:0.5', unit: A, present: 1}", "must rise, or fall"),
    ("- {knob: QF, unit: A}", "state its present setting"),
    ("- {knob: QF, step: much}", "not a number"),
    ("- {knob: QF, low: 0_9}", "not a number"),
    ("- {knob: QF, curve: '0:0 1_0:1', unit: A, present: 1}", "not a number"),
    ("- {knob: qf}\n- {knob: QF}", "occurs twice"),
    ("- {knob: QF, colour: red}", "unknown column"),
    ("- {knob: QF}\n- {knob: QF}", "occurs twice"),
    ("- {knob: QF}\n- {knob: trim, members: QF::3}", "'QF::3' is a member of 'QF' and 'trim'"),
    ("- {knob: trim, members: QF::3 QF::3}", "'QF::3' is a member of 'trim' and 'trim'"),
    ("- {knob: q, members: QF::1, kind: pump}", "no kind 'pump'"),
    ("knob: QF", "no list of knobs"),
    ("- {knob: q, members: [[QF::1]]}", "members are no list of names"),
    ("- {knob: q, members: QF::1 sf::1}", "cannot sit on 'sf::1', a sextupole"),
    ("- {knob: q, members: QF::1, kind: hcorrector}", "cannot sit on 'QF::1', a quadrupole"),
    ("knob,low,low\nQF,1,2", "the column 'low' stands twice"),
    ("knob,low\nQF,1,2", "line 2: more than the 2 fields of the header"),
    ('knob,low\n"QF,1', "line 2: not CSV"),
    ("device,new\nQF,1\n", "no device, present or new"),
    ("device,present,new\n", "contains no setting"),
    ("device,present,new\nQF,0.9,nan\n", "no device, present or new"),
    ("device,present,new\nQF,0.9,0.91\nQX,0.9,0.91\n", "'QX'.*none of this name"),
    ("device,present,new\nQF,0.9,0.91\nQF,0.9,0.91\n", "occurs twice"),
    ("device,present,new\nQF,0_9,0.91\n", "no device, present or new"),
    ("device,present,new\nQF\n", "no device, present or new"),
    ("device,present,new,change\nQF,0.9,0.91,0.02\n", "change of 'QF' is 0.02, but.* is 0.01;"),
])  # fmt: skip
def test_tables_that_cannot_be_used(small_ring, tmp_path, row, said):
    """Of knobs (.yaml or .csv), and of the settings of a correction (.csv)."""
    of_settings = row.startswith("device")
    path = tmp_path / ("knobs.csv" if row.startswith("knob,") else
                       "settings.csv" if of_settings else "knobs.yaml")  # fmt: skip
    path.write_text(row)
    with pytest.raises(MeasurementError, match=said):
        (read_settings if of_settings else read_knobs)(path, small_ring)


def test_names_that_do_not_exist(small_ring, tmp_path):
    path = tmp_path / "knobs.yaml"
    path.write_text("- {knob: q, members: QF::99}")
    with pytest.raises(UnknownNameError, match="QF::99"):
        read_knobs(path, small_ring)
    with pytest.raises(ChoiceError, match="no target 'beta'"):
        correct(small_ring, goal=small_ring, targets=["beta"])
    with pytest.raises(ChoiceError, match="no kind of knobs 'pumps'"):
        default_knobs(small_ring, ["pumps"])
    with pytest.raises(TmlatticeError, match="has no goal"):
        correct(small_ring)
    with pytest.raises(MeasurementError, match="'QF::0' is a member of 'QF' and 'QF::0'"):
        correct(small_ring, goal=small_ring, knobs=["supplies", "quadrupoles"])


def test_statements_set_the_strengths(small_ring, wrong, tmp_path):
    """AT's are run on the design: the optics are those of the new settings."""
    machine = apply(small_ring, [*wrong, Cause("family_gradient", "QF", 0.01)])
    every = default_knobs(small_ring, ["supplies"]) + [
        k for k in default_knobs(small_ring, ["quadrupoles"]) if k.name == wrong[0].element
    ]
    found = correct(machine, goal=small_ring, knobs=every[:1] + every[2:], targets=NO_ORBIT)
    alone = replace(found, settings=tuple(s for s in found.settings if s.knob.name != "QF"))
    family = replace(found, settings=tuple(s for s in found.settings if s.knob.name == "QF"))
    save_ring(small_ring, tmp_path / "design.at.json")
    for own in (alone, family):
        with quiet_at():
            ring = at.load_lattice(tmp_path / "design.at.json")
        exec(own.snippet("at"), {"ring": ring})
        expected = [e.k1 for e in set_to(small_ring, own).elements if e.kind == "quadrupole"]
        set_k1 = [e.PolynomB[1] for e in ring if isinstance(e, at.Quadrupole)]
        np.testing.assert_allclose(set_k1, expected, rtol=1e-9)
        assert set_k1 != pytest.approx([e.k1 for e in small_ring.elements
                                        if e.kind == "quadrupole"], rel=1e-6)  # fmt: skip
    assert re.fullmatch(r"qf->k1 = [\d.]+;\n", family.snippet("madx"))
    place = wrong[0].element.split("::")[1]
    assert re.match(rf"q[fd]\.\.{place}->k1 = ", alone.snippet("madx"))
    assert f"start_occurence={int(place) + 1}" in alone.snippet("elegant")


def test_on_the_command_line(small_ring, wrong, quadrupoles, tmp_path):
    save_ring(small_ring, tmp_path / "design.json")
    save_ring(apply(small_ring, wrong), tmp_path / "estimated.json")
    known = known_document(posterior(quadrupoles, 1e-4), tmp_path / "estimated.json")
    write_json(tmp_path / "estimated.json.known.json", known)
    words = ("correct", "estimated.json", "--design", "design.json", "--knobs")
    run(*words, "quadrupoles", "--example", "knobs.csv", cwd=tmp_path, check=0)
    with (tmp_path / "knobs.csv").open() as example:
        assert len(list(csv.DictReader(example))) == len(quadrupoles)
    done = run(*words, "knobs.csv", "--target", "beta_beating=0.02", "--target", "tunes", "--out",
               "out", cwd=tmp_path, check=0)  # fmt: skip
    assert "the beta beating in" in done.stdout
    assert "e-1" not in done.stdout  # rounding of an uncoupled ring is 0
    document = json.loads((tmp_path / "out" / "correction.json").read_text())
    assert document["targets"]["beta_beating"] == 0.02
    first = settings_in(tmp_path / "out")[wrong[0].element]
    assert float(first["new"]) == pytest.approx(
        small_ring[wrong[0].element].k1 / (1 + wrong[0].amount), rel=2e-3
    )
    assert document["after"]["beta_beating"][0][1] < document["after"]["beta_beating"][0][2]
    refused("correct", "estimated.json", cwd=tmp_path, says="--design")


# --- a beam that is not stored --------------------------------------------------------------------
def turns_of_at(ring, turns=20):
    """Share of the readings that a beam launched on the axis reaches, and its rms, m."""
    readings = AtEngine(ring).track(np.zeros((1, 6)), turns)[0]
    alive = np.isfinite(readings).all(axis=-1)
    return float(np.mean(np.cumsum(~alive.ravel()) == 0)), float(np.sqrt(np.nanmean(readings**2)))


def displaced(ring, rms, seed):
    rng = np.random.default_rng(seed)
    return [
        Cause(f"quadrupole_offset_{plane}", e.name, rms * rng.standard_normal())
        for e in ring.elements if e.kind == "quadrupole" for plane in "xy"
    ]  # fmt: skip


def measured_with(ring, causes, kicks, seed):
    settings = [{name: {"kick": kick} for name, kick in kicks.items()}] * 3
    made = simulate(ring, causes, shots=3, turns=2, settings=settings, seed=seed)
    return made.measurement()


@pytest.fixture(scope="module")
def kicking(ring_kicking_x):
    return ring_kicking_x("i % 2")


@pytest.fixture(scope="module")
def lost(kicking):
    """Displaced quadrupoles that lose the first turn."""
    return displaced(kicking, 3e-3, 2)


@pytest.fixture(scope="module")
def threaded(kicking, lost):
    """Measured and steered, again with all measurements so far, until AT's beam comes round:
    measurements, corrections, shares of the readings that the beam reaches."""
    machine, kicks, measured, found = apply(kicking, lost), {}, [], []
    reached = [turns_of_at(machine)[0]]
    while reached[-1] < 1.0 and len(measured) < 4:
        measured.append(measured_with(kicking, lost, kicks, len(measured)))
        found.append(correct(measured, goal=kicking, targets=["first_turn"]))
        assert [s.knob.present for s in found[-1].settings] == [
            kicks.get(s.knob.name, 0.0) for s in found[-1].settings
        ]
        kicks |= {s.knob.name: s.new for s in found[-1].settings}
        machine = set_to(machine, found[-1])
        reached.append(turns_of_at(machine)[0])
    return measured, found, reached


def test_threading_brings_a_lost_beam_round(kicking, lost):
    """Steered, AT's beam stays for twenty turns."""
    machine = apply(kicking, lost)
    reached, _ = turns_of_at(machine)
    assert reached < 0.1
    found = correct(machine, goal=kicking, targets=["first_turn"])
    assert {s.knob.kind for s in found.settings} == {"hcorrector", "vcorrector"}
    reached, rms = turns_of_at(set_to(machine, found))
    assert reached == 1.0
    assert rms < 1e-2
    assert "trajectory" in found.words
    with pytest.raises(TmlatticeError, match="give it alone"):
        correct(kicking, goal=kicking, targets=["first_turn", "tunes"])


def test_first_turns_of_a_lost_beam_thread_it(threaded):
    _, _, reached = threaded
    assert reached[0] < 0.1
    assert reached[-1] == 1.0, reached


def test_first_turns_are_steered_by_a_command(kicking, threaded, tmp_path):
    """All measurements so far in, new settings of the correctors out."""
    measured, (_, second, *_), _ = threaded
    save_ring(kicking, tmp_path / "design.json")
    for folder, own in zip(("first", "then"), measured[:2], strict=True):
        write_measurement(tmp_path / folder, own)
    words = ("--design", "design.json", "--target", "first_turn")
    run("correct", "first", "then", *words, "--out", "settings", cwd=tmp_path, check=0)
    rows = settings_in(tmp_path / "settings")
    assert set(rows) == {s.knob.name for s in second.settings}
    for s in second.settings:
        assert float(rows[s.knob.name]["present"]) == pytest.approx(s.knob.present, rel=1e-8)
        assert float(rows[s.knob.name]["new"]) == pytest.approx(s.new, rel=1e-6)
    response = OrbitResponse(("v1",), ("y",), np.ones(1), ("last_a",), np.zeros((1, 1, 2)))
    write_measurement(tmp_path / "response", response)
    words = ("correct", "response", "--design", "design.json")
    refused(*words, cwd=tmp_path, says="holds no first turns")


def test_a_loss_is_a_reading(kicking):
    """One kick behind the last BPM that reads the beam: only the loss shows it."""
    magnet = kicking["QD::5"]
    measured = measured_with(kicking, [Cause("quadrupole_offset_y", magnet.name, 0.06)], {}, 0)
    last = np.flatnonzero(np.isfinite(measured.readings[0, 0, :, 1]))[-1]
    assert kicking.monitors[last].s < magnet.s
    estimate = estimate_of_turns(kicking, [measured])
    beam = AtEngine(estimate.ring).track(np.zeros((1, 6)))[0, 0]
    assert np.isnan(beam[last + 1]).all()
    assert np.isfinite(beam[last]).all()


def test_scales_are_learnt_in_both_planes_and_carried_on(kicking):
    """Quadrupoles displaced by thirty times the usual, in a ring that loses the beam."""
    causes = displaced(kicking, 3e-3, 1)
    measured = [measured_with(kicking, causes, {}, seed) for seed in (0, 1)]
    assert not np.isfinite(measured[0].readings).all()
    first = estimate_of_turns(kicking, measured[:1]).known
    usual = find("quadrupole_offset_x").background
    rms = {name: r for (name, _), r in zip(first.hypotheses, first.rms, strict=True)}
    assert all(10 < rms[f"quadrupole_offset_{plane}"] / usual < 90 for plane in "xy"), rms
    again = estimate_of_turns(kicking, measured[1:], first)
    before, after = (np.diag(known.scales) for known in (first, again.known))
    assert (after < before).all()


def test_a_beam_is_threaded_as_far_as_it_is_known(kicking):
    """Errors behind the part that was read are unknown: they refuse no correction before it."""
    quadrupoles = [e.name for e in kicking.elements if e.kind == "quadrupole"]
    near, far = quadrupoles[:12], quadrupoles[16:]
    rng = np.random.default_rng(0)
    machine = apply(
        kicking, [Cause("quadrupole_offset_y", name, 3e-3 * rng.standard_normal()) for name in near]
    )
    known = replace(
        posterior(far, 3e-3), hypotheses=tuple(("quadrupole_offset_y", name) for name in far)
    )
    found = correct(Estimate(machine, kicking, known), targets=["first_turn"])
    assert found.settings
    read = [m.s < kicking[far[0]].s for m in kicking.monitors]
    now, then = (
        AtEngine(r).track(np.zeros((1, 6)))[0, 0][read, 1]
        for r in (machine, set_to(machine, found))
    )
    assert np.abs(then[2:]).max() < 0.5 * np.abs(now[2:]).max()


def test_what_is_known_has_no_place_twice_and_every_place():
    known = posterior(["a", "b"], 1e-3, [1.0, 2.0])
    known = known.updated(known.amounts, np.array([0.9]), np.array([[0.6, 0.8]]))
    more = known.extended([("quadrupole_gradient", p) for p in "bc"] + [("dipole_roll", "d")])
    assert [place for _, place in more.hypotheses] == ["a", "b", "c"]
    np.testing.assert_allclose(more.amounts, [1, 2, 0])
    np.testing.assert_allclose(more.errors, [*known.errors, 1e-3])


AFTER = 1.02 * (1 - 0.8 * (1 - 1 / 1.02)) - 1
"""Error of a supply that was 2 % too strong and makes four fifths of the correction asked for."""


@pytest.fixture(scope="module")
def supply(small_ring, tmp_path_factory):
    """A folder with the design, and responses to every other corrector of two machines whose
    supply QF is wrong."""
    folder = tmp_path_factory.mktemp("supply")
    save_ring(small_ring, folder / "design.json")
    some = [e.name for e in small_ring.elements if e.kind in ("hcorrector", "vcorrector")][::2]
    made = {"correctors": some, "engine": "ocelot", "progress": False, "noise": 1e-7}
    for name, amount in (("before", 0.02), ("after", AFTER)):
        causes = [Cause("family_gradient", "QF", amount)]
        write_measurement(folder / name, simulate_response(small_ring, causes, **made).measured)
    return folder


def test_diagnose_states_the_correction(small_ring, supply, tmp_path, monkeypatch):
    """A wrong supply: the terminal, the page and the table say how to set it; the files of the
    estimated ring may be in the new folder, and a terminal shows all that is printed."""
    design = supply / "design.json"
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    monkeypatch.setenv("COLUMNS", "90")
    done = run("diagnose", design, supply / "before", "--effects", "quadrupole_gradient",
               "--lattice-out", "out/found.json", "--corrected-out", "out/set.madx", "--json",
               "out/found_again.json", "--out", "out", cwd=tmp_path, check=0)  # fmt: skip
    monkeypatch.undo()
    assert "Correction: The " in done.stdout
    assert "More in report.txt" in done.stdout
    assert sum(-(-max(len(line), 1) // 90) for line in done.stdout.splitlines()) <= 40
    assert "out/found.json.known.json; out/set.madx" in done.stdout
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"found.json", "found.json.known.json", "set.madx", "found_again.json"} <= written
    run("report", "out", "--out", "redrawn", cwd=tmp_path, check=0)
    for folder in ("out", "redrawn"):
        assert '<h2 id="correction">' in (tmp_path / folder / "report.html").read_text()
    new = float(settings_in(tmp_path / "out")["QF"]["new"])
    assert new == pytest.approx(small_ring["QF::0"].k1 / 1.02, rel=1e-3)
    run("correct", "out", "--design", design, "--json", "again.json", cwd=tmp_path, check=0)
    # from the files the same answer: nothing that widens an interval is lost on the way
    first, second = (
        json.loads(path.read_text())
        for path in (tmp_path / "out" / "correction.json", tmp_path / "again.json")
    )
    for part in ("before", "after"):
        for name, planes in first[part].items():
            np.testing.assert_allclose(second[part][name], planes, rtol=1e-4, atol=1e-9)


def test_an_energy_is_as_uncertain_in_the_files_as_in_the_diagnosis(small_ring, tmp_path):
    path, energy = tmp_path / "found.json", Cause("energy_offset", None, 1e-3)
    save_ring(small_ring, path)
    errors = {("energy_offset", None): 2e-4}
    calibration = Calibration([energy], errors=errors)
    write_calibration(tmp_path / "found.json.calibration.json", calibration)
    estimate, (said,) = read_estimate(path, small_ring, small_ring)
    assert (estimate.energy, estimate.energy_error) == (1e-3, 2e-4)
    assert f"there is no '{path}.known.json'" in said


def test_applied_settings_have_a_calibration(small_ring, tmp_path):
    """A supply that makes four fifths of what it is asked for."""
    path = tmp_path / "settings.csv"
    path.write_text("device,present,new,change,unit,low,high,gain\nQF,0.9,0.909,0.009,1/m2,,,1\n")
    made = [simulate(small_ring, [Cause("family_gradient", "QF", amount)] * (amount != 0), shots=3,
                     amplitude=3e-4, noise=2e-6, engine="ocelot").measurement()
            for amount in (0.0, 0.008)]  # fmt: skip
    found = diagnose(small_ring, made[1], reference=made[0], effects=["family_gradient"])
    (own,) = applied(found, read_settings(path, small_ring))
    assert own.asked == pytest.approx(0.01)
    assert own.ratio == pytest.approx(0.8, abs=max(0.01, 3 * own.ratio_error))
    assert own.ratio_error < 0.05
    with pytest.raises(MeasurementError, match="--reference"):
        applied(diagnose(small_ring, made[1], effects=["family_gradient"]), [])
    kick = default_knobs(small_ring, ["correctors"])[0]
    (other,) = applied(found, [(kick, 1e-5)])
    assert other.error == np.inf
    assert "does not determine it" in sentence(other)


def test_settings_of_devices_of_a_table_come_back(small_ring, wrong, tmp_path):
    """The written table states members and excitation curve: the lattice need not know the name."""
    name = wrong[0].element
    k1 = small_ring[name].k1
    curve = ((0.0, 0.0), (100.0, k1), (200.0, 1.5 * k1))
    knob = Knob("PS-7", "quadrupole", (name,), "A", 100.0, 90.0, 120.0, 0.25, curve, 0.01)
    found = correct(apply(small_ring, wrong), goal=small_ring, knobs=[knob], targets=NO_ORBIT)
    found.save(tmp_path)
    ((own, new),) = read_settings(tmp_path / "settings.csv", small_ring)
    assert replace(own, curve=()) == replace(knob, curve=())
    np.testing.assert_allclose(own.curve, curve, rtol=1e-8)
    assert own.amount(new) == pytest.approx(found.settings[0].amount, rel=1e-6)


def test_a_second_iteration_and_the_way_back(small_ring, supply, tmp_path):
    """A folder of a diagnosis is corrected; a supply that makes four fifths of what it is asked for
    is corrected again, and undone. After a reference a folder holds no estimated ring."""
    design, settings = supply / "design.json", "first/settings.csv"

    def done(*words, effects="quadrupole_gradient"):
        effects = ("--effects", effects) if words[0] == "diagnose" else ()
        return " ".join(run(*words, *effects, cwd=tmp_path, check=0).stdout.split())

    def table(folder):
        row = settings_in(tmp_path / folder)["QF"]
        return {name: float(row[name]) for name in ("present", "new")}

    def corrected(name, out, *words):
        done("correct", name, "--design", design, "--target", "tunes", "--out", out, *words)
        return table(out)

    done("diagnose", design, supply / "before", "--out", "D")
    assert not (tmp_path / "D" / "settings.csv").exists()
    (tmp_path / "D").rename(tmp_path / "moved")
    first, k1 = corrected("moved", "first"), small_ring["QF::1"].k1
    assert first["new"] == pytest.approx(k1 / 1.02, rel=5e-4)
    assert "taken as certain" not in (tmp_path / "first" / "report.html").read_text()
    done("diagnose", design, supply / "after", "--settings", settings, "--lattice-out",
         "after.json", "--out", "at once")  # fmt: skip
    second, at_once = corrected("after.json", "second", "--knobs", settings), table("at once")
    assert second["present"] == at_once["present"] == first["new"]
    assert second["new"] == pytest.approx(first["new"] / (1 + AFTER), rel=2e-3)
    assert at_once["new"] == pytest.approx(second["new"], rel=2e-3)
    statement = (tmp_path / "second" / "settings.madx").read_text()
    assert float(statement.split("qf->k1 = ")[1].split(";")[0]) == pytest.approx(second["new"])
    words = ("--goal", "moved/estimated.json", "--knobs", settings)
    back = corrected("after.json", "back", *words)["new"]
    assert back == pytest.approx(first["new"] * 1.02 / (1 + AFTER), rel=2e-3)
    said = done("diagnose", design, supply / "after", "--reference", supply / "before",
                "--settings", settings, "--out", "moved", effects="family_gradient")  # fmt: skip
    assert "calibration 0.8 " in said or "calibration 0.79" in said or "calibration 0.80" in said
    assert "the same command without --reference" in said
    refused("correct", "moved", cwd=tmp_path, says="names no estimated ring")
    assert not (tmp_path / "moved" / "estimated.json.known.json").exists()


def test_a_reused_folder_holds_no_older_correction(small_ring, wrong, tmp_path):
    data = simulate(small_ring, [wrong[0]], shots=3, seed=1, engine="ocelot").measurement()
    found = diagnose(small_ring, data, effects=["quadrupole_gradient"])
    correct(apply(small_ring, wrong), goal=small_ring).save(tmp_path / "out")
    (tmp_path / "out" / "notes.txt").write_text("of another program")
    found.save(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert not [name for name in names if name.startswith(("settings.", "correction."))]
    assert names >= {"notes.txt", "diagnosis.json", "report.html"}


def test_a_report_of_a_correction_is_rendered_again(small_ring, wrong, tmp_path):
    out = tmp_path / "out"
    found = correct(apply(small_ring, wrong), goal=small_ring, knobs=["quadrupoles"])
    found.save(out)
    rows = settings_in(out)
    assert list(rows) == [s.knob.name for s in found.settings]
    shares = [float(row["gain"]) for row in rows.values()]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) == pytest.approx(1.0, abs=0.05)
    for row in rows.values():
        change = float(row["new"]) - float(row["present"])
        assert change == pytest.approx(float(row["change"]), abs=1e-8)
    document = valid(out / "correction.json", "correction")
    page = (out / "report.html").read_text()
    for name in ("report.html", "correction.png"):
        (out / name).unlink()
    run("report", out, cwd=tmp_path, check=0)
    assert (out / "report.html").read_text() == page
    again = read_correction(out / "correction.json", small_ring)
    assert again.report() == found.report()
    assert again.snippet("madx") == found.snippet("madx")
    document["settings"][0]["new"] = "much"
    (out / "correction.json").write_text(json.dumps(document))
    with pytest.raises(MeasurementError, match="much"):
        read_correction(out / "correction.json", small_ring)


def test_a_table_is_not_written_over(small_ring, tmp_path):
    save_ring(small_ring, tmp_path / "design.json")
    knobs = tmp_path / "knobs.yaml"
    knobs.write_text("- {knob: QF}\n")
    words = ("correct", "design.json", "--design", "design.json", "--knobs", knobs)
    refused(*words, "--json", knobs, cwd=tmp_path, says="is read, and would be written over")
