"""The examples of the tutorials and pages run as written, and what they print is the truth."""

import json
import re
import shlex
import types
from pathlib import Path

import at
import pytest
import scipy.io
from command import tmlattice
from conftest import SMALL
from shared import run_page
from test_import import simulated  # noqa: F401  (a fixture)

import tmlattice as package
from tmlattice.lattice import save_ring

DOCS = Path(__file__).parent.parent / "docs"
FAULT = package.Cause("quadrupole_gradient", "QD::5", -0.05)
MAGNET = "qd::5"  # as AT's file has it
WEAK = ("--effect", f"{FAULT.effect} {FAULT.element} {FAULT.amount}")


def blocks(page, language):
    """The blocks of one language on a page; what follows a `#` in a command is a comment."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def run(page, place, folder="tutorials/"):
    """Each command of a page, and what it did, in order."""
    said = []
    for block in blocks(f"{folder}{page}.md", "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            program, *words = shlex.split(line.removeprefix("$ "), comments=True)
            if program == "tmlattice":
                done = tmlattice(*words, cwd=place)
                assert done.returncode == 0, done
                said.append((line, done))
    return said


def right(recommended_action):
    assert recommended_action.element.lower() == MAGNET
    assert (
        abs(recommended_action.amount - FAULT.amount)
        < 4 * recommended_action.amount_sigma
        < 0.2 * abs(FAULT.amount)
    )


@pytest.fixture(scope="module")
def place(small_ring, simulated, tmp_path_factory):  # noqa: F811
    """A folder with the files that the pages call the reader's own."""
    place = tmp_path_factory.mktemp("examples")
    save_ring(small_ring, place / "ring.json")
    save_ring(small_ring, place / "small.at.json")
    lattice = at.load_json(str(place / "small.at.json"))
    for name in ("ring.mat", "my_ring.mat"):
        at.save_mat(lattice, str(place / name))
    scipy.io.savemat(place / "machine.loco.mat", simulated)
    turns = ("--kind", "turn-by-turn")
    for words in (
        ("yesterday",),
        ("today", "--seed", 1, *WEAK),
        ("kick", *turns, *WEAK),
        ("tunes", "--kind", "tunes", *WEAK),
    ):
        tmlattice("simulate", SMALL, "--out", *words, cwd=place, check=0)
    (place / "readings.csv").write_bytes((place / "today" / "readings.csv").read_bytes())
    return place


def test_a_physicist_finds_the_magnet(place):
    """From the lattice to the ring as found, and the LOCO file of a ring without errors."""
    design = package.load_ring(place / "my_ring.mat")
    info, _, found, _, response = (done.stdout for _, done in run("physicist", place))
    for tune in package.one_turn_optics(package.TaylorNetwork.from_ring(design)).tunes:
        assert f"{tune:.6f}".removeprefix("0") in info
    as_found = package.load_ring(place / "found.at.json")
    away = {
        now.name: now.k1 / then.k1 - 1
        for now, then in zip(as_found.elements, design.elements, strict=True)
        if now.k1 != then.k1
    }
    assert away == {MAGNET: pytest.approx(FAULT.amount, abs=3e-3)}
    assert f"{100 * away[MAGNET]:.2f}" in found
    assert "none" in response.lower()


def test_an_operator_is_told_the_magnet_and_the_settings(place):
    """No verdict is an error, and the repair is what the fault asks for."""
    check, found = (done for _, done in run("operator", place))
    assert (check.returncode, found.returncode) == (0, 0)
    result = json.loads((place / "report" / "diagnosis.json").read_text())
    (finding,) = result["findings"]
    right(types.SimpleNamespace(**finding["recommended_action"]))


def test_in_python_too(place, monkeypatch):
    monkeypatch.chdir(place)
    (finding,) = run_page("tutorials/physicist.md", tmlattice=package)["diagnosis"].findings
    right(finding.recommended_action)


def test_objects_of_other_packages(place, monkeypatch):
    monkeypatch.chdir(place)
    before = sorted(place.iterdir())
    names = run_page("objects.md")
    (finding,) = names["diagnosis"].findings
    right(finding.recommended_action)
    tunes, design = (names[k].get_tune()[:2] for k in ("estimated", "lattice"))
    assert abs(tunes - design).max() > 1e-3
    assert names["magnet"] in names["family"]
    assert names["table"].mux.iloc[-1] == pytest.approx(names["optics"].total_tunes[0])
    assert sorted(place.iterdir()) == before


def test_a_machine_file_from_a_lattice_and_a_file_of_data(place, tmp_path, monkeypatch):
    """The commands of the page in a folder of their own; its files of TOML are read."""
    for name in ("ring.mat", "readings.csv"):
        (tmp_path / name).write_bytes((place / name).read_bytes())
    said = [done for _, done in run("machine_file", tmp_path, "")]
    assert [len(done.stderr.splitlines()) for done in said] == [0, 1, 1, 1, 1]
    assert MAGNET in said[3].stdout
    assert (tmp_path / "settings" / "settings.csv").exists()
    for text in blocks("machine_file.md", "toml"):
        (tmp_path / "other.toml").write_text(text)
        supplies = package.load_machine_file(tmp_path / "other.toml").supplies
        assert supplies == tmp_path / "knobs.csv" or supplies[0]["curve"]
    monkeypatch.chdir(tmp_path)
    (finding,) = run_page("machine_file.md")["diagnosis"].findings
    right(finding.recommended_action)


def test_what_several_measurements_say_together(place, monkeypatch):
    monkeypatch.chdir(place)
    (code,) = blocks("together.md", "python")
    (finding,) = run_page("together.md")["diagnosis"].findings
    right(finding.recommended_action)
    (printed,) = re.findall(r"seen_by  # (.*)", code)
    assert finding.seen_by == pytest.approx(json.loads(printed), abs=0.05)


def test_the_ring_as_a_layer_learns_as_written():
    names = run_page("network_layer.md")
    assert names["losses"][-1] < 0.5 * names["losses"][0]
    assert names["closure"]().item() < 1e6 * names["losses"][-1]  # LBFGS goes further
    moved = (names["tuned"].W1 != names["network"].W1).any(dim=(1, 2)).tolist()
    magnets = names["ring"].magnets
    free = [m.kind == "sextupole" or m.name.startswith("qd") for m in magnets]
    assert moved == free
    assert names["two"].shape == (32, 2, 246, 2)
    assert names["found"].shape == (2, 32, 246, 2)
    small = names["tunes"].fraction[0]
    assert small == pytest.approx(names["optics"].tunes, abs=1e-3)
    motion = names["optics"].normalised(names["centroid"])[:, 0]  # of a rigid beam its size is kept
    assert abs(motion[0]) == pytest.approx(2e-5 * names["optics"].beta[0] ** 0.5, rel=0.1)
    assert abs(motion[-1]) < 1.05 * abs(motion[0])
