"""`dev study` and `dev reproduce` as a user runs them: resumed, on a cluster, cases that fail."""

import json

import pytest
from command import refused, tmlattice
from conftest import SMALL
from shared import valid

from tmlattice.errors import TmlatticeError
from tmlattice.fitting.study import (
    UNSTABLE,
    Case,
    run_case,
    study_tune_fit,
    summarise,
)


def test_study_prints_writes_and_goes_on(tmp_path):
    command = [
        "dev", "study", "tune-fit", SMALL, "--magnets", "2",
        "--change", "-0.02", "--epochs", "20", "--methods", "adam,map,sparse", "--jobs", "1",
    ]  # fmt: skip
    done = tmlattice(*command, cwd=tmp_path, check=0)
    result = valid(tmp_path / "study-tune-fit" / "study.json", "study-tune-fit")
    assert list(result["methods"]) == ["adam", "map", "sparse"]
    assert result["cases"] == 2
    assert result["methods"]["sparse"]["right"] == 1.0
    assert result["methods"]["adam"]["right"] is None
    assert result["methods"]["adam"]["stated"]["x"]["median"] is None
    assert "worst" in done.stdout
    assert done.stderr == ""
    folder = tmp_path / "study-tune-fit"
    assert (folder / "study.png").read_bytes().startswith(b"\x89PNG")
    kept = sorted((folder / "cases").iterdir())
    assert len(kept) == 6
    # Stopped after five: the sixth alone is done again.
    kept[3].unlink()
    times = {path: path.stat().st_mtime_ns for path in kept if path.exists()}
    assert tmlattice(*command, "--quiet", cwd=tmp_path, check=0).stdout == ""
    assert kept[3].exists()
    assert {path: path.stat().st_mtime_ns for path in times} == times
    again = json.loads((tmp_path / "study-tune-fit" / "study.json").read_text())
    assert [r["abs_dq"] for r in again["results"]] == [r["abs_dq"] for r in result["results"]]
    with pytest.raises(TmlatticeError, match="other options"):
        study_tune_fit(SMALL, ["sparse"], 2, shots=2, folder=str(folder))


def test_no_method_of_that_name_is_reported():
    with pytest.raises(TmlatticeError, match="no method 'magic'"):
        study_tune_fit(SMALL, ["magic"])


def test_unstable_rings_are_counted_apart(small_ring):
    case = run_case(small_ring, "QD::5", "sparse", change=-3.0)
    assert case.problem == UNSTABLE
    assert summarise([case])["unstable"] == 1
    assert summarise([case])["methods"]["sparse"]["failed"] == 0


def test_a_sextupole_is_found(small_ring):
    name = next(e.name for e in small_ring.magnets if e.kind == "sextupole")
    case = run_case(small_ring, name, "sparse", change=-0.5, shots=4, noise=2e-7,
                    launch=(1e-3, 0.0, 1e-3, 0.0))  # fmt: skip
    assert case.right, case


def test_summary_counts_coverage_and_right_magnets():
    def case(error, sigma, found):
        return Case("a", 1.0, "sparse", 0, (0.1, 0.2), (error, 0.0), (0, 0), (sigma, 1.0),
                    (1.0, 0.5), 1e-6, found)  # fmt: skip

    cases = [case(1.0, 1.0, ("a",)), case(3.0, 1.0, ("a",)), case(0.1, 1.0, ("a", "b"))]
    broken = Case("b", 1.0, "sparse", 0, problem="the worker broke")
    entry = summarise([*cases, broken])["methods"]["sparse"]
    assert (entry["predicted"], entry["failed"]) == (3, 1)
    assert entry["coverage"]["x"] == pytest.approx(2 / 3)
    assert entry["right"] == 2 / 4
    assert entry["abs_dq"]["x"]["worst"] == 3.0


# --- `tmlattice dev reproduce` as a user runs it --------------------------------------------------
@pytest.mark.parametrize("system", [
    "free-fall", "pendulum", "magnets", "lotka-volterra",
    pytest.param("cavitation", marks=pytest.mark.slow)])  # fmt: skip
def test_table_json_and_figure(system, tmp_path):
    out = tmp_path / "out"
    done = tmlattice("dev", "reproduce", system, "--small", "--out", out, cwd=tmp_path, check=0)
    assert "why they differ" in done.stdout
    assert sorted(p.name for p in out.iterdir()) == sorted([f"{system}.png", "reproduction.json"])
    assert (out / f"{system}.png").read_bytes().startswith(b"\x89PNG")
    result = valid(out / "reproduction.json", "reproduction")
    assert [entry["system"] for entry in result["systems"]] == [system]


def test_an_unknown_system_is_refused(tmp_path):
    refused("dev", "reproduce", "pendulums", cwd=tmp_path, says="'pendulum'")
