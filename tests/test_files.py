"""Outputs: whole or not there, never an input, a device or somebody else's work."""

import contextlib
import errno
import fcntl
import json
import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))
from pairs import pairs

from tmlattice import read_measurement, temporaries
from tmlattice.errors import MeasurementError
from tmlattice.files import OutputError, check_writable, output_file, output_folder
from tmlattice.measurement import Measurement, write_measurement
from tmlattice.temporaries import PREFIX, locked


def litter(folder):
    return [path.name for path in Path(folder).rglob(f"{PREFIX}*")]


def write_pair(folder, text, names=("a", "b")):
    with output_folder(folder) as temporary:
        for name in names:
            (temporary / name).write_text(text)


def test_a_folder_s_files_are_of_one_run(tmp_path):
    """Of whoever holds its lock; its other files stay."""
    folder = tmp_path / "out"
    write_pair(folder, "0")
    (folder / "mine").write_text("mine")
    mixed, seen, end = [], [], threading.Event()

    def watch():
        while not end.is_set():
            with locked(folder, shared=True):
                texts = [(folder / name).read_text() for name in "ab"]
            seen.append(texts[0])
            if len(set(texts)) > 1:
                mixed.append(texts)

    watcher = threading.Thread(target=watch)
    watcher.start()
    for number in range(100):
        write_pair(folder, str(number))
    end.set()
    watcher.join()
    assert not mixed
    assert len(set(seen)) > 10
    assert (folder / "mine").read_text() == "mine"
    assert not litter(tmp_path)


@pytest.mark.parametrize("there", [True, False])
def test_outputs_into_one_folder_lose_nothing(tmp_path, there):
    """Of two processes, and of another program that writes there all the time."""
    assert not pairs(tmp_path, 6, there)


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
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.raises(KeyboardInterrupt))
        stack.enter_context(output_file(folder / "a")).write_text("half")
        raise KeyboardInterrupt
    assert (folder / "a").read_text() == "old"
    assert not litter(tmp_path)


def test_a_folder_stays_the_same_folder(tmp_path, monkeypatch):
    """Its inode, owner, mode, set-group-ID bit, attributes, files; whoever is in it."""
    folder = tmp_path / "out"
    write_pair(folder, "old")
    (folder / "mine").write_text("mine")
    (folder / "figures").mkdir()
    monkeypatch.chdir(folder)
    if os.geteuid() == 0:
        os.chown(folder, 1234, 2345)
    folder.chmod(0o2775)
    with contextlib.suppress(OSError):  # a file system without
        os.setxattr(folder, "user.shift", b"night")
        os.setxattr(folder, "system.posix_acl_default", ACL)
    kept = os.stat(folder), attributes(folder)
    handle = os.open(folder, os.O_RDONLY)
    write_pair(folder, "new")
    after = os.stat(folder), attributes(folder)
    os.close(handle)
    for field in ("st_ino", "st_uid", "st_gid", "st_mode"):
        assert getattr(after[0], field) == getattr(kept[0], field)
    assert after[1] == kept[1]
    assert [(folder / name).read_text() for name in ("a", "b", "mine")] == ["new", "new", "mine"]
    assert (folder / "a").stat().st_gid == kept[0].st_gid  # of the folder, as any new file there
    if "system.posix_acl_default" in kept[1]:
        assert "system.posix_acl_access" in attributes(folder / "a")  # readable by user 2345
    assert not litter(tmp_path)


ACL = struct.pack("<I" + "HHI" * 5, 2, 1, 7, 2**32 - 1, 2, 5, 2345, 4, 7, 2**32 - 1, 16, 7,
                  2**32 - 1, 32, 5, 2**32 - 1)  # fmt: skip
"""user::rwx, user:2345:r-x, group::rwx, mask::rwx, other::r-x"""


def attributes(path):
    return {name: os.getxattr(path, name) for name in os.listxattr(path)}


