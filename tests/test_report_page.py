"""The report in a real browser: Chromium, driven by playwright, without a network."""

import json
import shutil

import numpy as np
import pytest
import shared

from tmlattice import Cause, diagnose, load_ring
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.stored import StoredBeam
from tmlattice.effects import apply
from tmlattice.lattice import save_ring
from tmlattice.machine.response import simulate_response
from tmlattice.measurement import TuneReading
from tmlattice.report.page import draw, page

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install '.[test]'"
)
BROWSERS = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
CHROMIUM = next(filter(None, BROWSERS), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt install chromium")

WEAK = Cause("quadrupole_gradient", "QD::5", -0.02)
EFFECTS = ["quadrupole_gradient", "quadrupole_roll", "monitor_gain_x", "corrector_kick_x"]
TERMINALS = (40, 60, 80, 100)
PHONE = {"width": 390, "height": 800}


def fits_terminals(diagnosis):
    for width in TERMINALS:
        assert max(map(len, diagnosis.report(width).splitlines())) <= width
        assert len(diagnosis.report(width, 34).splitlines()) <= 34
    return diagnosis


def written(diagnosis, folder):
    file = folder / "report.html"
    provenance = {**diagnosis.provenance, "measurement": "day_1"}
    file.write_text(page(diagnosis, draw(diagnosis, folder), provenance), encoding="utf-8")
    assert file.stat().st_size < 3e6
    return file.as_uri()


@pytest.fixture(scope="module")
def first_turns(small_ring, tmp_path_factory):
    found = diagnose(small_ring, shared.first_turns(small_ring, [WEAK]), effects=EFFECTS)
    return written(fits_terminals(found), tmp_path_factory.mktemp("first_turns"))


@pytest.fixture(scope="module")
def response(small_ring, tmp_path_factory):
    data = simulate_response(
        small_ring, [WEAK], background={"quadrupole_gradient": 2e-3, "monitor_gain_x": 0.02},
        engine="ocelot", progress=False,
    ).measured  # fmt: skip
    found = diagnose(small_ring, data, effects=["quadrupole_gradient", "monitor_gain_x",
                                                "corrector_calibration"])  # fmt: skip
    return written(fits_terminals(found), tmp_path_factory.mktemp("response"))


@pytest.fixture(scope="module")
def together(small_ring, tmp_path_factory):
    """First turns and the tunes of the same machine."""
    turns = shared.first_turns(small_ring, [WEAK])
    beam = StoredBeam(ResponseModel(apply(small_ring, [WEAK])))
    tunes = TuneReading(tune=beam.tunes[None], tune_error=np.full((1, 2), 1e-4))
    found = diagnose(small_ring, {"turns": turns, "tunes": tunes}, effects=EFFECTS)
    return written(fits_terminals(found), tmp_path_factory.mktemp("together"))


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def opened(browser):
    """A function that opens a page; whatever it complains of or asks the net for fails the test."""
    wrong, contexts = [], []

    def opening(address, **options):
        context = browser.new_context(**options)
        contexts.append(context)
        tab = context.new_page()
        tab.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.on(
            "request",
            lambda asked: (
                wrong.append(asked.url) if not asked.url.startswith(("file:", "data:")) else None
            ),
        )
        tab.goto(address)
        return tab

    yield opening
    for context in contexts:
        context.close()
    assert not wrong


def headings(tab):
    return tab.eval_on_selector_all("h2", "all => all.map(one => one.id)")


def hovered(tab, figure, name):
    """What a figure shows where the mouse is on the first point whose text has the name."""
    place = tab.locator(f'.figure[data-figure="data-{figure}"]')
    place.scroll_into_view_if_needed()
    place.evaluate(
        """(place, name) => {
            const named = trace => (trace.text || []).findIndex(x => x.includes(name));
            const own = place.data.findIndex(trace => named(trace) >= 0);
            const k = named(place.data[own]);
            const { xaxis, yaxis } = place._fullLayout;
            const box = place.getBoundingClientRect();
            window.at = [box.x + xaxis._offset + xaxis.d2p(place.data[own].x[k]),
                         box.y + yaxis._offset + yaxis.d2p(place.data[own].y[k])];
        }""",
        name,
    )
    x, y = tab.evaluate("window.at")
    tab.mouse.move(x - 3, y - 3)
    tab.mouse.move(x, y)
    hover = place.locator(".hoverlayer .hovertext")
    hover.first.wait_for(timeout=5000)
    return hover.first.text_content()


def zoomed(tab, figure):
    """Drag the mouse over a figure; it ends once another range of x is drawn."""
    own = f'.figure[data-figure="data-{figure}"]'
    place = tab.locator(own)
    place.scroll_into_view_if_needed()
    shown = "place => place._fullLayout.xaxis.range"
    before = place.evaluate(shown)
    box = place.locator(".xy .nsewdrag, .nsewdrag").first.bounding_box()
    tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 20)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 25, steps=5)
    tab.mouse.up()
    tab.wait_for_function(
        f"before => String(({shown})(document.querySelector('{own}'))) !== before",
        arg=",".join(map(str, before)),
    )


