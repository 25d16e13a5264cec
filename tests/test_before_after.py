"""What changed between two orbit responses of one machine, simulated and measured."""

import json
import pickle
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from shared import measured_data, small_steps, valid

from tmlattice import diagnose, load_ring
from tmlattice.diagnosis.response.state import begin, bend
from tmlattice.effects import Cause, apply
from tmlattice.errors import MeasurementError
from tmlattice.lattice import save_ring
from tmlattice.measurement import read_measurement, write_measurement
from tmlattice.observe.orbit_response import Errors, Predicted, response_change
from tmlattice.observe.response_data import response_data, split_columns
from tmlattice.optics import ring_tunes
from tmlattice.report.plain import report_text

CHANGED = [Cause("family_gradient", "QF", 0.003), Cause("quadrupole_gradient", "QD::5", -0.008)]
FEW = ["family_gradient", "quadrupole_gradient", "corrector_calibration", "monitor_gain_x"]


def gradients(rng):
    """Those of every day."""
    return [
        Cause("quadrupole_gradient", f"{name}::{i}", 3e-3 * rng.standard_normal())
        for name in ("QF", "QD")
        for i in range(16)
    ]


def machine(ring, changes=(), seed=1, drift=0.0):
    """Of a ring with distributed errors; monitors and correctors drift from day to day."""
    rng = np.random.default_rng(7)
    static = gradients(rng)
    static += [
        Cause(f"monitor_gain_{p}", m.name, 0.02 * rng.standard_normal())
        for m in ring.monitors
        for p in "xy"
    ]
    day = np.random.default_rng(seed)
    drifts = [
        Cause("corrector_calibration", f"v{i}", 0.05 * rng.standard_normal()
              + drift * day.standard_normal())
        for i in range(16)
    ]  # fmt: skip
    return small_steps(ring, [*static, *drifts, *changes], seed=seed)


@pytest.fixture(scope="module")
def before(small_ring):
    return machine(small_ring)


@pytest.fixture(scope="module")
def after(small_ring):
    return machine(small_ring, CHANGED, seed=2, drift=0.01)


@pytest.fixture(scope="module")
def change(small_ring, before, after):
    return diagnose(small_ring, after, reference=before)


def with_names_of_their_own(ring, folder, form="{}_a{}"):
    """QF_a0 for QF::0: what MAD-X and many a laboratory call magnets."""
    save_ring(ring, folder / "ring.json")
    document = json.loads((folder / "ring.json").read_text())
    known = document["definitions"]
    count = Counter()
    for i, name in enumerate(document["sequence"]):
        if known[name]["kind"] == "quadrupole":
            own = form.format(name, count[name])
            count[name] += 1
            known[own] = known[name]
            document["sequence"][i] = own
    for name in count:
        del known[name]
    (folder / "ring.json").write_text(json.dumps(document))
    return load_ring(folder / "ring.json")


def test_a_supply_of_magnets_with_names_of_their_own(small_ring, tmp_path):
    """What their names begin with stands for it."""
    ring = with_names_of_their_own(small_ring, tmp_path)
    supply = Cause("family_gradient", "qf", 0.01)
    weaker = apply(ring, [supply])
    assert weaker["QF_a3"].k1 == pytest.approx(1.01 * ring["QF_a3"].k1)
    assert weaker["QD_a3"].k1 == ring["QD_a3"].k1


@pytest.mark.slow
def test_a_supply_of_magnets_that_are_alike_in_the_design_alone(
    small_ring, before, after, change, tmp_path
):
    """Where no two names begin alike, as at BESSY II and MLS (q1m1t1r, q1m2t1r, ...)."""
    ring = with_names_of_their_own(small_ring, tmp_path, "{}m{}r")
    supply = "QFm0r and 15 of its strength"
    result = diagnose(ring, after, reference=before, effects=FEW)
    found = {(own.effect, own.element): own.amount for own in result.findings}
    same = {own.effect: own.amount for own in change.findings}
    expected = {
        ("family_gradient", supply): same["family_gradient"],
        ("quadrupole_gradient", "QDm5r"): same["quadrupole_gradient"],
    }
    assert found == pytest.approx(expected, rel=0.01)  # as far as fits converge
    weaker = apply(ring, [Cause("quadrupole_gradient", "QFm3r", 0.02)])  # alike it was designed
    weaker = apply(weaker, [Cause("family_gradient", supply.upper(), 0.01)])
    for at, k1 in (("QFm3r", 1.02 * 1.01), ("QFm4r", 1.01)):
        assert weaker[at].k1 == pytest.approx(k1 * ring[at].k1)
    assert weaker["QDm3r"].k1 == ring["QDm3r"].k1
    assert pickle.loads(pickle.dumps(weaker)).supplies == ring.supplies


