"""One judgement, stated once: text, page and JSON agree, and no two sentences contradict."""

import itertools
import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from shared import first_turns as turns

from tmlattice import Cause, diagnose, simulate
from tmlattice.diagnosis.assessment import STATEMENTS, Assessment, Block, compared_of
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.effects import background_rms
from tmlattice.inference.validation import Gap, Misfit
from tmlattice.machine.response import simulate_response
from tmlattice.report.page import page
from tmlattice.report.plain import report_text
from tmlattice.report.tables import optics_rows

WEAK = Cause("quadrupole_gradient", "QD::5", -0.02)
USUAL = background_rms({"all": None})


def response(ring, causes=(), **options):
    options = {"engine": "ocelot", "progress": False, **options}
    return simulate_response(ring, list(causes), **options).measured


def with_reference(ring, causes, seed):
    usual = {"background": USUAL, "noise": 2e-5, "seed": seed}
    return diagnose(ring, turns(ring, causes, **usual), reference=turns(ring, **usual))


MANY = [Cause("quadrupole_gradient", f"QD::{i}", 0.05) for i in (2, 5, 8, 11)]
GAINS = {"quadrupole_gradient": 2e-3, "monitor_gain_x": 0.02}
SCENARIOS = {
    "turns of a faultless ring": lambda ring: diagnose(ring, turns(ring)),
    "turns, weak quadrupole": lambda ring: diagnose(ring, turns(ring, [WEAK])),
    "one shot, weak quadrupole": lambda ring: diagnose(ring, turns(ring, [WEAK], shots=1)),
    "turns, small errors": lambda ring: diagnose(
        ring, turns(ring, background=USUAL, noise=2e-5, shots=6)
    ),
    "turns, weak quadrupole, reference": lambda ring: with_reference(ring, [WEAK], 3),
    "turns, no fault, reference": lambda ring: with_reference(ring, [], 4),
    "turns, one of four faults may be found": lambda ring: diagnose(
        ring, turns(ring, MANY), background={}, max_effects=1
    ),
    "turns, estimated noise": lambda ring: diagnose(
        ring, replace(turns(ring, [WEAK]), noise=None), background={}
    ),
    "response of a faultless ring": lambda ring: diagnose(
        ring, response(ring), effects=["quadrupole_gradient", "corrector_calibration"]
    ),
    "response, small errors": lambda ring: diagnose(
        ring, response(ring, background=GAINS), effects=[*GAINS, "corrector_calibration"]
    ),
    "response, gains that are not fitted": lambda ring: diagnose(
        ring, response(ring, [WEAK], background=GAINS),
        effects=["quadrupole_gradient", "corrector_calibration"],
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def results(small_ring):
    return {name: make(small_ring) for name, make in SCENARIOS.items()}


def in_a_line(text):
    return " ".join(text.split())


def outputs(result):
    """What text, page and JSON say."""
    html = re.sub(r"<script.*?</script>", "", page(result, []), flags=re.S)
    html = unescape(re.sub(r"<[^>]+>", " ", html))
    return in_a_line(result.report()), in_a_line(html), json.loads(json.dumps(result.as_json()))


@pytest.mark.parametrize("name", SCENARIOS)
def test_text_page_and_json_state_the_same_sentences(results, name):
    result = results[name]
    text, html, document = outputs(result)
    stated = document["assessment"]["statements"]
    assert [one.name for one in result.assessment.statements] == list(stated)
    for topic in ("gap", "remainder"):
        sentence = result.assessment.sentence(topic)
        assert sentence
        assert sentence in text
        assert sentence in html
        assert sentence in stated.values()
    assert document["unexplained"]["p_value"] == document["assessment"]["p_value"]


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_terminal_has_the_answer_and_names_what_it_leaves_out(results, name):
    result = results[name]
    whole, short = (report_text(result, 80, most) for most in (None, 34))
    assert len(short.splitlines()) <= 34
    assert short.splitlines()[0] == whole.splitlines()[0]
    assert in_a_line(result.assessment.sentence("gap")) in in_a_line(short)
    for paragraph in whole.split("\n\n"):
        if paragraph not in short:
            assert "More in report.txt of --out DIR" in short


CONTRADICTIONS = (
    ("residual is noise", "An effect is missing from the model"),
    ("residual is noise", "is larger than the noise"),
    ("explains the readings within their noise", "An effect is missing from the model"),
    ("Distributed errors explain the readings", "An effect is missing from the model"),
    ("show no gap beyond the noise", "of the gap is explained"),
    ("No reading was held out", "of the gap is explained"),
    ("Nothing was put into the model", "of the gap is explained"),
    ("Nothing was put into the model", "within their noise"),
)


@pytest.mark.parametrize("name", SCENARIOS)
def test_no_two_sentences_contradict(results, name):
    for said in outputs(results[name])[:2]:
        for one, other in CONTRADICTIONS:
            assert not (one in said and other in said), (one, other)


def test_simulated_data_lack_no_effect_that_was_fitted(results):
    found = {name: result.assessment.remainder for name, result in results.items()}
    assert found.pop("response, gains that are not fitted") == "effect_missing"
    assert found.pop("turns, one of four faults may be found") == "effect_missing"
    assert found.pop("turns, estimated noise") in ("noise", "unknown")
    assert set(found.values()) == {"noise"}


def test_a_few_causes_that_do_not_explain_the_readings_are_not_stated(results):
    found = results["turns, one of four faults may be found"]
    assert (found.verdict, found.findings) == ("distributed", ())
    assert any("not explain" in said for said in found.warnings)
    assert found.gap["fit"]["before"] == found.gap["fit"]["after"]


def test_a_gap_that_falls_by_orders_of_magnitude_is_closed(results):
    """Two held-out shots: the small errors' covariance joins them, the design's does not."""
    found = results["turns, small errors"]
    assert len(found.heldout_shots) == 2
    before, after = found.heldout.misfits[0].rms, found.heldout.misfits[-1].rms
    assert before > 10 * after
    assert found.assessment.gap == "explained"
    assert found.heldout.explained > 0.99


@pytest.mark.parametrize("name", [name for name in SCENARIOS if "reference" in name])
def test_a_reference_that_was_given_is_not_asked_for(results, name):
    for said in outputs(results[name])[:2]:
        assert "--reference" not in said


def test_small_errors_are_compared_with_usual_ones_where_the_readings_determine_them(results):
    found = results["turns, small errors"]
    rows = [line for line in found.report().splitlines() if "times the usual one" in line]
    determined = [name for name, error in found.prior_errors.items() if error <= 0.5]
    assert 0 < len(determined) < len(found.priors)
    assert len(rows) == len(determined)


def test_a_closed_orbit_that_was_not_measured_has_no_number(results):
    found = results["response, small errors"]
    assert "closed_orbit" not in found.assessment.measured
    for said in outputs(found)[:2]:
        assert "closed orbit, rms" not in said
        assert "beta beating, rms" in said


def test_a_named_verdict_has_no_suspects(results):
    found = results["turns, weak quadrupole"]
    assert (found.verdict, found.suspects) == ("identified", ())


def noise_of(ring, data):
    return {check.name: check for check in check_data(ring, data).checks}["noise"]


def test_a_noise_far_below_what_neighbours_leave_is_not_just_ok(small_ring):
    """Two shots do not tell noise from errors of the machine; eight do, from shot to shot."""
    usual = {"background": {"all": None}, "seed": 1, "machine_seed": 5}
    data = simulate(small_ring, shots=6, **usual).measurement()
    data = replace(data, noise=np.full((35, 2), 2e-6))
    two = noise_of(small_ring, data.select(shots=[0, 1]))
    assert two.status == "note"
    assert "2 shots do not show which" in two.sentence
    exact = simulate(small_ring, shots=8, noise=2e-6, **usual).measurement()
    eight = noise_of(small_ring, exact)
    assert eight.status == "fine"
    assert "errors of the machine" in eight.sentence


def test_a_closed_orbit_stands_where_an_error_makes_one(small_ring):
    def names(cause):
        found = diagnose(small_ring, simulate(small_ring, [cause], shots=4, seed=1).measurement())
        assert found.causes
        return [name for name, *_ in optics_rows(found)]

    assert not any("orbit" in n for n in names(Cause("quadrupole_gradient", "QD::5", -0.1)))
    assert any("orbit" in n for n in names(Cause("corrector_kick_y", "v5", 1e-4)))


# --- the table of sentences -----------------------------------------------------------------------
FITTED = {
    "noise": Block("fitted readings", 100.0, 100),
    "above": Block("fitted readings", 14000.0, 10000),
    "missing": Block("fitted readings", 900.0, 100),
}


def gap_of(before, after, explained, readings=100):
    misfits = (Misfit(before * 1e-5, before**2), Misfit(after * 1e-5, after**2))
    return Gap(misfits, np.zeros((0, 0, 0)), explained, None, 0, readings)


GAPS = (None, gap_of(5, 1, 0.99), gap_of(5, 2, 0.9), gap_of(1, 1, None), gap_of(2, 1, None),
        gap_of(2, 2, None), gap_of(1.2, 1.2, None))  # fmt: skip
FLAGS = ("amounts", "findings", "noise_estimated", "families", "small_errors", "reference")


def every_assessment():
    """All combinations that a diagnosis can have."""
    for verdict in ("identified", "localised", "distributed", "none"):
        for fitted, gap in itertools.product(FITTED.values(), GAPS):
            for flags in itertools.product((False, True), repeat=len(FLAGS)):
                told = dict(zip(FLAGS, flags, strict=True))
                if told["small_errors"] and (told["families"] or not told["amounts"]):
                    continue
                alone = not told["families"] and not told["small_errors"]
                if verdict == "distributed" and alone and told["amounts"]:
                    continue  # it puts nothing into the model
                yield Assessment(verdict, compared_of(fitted, gap), gap, **told)
    yield Assessment("none", (), None, amounts=False, findings=False, noise_estimated=False)
    for fitted in FITTED.values():
        yield Assessment("none", (fitted,), None, amounts=False, findings=False,
                     noise_estimated=False, reference=True, change=True)  # fmt: skip


def test_one_sentence_of_a_topic_holds_and_none_excludes_another():
    seen = set()
    for own in every_assessment():
        topics = [one.topic for one in own.statements]
        assert len(topics) == len(set(topics)), own.statements
        assert {"remainder", "gap"} <= set(topics)
        names = {one.name for one in own.statements}
        for one in own.statements:
            assert not set(one.excludes) & names, (one.name, own)
        seen |= names
    assert seen | {"gap_beam_lost"} == {one.name for one in STATEMENTS}