def test_first_turns_have_every_section_hover_tells_names_and_zoom_draws(opened, first_turns):
    tab = opened(first_turns)
    assert headings(tab) == ["findings", "notes", "gap", "scan", "sensitivity", "provenance"]
    answer = tab.inner_text("#answer")
    colour = tab.evaluate("getComputedStyle(document.querySelector('#answer')).borderLeftColor")
    assert colour == "rgb(42, 127, 59)"  # green: the fault is identified
    for words in ("IDENTIFIED", "QD::5", "Place", "Gap", "Do next"):
        assert words in answer
    assert tab.locator("nav a").count() == 6
    assert tab.locator(".figure .main-svg").first.is_visible()
    assert tab.locator(".figure").count() == 5
    for figure in ("plan", "scan"):
        assert "QD::5" in hovered(tab, figure, "QD::5")
    zoomed(tab, "readings")


def test_a_response_has_tables_that_are_sorted_and_copied(opened, response):
    tab = opened(response, permissions=["clipboard-read", "clipboard-write"])
    assert {"findings", "notes", "gap", "steps", "optics", "errors"} <= set(headings(tab))
    assert "QD::5" in tab.inner_text("#answer")
    assert "suspects" not in headings(tab)  # what would be one is a finding
    table = tab.locator("table.sortable").first
    column = "all => all.map(row => row.cells[2].textContent)"
    for _ in range(2):
        table.locator("th button").nth(2).click()
    ascending = [float(text) for text in table.locator("tbody tr").evaluate_all(column) if text]
    assert len(ascending) > 20
    assert ascending == sorted(ascending)
    table.locator("th button").nth(2).click()
    descending = [float(text) for text in table.locator("tbody tr").evaluate_all(column) if text]
    assert descending == ascending[::-1]
    tab.locator("button.copy").first.click()
    copied = tab.evaluate("navigator.clipboard.readText()").splitlines()
    assert copied[0].startswith("name,s [m],")
    assert len(copied) == len(table.locator("tbody tr").all()) + 1
    assert any(line.startswith("QD::5,") for line in copied)


def test_several_measurements_are_told_and_drawn_one_by_one(opened, together):
    tab = opened(together)
    assert "QD::5" in tab.inner_text("#answer")
    assert tab.locator('.figure[data-figure="data-readings"] .main-svg').first.is_visible()
    assert "tune" in tab.inner_text("#gap ~ .scroll")
    numbers = tab.locator("table", has=tab.get_by_text("estimated", exact=True)).first
    assert [row.split("\t")[0] for row in numbers.inner_text().splitlines()[1:]] == ["Qx", "Qy"]


@pytest.mark.parametrize("kind", ["first_turns", "response"])
def test_page_fits_a_phone_dark_paper_and_a_reader_without_scripts(opened, kind, request):
    address = request.getfixturevalue(kind)
    tab = opened(address, viewport=PHONE, color_scheme="dark")
    assert tab.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(24, 25, 27)"
    drawn, still = tab.locator(".figure").first, tab.locator("#answer img")
    assert (drawn.is_visible(), still.is_visible()) == (True, False)
    tab.emulate_media(media="print")
    assert (drawn.is_visible(), still.is_visible()) == (False, True)
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    plain = opened(address, java_script_enabled=False)
    assert plain.locator("#answer img").is_visible()


def test_names_that_are_markup_are_shown_as_they_stand(opened, small_ring, tmp_path):
    """To HTML, to plotly (tags, entities, templates, the page's colours) and to matplotlib."""
    name = '@ink q<!--<b>%{x}</b>&lt;$\\frac$<a href="https://e.example/">z</a></script>'
    save_ring(small_ring, tmp_path / "ring.json")
    document = json.loads((tmp_path / "ring.json").read_text())
    definitions = document["definitions"]
    document["definitions"] = {name if k == "QD" else k: d for k, d in definitions.items()}
    document["sequence"] = [name if k == "QD" else k for k in document["sequence"]]
    (tmp_path / "ring.json").write_text(json.dumps(document))
    ring = load_ring(tmp_path / "ring.json")
    weak = Cause("quadrupole_gradient", f"{name}::5", -0.02)
    data = shared.first_turns(ring, [weak])
    tab = opened(written(diagnose(ring, data, effects=EFFECTS), tmp_path))
    assert name in tab.inner_text("#answer")
    for figure in ("plan", "scan"):
        assert f"{name}::5" in hovered(tab, figure, "z&#60;/a&#62;&#60;/script&#62;::5")
    links = tab.eval_on_selector_all(".figure a", "all => all.map(one => one.outerHTML)")
    assert not [link for link in links if "e.example" in link]
