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


def test_a_stream_of_few_letters_has_a_message(data):
    (data / "µ.csv").write_text("no table")
    done = run(data, "check", "ring.py", "µ.csv", PYTHONIOENCODING="ascii")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("home", ["/proc/nowhere", None])
def test_surroundings_change_no_result(data, home):
    """Figures need no display, and a stream of few letters spells units."""
    environment = {"TMPDIR": "/proc/nowhere", "COLUMNS": "40", "HOME": home,
                   "TMLATTICE_CACHE": None, "MPLBACKEND": "none such", "DISPLAY": None,
                   "PYTHONIOENCODING": "ascii"}  # fmt: skip
    outputs = "lattice.json", "found.json"
    words = ("--lattice-out", outputs[0], "--json", outputs[1])
    words += ("--out", "R", "-q") if home is None else ()
    done = run(data, *QUICK, *words, **environment)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert not (data / "~").exists()
    if home is None:
        assert (data / "R" / "gap.png").exists()
    else:
        assert done.stdout.isascii()
        assert " um in x" in " ".join(done.stdout.split())
        assert "chi^2" in done.stdout
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
        [sys.executable, "-m", "tmlattice", *map(str, words)], cwd=folder,
        stderr=subprocess.PIPE, text=True,
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


LONG = ("simulate", "ring.py", "--shots", "100000", "--out", "long", "-q", "--jobs")


@pytest.mark.parametrize(
    ("number", "status", "workers"),
    [(signal.SIGTERM, 143, 2), (signal.SIGHUP, 129, 0), (signal.SIGINT, 130, 0)],
)
def test_a_stopped_command_leaves_nothing(data, number, status, workers):
    """At work alone, or as soon as it has its workers, which stop too."""
    before = set(os.listdir(data))

    def ready(process):
        if workers:
            return len(process.children()) == workers
        return any(path.stat().st_size for path in data.glob(f"{PREFIX}*/readings.csv"))

    code, said = stopped(data, (*LONG, workers or 1), number, ready)
    assert code == status
    assert said.strip() == "tmlattice: stopped; nothing was written"  # behind the line of ^C
    assert set(os.listdir(data)) == before


def two_workers(process):
    """The worker processes of a command, once both are there."""
    while len(children := process.children()) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    return children


def test_a_killed_worker_of_simulate_is_one_sentence(data):
    process = psutil.Popen(
        [sys.executable, "-m", "tmlattice", *LONG, "2"], cwd=data, stderr=subprocess.PIPE, text=True
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
    process = psutil.Popen([sys.executable, "-m", "tmlattice", *LONG, "2"], cwd=data)
    children = two_workers(process)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive
