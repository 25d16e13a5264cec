"""Small decks of MAD-X, one statement, attribute or class each; referee: MAD-X 5.09 itself."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.optics import closed_orbit, twiss

DECKS = json.loads((Path(__file__).parent / "lattices" / "madx_decks.json").read_text())["decks"]


def read(folder, text, **options):
    path = folder / "ring.madx"
    path.write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_ring(path, **options)


@pytest.mark.parametrize("name", DECKS)
def test_deck_is_the_ring_that_madx_tracks(tmp_path, name):
    deck = DECKS[name]
    ring = read(tmp_path, deck["text"])
    assert ring.energy == pytest.approx(deck["energy"], rel=1e-7)
    light = deck["mass"] < 1e-3
    assert ring.mass == pytest.approx(deck["mass"], rel=1e-6 if light else 1e-8)
    assert ring.length == pytest.approx(deck["length"], abs=1e-9)
    chain = Chain.from_ring(ring)
    # both are products of the same linear maps; where the orbit is bent, second order differs
    orbit = closed_orbit(chain)
    away = np.abs(deck["orbit"]).max()
    np.testing.assert_allclose(orbit[:4], deck["orbit"], rtol=0, atol=1e-9 + 2e-3 * away)
    tolerance = 2e-6 + 0.02 * away
    np.testing.assert_allclose(
        twiss(chain).total_tunes % 1, [deck["q1"] % 1, deck["q2"] % 1], rtol=0, atol=tolerance
    )
