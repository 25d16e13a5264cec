"""Outputs: whole or not there, never an input, a device or somebody else's work."""

import contextlib
import errno
import fcntl
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL

from tmlattice import files, read_measurement
from tmlattice.errors import MeasurementError
from tmlattice.files import OutputError, check_writable, output_file, output_folder
from tmlattice.measurement import Measurement, write_measurement
from tmlattice.temporaries import PREFIX, exchange


def litter(folder):
    return [path.name for path in Path(folder).rglob(f"{PREFIX}*")]


def write_pair(folder, text, names=("a", "b")):
    with output_folder(folder) as temporary:
        for name in names:
            (temporary / name).write_text(text)


def test_a_folder_never_holds_files_of_two_runs(tmp_path):
    folder = tmp_path / "out"
    write_pair(folder, "0")
    (folder / "mine").write_text("mine")
    mixed, seen, end = [], [], threading.Event()

    def watch():
        while not end.is_set():
            handle = os.open(folder, os.O_RDONLY)  # one and the same folder for both readings
            texts = []
            with contextlib.suppress(FileNotFoundError):  # it was exchanged, and is on its way out
                for name in ("a", "b"):
                    file = os.open(name, os.O_RDONLY, dir_fd=handle)
                    texts.append(os.read(file, 10))
                    os.close(file)
                seen.append(texts[0])
            os.close(handle)
            if len(set(texts)) > 1:
                mixed.append(texts)

    watcher = threading.Thread(target=watch)
    watcher.start()
    for number in range(100):
        write_pair(folder, str(number))
    end.set()
    watcher.join()
    assert not mixed
    assert len(seen) > 10
    assert (folder / "mine").read_text() == "mine"
    assert not litter(tmp_path)


def test_two_writers_leave_the_folder_of_one_of_them(tmp_path):
    folder = tmp_path / "out"
    wrong = []

    def write(text):
        for number in range(40):
            try:
                write_pair(folder, f"{text} {number}")
            except OutputError as error:  # the other one exchanged it at this moment
                wrong.append(str(error))

    both = [threading.Thread(target=write, args=(text,)) for text in ("one", "other")]
    for writer in both:
        writer.start()
    for writer in both:
        writer.join()
    assert not wrong
    assert len({(folder / name).read_text() for name in "ab"}) == 1
    assert not litter(tmp_path)


def test_what_fails_leaves_the_folder_as_it_was(tmp_path):
    folder = tmp_path / "deep" / "out"
    with pytest.raises(ZeroDivisionError), output_folder(folder):
        raise ZeroDivisionError
    assert not any(tmp_path.iterdir())
    write_pair(folder, "old")
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.raises(ZeroDivisionError))
        temporary = stack.enter_context(output_folder(folder))
        (temporary / "a").write_text("new")
        raise ZeroDivisionError
    assert [(folder / name).read_text() for name in "ab"] == ["old", "old"]


@pytest.mark.parametrize("why", ["folders in it", "somebody stands in it", "no exchange"])
def test_a_folder_that_cannot_be_exchanged_keeps_what_it_has(tmp_path, monkeypatch, why):
    folder = tmp_path / "out"
    write_pair(folder, "old")
    (folder / "mine").write_text("mine")
    if why == "folders in it":
        (folder / "figures").mkdir()
    elif why == "somebody stands in it":
        monkeypatch.chdir(folder)
    else:
        monkeypatch.setattr(files, "exchange", lambda *_: False)
    before = folder.stat().st_ino
    write_pair(folder, "new")
    assert folder.stat().st_ino == before
    assert [(folder / name).read_text() for name in ("a", "b", "mine")] == ["new", "new", "mine"]
    assert not litter(tmp_path)


def test_folders_are_exchanged_at_once_on_this_system(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "who").write_text(name)
    assert exchange(tmp_path / "a", tmp_path / "b")  # Linux has it: the tests above mean it
    assert (tmp_path / "a" / "who").read_text() == "b"


