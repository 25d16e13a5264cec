"""What a process finds around it: streams, signals, terminals, folders, no home."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from command import python, tmlattice
from conftest import SMALL

from tmlattice.temporaries import PREFIX

QUICK = ("diagnose", "ring.py", "M", "--effects", "quadrupole_gradient")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    (folder / "ring.py").write_bytes(SMALL.read_bytes())
    tmlattice("simulate", "ring.py", "--shots", 3, "--out", "M", "-q", cwd=folder, check=0)
    return folder


def run(folder, *words, **environment):
    """The command in a process of its own, with another environment."""
    return python("-m", "tmlattice", *words, cwd=folder, **environment)


def test_a_stream_of_few_letters_spells_units(data):
    done = run(data, *QUICK, PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii()
    assert " um in x" in done.stdout
    assert "chi^2" in done.stdout
    (data / "µ.csv").write_text("no table")
    done = run(data, "check", "ring.py", "µ.csv", PYTHONIOENCODING="ascii")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("home", ["/proc/nowhere", None])
def test_surroundings_change_no_result(data, home):
    """Figures need no display."""
    environment = {"TMPDIR": "/proc/nowhere", "COLUMNS": "40", "HOME": home,
                   "TMLATTICE_CACHE": None, "MPLBACKEND": "none such", "DISPLAY": None}  # fmt: skip
    outputs = "lattice.json", "found.json"
    words = ("--lattice-out", outputs[0], "--json", outputs[1], "-q")
    words += ("--out", "R") if home is None else ()
    done = run(data, *QUICK, *words, **environment)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert not (data / "~").exists()
    assert home or (data / "R" / "gap.png").exists()
    for output in outputs:
        (data / output).unlink()


def test_a_reader_that_leaves_ends_the_command_quietly(data):
    for words in (QUICK, ("--help",)):
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run(
            [sys.executable, "-m", "tmlattice", *words], cwd=data, stdout=writer,
            stderr=subprocess.PIPE, check=False,
        )  # fmt: skip
        os.close(writer)
        assert done.returncode == 141, words
        assert not done.stderr


def stopped(folder, words, number, ready):
    """Send a signal to the command as soon as it is ready; its status and stderr."""
    process = psutil.Popen(
        [sys.executable, "-m", "tmlattice", *words], cwd=folder, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # nohup and a shell's & ignore it
    )  # fmt: skip
    end = time.monotonic() + 60
    while not ready(process) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    children = process.children(recursive=True)
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive
    return process.returncode, said


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)]
)
def test_a_stopped_command_leaves_nothing(data, number, status):
    before = set(os.listdir(data))

    def ready(process):  # at work
        return any(path.stat().st_size for path in data.glob(f"{PREFIX}*/readings.csv"))

    words = ("simulate", "ring.py", "--shots", "100000", "--out", "long", "-q")
    code, said = stopped(data, words, number, ready)
    assert code == status
    assert said.strip() == "tmlattice: stopped; nothing was written"
    assert set(os.listdir(data)) == before


def test_a_stopped_command_stops_its_workers(data):
    words = ("simulate", "ring.py", "--shots", "100000", "--jobs", "2", "--out", "long", "-q")
    code, said = stopped(data, words, signal.SIGTERM, lambda process: len(process.children()) == 2)
    assert code == 143
    assert said == "tmlattice: stopped; nothing was written\n"


def two_workers(process):
    """The worker processes of a command, once both are there."""
    while len(children := process.children()) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    return children


def test_a_killed_worker_of_simulate_is_one_sentence(data):
    words = ("simulate", "ring.py", "--shots", "100000", "--jobs", "2", "--out", "long", "-q")
    process = psutil.Popen(
        [sys.executable, "-m", "tmlattice", *words], cwd=data, stderr=subprocess.PIPE, text=True
    )
    children = two_workers(process)
    time.sleep(0.5)
    children[0].kill()
    _, said = process.communicate(timeout=60)
    assert process.returncode == 2
    assert said.startswith("tmlattice: a worker process was lost (SIGKILL)")
    assert len(said.splitlines()) == 1
    assert not any(name.startswith(PREFIX) or name == "long" for name in os.listdir(data))


def test_workers_end_with_their_process(data):
    words = ("simulate", "ring.py", "--shots", "100000", "--jobs", "2", "--out", "long", "-q")
    process = psutil.Popen([sys.executable, "-m", "tmlattice", *words], cwd=data)
    children = two_workers(process)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive
