"""What seeded damage found once, each by hand: one sentence that says where, and exit code 2."""

import json
import os
import shutil
import subprocess
import sys
import time
import zlib
from pathlib import Path
from unittest import mock

import at
import numpy as np
import pytest
from at_ring import at_lattice
from command import tmlattice

sys.path.insert(0, str(Path(__file__).parent))
from inputs import ring, write_all

from tmlattice import batch, diagnose, load_ring, read_measurement
from tmlattice.diagnosis.families.fields import VerticalFocusing
from tmlattice.diagnosis.families.steps import MonitorGain
from tmlattice.diagnosis.response.hierarchical import fit_families
from tmlattice.importers import Options, bring_in
from tmlattice.observe.response_data import response_data, split_columns


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


def document(change):
    return lambda folder: edited(folder / "turns/measurement.json", change)


def turns(change):
    return lambda folder: rows_of(folder / "turns/readings.csv", change)


def response(change):
    return lambda folder: rows_of(folder / "response/response.csv", change)


def text(file, content):
    return lambda folder: (folder / file).write_text(content)


def pipe(folder):
    (folder / "turns/readings.csv").unlink()
    os.mkfifo(folder / "turns/readings.csv")


TURNS = ("diagnose", "ring.json", "turns")
RESPONSE = ("diagnose", "ring.json", "response")
CHECK = ("check", "ring.json", "a.csv")
CORRECT = ("correct", "ring.json", "--design", "ring.json", "--knobs", "k.csv")
WIDE = (
    "shot,m::0 x [mm],m::1 x [mm],m::2 x [mm],m::0 y [mm]\n0,0.1,{},0.3,0.1\n1,0.2,0.1,-0.1,0.2\n"
)
LONG = "9" * 200_000
WRONG = {  # a command, what was changed in a folder of every kind, and a word of the sentence
    "a key in other letters": (
        TURNS, document(lambda d: d.update(NOISE=d.pop("noise"))), "NOISE"),
    "an energy in eV": (TURNS, document(lambda d: d.update(energy_gev=3e9)), "eV"),
    "a launch outside every pipe": (
        TURNS, document(lambda d: d["shots"][0]["launch"].update(x=0.1)), "lost"),
    "a kick of a radian": (
        TURNS, document(lambda d: [shot.update(settings={"ch::0": {"kick": 1.0}})
                                   for shot in d["shots"]]), "settings"),
    "a number of 400 digits": (TURNS, document(lambda d: d.update(energy_gev=10**400)), "digits"),
    "a list in a list in a list": (
        TURNS, document(lambda d: d.update(noise=json.loads("[" * 400 + "]" * 400))), "noise"),
    "shots by the thousand without a reading": (
        TURNS, document(lambda d: d.update(shots=d["shots"] * 4_000)), "shots"),
    "one row of turn 100": (TURNS, turns(lambda rows: rows[0].update(turn="100")), "turn"),
    "all turns counted from 1": (TURNS, turns(every(turn="1")), "turn"),
    "an element that is no monitor": (
        TURNS, turns(lambda rows: rows[0].update(monitor="qf::0")), "qf::0"),
    "readings that never change": (TURNS, turns(every(x="1e-4", y="1e-4")), "the same"),
    "readings that are all zero": (TURNS, turns(every(x="0", y="0")), "zero"),
    "a response without readings": (RESPONSE, response(every(x="", y="")), ""),
    "a response of zeros": (RESPONSE, response(every(x="0", y="0")), ""),
    "one column of a response": (RESPONSE, response(lambda rows: rows[:6]), ""),
    "a pipe in place of a table": (TURNS, pipe, "readings.csv"),
    "readings far above the pipe's radius": (
        CHECK, text("a.csv", WIDE.format("1").replace("0.", "900.")),
        "most readings are above 0.2 m"),
    "a field that CSV does not take": (
        CHECK, text("a.csv", WIDE.format(LONG)), "not CSV (field larger"),
    "a setting that CSV does not take": (
        CORRECT, text("k.csv", f"knob,present\nqf,{LONG}"), "field larger than field limit"),
    "a path of supplies that no file has": (
        CORRECT[:2],
        text("tmlattice.toml", 'supplies = "k\\u0000.csv"\n[lattice]\nfile = "ring.json"\n'),
        "k\\x00.csv'"),
}  # fmt: skip


