"""The ring from above, against AT's own geometry."""

from types import SimpleNamespace

import at
import pytest
from at_ring import at_lattice
from numpy.testing import assert_allclose

from tmlattice.lattice.survey import survey
from tmlattice.plots import plan


@pytest.mark.parametrize("name", ["small_ring", "petra3"])
def test_plan_matches_at(name, request):
    """Element by element; AT's y points to the other side where it turns the other way."""
    ring = request.getfixturevalue(name)
    plan = survey(ring)
    theirs, _ = at.get_geometry(at_lattice(ring))
    assert len(theirs.x) == len(plan.ends)
    assert_allclose(plan.ends[:, 0], theirs.x, atol=1e-9 * ring.length)
    assert_allclose(abs(plan.ends[:, 1]), abs(theirs.y), atol=1e-9 * ring.length)


def test_a_ring_closes_and_turns_to_the_right(petra3):
    plan = survey(petra3)
    assert_allclose(plan.ends[-1], plan.ends[0], atol=1e-3)  # of a diameter of 730 m
    assert plan.ends[:, 1].min() < -700
    assert plan.ends[:, 1].max() < 1


def test_places_between_elements_lie_on_the_orbit(small_ring):
    plan = survey(small_ring)
    quadrupole = small_ring["QD::5"]
    assert_allclose(plan.along(quadrupole.s, small_ring), plan.at(["QD::5"])[0], atol=1e-9)


def test_names_of_findings_that_stand_together_step_aside(small_ring):
    """The name of the last but one would stand on that of the one before, from the other side."""
    places = {"a": 10.0, "b": 11.0, "c": 12.0, "end_1": 13.2, "QF::3": 20.0, "d": 60.0}
    found = [
        SimpleNamespace(s=s, where=None, element=name, label=name) for name, s in places.items()
    ]
    nowhere = SimpleNamespace(s=None, where=None, element=None, elements=())
    plan_of = survey(small_ring)
    diagnosis = SimpleNamespace(ring=small_ring, findings=(*found, nowhere))
    placed = plan.placed(diagnosis, plan_of)
    assert [number for number, *_ in placed] == [1, 2, 3, 4, 5, 6]
    assert placed[0][-1] == placed[-1][-1] == 0
    boxes = [
        plan._box(at, plan.label(number, own), lines, plan_of) for number, own, at, lines in placed
    ]
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            assert (one[1] <= other[0]).any() or (other[1] <= one[0]).any()