def test_a_new_folder_is_as_any_other(tmp_path):
    """Its mode is the process's, its group that of the folder it is in."""
    tmp_path.chmod(0o2775)
    before = os.umask(0o027)
    try:
        write_pair(tmp_path / "out", "x")
        (tmp_path / "made").mkdir()
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "made").stat().st_mode
    assert (tmp_path / "out" / "a").stat().st_mode & 0o777 == 0o640


def test_a_file_does_not_replace_a_folder(tmp_path):
    write_pair(tmp_path / "out", "old")
    (tmp_path / "out" / "c").mkdir()
    with pytest.raises(OutputError, match="'c' is a folder there"):
        write_pair(tmp_path / "out", "new", names=("a", "b", "c"))
    assert (tmp_path / "out" / "a").read_text() == "old"
    assert not litter(tmp_path)


def test_a_lock_that_somebody_keeps_stops_no_output(tmp_path, monkeypatch):
    monkeypatch.setattr(temporaries, "PATIENCE", 0.1)
    write_pair(tmp_path / "out", "old")
    with locked(tmp_path / "out"):
        write_pair(tmp_path / "out", "new")
    assert (tmp_path / "out" / "a").read_text() == "new"


def test_devices_and_pipes_stay_what_they_are(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="no process reads this pipe"), output_file(pipe) as path:
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
    (folder / "link").symlink_to(folder / "ring.py")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("diagnose", "ring.py", "M", "--json", "M/measurement.json"),
        ("diagnose", "ring.py", "M", "--json", "linked.csv"),
        ("diagnose", "ring.py", "M", "--lattice-out", "ring.py"),
        ("diagnose", "ring.py", "M", "--json", "x.json", "--corrected-out", "x.json"),
        ("check", "ring.py", "M", "--json", "ring.py"),
        ("info", "ring.py", "--json", "./x/../ring.py"),
        ("info", "ring.py", "--json", "link"),
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
    """Not what lives, is young, another user's, or only begins with the same letters."""
    old = time.time() - 100
    stale = [tmp_path / f"{PREFIX}{k:016x}" for k in range(2)]
    stale[0].mkdir()
    (stale[0] / "x").write_text("x")
    stale[1].write_text("x")
    living, linked, young = (tmp_path / f"{PREFIX}{k:016x}" for k in (10, 11, 12))
    notes, others = tmp_path / f"{PREFIX}notes", tmp_path / f"{PREFIX}{13:016x}"
    linked.symlink_to(tmp_path / "elsewhere")
    for path in (living, notes, others):
        path.write_text("x")
    if os.geteuid() == 0:
        os.chown(others, 1234, 1234)
    else:
        others.unlink()
    for path in tmp_path.iterdir():
        os.utime(path, (old, old), follow_symlinks=False)
    young.write_text("x")
    before = set(litter(tmp_path))
    with living.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with output_file(tmp_path / "out") as path:
            path.write_text("x")
    assert before - set(litter(tmp_path)) == {path.name for path in stale}


AMID = """
import os, sys
from pathlib import Path
from tmlattice.files import output_folder
real, left = os.replace, [int(sys.argv[1])]
def replace(*paths):
    if not left[0]:
        os.kill(os.getpid(), 9)
    left[0] -= 1
    real(*paths)
os.replace = replace
with output_folder(Path("out")) as folder:
    for name in "abc":
        (folder / name).write_text("new")
"""


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_run_that_is_killed_while_it_moves_its_files_is_finished(tmp_path, moved):
    """By whoever has the folder's lock next: it never sees files of two runs."""
    folder = tmp_path / "out"
    write_pair(folder, "old", "abc")
    done = subprocess.run([sys.executable, "-c", AMID, str(moved)], cwd=tmp_path, check=False)
    assert done.returncode == -9
    assert [(folder / name).read_text() for name in "abc"].count("new") == moved
    with locked(folder, shared=True):
        assert [(folder / name).read_text() for name in "abc"] == ["new"] * 3
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
