"""The page that tells how to add an effect: its example is run as it stands there."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from tmlattice.cli.command import tmlattice as command
from tmlattice.diagnosis import diagnose
from tmlattice.effects import CATALOGUE, Cause, names
from tmlattice.machine import Machine, draw_shots, simulate
from tmlattice.report.plain import report_text

PAGE = Path(__file__).parent.parent / "docs" / "new_effect.md"


@pytest.fixture
def effect():
    before = dict(CATALOGUE)
    exec(re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1], {})
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
    assert CliRunner().invoke(command, ["effects", "--json", str(path)]).exit_code == 0
    rows = {row["effect"]: row for row in json.loads(path.read_text())["effects"]}
    assert rows[effect.name]["words"] == effect.words
    assert rows[effect.name]["group"] == effect.group


def test_page_names_what_is_there(effect):
    page = PAGE.read_text(encoding="utf-8")
    root = PAGE.parent.parent
    for path in re.findall(r"`((?:tests|effects|tmlattice)/[\w/]+\.py)`", page):
        assert (root / path).exists() or (root / "tmlattice" / path).exists(), path
    said = page[page.index("## What else") :]
    for attribute in re.findall(r"`([a-z_]+)(?: = \w+)?`", said):
        assert hasattr(effect, attribute), attribute
