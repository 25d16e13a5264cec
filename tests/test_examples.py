"""The examples of the tutorials and pages run as written, and what they print is the truth."""

import contextlib
import io
import json
import re
import shlex
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


def lines(text):
    return [line.rstrip() for line in text.splitlines()]


def printed(page, output):
    """The outputs that a tutorial shows, each of which a command or its Python printed."""
    shown = blocks(f"tutorials/{page}.md", "text")
    kept = [block for block in shown if "[mm]" not in block]  # a table of readings is no output
    for block in kept:
        first, *others = lines(block)
        places = [i for i, line in enumerate(output) if line == first]
        assert [i for i in places if output[i + 1 : i + 1 + len(others)] == others], block
    return kept


def right(recommended_action):
    assert recommended_action.element.lower() == MAGNET
    assert (
        abs(recommended_action.amount - FAULT.amount)
        < 4 * recommended_action.amount_sigma
        < 0.2 * abs(FAULT.amount)
    )


@pytest.fixture(scope="module")
def place(small_ring, tmp_path_factory):
    """A folder with the files that the pages call the reader's own."""
    place = tmp_path_factory.mktemp("examples")
    save_ring(small_ring, place / "ring.json")
    save_ring(small_ring, place / "small.at.json")
    lattice = at.load_json(str(place / "small.at.json"))
    at.save_mat(lattice, str(place / "ring.mat"))
    turns = ("--kind", "turn-by-turn")
    for words in (
        ("today", "--seed", 1, *WEAK),
        ("kick", *turns, *WEAK),
        ("tunes", "--kind", "tunes", *WEAK),
    ):
        tmlattice("simulate", SMALL, "--out", *words, cwd=place, check=0)
    (place / "readings.csv").write_bytes((place / "today" / "readings.csv").read_bytes())
    return place


@pytest.mark.parametrize(("page", "outputs"), [("physicist", 7), ("operator", 1)])
def test_a_tutorial_prints_what_it_shows_and_finds_the_truth(
    page, outputs, simulated, tmp_path, monkeypatch  # noqa: F811
):  # fmt: skip
    scipy.io.savemat(tmp_path / "machine.loco.mat", simulated)
    output = [line for _, done in run(page, tmp_path) for line in lines(done.stdout)]
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as said:
        run_page(f"tutorials/{page}.md")
    shown = printed(page, output + lines(said.getvalue()))
    assert len(shown) == outputs
    text = (DOCS / "tutorials" / f"{page}.md").read_text(encoding="utf-8")
    name, amount = re.findall(r'quadrupole_gradient (\S+) (\S+)"', text)[0]
    (finding,) = json.loads(Path("report", "diagnosis.json").read_text())["findings"]
    found = finding["recommended_action"]
    assert found["element"] == name
    assert abs(found["amount"] - float(amount)) < 4 * found["amount_sigma"] < 5e-3
    if page == "physicist":
        design, estimated = (package.load_ring(own) for own in ("petra3", "found.at.json"))
        changed = [then.name for now, then in zip(estimated.elements, design.elements, strict=True)
                   if now.k1 != then.k1]  # fmt: skip
        assert changed == [name]
        response = json.loads(Path("response", "diagnosis.json").read_text())
        assert response["verdict"] == "none"


def test_a_reader_of_the_paper_sees_what_the_page_shows():
    """The last digits depend on the processor."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        names = run_page("tutorials/machine_learning.md")
    shown = "\n".join(blocks("tutorials/machine_learning.md", "text"))
    number = r"-?\d+\.\d+|\d+"
    assert re.sub(number, "N", said.getvalue()).split() == re.sub(number, "N", shown).split()
    read, own = (list(map(float, re.findall(number, text))) for text in (shown, said.getvalue()))
    assert own == pytest.approx(read, abs=1.1e-3)
    assert list(names["fit"].changes) == [names["weak"].element]
    tunes = package.one_turn_optics(names["machine"]).tunes
    assert (abs(names["fit"].tunes - tunes) < 3 * names["fit"].tune_sigma).all()


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
