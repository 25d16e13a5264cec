"""The command as a user runs it: what it prints and writes, and how it ends on wrong input."""

import contextlib
import fcntl
import importlib
import json
import os
import shlex
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from command import printed, python, refused, tmlattice
from conftest import SMALL
from shared import valid

import tmlattice as package
from tmlattice import Measurement, OrbitResponse, TaylorNetwork, simulate, write_measurement
from tmlattice.cli.command import SECTIONS
from tmlattice.cli.command import tmlattice as group
from tmlattice.fitting.experiment import perturbed_ring
from tmlattice.maps import ring_matrix
from tmlattice.network import load_network
from tmlattice.optics import matrix_tunes, one_turn_optics

QUICK = ["--launch", "1e-4,0,1e-4,0", "--change", "-0.02", "--epochs", "20"]


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    words = ("tune-fit", "--epochs", 60, "--json", "result.json", "--out", "figures")
    done = tmlattice(*words, cwd=folder, check=0)
    return folder, done


def test_tune_fit_on_the_built_in_ring(outcome):
    folder, _ = outcome
    result = valid(folder / "result.json", "tune-fit")
    assert result["layers"] == 1519
    assert result["monitors"] == 246
    assert result["change"] == -0.2
    assert len(result["loss"]) == 60
    assert result["orbit_rms"]["after"] < 0.5 * result["orbit_rms"]["before"]
    for plane in range(2):
        network, true = (result["tunes"][key][plane] for key in ("network", "true"))
        assert result["error"]["absolute"][plane] == pytest.approx(abs(network - true))
        assert result["error"]["relative"][plane] == pytest.approx(abs(network - true) / true)
    assert set(result["seconds"]) == {"maps", "compile", "fit", "tunes", "total"}
    assert json.loads((folder / "figures" / "tune-fit.json").read_text()) == result


def test_tune_fit_has_a_column_for_each_method_and_says_which_to_trust(outcome, petra3):
    folder, done = outcome
    result = json.loads((folder / "result.json").read_text())
    assert [m["method"] for m in result["methods"]] == ["adam", "sparse", "map"]
    adam, sparse, most = result["methods"]
    assert adam["tunes"] == result["tunes"]["network"]
    assert adam["tune_sigma"] is None
    assert (result["best"], result["trusted"]) == ("sparse", "sparse")
    (named,) = sparse["named"]
    assert named["magnet"] == result["magnet"]
    assert abs(named["change"] + 0.2) < 5 * named["change_sigma"] < 0.01
    for method in (sparse, most):
        for error, sigma in zip(method["error"]["absolute"], method["tune_sigma"], strict=True):
            assert error < 4 * sigma < 0.01
        assert max(method["error"]["relative"]) < 0.1 * max(adam["error"]["relative"])
        assert method["orbit_rms"] < 1.1 * result["noise"] < 0.5 * adam["orbit_rms"]
    network = load_network(petra3, folder / "figures" / "network.pt")  # of the best method
    np.testing.assert_allclose(one_turn_optics(network).tunes, sparse["tunes"], atol=1e-9)
    said = " ".join(done.stdout.split())
    assert "Trust sparse" in said
    assert f"492 readings do not determine {1519 * (16 + 40):,} free weights" in said
    assert f"{result['magnet']} -20." in said
    assert "more than the noise of 20 µm" in said