SINGLE = {"QF::3": 8e-3, "QF::9": -7e-3, "QF::12": 6e-3, "QD::1": 1e-2, "QD::5": -8e-3,
          "QD::11": 9e-3}  # fmt: skip


@pytest.fixture(scope="module")
def crowded(small_ring):
    """Single magnets that changed, and a supply, by far less."""
    changes = [Cause("family_gradient", "QF", 4e-4)]
    changes += [Cause("quadrupole_gradient", name, amount) for name, amount in SINGLE.items()]
    return machine(small_ring, changes, seed=2)


@pytest.mark.slow
def test_single_magnets_do_not_hide_a_small_change_of_their_supply(small_ring, before, crowded):
    """They had counted as the scatter of the supply's magnets, 8e-4, which hid its change."""
    change = diagnose(small_ring, crowded, reference=before)
    true = {("family_gradient", "qf"): 4e-4}
    true |= {("quadrupole_gradient", name): amount for name, amount in SINGLE.items()}
    found = {(own.effect, own.element): own for own in change.findings}
    assert set(found) == set(true)
    for place, own in found.items():
        assert abs(own.amount - true[place]) < 4 * own.amount_sigma
        assert own.amount_sigma < 3e-4


@pytest.mark.slow
def test_a_limit_of_findings_does_not_make_the_others_scatter(small_ring, before, crowded):
    sparse = diagnose(small_ring, crowded, reference=before, max_effects=1)
    (own,) = sparse.findings
    assert abs(own.amount - SINGLE[own.element]) < 4 * own.amount_sigma
    assert own.amount_sigma < 3e-4


@pytest.mark.slow
def test_the_largest_drift_is_no_finding(small_ring, before):
    """A gain that changed by 0.6 %, where nobody else did, explained all that differs."""
    drift = Cause("monitor_gain_y", "bpm::6", 0.006)
    after = machine(small_ring, [drift], seed=2)
    assert diagnose(small_ring, after, reference=before).findings == ()


def test_the_changed_supply_and_the_changed_magnet_are_found_and_no_other(change):
    assert change.verdict == "identified"
    found = {(own.effect, own.element): own for own in change.findings}
    supply = found.pop(("family_gradient", "qf"))
    magnet = found.pop(("quadrupole_gradient", "QD::5"))
    assert not found
    for own, true in ((supply, 0.003), (magnet, -0.008)):
        assert own.detection.statistic > 25
        assert abs(own.amount - true) < 3 * own.amount_sigma
        assert own.amount_sigma < 0.1 * abs(true)  # noise, drifts and what magnets scatter by


def test_a_measurement_against_itself_is_nothing(small_ring, before):
    same = diagnose(small_ring, before, reference=before)
    assert (same.verdict, same.findings) == ("none", ())
    assert "Nothing changed since the reference" in report_text(same)


def exchanged(measured, axis, a, b):
    order = np.arange(measured.response.shape[axis])
    order[[a, b]] = b, a
    response = np.take(measured.response, order, axis)
    if axis == 0:
        return replace(measured, response=response, kicks=measured.kicks[order])
    rf = replace(measured.rf, orbit=measured.rf.orbit[order])
    return replace(measured, response=response, rf=rf, noise=measured.noise[order])


def test_what_changed_is_found_together_with_what_was_exchanged_on_one_day(
    small_ring, before, after
):
    """Two correctors, one of each plane, in the reference; two BPMs since."""
    reference = exchanged(before, 0, 16, 5)
    result = diagnose(small_ring, exchanged(after, 1, 3, 20), reference=reference, effects=FEW)
    assert result.verdict == "localised"
    assert {own.element for own in result.findings if own.effect} == {"qf", "QD::5"}
    pairs = {frozenset(own.elements) for own in result.findings if own.effect is None}
    names = before.correctors, before.monitors
    assert pairs == {frozenset(names[axis][k] for k in pair)
                     for axis, pair in enumerate([(16, 5), (3, 20)])}  # fmt: skip
    text = " ".join(report_text(result).split())
    assert text.count("respond each as the other one did") >= 2


@pytest.mark.parametrize(("axis", "a", "b"), [(0, 4, 5), (1, 3, 20)])
def test_what_was_exchanged_on_both_days_is_no_change(small_ring, before, axis, a, b):
    """Neighbouring correctors, and BPMs; in a machine that drifts."""
    days = before, machine(small_ring, seed=5, drift=0.01)
    first, second = (exchanged(one, axis, a, b) for one in days)
    same = diagnose(small_ring, second, reference=first, effects=FEW)
    assert (same.verdict, same.findings) == ("none", ())
    (message,) = (own for own in same.warnings if own.startswith("on both days"))
    names = (before.correctors, before.monitors)[axis]
    assert {names[a], names[b]} <= set(message.replace(";", " ").split())


