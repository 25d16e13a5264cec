"""The developers' pages on a new kind, reader, check and effect: examples run as they stand."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from shared import run_page

from tmlattice import Cause, diagnose
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.diagnosis import signals
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.diagnosis.kinds import KINDS, Kind
from tmlattice.effects import CATALOGUE, names
from tmlattice.errors import MeasurementError
from tmlattice.importers import write_imported
from tmlattice.machine import Machine, draw_shots, simulate
from tmlattice.machine.stored_beam import (
    simulate_dispersion,
    simulate_orbits,
    simulate_tunes,
    simulate_turns,
)
from tmlattice.measurement import read_measurement, write_measurement
from tmlattice.report.plain import report_text

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("new_*.md"))
WEAK = Cause("quadrupole_gradient", "QD::3", -0.01)


def names_of(page):
    """What the Python of a page defines."""
    return run_page(f"{page}.md", __name__=page)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short_and_names_files_that_are_there(page):
    text = page.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    named = re.findall(r"`([\w/]+\.(?:py|json))`", text)
    assert len(named) > 3
    places = (ROOT, ROOT / "tmlattice", ROOT / "tmlattice" / "diagnosis")
    assert [name for name in named if not any((p / name).exists() for p in places)] == []


# --- a kind ---------------------------------------------------------------------------------------
@pytest.fixture
def scan(small_ring, monkeypatch):
    """Tunes at three RF frequencies by AT's tunes and chromaticities, of a weak quadrupole."""
    names = names_of("new_kind")
    monkeypatch.setitem(KINDS, "tune_scan", Kind(names["TuneScan"], names["tune_scan"]))
    read = simulate_tunes(small_ring, [WEAK], noise=(0, 0)).measured
    frequency = np.array([-1e-5, 0, 1e-5])
    momentum = frequency * ResponseModel(small_ring).rf_start[5] / small_ring.beta
    noise = 1e-5 * np.random.default_rng(1).standard_normal((3, 2))
    tune = read.tune + read.chromaticity * momentum[:, None] + noise
    return names["TuneScan"](frequency, tune, np.full((3, 2), 1e-5))


def test_the_kind_of_the_page_is_diagnosed_alone_and_together(small_ring, scan):
    alone = diagnose(small_ring, {"scan": scan})
    assert alone.verdict in ("identified", "ambiguous")
    members = [(one.effect, one.element) for one in alone.findings[0].credible_set]
    assert (WEAK.effect, WEAK.element) in members
    both = {"scan": scan, "dispersion": simulate_dispersion(small_ring, [WEAK]).measured}
    (found,) = diagnose(small_ring, both).findings
    assert (found.effect, found.element) == (WEAK.effect, WEAK.element)
    assert abs(found.amount - WEAK.amount) < 4 * found.amount_sigma < 1e-3


def test_the_record_of_the_page_refuses_another_shape(scan):
    with pytest.raises(MeasurementError, match=r"give \[step, 2\]"):
        type(scan)(scan.frequency[:2], scan.tune, scan.error)


# --- a reader -------------------------------------------------------------------------------------
@pytest.fixture
def archive(small_ring, tmp_path):
    orbit = simulate_orbits(small_ring, [Cause("corrector_kick_x", "v6", 3e-5)]).measured
    lines = [
        json.dumps({"bpm": name.upper(), "x": 1e3 * x, "y": 1e3 * y})
        for name, (x, y) in zip(orbit.monitors, orbit.orbit[0], strict=True)
    ]
    path = tmp_path / "orbit.jsonl"
    path.write_text("\n".join(lines))
    return orbit, path


def test_the_reader_of_the_page_gives_what_was_written(small_ring, archive, tmp_path):
    orbit, path = archive
    brought = names_of("new_reader")["bring_archive"](path, small_ring)
    assert brought.assumed[0] == "readings are in mm"
    order = [brought.measurement.monitors.index(name) for name in orbit.monitors]
    np.testing.assert_allclose(brought.measurement.orbit[:, order], orbit.orbit, atol=1e-15)
    write_imported(brought, tmp_path / "day")
    assert read_measurement(tmp_path / "day") == brought.measurement