def test_devices_and_pipes_stay_what_they_are(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="nobody reads this pipe"), output_file(pipe) as path:
        path.write_text("x")
    told = []
    reader = threading.Thread(target=lambda: told.append(pipe.read_text()))
    reader.start()
    for _ in range(100):  # until the reader has opened it
        try:
            with output_file(pipe) as path:
                path.write_text("told")
            break
        except OutputError:
            time.sleep(0.01)
    reader.join()
    assert told == ["told"]
    assert pipe.is_fifo()
    link = tmp_path / "link"
    link.symlink_to("/dev/null")
    done = tmlattice("info", SMALL, "--json", "link", "-q", cwd=tmp_path, check=0)
    assert not done.stderr
    assert Path("/dev/null").is_char_device()
    assert link.is_symlink()
    full = tmlattice("info", SMALL, "--json", "/dev/full", "-q", cwd=tmp_path, check=2)
    assert os.strerror(errno.ENOSPC) in full.stderr
    check_writable(pipe)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "pipe"]


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "loop/x"])
def test_names_that_no_file_has_end_in_one_sentence(tmp_path, name):
    (tmp_path / "loop").symlink_to("loop")
    for opened in (output_file, output_folder):
        with pytest.raises(OutputError, match="cannot write to"), opened(tmp_path / name):
            pass
    with pytest.raises(OutputError, match="cannot write to"):
        check_writable(tmp_path / name)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("measured")
    tmlattice("simulate", SMALL, "--shots", 2, "--engine", "ocelot", "--out", "M", "-q",
              cwd=folder, check=0)  # fmt: skip
    (folder / "ring.py").write_bytes(SMALL.read_bytes())
    os.link(folder / "M" / "readings.csv", folder / "linked.csv")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("diagnose", "ring.py", "M", "--json", "M/measurement.json"),
        ("diagnose", "ring.py", "M", "--json", "linked.csv"),
        ("diagnose", "ring.py", "M", "--lattice-out", "ring.py"),
        ("diagnose", "ring.py", "M", "--json", "x.json", "--repaired-out", "x.json"),
        ("check", "ring.py", "M", "--json", "ring.py"),
        ("info", "ring.py", "--json", "ring.py"),
        ("simulate", "ring.py", "--out", "N", "--truth", "ring.py"),
        ("import", "linked.csv", "--lattice", "ring.py", "--out", "linked.csv"),
        ("simulate", "ring.py", "--out", "M"),
    ],
)
def test_an_output_is_no_input(measured, words):
    before = {p: p.read_bytes() for p in measured.rglob("*") if p.is_file()}
    done = tmlattice(*words, "-q", cwd=measured, check=2)
    assert done.stderr.startswith("tmlattice: ")
    assert {p: p.read_bytes() for p in measured.rglob("*") if p.is_file()} == before


def test_what_a_killed_run_left_is_removed_and_no_more(tmp_path):
    old = time.time() - 100
    (tmp_path / f"{PREFIX}folder").mkdir()
    (tmp_path / f"{PREFIX}folder" / "x").write_text("x")
    (tmp_path / f"{PREFIX}file").write_text("x")
    (tmp_path / f"{PREFIX}living").write_text("x")
    for path in tmp_path.iterdir():
        os.utime(path, (old, old))
    (tmp_path / f"{PREFIX}young").write_text("x")
    with (tmp_path / f"{PREFIX}living").open() as living:
        fcntl.flock(living, fcntl.LOCK_EX)
        with output_file(tmp_path / "out") as path:
            path.write_text("x")
        assert sorted(litter(tmp_path)) == [f"{PREFIX}living", f"{PREFIX}young"]


KILLED = """
import os, sys
from pathlib import Path
from tmlattice.files import output_folder, output_file
with output_folder(Path("out")) as folder, output_file(Path("file")) as file:
    (folder / "a").write_text("new")
    file.write_text("new")
    os.kill(os.getpid(), 9)
"""


def test_a_killed_run_leaves_only_what_the_next_removes(tmp_path):
    write_pair(tmp_path / "out", "old")
    done = subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, check=False)
    assert done.returncode == -9
    assert (tmp_path / "out" / "a").read_text() == "old"
    left = litter(tmp_path)
    assert len(left) == 2
    old = time.time() - 100
    for name in left:
        os.utime(tmp_path / name, (old, old))
    write_pair(tmp_path / "out", "new")
    assert not litter(tmp_path)


def test_a_table_that_was_cut_is_not_read(tmp_path, rng):
    readings = rng.normal(0, 1e-3, (1, 1, 4, 2))
    write_measurement(tmp_path / "M", Measurement(np.zeros((1, 5)), readings, tuple("abcd")))
    table = tmp_path / "M" / "readings.csv"
    whole = table.read_bytes()
    for kept in range(len(whole) - 40, len(whole)):
        table.write_bytes(whole[:kept])
        with pytest.raises(MeasurementError, match=r"not the table that|line 5: "):
            read_measurement(tmp_path / "M")
    table.write_bytes(whole.replace(b"\n", b"\r\n"))  # a system's own ends of lines
    np.testing.assert_array_equal(read_measurement(tmp_path / "M").readings, readings)
    document = json.loads((tmp_path / "M" / "measurement.json").read_text())
    del document["table_sha256"]
    (tmp_path / "M" / "measurement.json").write_text(json.dumps(document))
    table.write_bytes(whole.splitlines(keepends=True)[0] + b"0,0,a,1e-3,\n")
    assert read_measurement(tmp_path / "M").monitors == ("a",)