def test_a_bad_step_and_channels_of_one_measurement_alone_do_no_harm(small_ring):
    """A supply jumped during the step of v6, v9 was reversed, the energy is off by 2e-3."""
    energy = Cause("energy_offset", None, 2e-3)
    before = machine(small_ring, [energy])
    after = machine(small_ring, [energy, *CHANGED], seed=2, drift=0.01)
    orbits = before.response.copy()
    orbits[6] += 0.3 * orbits[10]
    fewer = replace(before, response=orbits).select(monitors=before.monitors[2:])
    kicks = np.where(np.array(after.correctors) == "v9", -1.0, 1.0)
    after = replace(after, response=after.response * kicks[:, None, None])
    other = after.select(correctors=after.correctors[1:], monitors=after.monitors[::-1])
    few = [*FEW, "energy_offset"]
    result = diagnose(small_ring, other, reference=fewer, effects=few)
    found = {own.element: own for own in result.findings}
    assert set(found) == {"qf", "QD::5", "v9"}
    assert found["v9"].effect == "corrector_calibration"
    assert abs(found["v9"].amount + 2) < 0.05  # it drifts by a per cent
    assert any(before.monitors[0].casefold() in said for said in result.warnings)
    (text,) = [text for text in result.warnings if "v6 (" in text]
    assert text.startswith("of the reference: ")
    assert "µrad in y, as behind v10)" in text
    (told,) = [said for said in result.warnings if "differs from the nominal energy by" in said]
    assert float(told.split(" by ")[1].split()[0]) == pytest.approx(energy.amount, rel=0.1)
    static = gradients(np.random.default_rng(7))  # as the machine has them
    for day, more in (("before", []), ("after", CHANGED)):
        true = ring_tunes(apply(small_ring, [*static, *more]), energy.amount)
        assert result.tunes[day] == pytest.approx(true, abs=1.5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("days", ["after", "both"])
@pytest.mark.parametrize("gone", ["y of every other monitor", "x", "across"])
def test_a_plane_that_is_not_read_takes_nothing_of_the_other(small_ring, before, after, gone, days):
    """Monitors mix the planes: what one has read alone had been lost with the other."""

    def less(measured):
        response, orbit = measured.response.copy(), measured.rf.orbit.copy()
        if gone == "across":
            own = np.array(["x", "y"]) == np.array(measured.planes)[:, None]
            response = np.where(own[:, None, :], response, np.nan)
        elif gone == "x":
            response[:, :, 0] = orbit[:, 0] = np.nan
        else:
            response[:, ::2, 1] = orbit[::2, 1] = np.nan
        return replace(measured, response=response, rf=replace(measured.rf, orbit=orbit))

    reference = less(before) if days == "both" else before
    result = diagnose(small_ring, less(after), reference=reference)
    found = {(own.effect, own.element.casefold()): own for own in result.findings}
    assert set(found) == {(own.effect, own.element.casefold()) for own in CHANGED}
    for cause in CHANGED:
        own = found[cause.effect, cause.element.casefold()]
        assert abs(own.amount - cause.amount) < 4 * own.amount_sigma


def test_a_change_is_one_of_the_beam_by_monitors_that_mix_the_planes(small_ring, before):
    """Gains, rolls and a shear of each monitor: what the beam did is what was put in."""
    rng = np.random.default_rng(5)
    data = response_data(small_ring, before)
    monitors = np.eye(2) + 0.2 * rng.standard_normal((len(before.monitors), 2, 2))
    errors = replace(Errors.none(data), monitors=monitors)
    beam = 1e-6 * rng.standard_normal(data.orbits.shape)
    read = np.einsum("mij,cmj->cmi", monitors, beam)
    change, nothing = (
        response_change(data, errors, replace(data, orbits=data.orbits + more))
        for more in (read, 0.0)
    )
    assert change.orbits - nothing.orbits == pytest.approx(beam, abs=1e-17)
    mend = np.linalg.inv(monitors)
    made = np.array(
        [[np.hypot(*(row * data.noise[m])) for row in own] for m, own in enumerate(mend)]
    )
    assert change.noise == pytest.approx(np.sqrt(2) * made)
    alone = read.copy()
    alone[..., 1] = np.nan
    in_x = response_change(data, errors, replace(data, orbits=data.orbits + alone))
    expected = read[..., 0] / monitors[:, 0, 0]
    assert (in_x.orbits - nothing.orbits)[..., 0] == pytest.approx(expected, abs=1e-17)
    assert np.isnan(in_x.orbits[..., 1]).all()


def test_a_reference_of_another_kind_or_machine_is_a_sentence(small_ring, before, after):
    with pytest.raises(MeasurementError, match="give a reference of the same kind"):
        diagnose(small_ring, after, reference=object())
    sparse = before.select(correctors=before.correctors[:2])
    with pytest.raises(MeasurementError, match="shares 2 of"):
        diagnose(small_ring, after, reference=sparse)


def test_command_report_and_json(tmp_path, monkeypatch, before, after, change):
    for name, measured in (("before", before), ("after", after)):
        write_measurement(tmp_path / name, measured)
    asked = {}

    def found(ring, measured, **options):  # the work is another test's
        (measured,) = measured.values()
        (options["reference"],) = options["reference"].values()
        asked.update(options, correctors=measured.correctors)
        return change

    monkeypatch.setattr("tmlattice.diagnosis.diagnose", found)
    words = ["diagnose", SMALL, "after", "--reference", "before"]
    done = tmlattice(*words, "--out", "out", cwd=tmp_path, check=0)
    assert asked["reference"].correctors == before.correctors == asked["correctors"]
    assert "Since the reference: 2 faults" in done.stdout
    document = valid(tmp_path / "out" / "diagnosis.json", "diagnosis")
    assert document["provenance"]["options"]["reference"] is True
    assert {own["element"] for own in document["findings"]} == {"qf", "QD::5"}
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Since the reference" in page
    assert "residuals of the reference and the result" in page
    wrong = tmlattice(*words, "--lattice-out", "r.json", cwd=tmp_path, check=2)
    assert "no meaning for a change since a reference" in wrong.stderr


@pytest.mark.slow
@pytest.mark.parametrize("null", [False, True])
def test_measured_pairs(tmp_path, null):
    """Fourteen supplies that were changed on purpose, by 0.1 to 0.75 %; and a pair of nothing."""
    names = ("07-11_a", "07-11_b") if null else ("07-17_before", "07-17_after")
    folder_of, folders = measured_data("real_rings"), []
    for name in names:
        folder = tmp_path / name
        file = folder_of / f"lnls_2014-{name}.loco.mat"
        tmlattice("import", file, "--out", folder, cwd=tmp_path, check=0)
        folders.append(folder)
    ring = load_ring(folders[0] / "lattice.json")
    first, second = (read_measurement(folder) for folder in folders)
    result = diagnose(ring, second, reference=first)
    if null:
        assert (result.verdict, result.findings) == ("none", ())
        return
    settings = [json.loads((folder_of / f"lnls_2014-{name}.setpoints.json").read_text())
                for name in names]  # fmt: skip
    currents = {
        supply.casefold(): [float(np.ravel(own[supply]["value"])[0]) for own in settings]
        for supply in settings[0]
        if supply[:3] in ("A2Q", "A6Q")
    }
    signs = {name: np.sign(b - a) for name, (a, b) in currents.items() if a != b}
    assert {own.element: np.sign(own.amount) for own in result.findings} == signs
    assert all(own.effect == "family_gradient" for own in result.findings)
    assert min(own.detection.statistic for own in result.findings) > 25  # five sigma


def test_correctors_of_the_machine_before_kick_as_they_were_fitted(small_ring, before):
    """A rolled one, one that is reversed as well, and one that kicks across alone."""
    data = response_data(small_ring, before)
    calibration, roll = np.zeros((2, len(data.kicks)))
    calibration[[4, 5, 6]], roll[[4, 5, 6]] = (0.01, -2.0, -1.0), (0.05, 0.05, 0.9)
    errors = replace(Errors.none(data), calibration=calibration, roll=roll)
    change = response_change(data, errors, data).measured
    fitted = Predicted(data, errors).kicked[:-1]
    assert np.abs(change.response - fitted).max() < 1e-5 * np.abs(fitted).max()


def test_an_unchanged_machine_leaves_nothing_of_large_steps(small_ring, before):
    """Their orbits are bent, on both days."""
    data = response_data(small_ring, before)
    large = np.append(np.full(len(data.kicks) - 1, 50.0), 1.0)  # of correctors alone
    data = replace(data, kicks=large * data.kicks, orbits=large[:, None, None] * data.orbits)
    change = response_change(data, Errors.none(data), data)
    state = bend(begin(change, split_columns(change, 0.2, np.random.default_rng(0))))
    assert np.abs(state.at.bent).max() > 1e-7
    assert np.abs(state.at.left).max() < 1e-12