def told(done):
    """The sentence."""
    before = ("tmlattice: warning", "tmlattice: machine file")
    sentences = [s for s in done.stderr.splitlines() if not s.startswith(before)]
    assert done.returncode == 2, done.stdout
    assert sentences[0].startswith("tmlattice: ")
    return sentences[0]


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_one_sentence_that_says_where(folder, what):
    words, change, word = WRONG[what]
    change(folder)
    assert word in told(tmlattice(*words, cwd=folder))


def test_readings_a_hundred_times_too_large_are_an_answer(folder):
    """Along the way the beam is lost: that is no traceback, in Python either."""
    rows_of(folder / "turns/readings.csv", scaled(100.0))
    ring, turns = load_ring(folder / "ring.json"), read_measurement(folder / "turns")
    assert diagnose(ring, turns).verdict in ("localised", "distributed")


@pytest.mark.parametrize("suffix", ["json", "mat", "m", "repr"])
def test_an_order_of_a_field_lays_out_no_memory(tmp_path, suffix):
    """AT would make tables of 8 GB."""
    lattice = at.Lattice([*at_lattice(ring())], energy=3e9, periodicity=1)
    next(e for e in lattice if isinstance(e, at.Quadrupole)).__dict__["MaxOrder"] = 10**9
    at.save_lattice(lattice, tmp_path / f"a.{suffix}")
    assert "has the MaxOrder 1e+09" in told(tmlattice("info", f"a.{suffix}", cwd=tmp_path))


def test_what_a_ring_has_no_places_of_is_no_step_of_a_fit(whole):
    """Linear algebra of no numbers at all prints what nobody asked for, past Python."""
    data = response_data(load_ring(whole / "ring.json"), read_measurement(whole / "response"))
    split = split_columns(data, 0.2, np.random.default_rng(1))
    straights = (VerticalFocusing(),)
    assert not straights[0].count(data)
    found = fit_families(data, split, (straights, (MonitorGain(),)))
    tried = [own.effect for own in found.families]
    assert tried == [MonitorGain().title]


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


@pytest.fixture(scope="module")
def kept(whole, tmp_path_factory):
    """A folder with a diagnosis in R, and its estimated ring."""
    folder = tmp_path_factory.mktemp("kept") / "w"
    shutil.copytree(whole, folder)
    words = ("--out", "R", "--lattice-out", "found.json", "-q")
    tmlattice(*TURNS, *words, cwd=folder, check=0)
    return folder


@pytest.mark.parametrize("key", ["lattice", "lattice_out"])
@pytest.mark.parametrize("words", [("report", "R"), ("compare", "R", "R"), ("correct", "R")])
def test_a_diagnosis_runs_no_code_that_it_names(kept, tmp_path, words, key):
    folder = Path(shutil.copytree(kept, tmp_path / "w"))
    (folder / "evil.py").write_text(f"open({str(folder / 'MARK')!r}, 'w')\n")
    edited(folder / "R/diagnosis.json", lambda d: d["provenance"].update({key: "evil.py"}))
    tmlattice(*words, cwd=folder)  # the lattice next to it is data
    (folder / "R/diagnosis.lattice.json").unlink()
    said = tmlattice(*words, cwd=folder)
    if key == "lattice" or words[0] == "correct":
        assert "evil.py' is Python code, which would be run" in told(said)
    if words[0] == "correct" and key == "lattice":
        tmlattice(*words, "--design", "ring.json", "-q", cwd=folder, check=0)
    assert not (folder / "MARK").exists()


@pytest.mark.parametrize("text", ["[]", "null", '{"provenance": null}', '{"provenance": [1]}'])
def test_what_is_no_diagnosis_is_not_corrected(tmp_path, text):
    (tmp_path / "diagnosis.json").write_text(text)
    assert 'its "format" is null' in told(tmlattice("correct", ".", cwd=tmp_path))


