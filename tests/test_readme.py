"""The README is short, its links lead somewhere, and its commands do what it says, as written."""

import re
import shlex
from pathlib import Path

import pytest
from command import tmlattice
from conftest import SMALL

from tmlattice.lattice import save_ring

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
LONGEST = 130  # lines
HEAVIEST = 150_000  # bytes of a picture
BLOCKS = [block.strip().splitlines() for block in re.findall(r"```sh\n(.*?)```", README, re.S)]


@pytest.fixture(scope="module")
def reader(small_ring, tmp_path_factory):
    """A folder with the files that the README calls the reader's own."""
    place = tmp_path_factory.mktemp("reader")
    save_ring(small_ring, place / "my_ring.json")
    fault = ("--effect", "quadrupole_gradient QD::5 -0.05")
    for words in (
        ("--out", "yesterday"),
        ("--out", "today", "--seed", 1, *fault),
        ("--kind", "orbit-response", "--engine", "ocelot", "--out", "my_response", *fault),
    ):
        tmlattice("simulate", SMALL, *words, cwd=place, check=0)
    (place / "my_readings.csv").write_bytes((place / "today" / "readings.csv").read_bytes())
    return place


@pytest.fixture(scope="module")
def tried(reader):
    """A function that runs a block of commands, once, in the reader's folder."""
    done = set()

    def trying(number):
        if number not in done:
            done.add(number)
            for line in BLOCKS[number]:
                program, *words = shlex.split(line)
                assert program == "tmlattice"
                tmlattice(*words, cwd=reader, check=0)
        return BLOCKS[number]

    return trying


@pytest.mark.parametrize("number", range(1, len(BLOCKS)))
def test_commands_run_as_written_and_write_what_they_name(reader, tried, number):
    for line in tried(number):
        words = shlex.split(line)
        for option in ("--out", "--lattice-out", "--corrected-out"):
            if option in words:
                assert (reader / words[words.index(option) + 1]).exists(), line


def test_what_it_shows_of_a_report_is_what_the_command_says(reader, tried):
    tried(1)
    (shown,) = re.findall(r"```text\n(.*?)\n```", README)
    assert (reader / "diagnosis_1" / "report.txt").read_text().startswith(shown)


def test_its_python_is_of_this_package(reader, tried, monkeypatch):
    tried(1)
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    monkeypatch.chdir(reader)
    exec(code, {})
    assert (reader / "diagnosis_5" / "report.html").exists()


def test_there_are_five_examples_and_the_page_is_short():
    assert len(BLOCKS) == 5
    assert BLOCKS[0] == ["tmlattice tune-fit"]  # which `test_cli` runs
    assert len(README.splitlines()) <= LONGEST


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_links_and_pictures_are_there(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for picture, link in re.findall(r"(!?)\[[^\]]*\]\(([^)#]+)", text):
        if not link.startswith("http"):
            path = (ROOT / page).parent / link
            assert path.exists(), link
            assert not picture or path.stat().st_size < HEAVIEST, link