def test_a_method_alone_does_not_pay_for_the_others_and_quiet_prints_nothing(tmp_path, monkeypatch):
    adam = importlib.import_module("torch.optim.adam")  # `torch.optim` hides it
    monkeypatch.setattr(adam, "adam", None)  # whoever fits by it fails
    words = ("tune-fit", SMALL, *QUICK, "--noise", "1e-6", "--method", "sparse")
    done = tmlattice(*words, "--json", "a.json", "--quiet", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    result = valid(tmp_path / "a.json", "tune-fit")
    assert [m["method"] for m in result["methods"]] == ["sparse"]
    assert result["regularization"] is None
    assert sorted(p.name for p in (tmp_path / "tune-fit").iterdir()) == [
        "network.pt", "orbit.png", "spectrum.png", "tune-fit.json"
    ]  # fmt: skip


def test_tune_fit_prints_the_table_and_writes_three_figures(outcome):
    folder, done = outcome
    for words in ("1519 layers", "246 BPMs", "true, perturbed (OCELOT)", "relative to the frac",
                  "rms [µm]", "noise", "seconds", "(of sparse)"):  # fmt: skip
        assert words in done.stdout
    assert sorted(p.name for p in (folder / "figures").iterdir()) == [
        "loss.png", "network.pt", "orbit.png", "spectrum.png", "tune-fit.json"
    ]  # fmt: skip
    for name in ("loss", "orbit", "spectrum"):
        assert (folder / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in folder.iterdir()) == ["figures", "result.json"]
    assert "\x1b" not in done.stdout  # no colours and no bar where there is no terminal
    assert done.stderr == ""


def test_info(tmp_path):
    done = tmlattice("info", SMALL, "--json", "info.json", cwd=tmp_path, check=0)
    assert "quadrupole" in done.stdout
    facts = valid(tmp_path / "info.json", "info")
    assert facts["counts"]["quadrupole"] == 32
    assert facts["layers"] == 114


def test_info_on_an_unstable_ring_still_counts(tmp_path):
    (tmp_path / "wild.py").write_text(
        "from ocelot import *\nenergy = 1.0\nring = [Quadrupole(l=1, k1=9.0, eid='q')]"
    )
    done = tmlattice("info", "wild.py", cwd=tmp_path, check=0)
    assert "unstable" in done.stdout


def test_help_imports_nothing_heavy(tmp_path):
    code = (
        "import sys\nfrom click.testing import CliRunner\n"
        "from tmlattice.cli.command import tmlattice\n"
        "for words in (['--help'], ['tune-fit', '--help'], ['--version']):\n"
        "    assert CliRunner().invoke(tmlattice, words).exit_code == 0\n"
        "heavy = {'torch', 'ocelot', 'numpy', 'matplotlib', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    printed("-c", code, cwd=tmp_path)


def test_help_groups_the_commands_by_what_they_are_for(tmp_path):
    done = tmlattice("--help", cwd=tmp_path, check=0)
    titles = ("Describe", "Measure", "Diagnose", "Fit", "Develop")
    at = [done.stdout.index(f"\n{title}:") for title in titles]
    assert at == sorted(at)
    listed = [command.name for commands in SECTIONS.values() for command in commands]
    assert sorted(listed) == sorted(group.commands)
    for name in listed:
        assert f"\n  {name} " in done.stdout, name


def test_commands_of_make_run_are_understood():
    """Their options; an example of the README runs what they do."""
    text = (Path(__file__).parent.parent / "Makefile").read_text().split("\nrun:")[1]
    lines = text.split("\n\n")[0].splitlines()[1:]
    commands = [shlex.split(line.removeprefix("\t$(BIN)/tmlattice ")) for line in lines]
    assert [words[0] for words in commands] == ["tune-fit", "simulate", "diagnose"]
    for name, *words in commands:
        group.commands[name].make_context(name, words)


def test_version_has_one_source(tmp_path):
    from importlib.metadata import version

    done = tmlattice("--version", cwd=tmp_path, check=0)
    assert package.__version__ in done.stdout
    assert version("tmlattice") == package.__version__


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tune-fit", "petra4"], "no lattice 'petra4'; did you mean 'petra3'"),
        (["tune-fit", "nowhere/ring.py"], "no lattice file"),
        (["tune-fit", SMALL, "--magnet", "QD:8"], "no element 'QD:8'; did you mean"),
        (["tune-fit", SMALL, "--magnet", "bend::1"], "name a quadrupole or a sextupole"),
        (["tune-fit", SMALL, "--change", "-3"], "unstable"),
        (["tune-fit", SMALL, "--launch", "0.5,0.5,0,0"], "is lost in layer"),
        (["tune-fit", SMALL, "--launch", "1,2"], "four numbers"),
        (["tune-fit", SMALL, "--launch", "nan,0,0,0"], "four numbers"),
        (["tune-fit", SMALL, "--noise", "-1e-5"], "--noise"),
        (["tune-fit", SMALL, "--epochs", "0"], "--epochs"),
        (["tune-fit", SMALL, "--sequence", "loop"], "no sequence in"),
        (["tune-fit", SMALL, "--out", "/dev/null/folder"], "cannot write"),
        (["tune-fit", SMALL, "--json", "no/such/folder/a.json"], "cannot write"),
        (["tune-fit", SMALL, "--wrong"], "--wrong"),
        (["study", "tune-fit"], "did you mean 'dev study'?"),
        (["tunefit"], "no command 'tunefit'; did you mean 'tune-fit'?"),
        (["nonsense"], "`tmlattice --help` lists them"),
        (["simulate", SMALL, "--effect", "quadrupol QD::5 -1", "--out", "y"],
         "no effect 'quadrupol'; did you mean 'quadrupole_gradient'"),
        (["diagnose", SMALL, "day", "./day"], "is given twice"),
        (["info", "petra4"], "no lattice"),
    ],
)  # fmt: skip
def test_wrong_input_ends_in_one_sentence_and_leaves_nothing(tmp_path, arguments, words):
    refused(*arguments, cwd=tmp_path, says=words)


