"""What to measure next of the kinds that were not taken: it parts what it says it parts."""

from dataclasses import replace

import pytest
from shared import valid

from tmlattice import Cause, diagnose
from tmlattice.challenge.kinds import measure
from tmlattice.diagnosis import next_measurement as module
from tmlattice.diagnosis.kinds import KINDS
from tmlattice.diagnosis.next_measurement import next_kind
from tmlattice.diagnosis.options import Options
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.judgement import DEFAULT
from tmlattice.report.action_texts import next_text
from tmlattice.report.text import to_do

WEAK = Cause("quadrupole_gradient", "QD::3", -0.01)


def measured(ring, kind, seed=1):
    return measure(kind, ring, [WEAK], 1.0, 3, seed=seed, machine_seed=1)


@pytest.fixture(scope="module")
def tunes(small_ring):
    """Four numbers: other magnets move the tunes as this one does."""
    reading = measured(small_ring, "tunes")
    return reading, diagnose(small_ring, reading)


def how(**more):
    return Options(ring=None, places={}, judgement=DEFAULT, **more)


def test_what_is_proposed_parts_them(small_ring, tunes):
    reading, diagnosis = tunes
    assert diagnosis.verdict == "ambiguous"
    proposed = diagnosis.next
    assert proposed.kind in KINDS
    assert proposed.kind != "tunes"
    assert proposed.separation > 5
    further = measured(small_ring, proposed.kind, seed=2)
    both = diagnose(small_ring, {"tunes": reading, "further": further})
    (found,) = both.findings
    assert both.verdict == "identified"
    assert (found.recommended_action.effect, found.recommended_action.element) == (
        WEAK.effect,
        WEAK.element,
    )


def test_it_is_told_in_text_and_json(tunes):
    _, diagnosis = tunes
    said = next_text(diagnosis)
    assert "minutes) would separate 'quadrupole_gradient QD::3' from" in said
    assert said in to_do(diagnosis)
    document = valid(diagnosis.as_json(), "diagnosis")
    told = document["next_measurement"]
    assert told["launch"] is None
    assert told["minutes"] == KINDS[told["kind"]].minutes(diagnosis.ring)


def test_the_dearer_of_two_that_part_alike_is_not_proposed(small_ring, tunes, monkeypatch):
    _, diagnosis = tunes
    seen = {**how().__dict__, "ring": small_ring}
    ask = (small_ring, diagnosis.explanation)
    monkeypatch.setattr(module, "separation", lambda problem, pair: 10.0)
    assert next_kind(*ask, ["tunes"], Options(**seen), ()).kind == "closed_orbit"
    assert next_kind(*ask, ["tunes", "closed_orbit"], Options(**seen), ()).kind == "turn_by_turn"


def test_nothing_is_proposed_that_gains_little(small_ring, tunes, monkeypatch):
    _, diagnosis = tunes
    asked = replace(how(), ring=small_ring)
    assert next_kind(small_ring, diagnosis.explanation, list(KINDS), asked, ()) is None
    monkeypatch.setattr(module, "separation", lambda problem, pair: 1.9)
    assert next_kind(small_ring, diagnosis.explanation, ["tunes"], asked, ()) is None
    sound = diagnose(small_ring, measure("tunes", small_ring, [], 1.0, 1, seed=3, machine_seed=1))
    assert sound.next is None


def test_what_a_kind_cannot_see_it_does_not_part(small_ring, tunes):
    """The zero of a monitor, one way or the other: an orbit alone knows of it."""
    _, diagnosis = tunes
    fit = diagnosis.explanation.fit
    asked = replace(how(), ring=small_ring)
    for kind, parts in (("tunes", False), ("dispersion", False), ("closed_orbit", True)):
        pair = []
        for amount in (1e-4, -1e-4):
            cause = Cause("monitor_offset_x", "end_3", amount)
            point = replace(fit.point, causes=(cause,))
            known = 1e-16 + 0 * fit.covariance  # its amount is not free to take it up
            pair.append(
                Alternative(
                    (cause.effect, cause.element), replace(fit, point=point, covariance=known)
                )
            )
        apart = module.separation(KINDS[kind].proposal(small_ring, asked), tuple(pair))
        assert (apart > 10) is parts
        if parts:  # 200 um in one reading of 2 um
            assert apart == pytest.approx(100, rel=0.01)
