"""Cases of every kind of measurement: blind, as clearly seen as they say, and scored."""

import json
from importlib import resources

import jsonschema
import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL

from tmlattice.challenge import kinds, make, read_case, read_truth, run, score
from tmlattice.challenge.case import Truth
from tmlattice.challenge.draw import Draw
from tmlattice.challenge.figures import summary
from tmlattice.challenge.kinds import Ruler, problem_of
from tmlattice.challenge.oracle import refitted
from tmlattice.challenge.record import Places
from tmlattice.challenge.score import row_of
from tmlattice.effects import Cause
from tmlattice.errors import TmlatticeError
from tmlattice.machine.stored_beam import simulate_dispersion

LATTICE = str(SMALL)
EFFECTS = ["quadrupole_gradient", "skew_gradient", "monitor_gain_x"]


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    folder = tmp_path_factory.mktemp("challenge") / "M"
    make(
        "M", 2, 3, folder, lattice=LATTICE, effects=EFFECTS, signal=(30, 60), progress=False,
        kinds=["trajectory", "dispersion"],
    )  # fmt: skip
    return folder


def test_the_public_part_of_kinds_holds_no_truth(several):
    files = [p for p in sorted((several / "cases").rglob("*")) if p.is_file()]
    text = b"".join(p.read_bytes() for p in files if p.suffix != ".npz").decode()
    for name in ("0000", "0001"):
        truth, case = read_truth(several, name), read_case(several, name)
        assert set(case.measured) == {"trajectory", "dispersion"}
        assert repr(truth.causes[0].amount) not in text
        assert str(truth.seed) not in text
    assert '"alone"' not in text


def test_signal_to_noise_of_a_kind_by_brute_force_with_at(small_ring):
    """A dispersion has no nuisance: it is the change that AT makes, over its noise."""
    fault = Cause("quadrupole_gradient", "QD::3", -4e-3)
    sick, healthy = (
        simulate_dispersion(small_ring, causes, seed=4).measured for causes in ([fault], [])
    )
    ruler = Ruler(problem_of(small_ring, {"dispersion": healthy}, {}, {}))
    change = sick.steps[0].orbit - healthy.steps[0].orbit  # of one seed: the noise is gone
    expected = np.linalg.norm(change / np.asarray(healthy.noise))
    assert ruler.of([fault]) == pytest.approx(expected, rel=0.01)  # second-order maps


def test_what_no_stored_beam_survives_is_smaller_until_one_does(small_ring, tmp_path):
    """30 % of a quadrupole has no closed orbit here; it is drawn all the same."""
    make(
        "T", 3, 2, tmp_path, lattice=LATTICE, effects=["quadrupole_gradient"], signal=(20, 30),
        progress=False, shots=2,
    )  # fmt: skip
    for name in ("0000", "0001", "0002"):
        (cause,) = read_truth(tmp_path, name).causes
        assert 0 < abs(cause.amount) < 0.3


def test_each_kind_alone_and_all_together_are_scored(several):
    results = run(several, jobs=1, progress=False, lattice=LATTICE)
    assert all(set(r["alone"]) == {"trajectory", "dispersion"} for r in results.values())
    result = score(several, jobs=1, progress=False, lattice=LATTICE)
    schema = resources.files("tmlattice") / "schemas" / "challenge.schema.json"
    jsonschema.validate(json.loads(json.dumps(result)), json.loads(schema.read_text()))
    assert not result["failed"]
    assert result["measured_kinds"] == ["trajectory", "dispersion"]
    names = {"tool", "alone: trajectory", "alone: dispersion", "oracle", "omp", "lasso"}
    for row in result["rows"]:
        assert names <= set(row["answers"])
        assert row["answers"]["tool"]["in_set"]
        assert row["answers"]["oracle"]["in_set"]
    told = result["together"]
    assert told["of_found_alone"]["cases"] + told["of_none_alone"]["cases"] == 2


def test_scoring_again_reads_no_table(several, monkeypatch):
    """Tables of turns take longer to be read than all else takes where the oracle was asked."""
    run(several, jobs=1, progress=False, lattice=LATTICE)
    score(several, jobs=1, progress=False, lattice=LATTICE)

    def read(*args, **options):
        raise AssertionError("a table was read")

    monkeypatch.setattr("tmlattice.challenge.case.read_measurement", read)
    assert not score(several, jobs=1, progress=False, lattice=LATTICE)["failed"]


def test_the_oracle_weighs_the_truth_by_the_full_model(several):
    case, truth = read_case(several, "0000"), read_truth(several, "0000")
    found = refitted(case, truth)
    (cause,) = truth.causes
    at = found.seen.hypotheses.index((cause.effect, cause.element))
    assert found.statistic[at] > found.statistic.max() - 9
    assert found.statistic[at] == pytest.approx(truth.total**2, rel=0.5)  # one draw of noise
    assert found.amount[at] == pytest.approx(cause.amount, rel=0.2)