WAITS_IN_A_SCAN = (
    "import signal, time, tmlattice.cli.diagnose as diagnose, tmlattice.cli.progress as progress\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "progress.AFTER, progress.EVERY = 0.2, 0.05\n"
    "def told(stage):\n"
    "    progress.tell(stage)\n"
    "    if stage == 'scan':\n"
    "        print('it scans', flush=True)\n"
    "        time.sleep(WAIT)\n"
    "diagnose.tell = told\n"
    "from tmlattice.cli.command import main\n"
    "main()\n"
)


def on_a_terminal(code, *words, cwd, stop):
    """Exit code, stdout, and what a terminal of 100 columns was sent."""
    own, end = os.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=cwd, stdout=subprocess.PIPE, stderr=end, text=True,
    )  # fmt: skip
    os.close(end)
    sent = b""
    first = process.stdout.readline()
    time.sleep(1.0)
    if stop:
        process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=120)
    with contextlib.suppress(OSError):  # the terminal's other end is closed
        while part := os.read(own, 4096):
            sent += part
    os.close(own)
    return process.returncode, first + out, sent.decode()


@pytest.mark.skipif(os.name == "nt", reason="POSIX terminals")
@pytest.mark.parametrize("stop", [False, True])
def test_a_terminal_shows_the_progress_and_ctrl_c_writes_nothing(tmp_path, small_ring, stop):
    write_measurement(tmp_path / "day", simulate(small_ring, [], shots=3, seed=1).measurement())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.txt").write_text("of yesterday")
    words = ["diagnose", SMALL, "day", "--effects", "quadrupole_gradient", "--out", "out",
             "--json", "a.json"]  # fmt: skip
    code = WAITS_IN_A_SCAN.replace("WAIT)", "60)" if stop else "1.5)")
    exit_code, out, sent = on_a_terminal(code, *words, cwd=tmp_path, stop=stop)
    assert "tmlattice diagnose: scan, " in sent
    if not stop:
        assert exit_code == 0
        assert "written: out/" in out
        assert "scan, " not in sent.rsplit("\r", 1)[-1]  # the line is gone
        return
    assert exit_code == 130
    assert "stopped in 'scan'; nothing was written" in sent
    assert sorted(path.name for path in tmp_path.iterdir()) == ["day", "out"]
    assert [path.read_text() for path in (tmp_path / "out").iterdir()] == ["of yesterday"]