@pytest.mark.parametrize("line", ["{", "[1]", '{"bpm": 3}', '{"bpm": "end_99", "x": 1, "y": 2}',
                                  '{"bpm": "end_1", "x": "a", "y": 2}', "[" * 100_000])  # fmt: skip
def test_the_reader_of_the_page_rejects_a_damaged_line_with_its_number(small_ring, archive, line):
    path = archive[1]
    path.write_text(f"{path.read_text().splitlines()[0]}\n{line}")
    with pytest.raises(MeasurementError, match=r"orbit\.jsonl:2: "):
        names_of("new_reader")["bring_archive"](path, small_ring)


# --- a check --------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["turns", "first turns"])
def test_the_check_of_the_page_finds_clipped_readings_alone(
    small_ring, tmp_path, kind, monkeypatch
):
    saturated, plain = names_of("new_check")["saturated"], signals.monitors

    def with_it(ring, names, values, moved=True):
        return [*plain(ring, names, values, moved), saturated(names, values)]

    monkeypatch.setattr(signals, "monitors", with_it)
    if kind == "turns":
        data = simulate_turns(small_ring, turns=64).measured
    else:
        data = simulate(small_ring, shots=8, amplitude=1e-4, noise=1e-6).measurement()
    (own,) = [c for c in check_data(small_ring, data).checks if c.name == "saturated BPMs"]
    assert own.status == "fine"
    readings = data.readings.copy()
    m = data.monitors.index("end_2")
    end = np.quantile(readings[..., m, 0], 0.4)
    readings[..., m, 0] = np.minimum(readings[..., m, 0], end)
    vars(data)["readings"] = readings
    write_measurement(tmp_path / "day", data)
    done = tmlattice("check", SMALL, "day", "--json", "check.json", cwd=tmp_path)
    assert done.returncode in (0, 1)
    checks = json.loads((tmp_path / "check.json").read_text())["checks"]
    (own,) = [c for c in checks if c["name"] == "saturated BPMs"]
    assert own["status"] == "note"
    assert "in end_2:" in own["sentence"]


# --- the page that tells how to add an effect: its example is run as it stands there --------------
PAGE = Path(__file__).parent.parent / "docs" / "new_effect.md"


@pytest.fixture
def effect():
    before = dict(CATALOGUE)
    run_page(PAGE.name)
    (added,) = set(CATALOGUE) - set(before)
    yield CATALOGUE[added]
    del CATALOGUE[added]


def test_example_of_the_page_is_known_everywhere(small_ring, effect, tmp_path):
    place = effect.places(small_ring)[20]
    cause = Cause(effect.name, place, effect.largest)
    shots = draw_shots(small_ring, 2, 3e-4, seed=1)
    at, ocelot = (
        Machine(small_ring, [cause], engine=engine).beam(shots.launches)
        - Machine(small_ring, engine=engine).beam(shots.launches)
        for engine in ("at", "ocelot")
    )
    # the engines differ in the third order of the launch
    assert np.abs(at - ocelot).max() < 0.01 * np.abs(at).max()

    data = simulate(small_ring, [cause], shots=3, seed=1, amplitude=3e-4, noise=2e-6).measurement()
    found = diagnose(small_ring, data)
    assert (found.findings[0].effect, found.findings[0].element) == (effect.name, place)
    off = found.findings[0].amount - effect.largest
    assert abs(off) < 4 * found.findings[0].amount_sigma
    assert effect.words in report_text(found)

    assert effect.name in names()  # the challenge draws from these
    path = tmp_path / "effects.json"
    tmlattice("effects", "--json", path, cwd=tmp_path, check=0)
    rows = {row["effect"]: row for row in json.loads(path.read_text())["effects"]}
    assert rows[effect.name]["words"] == effect.words
    assert rows[effect.name]["group"] == effect.group


def test_page_names_attributes_that_are_there(effect):
    page = PAGE.read_text(encoding="utf-8")
    for attribute in re.findall(r"`([a-z_]+)(?: = \w+)?`", page[page.index("## What else") :]):
        assert hasattr(effect, attribute), attribute
