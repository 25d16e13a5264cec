"""The documentation is built, with warnings as errors, and holds what it promises."""

import html
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path

import click
import pytest
from test_walls import FILES, ORDER, PACKAGE, imported

import tmlattice
from tmlattice.cli.command import tmlattice as command
from tmlattice.diagnosis.assessment import STATEMENTS
from tmlattice.effects import CATALOGUE

ROOT = Path(__file__).parent.parent
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocstrings", reason="mkdocs is not installed: pip install '.[docs]'")
    pytest.importorskip("mkdocs_click", reason="mkdocs is not installed: pip install '.[docs]'")
    pytest.importorskip("latex2mathml", reason="mkdocs is not installed: pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def every(group):
    """A group, its commands, and theirs."""
    yield group
    for one in getattr(group, "commands", {}).values():
        yield from every(one)


def text(site, page):
    return (site / page / "index.html").read_text(encoding="utf-8")


def test_every_public_name_is_in_the_reference(site):
    inventory = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    lines = zlib.decompress(inventory).decode().splitlines()
    listed = {line.split(" ")[0].rsplit(".", 1)[-1] for line in lines if " py:" in line}
    missing = [name for name in tmlattice.__all__ if name not in {*listed, "__version__"}]
    assert not missing


def test_every_effect_is_in_the_table(site):
    page = text(site, "effects")
    assert [name for name in CATALOGUE if f"<code>{name}</code>" not in page] == []
    assert page.count("<tr>") == len(CATALOGUE) + 1


def test_every_sentence_of_a_report_is_in_the_table(site):
    page = text(site, "diagnose")
    assert [one.name for one in STATEMENTS if f"<code>{one.name}</code>" not in page] == []


def test_every_command_and_option_is_on_the_page(site):
    page = text(site, "command_line")
    for one in every(command):
        for parameter in one.params:
            for option in getattr(parameter, "secondary_opts", []) + parameter.opts:
                assert not option.startswith("--") or option in page, f"{one.name} {option}"
    assert "UNSET" not in page  # a default where there is none


def test_no_mark_is_left_and_shots_are_in_the_format(site):
    page = text(site, "formats")
    assert "<!-- schema" not in page
    for field in ("shots[].launch_sigma.px", "columns[].kick", "findings[].credible_set[].effect"):
        assert f"<code>{field}</code>" in page, field


def test_packages_are_drawn_in_their_order_and_every_import_is_a_way_up(site):
    page = text(site, "contributing")
    assert tuple(re.findall(r"<text [^>]*>(\w+)</text>", page)) == ORDER
    arcs = re.findall(r'data-from="(\w+)" data-to="(\w+)"', page)
    assert len(arcs) > len(ORDER)
    reached = {name: {name} for name in ORDER}
    for own, other in sorted(arcs, key=lambda arc: ORDER.index(arc[0])):
        assert ORDER.index(other) < ORDER.index(own)
        reached[own] |= reached[other]
    for path in FILES:
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if own in reached:
            needed = {parts[0] for parts, _ in imported(path) if parts and parts[0] in reached}
            assert needed <= reached[own], path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_scripts_and_tests_that_a_page_names_are_there(page):
    named = re.findall(r"\b(?:benchmarks|tests|lattices)/[\w/]+\.py",
                       page.read_text(encoding="utf-8"))  # fmt: skip
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_every_option_says_what_it_is_for():
    options = [(one.name, p) for one in every(command) for p in one.params
               if isinstance(p, click.Option)]  # fmt: skip
    assert not [(name, option.opts) for name, option in options if not option.help]
    assert len(options) <= 110


def test_lists_go_on_after_an_equation(site):
    """Every numbered point of the method begins a line of its own."""
    page = text(site, "method")
    source = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    points = len(re.findall(r"^\d+\. ", source, re.M))
    assert page.count("<li>", page.index("<ol>"), page.rindex("</ol>")) == points


def test_equations_are_drawn_and_nothing_is_fetched(site):
    page = text(site, "method")
    assert page.count("<math") >= 5
    assert "\\(" not in page
    assert "\\[" not in page
    fetched = [
        (path.name, found)
        for path in site.rglob("*.html")
        for found in re.findall(
            r'<(?:script|link|img|iframe)[^>]*(?:src|href)="(https?:[^"]*)"',
            path.read_text(encoding="utf-8"),
        )
    ]
    assert not fetched


def test_notebooks_are_pages_with_their_pictures(site):
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        page = text(site, f"notebooks/{notebook.stem}")
        pictures = re.findall(r'src="\.\./([^"]+\.png)"', page)
        assert len(pictures) >= 2, notebook.stem
        for picture in pictures:
            assert (site / "notebooks" / picture).read_bytes().startswith(b"\x89PNG")


def test_example_files_of_the_formats_are_read_as_they_stand(site, tmp_path):
    """The page's own text makes a folder, and the reader takes it."""
    page = text(site, "formats")
    shown = re.findall(r'<span class="filename">([\w.]+)</span>.*?<code>(.*?)</code>', page, re.S)
    assert [name for name, _ in shown] == [
        "measurement.json", "readings.csv", "measurement.json", "response.csv",
    ]  # fmt: skip
    for kind, files in (("trajectory", shown[:2]), ("orbit_response", shown[2:])):
        (tmp_path / kind).mkdir()
        for name, marked in files:
            plain = html.unescape(re.sub(r"<[^>]+>", "", marked))
            (tmp_path / kind / name).write_text(plain)
        assert tmlattice.read_measurement(tmp_path / kind).monitors == ("bpm_1", "bpm_2")


def test_pages_have_at_most_26_000_words():
    pages = [page.read_text(encoding="utf-8") for page in PAGES if page.name != "CONTRIBUTING.md"]
    assert sum(any(c.isalnum() for c in word) for word in " ".join(pages).split()) < 26_000