def test_an_effect_that_no_amount_makes_small_is_drawn_in_vain():
    """An RF that comes on with any loss of energy makes what is seen, not the loss."""

    class Sudden:
        def of(self, causes):
            return 150.0 + causes[0].amount

    draw = Draw(np.random.default_rng(0), (5.0, 100.0))
    assert draw.sized(Sudden(), [Cause("radiation_loss_bends", None, 1.0)], 20.0) is None
    assert draw.unreachable[0][:2] == ("radiation_loss_bends", None)
    (kept,) = draw.sized(Sudden(), [Cause("radiation_loss_bends", None, 1.0)], 140.0)
    assert kept.amount > 0


def test_a_cause_is_drawn_among_what_is_measured_of_the_case(monkeypatch, tmp_path):
    """A monitor that counts its turns late is no fault where no turns are read."""
    seen = []

    def drawn(asked, draw, ruler, machine):
        seen.append((asked.kinds, [part.monitors for part in ruler.problem.parts]))
        raise TmlatticeError("enough")

    monkeypatch.setattr(kinds, "_drawn", drawn)
    with pytest.raises(TmlatticeError, match="enough"):
        make(
            "M", 1, 2, tmp_path, lattice=LATTICE, progress=False,
            kinds=["closed_orbit", "tunes", "dispersion", "trajectory"],
        )  # fmt: skip
    ((asked, parts),) = seen
    assert len(asked) == len(parts) < 4


def test_what_many_find_where_one_does_not_by_hand(small_ring):
    name = "QD::3"
    right = {
        "effect": "quadrupole_gradient", "element": name, "s": None, "amount": 0.1,
        "amount_sigma": 0.01, "probability": 1.0, "mass": 1.0,
        "credible_set": [{"effect": "quadrupole_gradient", "element": name, "probability": 1.0}],
    }  # fmt: skip
    truth = Truth(
        "x", "M", (Cause("quadrupole_gradient", name, 0.1),), None, (30.0,), 30.0, {}, 0.0, 1.0, 0,
        {}, {}, {"a": 1.0, "b": 2.0},
    )  # fmt: skip
    rows = []
    for together, alone in ((True, True), (False, True), (True, False), (True, False)):
        said = {
            "verdict": "identified" if together else "none", "findings": [right] * together,
            "gap": {"explained": None, "heldout": None}, "next_measurement": None, "seconds": 1.0,
            "alone": {
                "a": {"verdict": "none", "findings": []},
                "b": {"verdict": "identified", "findings": [right] * alone},
            },
        }  # fmt: skip
        rows.append(row_of(said, truth, None, None, Places(small_ring)))
        rows[-1] |= {"clean_before": None, "clean_after": None}
    told = summary(rows, "M")["together"]
    assert (told["of_found_alone"]["share"], told["of_found_alone"]["cases"]) == (0.5, 2)
    assert (told["of_none_alone"]["share"], told["of_none_alone"]["cases"]) == (1.0, 2)


def test_small_errors_are_no_false_alarm_where_there_are_some(small_ring):
    truth = Truth("x", "E", (), None, (), 0.0, {"quadrupole_gradient": 1e-3}, 0.0, 1.0, 0, {}, {})
    said = {
        "verdict": "distributed", "findings": [], "gap": {"explained": None, "heldout": None},
        "next_measurement": None, "priors": {"quadrupole_gradient": 1e-3},
    }  # fmt: skip
    row = row_of(said, truth, None, None, Places(small_ring))
    assert summary([row], "E")["false_alarms"]["share"] == 0.0
    sound = Truth("x", "E", (), None, (), 0.0, {}, 0.0, 1.0, 0, {}, {})
    row = row_of(said, sound, None, None, Places(small_ring))
    assert summary([row], "E")["false_alarms"]["share"] == 1.0


def test_kinds_that_make_no_sense_are_a_sentence(tmp_path):
    told = [
        (("T",), {"kinds": ["tunes"]}, "tiers E, M and P"),
        (("M",), {"kinds": ["tunes"]}, "two of them"),
        (("P",), {"kinds": ["turns"]}, "no kind 'turns'"),
        (("R",), {"known_rms": True}, "leave --known-rms out"),
    ]
    for (tier,), options, said in told:
        with pytest.raises(TmlatticeError, match=said):
            make(tier, 1, 0, tmp_path / tier, lattice=LATTICE, progress=False, **options)


def test_the_command_makes_kinds(tmp_path):
    tmlattice(
        "dev", "challenge", "make", "E", "--kind", "tunes", "--cases", "2", "--out", "e",
        "--lattice", LATTICE, cwd=tmp_path, check=0,
    )  # fmt: skip
    tmlattice(
        "dev", "challenge", "run", "e", "--jobs", "1", "--lattice", LATTICE, cwd=tmp_path, check=0
    )
    told = tmlattice(
        "dev", "challenge", "score", "e", "--jobs", "1", "--lattice", LATTICE, cwd=tmp_path, check=0
    )
    assert "false alarms" in told.stdout