def test_a_report_shows_no_figure_of_another_diagnosis(kept, tmp_path):
    """Nor is a pipe in place of one waited for, or another program's laid out in memory."""
    folder = Path(shutil.copytree(kept, tmp_path / "w"))
    tmlattice("report", "R", "-q", cwd=folder, check=0)
    page = folder / "R/report.html"
    assert "before any finding" in page.read_text()  # the scan, which no diagnosis.json holds
    rows_of(folder / "turns/readings.csv", scaled(1.1))
    tmlattice(*TURNS, "--json", "R/diagnosis.json", "-q", cwd=folder, check=0)
    os.mkfifo(folder / "R/maps.png")
    size = (200_000).to_bytes(4, "big")
    head = b"IHDR" + size + size + b"\x08\x02\0\0\0"
    chunk = b"\0\0\0\x0d" + head + zlib.crc32(head).to_bytes(4, "big")
    (folder / "R/steps.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    tmlattice("report", "R", "-q", cwd=folder, check=0)
    assert "before any finding" not in page.read_text()


def test_a_reading_that_no_pipe_has_room_for_is_rejected_by_name(folder):
    for value in ("-1e300", "1e9", "inf"):
        (folder / "a.csv").write_text(WIDE.format(value))
        done = tmlattice(*CHECK, cwd=folder)
        assert "rejected readings, above 0.2 m: 1, of 'm::1'" in done.stdout


@pytest.mark.parametrize("place", ["/dev/zero", "/proc/kmsg"])
@pytest.mark.parametrize("sealed", [False, True])
def test_a_table_that_never_ends_is_not_read(folder, place, sealed):
    """By a batch neither, which would wait for it or fill the memory."""
    table = folder / "turns/readings.csv"
    table.unlink()
    table.symlink_to(place)
    if sealed:
        edited(folder / "turns/measurement.json", lambda d: d.update(table_sha256="0" * 64))
    assert "readings.csv" in told(tmlattice("check", "ring.json", "turns", cwd=folder))
    files = batch.diagnose(
        folder / "ring.json", [folder / "turns"], folder / "B", jobs=1, progress=False
    )
    assert "readings.csv" in json.loads(files["turns"].read_text())["error"]


def test_streams_that_are_closed_take_no_file_s_place(folder):
    command = (
        f"'{sys.executable}' -P -m tmlattice simulate ring.json --shots 2 --engine ocelot --out"
    )
    for number, closed in enumerate((">&-", "<&- >&- 2>&-")):
        words = ["sh", "-c", f"{command} D{number} {closed}"]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        assert (done.returncode, "Traceback" in done.stderr) == (0, False)
        assert (folder / f"D{number}/readings.csv").read_text().startswith("shot,")


@pytest.mark.parametrize("suffix", ["json", "mat", "m", "repr", "tfs", "seq", "lte"])
def test_a_lattice_that_never_ends_is_not_read(tmp_path, suffix):
    (tmp_path / f"a.{suffix}").symlink_to("/proc/kmsg")
    assert "is empty" in told(tmlattice("info", f"a.{suffix}", cwd=tmp_path))


def test_deep_json_ends_in_its_own_sentence(folder):
    edited(folder / "own.json", lambda d: d.update(extra=0))
    text = (folder / "own.json").read_text()
    for depth in (150, 960, 100_000):
        deep = "[" * depth + "]" * depth
        (folder / "own.json").write_text(text.replace('"extra": 0', f'"extra": {deep}'))
        done = tmlattice("info", "own.json", cwd=folder, check=2)
        assert len(done.stderr.splitlines()) == 1


def test_a_name_of_thousands_of_words_is_searched_once(folder):
    """For runs of words that are a monitor's name: no longer ones than such a name has."""
    name = "m::1 " + "a " * 20_000
    (folder / "a.csv").write_text(WIDE.format("0.2").replace("m::1", name))
    begun = time.process_time()
    found = bring_in([folder / "a.csv"], Options(ring=load_ring(folder / "ring.json")))
    assert time.process_time() - begun < 2.0
    assert "m::1" in found.measurement.monitors


def test_init_reads_a_file_that_is_damaged_once(folder):
    """Only names that the lattice does not have are a reason to read it again."""
    (folder / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(2000))
    with mock.patch("tmlattice.lattice.mat_file.subprocess.run", wraps=subprocess.run) as read:
        said = told(tmlattice("init", "ring.json", "a.h5", cwd=folder))
    assert read.call_count == 1
    assert "a.h5' cannot be read as HDF5" in said
