"""`tmlattice simulate` and `tmlattice effects` as a user runs them."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from command import refused, tmlattice
from conftest import SMALL

from tmlattice.effects import CATALOGUE, Cause
from tmlattice.machine import simulate
from tmlattice.measurement import read_measurement, read_truth

QUICK = ("simulate", SMALL, "--engine", "ocelot", "--amplitude", "1e-4")


def run(*arguments):
    """The exit code, and all that was printed or said."""
    done = tmlattice(*arguments, cwd=".")
    return done.returncode, done.stdout + done.stderr


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_simulate_writes_the_folder_and_the_truth(folder, small_ring):
    code, text = run(
        *QUICK, "--effect", "quadrupole_gradient qd::5 -0.02", "--effect", "energy_offset 1e-4",
        "--background", "monitor_roll", "--background", "quadrupole_gradient=2e-3",
        "--shots", 3, "--turns", 2, "--seed", 5, "--machine-seed", 1,
        "--out", "day", "--truth", "truth.json",
    )  # fmt: skip
    assert code == 0, text
    assert sorted(path.name for path in folder.rglob("*")) == [
        "day", "measurement.json", "readings.csv", "truth.json"
    ]  # fmt: skip
    for words in ("3 shots of 2 turn(s)", "noise 20 µm", "engine ocelot, seed 5",
                  "quadrupole_gradient", "QD::5", "background monitor_roll: rms 0.005 rad",
                  "background quadrupole_gradient: rms 0.002", "written: day/"):  # fmt: skip
        assert words in " ".join(text.split())  # wherever the lines break
    causes = [Cause("quadrupole_gradient", "QD::5", -0.02), Cause("energy_offset", None, 1e-4)]
    same = simulate(
        small_ring, causes, background={"monitor_roll": None, "quadrupole_gradient": 2e-3},
        engine="ocelot", amplitude=1e-4, shots=3, turns=2, seed=5, machine_seed=1,
    )  # fmt: skip
    np.testing.assert_array_equal(read_measurement("day").readings, same.measurement().readings)
    truth = read_truth("truth.json")
    assert [(e["effect"], e["element"], e["amount"]) for e in truth.effects] == [
        (c.effect, c.element, c.amount) for c in causes
    ]


def test_simulate_measures_with_given_settings(folder):
    settings = [{"v3": {"kick": 1e-5}}, {}]
    Path("settings.json").write_text(json.dumps(settings))
    code, text = run(*QUICK, "--shots", 2, "--settings", "settings.json", "--out", "day", "-q")
    assert (code, text) == (0, "")
    assert read_measurement("day").settings == tuple(settings)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--effect", "quadrupole_gradiant qd::5 -0.2"], "did you mean 'quadrupole_gradient'"),
        (["--effect", "quadrupole_gradient qd::55 -0.2"], "no element 'qd::55'; did you mean"),
        (["--effect", "quadrupole_gradient bend::1 -0.2"], "a bend; it sits on: quadrupoles"),
        (["--effect", "quadrupole_gradient -0.2"], "needs an element: quadrupoles"),
        (["--effect", "quadrupole_gradient qd::5"], "give NAME [ELEMENT] AMOUNT in quotes"),
        (["--effect", "quadrupole_gradient qd::5 much"], "give NAME [ELEMENT] AMOUNT in quotes"),
        (["--effect", ""], "give NAME [ELEMENT] AMOUNT in quotes"),
        (["--effect", "quadrupole_gradient qd::5 nan"], "the amount is nan"),
        (["--effect", "energy_offset qd::5 1e-3"], "leave 'qd::5' out"),
        (["--effect", "monitor_dead bpm::0 1", "--effect", "monitor_dead BPM::0 1"],
         "--effect 'monitor_dead bpm::0' is given twice"),
        (["--background", "monitor_roll=1e-3", "--background", "monitor_roll"],
         "--background 'monitor_roll' is given twice"),
        (["--background", "monitor_rol"], "did you mean 'monitor_roll'"),
        (["--background", "energy_offset"], "give energy_offset=RMS"),
        (["--background", "monitor_roll=much"], "'much' is no rms"),
        (["--background", "all=-1"], "zero or more"),
        (["--shots", "0"], "--shots"),
        (["--turns", "0"], "--turns"),
        (["--noise", "-1"], "--noise"),
        (["--amplitude", "0"], "--amplitude"),
        (["--amplitude", "1"], "smaller amplitude"),
        (["--engine", "madx"], "--engine"),
        (["--settings", "wrong.json"], "should be a list"),
        (["--settings", "broken.json"], "not JSON"),
        (["--settings", "three.json"], "3 settings do not fit 6 shots"),
        (["--settings", "kick.json", "--shots", "1"], "kick"),
        (["--settings", "unknown.json", "--shots", "1"], "no element 'v33'; did you mean"),
        (["--truth", "day/truth.json"], "may not lie in a measurement's folder"),
        (["--truth", "./x/../day/deeper/truth.json"], "may not lie in a measurement's folder"),
        (["--truth", "other/truth.json"], "may not lie in a measurement's folder"),
        (["--truth", "nowhere/truth.json"], "cannot write"),
        (["--truth", "taken"], "is a folder"),
        (["--out", "/dev/null/day"], "cannot write"),
        (["--out", "wrong.json", "--truth", "truth.json"], "is a file"),
    ],
)  # fmt: skip
def test_wrong_input_ends_in_one_sentence_and_leaves_nothing(folder, arguments, words):
    (folder / "other").mkdir()
    (folder / "other" / "measurement.json").write_text("{}")
    (folder / "taken").mkdir()
    for name, text in (("wrong", '{"v3": 1}'), ("broken", "[{"), ("three", "[{}, {}, {}]"),
                       ("kick", '[{"qd::5": {"kick": 1e-5}}]'),
                       ("unknown", '[{"v33": {"kick": 1e-5}}]')):  # fmt: skip
        (folder / f"{name}.json").write_text(text)
    refused(*QUICK, "--out", "day", *arguments, cwd=folder, says=words)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_folder_without_leave_to_write(folder):
    (folder / "closed").mkdir(mode=0o500)
    code, text = run(*QUICK, "--out", "closed/day")
    assert (code, "cannot write" in text) == (2, True)


def test_effects_lists_the_catalogue():
    code, text = run("effects")
    assert code == 0
    flat = " ".join(text.split())
    for name, effect in CATALOGUE.items():
        assert f" {name} {effect.unit} " in flat, name


def test_effects_as_json(folder):
    code, text = run("effects", "--json", "effects.json")
    assert (code, text) == (0, "")
    document = json.loads(Path("effects.json").read_text())
    assert (document["format"], document["version"]) == ("tmlattice-effects", 1)
    rows = {row["effect"]: row for row in document["effects"]}
    assert list(rows) == list(CATALOGUE)
    for name, effect in CATALOGUE.items():
        assert rows[name] == {
            "effect": name, "sits_on": effect.sits_on_text, "unit": effect.unit,
            "sign": effect.sign, "background_rms": effect.background,
            "largest_fault": effect.largest, "words": effect.words, "group": effect.group,
            "modelled": effect.modelled, "energy": effect.energy, "usual": effect.usual,
            "acts_on_settings": effect.acts_on_settings,
        }  # fmt: skip
    code, text = run("effects", "--json", "nowhere/effects.json")
    assert (code, "cannot write" in text) == (2, True)


def test_a_measurement_that_is_there_is_kept_unless_forced(folder):
    code, text = run(*QUICK, "--out", "day", "-q")
    assert code == 0, text
    before = {p.name: p.read_bytes() for p in (folder / "day").iterdir()}
    for more in ([], ["--kind", "orbit-response", "--corrector", "ch::0"]):
        code, text = run(*QUICK[:2], *more, "--seed", 2, "--out", "day", "--truth", "t.json", "-q")
        assert code == 2
        assert "'day' holds a measurement already" in text
        assert "--force" in text
        assert {p.name: p.read_bytes() for p in (folder / "day").iterdir()} == before
        assert not (folder / "t.json").exists()
    code, text = run(*QUICK, "--seed", 2, "--out", "day", "--force", "-q")
    assert code == 0, text
    assert (folder / "day" / "readings.csv").read_bytes() != before["readings.csv"]


def test_an_amount_in_per_cent_is_warned_of(folder):
    for amount, warned in ((-2, True), (-0.2, False)):
        fault = f"quadrupole_gradient QD::5 {amount}"
        _, said = run(*QUICK, "--effect", fault, "--shots", 1, "--out", f"of{amount}")
        assert ("-0.2 is -20 %" in said) == warned
