"""What seeded damage found once, each by hand: one sentence that says where, and exit code 2."""

import json
import os
import shutil
import sys
from pathlib import Path

import at
import numpy as np
import pytest
from at_ring import at_lattice
from command import tmlattice

sys.path.insert(0, str(Path(__file__).parent))
from inputs import ring, write_all

from tmlattice import diagnose, load_ring, read_measurement
from tmlattice.diagnosis.families.fields import VerticalFocusing
from tmlattice.diagnosis.families.steps import MonitorGain, Trial
from tmlattice.diagnosis.response.stepwise import fit_steps
from tmlattice.observe.response_data import response_data
from tmlattice.observe.split import split_columns

TURNS = ("diagnose", "ring.json", "turns")
RESPONSE = ("diagnose", "ring.json", "response")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    write_all(folder, challenges=False, more=False)
    return folder


@pytest.fixture
def folder(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "w"))


def edited(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def rows_of(path, change):
    head, *rows = path.read_text().splitlines()
    columns = head.split(",")
    table = [dict(zip(columns, row.split(","), strict=True)) for row in rows]
    table = change(table) or table
    text = [",".join(str(row[c]) for c in columns) for row in table]
    path.write_text("\n".join([head, *text, ""]))


def every(**values):
    def change(rows):
        for row in rows:
            row.update(values)

    return change


def scaled(factor):
    def change(rows):
        for row in rows:
            for plane in "xy":
                row[plane] = repr(factor * float(row[plane]))

    return change


DOCUMENTS = {
    "a key in other letters": (lambda d: d.update(NOISE=d.pop("noise")), "NOISE"),
    "an energy in eV": (lambda d: d.update(energy_gev=3e9), "eV"),
    "a launch outside every pipe": (lambda d: d["shots"][0]["launch"].update(x=0.1), "lost"),
    "a kick of a radian": (
        lambda d: d["shots"][0].update(settings={"ch::0": {"kick": 1.0}}), "settings"),
    "a number of 400 digits": (lambda d: d.update(energy_gev=10**400), "digits"),
    "a list in a list in a list": (
        lambda d: d.update(noise=json.loads("[" * 400 + "]" * 400)), "noise"),
    "shots by the thousand without a reading": (
        lambda d: d.update(shots=d["shots"] * 4_000), "shots"),
}  # fmt: skip
TABLES = {
    "one row of turn 100": (lambda rows: rows[0].update(turn="100"), "turn"),
    "all turns counted from 1": (every(turn="1"), "turn"),
    "an element that is no monitor": (lambda rows: rows[0].update(monitor="qf::0"), "qf::0"),
    "readings that never change": (every(x="1e-4", y="1e-4"), "the same"),
    "readings that are all zero": (every(x="0", y="0"), "zero"),
}  # fmt: skip


def told(done):
    """The sentence."""
    sentences = [s for s in done.stderr.splitlines() if not s.startswith("tmlattice: warning")]
    assert done.returncode == 2, done.stdout
    assert sentences[0].startswith("tmlattice: ")
    return sentences[0]


@pytest.mark.parametrize("what", DOCUMENTS)
def test_first_turns_whose_description_is_wrong(folder, what):
    change, word = DOCUMENTS[what]
    edited(folder / "turns/measurement.json", change)
    assert word in told(tmlattice(*TURNS, cwd=folder))


@pytest.mark.parametrize("what", TABLES)
def test_first_turns_whose_readings_are_wrong(folder, what):
    change, word = TABLES[what]
    rows_of(folder / "turns/readings.csv", change)
    assert word in told(tmlattice(*TURNS, cwd=folder))


def test_readings_a_hundred_times_too_large_are_an_answer(folder):
    """Along the way the beam is lost: that is no traceback, in Python either."""
    rows_of(folder / "turns/readings.csv", scaled(100.0))
    ring, turns = load_ring(folder / "ring.json"), read_measurement(folder / "turns")
    assert diagnose(ring, turns).verdict in ("localised", "distributed")


@pytest.mark.parametrize("what", ["empty", "zero", "one column"])
def test_responses_of_nothing(folder, what):
    change = {
        "empty": every(x="", y=""),
        "zero": every(x="0", y="0"),
        "one column": lambda rows: rows[:6],
    }[what]
    rows_of(folder / "response/response.csv", change)
    told(tmlattice(*RESPONSE, cwd=folder))


@pytest.mark.parametrize("suffix", ["json", "mat", "m", "repr"])
def test_an_order_of_a_field_lays_out_no_memory(tmp_path, monkeypatch, suffix):
    """AT would make tables of 8 GB."""
    monkeypatch.setattr("tmlattice.lattice.at_file.check_mat", lambda path: None)
    lattice = at.Lattice([*at_lattice(ring())], energy=3e9, periodicity=1)
    next(e for e in lattice if isinstance(e, at.Quadrupole)).__dict__["MaxOrder"] = 10**9
    at.save_lattice(lattice, tmp_path / f"a.{suffix}")
    assert "has the MaxOrder 1e+09" in told(tmlattice("info", f"a.{suffix}", cwd=tmp_path))


def test_what_a_ring_has_no_places_of_is_no_step_of_a_fit(whole):
    """Linear algebra of no numbers at all prints what nobody asked for, past Python."""
    data = response_data(load_ring(whole / "ring.json"), read_measurement(whole / "response"))
    split = split_columns(data, 0.2, np.random.default_rng(1))
    straights = Trial((VerticalFocusing(),), 2, 0)
    assert not straights.families[0].count(data)
    found = fit_steps(data, split, (straights, Trial((MonitorGain(),), 2, 0)))
    tried = [step.effect for step in (*found.steps[1:], *found.rejected_steps)]
    assert tried == [MonitorGain().title]


def test_a_pipe_in_place_of_a_table_is_not_waited_for(folder):
    path = folder / "turns/readings.csv"
    path.unlink()
    os.mkfifo(path)
    assert "readings.csv" in told(tmlattice(*TURNS, cwd=folder))


@pytest.mark.parametrize("place", ["lattice", "monitor"])
def test_names_steer_no_terminal(folder, place):
    evil = "\x1b]0;evil\x07\u202e"
    if place == "lattice":
        done = tmlattice("info", f"{evil}.json", cwd=folder)
    else:
        own = folder / "own.json"
        own.write_text(own.read_text().replace('"qf"', json.dumps(f"q{evil}")))
        done = tmlattice("info", "own.json", cwd=folder)
    assert not {"\x1b", "\x07", "\u202e"} & set(done.stdout + done.stderr)
