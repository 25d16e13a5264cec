"""The challenge is blind, its signal to noise is what it says, its scores are those by hand."""

import json
import shutil

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from shared import valid

from tmlattice.challenge import kinds, make, read_case, read_truth, run, score
from tmlattice.challenge.case import Truth, ring_of
from tmlattice.challenge.draw import Draw
from tmlattice.challenge.figures import calibration, confusion, pulls, summary
from tmlattice.challenge.kinds import Ruler, problem_of
from tmlattice.challenge.oracle import evaluate, refitted
from tmlattice.challenge.record import Places, exact, one_action
from tmlattice.challenge.score import row_of
from tmlattice.challenge.unknown import Unknown, clean_readings
from tmlattice.effects import Cause
from tmlattice.errors import TmlatticeError
from tmlattice.machine import Machine, draw_shots
from tmlattice.machine.stored_beam import simulate_dispersion

LATTICE = str(SMALL)
EFFECTS = ["quadrupole_gradient", "quadrupole_offset_y", "monitor_gain_x", "corrector_calibration"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("challenge") / "A"
    make("A", 3, 5, folder, lattice=LATTICE, effects=EFFECTS, progress=False)
    return folder


@pytest.fixture(scope="module")
def blind(made, tmp_path_factory):
    """Run, with the truth hidden beside it."""
    folder = tmp_path_factory.mktemp("blind")
    shutil.copytree(made, folder / "A")
    (folder / "A" / "truth").rename(folder / "hidden")
    results = run(folder / "A", jobs=1, progress=False, lattice=LATTICE)
    assert len(results) == 3
    assert all("error" not in result for result in results.values())
    return folder


def public(folder):
    files = [p for p in sorted((folder / "cases").rglob("*")) if p.is_file()]
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def test_a_fault_outside_the_catalogue_leaves_nothing_in_the_ring(small_ring):
    """The ring remembers AT's elements, which all machines share."""
    shots = draw_shots(small_ring, 2, seed=1)
    healthy = clean_readings(Machine(small_ring), shots)
    fault = Unknown(small_ring, "octupole", shots, healthy, np.random.default_rng(1))
    first, second = (fault.readings(1e3) for _ in range(2))
    assert np.abs(first - healthy).max() > 1e-7
    assert (second == first).all()
    assert (clean_readings(Machine(small_ring), shots) == healthy).all()


def test_cases_are_those_of_the_seed_whatever_their_number(made, tmp_path):
    make("A", 2, 5, tmp_path / "same", lattice=LATTICE, effects=EFFECTS, progress=False)
    make("A", 1, 6, tmp_path / "other", lattice=LATTICE, effects=EFFECTS, progress=False)
    first, same = public(made), public(tmp_path / "same")
    assert same
    assert all(first[name] == content for name, content in same.items())
    other = public(tmp_path / "other")
    assert other["cases/0000/fit/readings.csv"] != first["cases/0000/fit/readings.csv"]


def test_the_public_part_holds_no_truth(made):
    text = b"".join(public(made).values()).decode() + (made / "challenge.json").read_text()
    for name in ("0000", "0001", "0002"):
        truth = read_truth(made, name)
        case = json.loads((made / "cases" / name / "case.json").read_text())
        assert set(case) == {"format", "version", "lattice", "reference", "options"}
        assert case["options"] == {}
        assert repr(truth.causes[0].amount) not in text
        assert str(truth.seed) not in text
        for launch in truth.launches["fit"][:, :4].ravel():  # the beam's own, not what was asked
            assert repr(float(launch)) not in text
    assert "signal_to_noise" not in text
    assert '"causes"' not in text


def test_every_case_sets_correctors_so_that_settings_betray_nothing(made):
    for name in ("0000", "0001", "0002"):
        fit = read_case(made, name).fit
        assert len({json.dumps(s, sort_keys=True) for s in fit.settings}) == 4
        kicks = [abs(c["kick"]) for setting in fit.settings for c in setting.values()]
        assert all(2e-5 <= kick <= 5e-5 for kick in kicks)


@pytest.mark.parametrize("name", ["0000", "0001", "0002"])
def test_signal_to_noise_by_brute_force_with_at(made, small_ring, name):
    truth, case = read_truth(made, name), read_case(made, name)
    sick, healthy = Machine(small_ring, truth.causes), Machine(small_ring)

    def read(machine, launches):
        state = np.zeros((len(launches), 6))
        state[:, :4], state[:, 5] = launches[:, :4], launches[:, 4]
        return machine.monitors.read(machine.beam(state, 1, case.fit.settings))[:, 0]

    launches = truth.launches["fit"]
    change = (read(sick, launches) - read(healthy, launches)).reshape(4, -1)
    total = 0.0
    for shot in range(4):
        columns = []
        for k in range(4):
            step = np.zeros((4, 5))
            step[:, k] = 1e-6
            slope = read(healthy, launches + step) - read(healthy, launches - step)
            columns.append(slope[shot].ravel() / 2e-6)
        J = np.array(columns).T
        left = change[shot] - J @ np.linalg.lstsq(J, change[shot], rcond=None)[0]
        total += float(left @ left)
    expected = np.sqrt(total) / truth.noise
    # the launch's slopes are the model's there and AT's here
    assert truth.signal_to_noise[0] == pytest.approx(expected, rel=5e-3)
    assert 5 * 0.98 <= expected <= 100 * 1.02


def test_run_needs_no_truth_and_score_does(blind, tmp_path):
    shutil.copytree(blind, tmp_path, dirs_exist_ok=True)
    folder = tmp_path / "A"
    written = {p.name: p.stat().st_mtime_ns for p in (folder / "results").iterdir()}
    run(folder, jobs=1, progress=False, lattice=LATTICE)  # nothing is done twice
    assert written == {p.name: p.stat().st_mtime_ns for p in (folder / "results").iterdir()}
    with pytest.raises(TmlatticeError, match="truth"):
        score(folder, progress=False, lattice=LATTICE)
    (tmp_path / "hidden").rename(folder / "truth")
    result = score(folder, jobs=1, progress=False, lattice=LATTICE)
    assert result["cases"] == 3
    assert not result["failed"]
    valid(result, "challenge")
    methods = {"tool", "oracle", "omp", "lasso", "svd_gradients", "weight_change"}
    assert methods <= set(result["rows"][0]["answers"])


def test_the_oracle_finds_something_in_noise_at_the_stated_rate(tmp_path):
    make("E", 1, 3, tmp_path, lattice=LATTICE, progress=False)
    oracle = refitted(read_case(tmp_path, "0000"), read_truth(tmp_path, "0000"))
    metric = oracle.problem.metric(oracle.start.point)
    draws = np.random.default_rng(99).standard_normal((4000, len(oracle.start.residual)))
    sums = metric.products(oracle.seen.hypotheses, metric.projection.out(draws))
    seen = oracle.seen.information > 0
    largest = (sums.inner[seen] ** 2 / (sums.whole - sums.inside)[seen, None]).max(axis=0)
    found = (largest > oracle.seen.threshold(5e-3)).sum()
    assert 6 <= found <= 45  # 20 expected; Poisson, and N known to 15 %


def test_the_oracle_of_several_causes_is_given_the_others(tmp_path):
    make("C", 1, 2, tmp_path, lattice=LATTICE, effects=EFFECTS, signal=(30, 60), progress=False)
    case, truth = read_case(tmp_path, "0000"), read_truth(tmp_path, "0000")
    judged = evaluate((case, truth))
    assert len(judged["oracles"]) == len(truth.causes) > 1
    for cause, said in zip(truth.causes, judged["oracles"], strict=True):
        assert (cause.effect, cause.element) in {
            (member["effect"], member["element"]) for member in said["class"]
        }
    # what the others do is gone from its data: the rest is noise
    told, untold = refitted(case, truth, truth.causes[1:]), refitted(case, truth)
    freedom = told.problem.freedom
    assert told.left == pytest.approx(freedom, abs=6 * np.sqrt(2 * freedom))
    assert untold.left > told.left + 100


# --- scores by hand ---
def truth_of(*causes, background=(), alone=(), snr=30.0):
    every = tuple(snr for _ in causes)
    return Truth("x", "A", causes, None, every, snr, dict(background), 1e-3, 2e-5, 0, {}, {},
                 dict(alone))  # fmt: skip


def finding(*members, amount=0.1, sigma=0.01, s=None):
    effect, element, probability = members[0]
    return {
        "effect": effect,
        "element": element,
        "s": s,
        "amount": amount,
        "amount_sigma": sigma,
        "probability": probability,
        "credible_set": [{"effect": e, "element": n, "probability": p} for e, n, p in members],
        "mass": sum(p for _, _, p in members),
    }


def result_of(*findings, verdict="identified"):
    gap = {"explained": None, "heldout": None}
    return {
        "verdict": verdict,
        "findings": list(findings),
        "gap": gap,
        "next_measurement": None,
        "seconds": 1.0,
    }


@pytest.fixture
def quads(small_ring):
    return [e for e in small_ring.elements if e.kind == "quadrupole" and e.k1 != 0]


def rows_by_hand(small_ring, quads):
    """One right, one equivalent, one refused, one with nothing found."""
    places = Places(small_ring)
    name, other = quads[0].name, quads[-1].name
    truth = truth_of(Cause("quadrupole_gradient", name, 0.08))
    results = [
        result_of(finding(("quadrupole_gradient", name, 1.0))),
        result_of(
            finding(("quadrupole_roll", name, 0.6), ("quadrupole_gradient", name, 0.4)),
            verdict="ambiguous",
        ),
        result_of(
            {**finding((None, None, 1.0), s=quads[-1].s), "credible_set": [], "mass": 0.0},
            verdict="localised",
        ),
        result_of(verdict="none"),
        result_of(finding(("quadrupole_gradient", other, 0.9))),
    ]
    rows = [row_of(result, truth, None, None, places) for result in results]
    for row in rows:
        row |= {"clean_before": 1.0, "clean_after": 0.04}
    rows[3]["clean_after"] = 1.0
    return rows


def test_rates_by_hand(small_ring, quads):
    found = summary(rows_by_hand(small_ring, quads), "A")
    tool = {key: value["share"] for key, value in found["methods"]["tool"].items()}
    assert tool["detected"] == 4 / 5
    assert tool["first"] == 1 / 5
    assert tool["in_set"] == 2 / 5
    assert tool["effect_first"] == 2 / 5
    assert tool["effect_in_set"] == 3 / 5
    assert tool["element_first"] == 2 / 5
    assert tool["place"] == 2 / 5  # the last quadrupole is far from the first
    assert found["false_refusals"]["share"] == 1 / 5
    assert found["coverage"]["holds_truth"]["share"] == 2 / 3
    assert found["coverage"]["holds_truth"]["cases"] == 3
    assert found["coverage"]["mean_stated_mass"] == pytest.approx((1 + 1 + 0.9) / 3)
    assert found["clean_gap_closed"]["within_5_percent"]["share"] == 4 / 5
    assert found["verdicts"] == {"identified": 2, "ambiguous": 1, "localised": 1, "none": 1}


def test_confusion_calibration_and_pulls_by_hand(small_ring, quads):
    rows = rows_by_hand(small_ring, quads)
    assert confusion(rows) == {
        "quadrupole_gradient": {"quadrupole_gradient": 2, "ambiguous": 1, "unknown": 1, "none": 1}
    }
    bins = {b["from"]: b for b in calibration(rows)}
    assert bins[0.95]["true"]["share"] == 1.0
    assert bins[0.4]["true"]["share"] == 1.0
    assert bins[0.6]["true"]["share"] == 0.0
    assert bins[0.9]["stated"] == pytest.approx(0.9)
    assert rows[0]["answers"]["tool"]["pull"] == pytest.approx((0.1 - 0.08) / 0.01)
    found = pulls([-1.0, 1.0, None, 3.0])
    assert (found["cases"], found["mean"], found["width"]) == (3, 1.0, 2.0)


def test_within_one_monitor_gap_counts_monitors_between(small_ring):
    places = Places(small_ring)
    m = [s for i, s in enumerate(places.monitors) if i == 0 or s - places.monitors[i - 1] > 0.01]
    places.monitors = m  # without pairs at one place
    assert places.between(m[0] + 0.001, m[1] - 0.001) == 0
    assert places.between(m[0], m[1]) == 0  # monitors next to each other
    assert places.between(m[0] - 0.001, m[0] + 0.001) == 1
    assert places.between(m[2] + 0.001, m[0] - 0.001) == 3


def test_one_action_by_hand(small_ring):
    """A thin gradient in the quadrupole has the true action; its roll or a neighbour has not."""
    true = Cause("quadrupole_gradient", "QD::5", 0.08)

    def told(effect, element, verdict="identified", more=0):
        recommended_action = {"effect": effect, "element": element}
        one = {**finding((effect, element, 1.0)), "recommended_action": recommended_action}
        return one_action(result_of(*[one] * (1 + more), verdict=verdict), true, small_ring)

    assert told("quadrupole_gradient", "QD::5")
    assert not told("quadrupole_roll", "QD::5")
    assert not told("quadrupole_gradient", "QD::6")
    assert not told("quadrupole_gradient", "QD::5", more=1)
    assert not told("quadrupole_gradient", "QD::5", verdict="ambiguous")
    thin = Cause("gradient_absolute", "QD::5", 0.01)
    one = {**finding(("x", "QD::5", 1.0)),
           "recommended_action": {"effect": "quadrupole_gradient", "element": "QD::5"}}  # fmt: skip
    assert one_action(result_of(one), thin, small_ring)


def test_several_causes_need_a_finding_each():
    a, b = Cause("quadrupole_roll", "q1", 1.0), Cause("dipole_field", "b1", 1.0)
    fa = finding(("quadrupole_roll", "q1", 0.5), ("dipole_field", "b1", 0.5))
    fb = finding(("dipole_field", "b1", 1.0))
    assert exact(result_of(fa, fb), (a, b))
    assert exact(result_of(fb, fa), (a, b))
    assert not exact(result_of(fa), (a, b))
    assert not exact(result_of(fb, fb), (a, b))
    assert not exact(result_of(fa, fb, fb), (a, b))


def scored(folder, tier, cases, lattice=LATTICE, **options):
    """A challenge made, run and scored; no case may fail."""
    make(tier, cases, 20, folder / tier, lattice=lattice, progress=False, **options)
    run(folder / tier, jobs=1, progress=False, lattice=LATTICE)
    found = score(folder / tier, jobs=1, oracle=False, progress=False, lattice=LATTICE)
    assert not found["failed"]
    return found


@pytest.mark.slow
def test_a_fixed_set_of_single_faults_keeps_its_rates(tmp_path):
    """Bounds leave room for one case of chance: a loss of a tenth of the rates breaks them."""
    found = scored(tmp_path, "A", 16, signal=(20.0, 100.0))
    tool = {key: value["share"] for key, value in found["bands"]["above 20"]["tool"].items()}
    assert tool["detected"] == 1.0
    assert tool["place"] >= 15 / 16
    assert tool["element_in_set"] >= 15 / 16
    assert tool["effect_in_set"] >= 15 / 16
    assert found["coverage"]["median_elements"] <= 2
    assert found["false_refusals"]["share"] <= 1 / 16
    assert abs(found["pulls"]["mean"]) < 0.8  # three standard errors of fourteen


@pytest.mark.slow
def test_a_fixed_set_without_a_fault_stays_silent(tmp_path):
    # 1 expected at a rate of 5 %; four or more have 2 % there, and 59 % at a rate of 20 %
    assert scored(tmp_path, "E", 20)["false_alarms"]["share"] <= 3 / 20


def test_another_seed_or_lattice_is_another_challenge(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SMALL, "ring.py")
    folder, options = tmp_path / "set", {"lattice": "ring.py", "shots": 2, "progress": False}
    make("A", 1, 1, folder, **options)
    with pytest.raises(TmlatticeError, match="contains another challenge"):
        make("A", 2, 2, folder, **options)
    ring = (tmp_path / "ring.py").read_text()
    (tmp_path / "ring.py").write_text(ring.replace("k = 0.9\n", "k = 0.91\n"))
    ring_of.cache_clear()
    for again in (run, score):
        with pytest.raises(TmlatticeError, match=r"was made with another 'ring\.py'"):
            again(folder, jobs=1, progress=False, lattice="ring.py")
    ring_of.cache_clear()


def test_a_damaged_result_or_truth_is_reported_and_not_fatal(blind, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(blind / "A", folder)
    shutil.copytree(blind / "hidden", folder / "truth")
    whole = (folder / "results" / "0000.json").read_text()
    (folder / "results" / "0000.json").write_text(json.dumps(json.loads(whole) | {"seconds": "x"}))
    found = score(folder, jobs=1, oracle=False, progress=False, lattice=LATTICE)
    assert set(found["failed"]) == {"0000"}
    (folder / "results" / "0000.json").write_text('{"verdict": null}')
    (folder / "truth" / "0001.npz").write_bytes(b"PK\3\4 cut off")
    found = score(folder, jobs=1, oracle=False, progress=False, lattice=LATTICE)
    assert set(found["failed"]) == {"0000", "0001"}
    assert len(found["rows"]) == 1
    (folder / "results" / "0002.json").unlink()
    found = score(folder, jobs=1, oracle=False, progress=False, lattice=LATTICE)
    assert found["not_run"] == ["0002"]
    (folder / "cases" / "0002" / "case.json").write_text("[]")
    done = tmlattice(
        "dev", "challenge", "run", folder, "--jobs", 1, "--lattice", LATTICE, cwd=tmp_path
    )
    assert done.returncode == 1
    assert "case 0002" in done.stdout


# --- cases of every kind of measurement: blind, as clearly seen as they say, and scored -----------
OF_KINDS = ["quadrupole_gradient", "skew_gradient", "monitor_gain_x"]


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    folder = tmp_path_factory.mktemp("challenge") / "M"
    make(
        "M", 2, 3, folder, lattice=LATTICE, effects=OF_KINDS, signal=(30, 60), progress=False,
        kinds=["trajectory", "dispersion"],
    )  # fmt: skip
    return folder


def test_the_public_part_of_kinds_holds_no_truth(several):
    files = [p for p in sorted((several / "cases").rglob("*")) if p.is_file()]
    text = b"".join(p.read_bytes() for p in files if p.suffix != ".npz").decode()
    for name in ("0000", "0001"):
        truth, case = read_truth(several, name), read_case(several, name)
        assert set(case.measured) == {"trajectory", "dispersion"}
        assert repr(truth.causes[0].amount) not in text
        assert str(truth.seed) not in text
    assert '"alone"' not in text


def test_signal_to_noise_of_a_kind_by_brute_force_with_at(small_ring):
    """A dispersion has no nuisance: it is the change that AT makes, over its noise."""
    fault = Cause("quadrupole_gradient", "QD::3", -4e-3)
    sick, healthy = (
        simulate_dispersion(small_ring, causes, seed=4).measured for causes in ([fault], [])
    )
    ruler = Ruler(problem_of(small_ring, {"dispersion": healthy}, {}, {}))
    change = sick.steps[0].orbit - healthy.steps[0].orbit  # of one seed: the noise is gone
    expected = np.linalg.norm(change / np.asarray(healthy.noise))
    assert ruler.of([fault]) == pytest.approx(expected, rel=0.01)  # second-order maps


def test_what_no_stored_beam_survives_is_smaller_until_one_does(small_ring, tmp_path):
    """30 % of a quadrupole has no closed orbit here; it is drawn all the same."""
    make(
        "M", 3, 2, tmp_path, lattice=LATTICE, effects=["quadrupole_gradient"], signal=(20, 30),
        progress=False, kinds=["dispersion", "tunes"],
    )  # fmt: skip
    for name in ("0000", "0001", "0002"):
        (cause,) = read_truth(tmp_path, name).causes
        assert 0 < abs(cause.amount) < 0.3


def test_each_kind_alone_and_all_together_are_scored(several):
    results = run(several, jobs=1, progress=False, lattice=LATTICE)
    assert all(set(r["alone"]) == {"trajectory", "dispersion"} for r in results.values())
    result = score(several, jobs=1, progress=False, lattice=LATTICE)
    valid(result, "challenge")
    assert not result["failed"]
    assert result["measured_kinds"] == ["trajectory", "dispersion"]
    names = {"tool", "alone: trajectory", "alone: dispersion", "oracle", "omp", "lasso"}
    for row in result["rows"]:
        assert names <= set(row["answers"])
        assert row["answers"]["tool"]["in_set"]
        assert row["answers"]["oracle"]["in_set"]
    told = result["together"]
    assert told["of_found_alone"]["cases"] + told["of_none_alone"]["cases"] == 2


def test_scoring_again_reads_no_table(several, monkeypatch):
    """Tables of turns take longer to be read than all else takes where the oracle was asked."""
    run(several, jobs=1, progress=False, lattice=LATTICE)
    score(several, jobs=1, progress=False, lattice=LATTICE)

    def read(*args, **options):
        raise AssertionError("a table was read")

    monkeypatch.setattr("tmlattice.challenge.case.read_measurement", read)
    assert not score(several, jobs=1, progress=False, lattice=LATTICE)["failed"]


def test_the_oracle_weighs_the_truth_by_the_full_model(several):
    case, truth = read_case(several, "0000"), read_truth(several, "0000")
    found = refitted(case, truth)
    (cause,) = truth.causes
    at = found.seen.hypotheses.index((cause.effect, cause.element))
    assert found.statistic[at] > found.statistic.max() - 9
    assert found.statistic[at] == pytest.approx(truth.total**2, rel=0.5)  # one draw of noise
    assert found.amount[at] == pytest.approx(cause.amount, rel=0.2)


def test_an_effect_that_no_amount_makes_small_is_drawn_in_vain():
    """An RF that comes on with any loss of energy makes what is seen, not the loss."""

    class Sudden:
        def of(self, causes):
            return 150.0 + causes[0].amount

    draw = Draw(np.random.default_rng(0), (5.0, 100.0))
    assert draw.sized(Sudden(), [Cause("radiation_loss_bends", None, 1.0)], 20.0) is None
    assert draw.unreachable[0][:2] == ("radiation_loss_bends", None)
    (kept,) = draw.sized(Sudden(), [Cause("radiation_loss_bends", None, 1.0)], 140.0)
    assert kept.amount > 0


def test_a_cause_is_drawn_among_what_is_measured_of_the_case(monkeypatch, tmp_path):
    """A monitor that counts its turns late is no fault where no turns are read."""
    seen = []

    def drawn(asked, draw, ruler, machine):
        seen.append((asked.kinds, [part.monitors for part in ruler.problem.parts]))
        raise TmlatticeError("enough")

    monkeypatch.setattr(kinds, "_drawn", drawn)
    with pytest.raises(TmlatticeError, match="enough"):
        make(
            "M", 1, 2, tmp_path, lattice=LATTICE, progress=False,
            kinds=["closed_orbit", "tunes", "dispersion", "trajectory"],
        )  # fmt: skip
    ((asked, parts),) = seen
    assert len(asked) == len(parts) < 4


def test_what_many_find_where_one_does_not_by_hand(small_ring):
    right = finding(("quadrupole_gradient", "QD::3", 1.0))
    truth = truth_of(Cause("quadrupole_gradient", "QD::3", 0.1), alone={"a": 1.0, "b": 2.0})
    found = {True: result_of(right), False: result_of(verdict="none")}
    rows = []
    for together, alone in ((True, True), (False, True), (True, False), (True, False)):
        said = found[together] | {"alone": {"a": found[False], "b": found[alone]}}
        rows.append(row_of(said, truth, None, None, Places(small_ring)))
        rows[-1] |= {"clean_before": None, "clean_after": None}
    told = summary(rows, "M")["together"]
    assert (told["of_found_alone"]["share"], told["of_found_alone"]["cases"]) == (0.5, 2)
    assert (told["of_none_alone"]["share"], told["of_none_alone"]["cases"]) == (1.0, 2)


def test_small_errors_are_no_false_alarm_where_there_are_some(small_ring):
    errors = {"quadrupole_gradient": 1e-3}
    said = result_of(verdict="distributed") | {"priors": errors}
    for background, share in ((errors, 0.0), ({}, 1.0)):
        row = row_of(said, truth_of(background=background), None, None, Places(small_ring))
        assert summary([row], "E")["false_alarms"]["share"] == share


def test_kinds_that_make_no_sense_are_a_sentence(tmp_path):
    told = [
        (("T",), {"kinds": ["tunes"]}, "tiers E, M and P"),
        (("M",), {"kinds": ["tunes"]}, "two of them"),
        (("P",), {"kinds": ["turns"]}, "no kind 'turns'"),
        (("R",), {"known_rms": True}, "leave known_rms out"),
    ]
    for (tier,), options, said in told:
        with pytest.raises(TmlatticeError, match=said):
            make(tier, 1, 0, tmp_path / tier, lattice=LATTICE, progress=False, **options)


def test_the_command_makes_kinds(tmp_path):
    for words in (
        ("make", "E", "--kind", "tunes", "--cases", "1", "--out", "e"),
        ("run", "e", "--jobs", "1"),
        ("score", "e", "--jobs", "1"),
    ):
        told = tmlattice(
            "dev", "challenge", *words, "--lattice", LATTICE, cwd=tmp_path, check=0
        )  # fmt: skip
    assert "false alarms" in told.stdout