def test_no_progress_is_shown_where_there_is_no_terminal(tmp_path):
    code = (
        "import tmlattice.cli.progress as progress\n"
        "progress.AFTER, progress.EVERY = 0.0, 0.01\n"
        "from tmlattice.cli.command import main\n"
        "main()\n"
    )
    done = python("-c", code, "simulate", SMALL, "--shots", "2", "--out", "day", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def folders(tmp_path_factory, small_ring):
    """Measurements of the small ring with one weak magnet, one of each kind that is tried."""
    place = tmp_path_factory.mktemp("folders")
    machine = perturbed_ring(small_ring, "QD::5", -0.02)
    launches = np.array([[1e-4, 0, 1e-4, 0, 0], [-1e-4, 1e-5, 5e-5, 0, 0]])
    off = launches + np.array([0, 0, 0, 0, 5e-4])
    for name, start in (("on", launches), ("off", off)):
        dimension = 6 if start[:, 4].any() else 4
        network = TaylorNetwork.from_ring(machine, dimension)
        empty = Measurement(start, np.zeros((2, 1, len(network.monitors), 2)), network.monitors)
        readings = network(empty.states(dimension)).detach().numpy()[:, None]
        readings[0, 0, 3:6] = np.nan
        data = Measurement(start, readings, network.monitors, (1e-6, 2e-6))
        write_measurement(place / name, data.select(monitors=network.monitors[::-1]))
    write_measurement(
        place / "corrector",
        Measurement(launches, readings, network.monitors, settings=({}, {"v1": {"kick": 1e-5}})),
    )
    axis = Measurement(np.zeros((2, 4)), readings, network.monitors, None, np.zeros((2, 4)))
    write_measurement(place / "axis", axis)
    clean = TaylorNetwork.from_ring(machine)(launches[:, :4]).detach().numpy()[:, None]
    noisy = clean + 2e-7 * np.random.default_rng(3).standard_normal(clean.shape)
    write_measurement(place / "blind", Measurement(np.zeros((2, 4)), noisy, network.monitors))
    write_measurement(
        place / "response",
        OrbitResponse(("v1",), ("y",), np.ones(1), ("last_a",), np.zeros((1, 1, 2))),
    )
    (place / "strange").mkdir()
    for file in (place / "on").iterdir():
        text = file.read_text().replace("last_a", "last_c").replace("table_sha256", "_")
        (place / "strange" / file.name).write_text(text)
    return place


@pytest.mark.parametrize(("name", "coordinates"), [("on", 4), ("off", 6)])
def test_tune_fit_on_a_measurement(folders, tmp_path, name, coordinates):
    done = tmlattice(
        "tune-fit", SMALL, "--measurement", folders / name, "--epochs", 100, "--method", "adam",
        "--out", "fit", cwd=tmp_path, check=0,
    )  # fmt: skip
    result = valid(tmp_path / "fit" / "tune-fit.json", "tune-fit")
    assert result["shots"] == 2
    assert result["measurement"] == str(folders / name)
    assert result["magnet"] is result["change"] is result["tunes"]["true"] is None
    assert result["error"] == {"absolute": None, "relative": None}
    assert result["noise"] == pytest.approx((2.5 * 1e-12) ** 0.5)
    assert len(result["launch"]) == coordinates
    assert result["orbit_rms"]["after"] < 0.9 * result["orbit_rms"]["before"]
    assert all(0 < tune < 1 for tune in result["tunes"]["network"])
    assert "2 shots of" in done.stdout
    assert done.stderr == ""
    for figure in ("loss", "orbit", "spectrum"):
        assert (tmp_path / "fit" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")


def test_launches_and_noise_that_nobody_states_are_fitted_beside(folders, tmp_path, small_ring):
    """Launches of 1e-4 m and rad, stated as unknown about the axis; 0.2 µm of noise."""
    done = tmlattice("tune-fit", SMALL, "--measurement", folders / "blind", "--epochs", 100,
                     "--out", "fit", cwd=tmp_path, check=0)  # fmt: skip
    result = json.loads((tmp_path / "fit" / "tune-fit.json").read_text())
    assert result["noise_estimated"]
    assert "(estimated)" in done.stdout
    assert result["noise"] == pytest.approx(2e-7, rel=0.4)  # a robust width of some 100 readings
    assert result["orbit_rms"]["before"] > 2 * result["noise"]
    _, sparse, most = result["methods"]
    assert [named["magnet"] for named in sparse["named"]] == ["QD::5"]
    true = matrix_tunes(ring_matrix(perturbed_ring(small_ring, "QD::5", -0.02)))
    for method in (sparse, most):
        for tune, sigma, right in zip(method["tunes"], method["tune_sigma"], true, strict=True):
            assert abs(tune - right) < 4 * sigma


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("on", ["--magnet", "QD::5"], "--magnet makes data"),
        ("on", ["--change", "-0.2"], "--change makes data"),
        ("on", ["--noise", "1e-5"], "--noise makes data"),
        ("on", ["--launch", "1e-3,0,1e-3,0"], "--launch makes data"),
        ("nowhere", [], "no measurement folder"),
        ("response", [], "is an orbit response"),
        ("corrector", [], "shot 1 has settings"),
        ("axis", [], "every launch is on the axis"),
        ("strange", [], "no BPM 'last_c'; did you mean"),
    ],
)
def test_tune_fit_refuses_a_measurement(folders, tmp_path, name, more, words):
    command = ("tune-fit", SMALL, "--measurement", folders / name)
    refused(*command, *more, cwd=tmp_path, says=words)
