"""What the lattice lacks is left out and told, unless it lacks most of it."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import diagnose
from tmlattice.challenge.kinds import measure
from tmlattice.diagnosis.data_checks import check_data, in_the_lattice
from tmlattice.effects import Cause
from tmlattice.errors import UnknownNameError
from tmlattice.machine.response import simulate_response

KINDS = ("trajectory", "turn_by_turn", "closed_orbit", "dispersion")
SOME = ["quadrupole_gradient"]


@pytest.fixture(scope="module")
def response(small_ring):
    fault = [Cause("quadrupole_gradient", next(m.name for m in small_ring.magnets
                                               if m.kind == "quadrupole"), 0.01)]  # fmt: skip
    return simulate_response(
        small_ring, fault, kick=1e-4, noise=2e-6, rf_step=-1000.0, seed=2, progress=False
    ).measured


def with_more(response):
    """The same with a corrector and a monitor elsewhere, in front of all others."""
    monitors, columns = len(response.monitors), len(response.correctors)
    wider = np.full((columns + 1, monitors + 1, 2), 1e-4)
    wider[1:, 1:] = response.response
    orbit = np.full((monitors + 1, 2), 1e-4)
    orbit[1:] = response.rf.orbit
    return replace(
        response,
        correctors=("steerer_of_the_line", *response.correctors),
        planes=("x", *response.planes),
        kicks=np.append(1e-4, response.kicks),
        monitors=("screen_of_the_line", *response.monitors),
        response=wider,
        noise=np.vstack([[2e-6, 2e-6], response.noise]),
        rf=replace(response.rf, orbit=orbit),
    )


def test_what_the_lattice_lacks_is_left_out_and_told(small_ring, response):
    alone, found = (diagnose(small_ring, one) for one in (response, with_more(response)))
    own, other = alone.as_json(), found.as_json()
    assert own["findings"] == other["findings"]
    assert own["findings"][0]["effect"] == "quadrupole_gradient"
    assert found.warnings[:2] == (
        f"not in the lattice, and left out: 1 of {len(response.monitors) + 1} BPMs "
        "(screen_of_the_line)",
        f"not in the lattice, and left out: 1 of {len(response.correctors) + 1} correctors "
        "(steerer_of_the_line)",
    )
    assert found.warnings[2:] == alone.warnings


def test_of_a_reference_too(small_ring, response):
    again = with_more(response)
    found = diagnose(small_ring, again, reference=again, effects=SOME)
    assert found.verdict == "none"
    assert sum("not in the lattice" in said for said in found.warnings) == 2


def test_the_data_checks_note_it(small_ring, response):
    notes = [check for check in check_data(small_ring, with_more(response)).reported
             if check.name == "names"]  # fmt: skip
    assert len(notes) == 2
    assert all(check.status == "note" for check in notes)


@pytest.mark.parametrize("kind", KINDS)
def test_of_every_kind_that_has_monitors(small_ring, kind):
    measured = measure(kind, small_ring, [], 1.0, 2, seed=3)
    names = list(measured.monitors)
    strange = replace(measured, monitors=("elsewhere", *names[1:]))
    kept, said = in_the_lattice(small_ring, strange)
    assert kept.monitors == tuple(names[1:])
    assert said == [f"not in the lattice, and left out: 1 of {len(names)} BPMs (elsewhere)"]
    assert diagnose(small_ring, strange, effects=SOME).warnings[0] == said[0]
    assert check_data(small_ring, strange).reported[0].sentence == said[0]


def test_another_ring_s_names_are_an_error(small_ring, response):
    names = tuple(f"other_{name}" for name in response.monitors)
    count = len(names)
    for run in (diagnose, check_data):
        with pytest.raises(UnknownNameError, match=f"^{count} of {count} BPMs are not in"):
            run(small_ring, replace(response, monitors=names))


def test_a_measurement_of_the_ring_is_itself(small_ring, response):
    kept, said = in_the_lattice(small_ring, response)
    assert kept is response
    assert not said


def test_of_several_and_of_what_judges_each_is_told_once(small_ring, response):
    again, apart = (
        with_more(response),
        replace(response, monitors=("nobody", *response.monitors[1:])),
    )
    day = {"day": again}
    alone = diagnose(small_ring, day, reference=day, effects=SOME).warnings
    assert sum("not in the lattice" in said for said in alone) == 2
    assert alone[0].startswith("not in the lattice")
    turns, orbit = (measure(kind, small_ring, [], 1.0, 2, seed=3) for kind in KINDS[1:3])
    orbit = replace(orbit, monitors=("nobody", *orbit.monitors[1:]))
    both = diagnose(small_ring, {"turns": turns, "orbit": orbit}, effects=SOME).warnings
    assert next(said for said in both if "not in the lattice" in said).startswith("orbit: not in")
    (told, *_) = diagnose(small_ring, response, reference=apart, effects=SOME).warnings
    assert apart.monitors[0] in told


def test_a_name_that_is_nearly_one_is_told_with_it(small_ring, response):
    name = response.monitors[3]
    wrong = (*response.monitors[:3], f"{name}_", *response.monitors[4:])
    (said,) = in_the_lattice(small_ring, replace(response, monitors=wrong))[1]
    assert f"did you mean '{name}'" in said


def test_half_of_the_names_may_be_unknown_and_no_more(small_ring, response):
    count = len(response.monitors)
    for unknown in (count // 2, count // 2 + 1):
        names = [f"far_{i}_off" for i in range(unknown)]
        measured = replace(response, monitors=(*names, *response.monitors[unknown:]))
        if unknown <= count / 2:
            assert len(in_the_lattice(small_ring, measured)[0].monitors) == count - unknown
        else:
            with pytest.raises(UnknownNameError, match=f"{unknown} of {count} BPMs"):
                in_the_lattice(small_ring, measured)
