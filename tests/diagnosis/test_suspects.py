"""Where to look first, where nothing explains the data."""

import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.machine.response import simulate_response
from tmlattice.report.page import page

SHOTS = {"shots": 4, "seed": 1, "engine": "ocelot", "amplitude": 3e-4, "noise": 2e-6}


@pytest.fixture(scope="module")
def among_small_errors(small_ring):
    """A wrong monitor, a corrector and a magnet, all strong, among errors everywhere."""
    name = next(e.name for e in small_ring.elements if e.kind == "hcorrector")
    causes = [
        Cause("monitor_gain_x", "end_3", -2.0),
        Cause("corrector_kick_x", name, 1e-4),
        Cause("quadrupole_gradient", "QD::5", -0.05),
    ]
    small = {"quadrupole_gradient": 5e-3, "quadrupole_offset_y": 1e-5}
    data = simulate(small_ring, causes, background=small, **SHOTS).measurement()
    # told that there are no small errors, so that nothing explains the data
    return causes, diagnose(small_ring, data, max_effects=3, background={})


def test_strong_faults_among_small_errors_are_suspects_and_no_findings(
    small_ring, among_small_errors
):
    causes, result = among_small_errors
    assert (result.verdict, result.findings) == ("distributed", ())
    (monitor, corrector, magnet) = causes
    by_kind = {}
    for one in result.suspects:
        by_kind.setdefault(one.kind, []).append(one)
    assert by_kind["monitor"][0].element == monitor.element
    assert corrector.element in [one.element for one in by_kind["corrector"]]
    s = small_ring[magnet.element].s
    assert any(one.where[0] <= s <= one.where[1] for one in by_kind["section"])
    assert all(len(some) <= 3 for some in by_kind.values())


def test_text_page_and_json_list_the_same_suspects(among_small_errors):
    result = among_small_errors[1]
    html, text, document = page(result, []), result.report(), result.as_json()
    assert [one["element"] for one in document["suspects"]] == [s.element for s in result.suspects]
    for said in (html, text):
        assert "Suspects, no findings" in said
        for one in result.suspects:
            assert one.kind == "section" or one.element in said


def test_an_outlier_of_a_family_is_a_suspect_everywhere(small_ring):
    """A gain 20 times the scatter of the others, in a fit that names no single fault."""
    wrong = Cause("monitor_gain_x", "end_3", 0.4)
    data = simulate_response(
        small_ring, [wrong], background={"monitor_gain_x": 0.02, "quadrupole_gradient": 2e-3},
        engine="ocelot", progress=False,
    ).measured  # fmt: skip
    result = diagnose(small_ring, data, effects=["monitor_gain_x", "quadrupole_gradient"],
                      max_effects=1)  # fmt: skip
    found = [*result.suspects, *result.findings]
    assert wrong.element in [one.element for one in found]
    for one in result.suspects:
        assert (one.measure, one.elements[0]) == ("scatter", one.element)
        assert one.statistic > one.threshold
        for said in (page(result, []), result.report()):
            assert f"{one.statistic:.0f} times the scatter of its family" in " ".join(said.split())


def test_small_errors_that_explain_all_leave_suspects(small_ring):
    small = {"quadrupole_gradient": 0.02, "quadrupole_offset_x": 1e-4}
    data = simulate(small_ring, [], background=small, **SHOTS).measurement()
    effects = [*small, "quadrupole_roll", "dipole_field", "monitor_gain_x"]
    result = diagnose(small_ring, data, effects=effects)
    assert result.verdict == "distributed"
    assert result.suspects
    assert all(one.statistic >= 9 for one in result.suspects)  # three sigma, looked at alone
