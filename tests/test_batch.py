"""Batches: failures stay alone, finished cases are kept, local processes and a scheduler agree."""

import json
import os
import signal
import sys
import time

import pytest

import tmlattice
from tmlattice import batch
from tmlattice.batch import fingerprint, finished, run_batch
from tmlattice.errors import TmlatticeError


def cases(**values):
    return {name: (lambda value=value: value) for name, value in values.items()}


def late(value):
    time.sleep(0.5)
    return value


def test_a_failed_case_does_not_stop_the_rest_and_is_done_again(tmp_path):
    def unread():
        raise OSError("no such file")

    some = cases(a={"n": 1}, b=5, c={"n": 3})
    first = run_batch(dict, {**some, "d": unread}, tmp_path, jobs=1, progress=False)
    assert first["a"] == {"n": 1}
    assert first["c"] == {"n": 3}
    assert "TypeError" in first["b"]["error"]
    assert "no such file" in first["d"]["error"]
    (tmp_path / "d.json").unlink()
    again = run_batch(dict, cases(a={"n": 7}, b={"n": 2}, c=5), tmp_path, jobs=1, progress=False)
    assert again == {"a": {"n": 1}, "b": {"n": 2}, "c": {"n": 3}}  # a and c were not done again
    assert finished(tmp_path) == again


def test_a_number_with_which_nothing_can_be_worked_out_is_no_result(tmp_path):
    (tmp_path / "a.json").write_text('{"mass": 1' + 400 * "0" + "}")
    assert finished(tmp_path) == {}


def test_two_processes_and_a_scheduler_by_its_address(tmp_path):
    from distributed import LocalCluster

    some = cases(**{f"c{i}": {"n": i} for i in range(5)}, bad=3)
    local = run_batch(dict, some, tmp_path / "local", jobs=2, progress=False)
    assert local["c4"] == {"n": 4}
    assert "error" in local["bad"]
    with LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        remote = run_batch(dict, some, tmp_path / "remote", scheduler=address, progress=False)
    assert "error" in remote.pop("bad")
    assert remote == {name: found for name, found in local.items() if name != "bad"}
    assert json.loads((tmp_path / "remote" / "c0.json").read_text()) == {"n": 0}


def test_no_scheduler_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "PATIENCE", 1.0)
    with pytest.raises(TmlatticeError, match="no Dask scheduler answers"):
        run_batch(dict, cases(a={}), tmp_path, scheduler="tcp://127.0.0.1:9", progress=False)


def test_workers_that_never_came_or_are_all_gone_are_one_sentence(tmp_path, monkeypatch):
    """It waited for ever. What was done before is kept."""
    from distributed import LocalCluster

    monkeypatch.setattr(batch, "PATIENCE", 1.0)
    inside = {"processes": False, "dashboard_address": None}
    with LocalCluster(n_workers=0, **inside) as cluster:
        where = {"scheduler": cluster.scheduler_address, "progress": False}
        with pytest.raises(TmlatticeError, match="has no worker; start one"):
            run_batch(dict, cases(a={"n": 1}), tmp_path, **where)
    with LocalCluster(1, threads_per_worker=1, **inside) as cluster:
        where = {"scheduler": cluster.scheduler_address, "progress": False}

        def gone():
            cluster.scale(0)
            return {"n": 2}

        some = {**cases(a={"n": 1}, b={"n": 1}), "c": gone, **cases(d={"n": 1}, e={"n": 1})}
        with pytest.raises(TmlatticeError, match="all workers are gone"):
            run_batch(late, some, tmp_path, **where)


def test_results_of_other_data_or_of_nobody_are_done_again(tmp_path):
    marks = {name: fingerprint("lattice", name) for name in "abc"}

    def once(value, marks):
        some = cases(**{name: {"n": value} for name in "abc"})
        return run_batch(dict, some, tmp_path, jobs=1, progress=False, made_by=marks)

    once(1, marks)
    marks["a"] = fingerprint("another lattice", "a")
    (tmp_path / "b.json").write_text("null")
    again = once(2, marks)
    assert {name: result["n"] for name, result in again.items()} == {"a": 2, "b": 2, "c": 1}
    (tmp_path / "c.json").write_text("[" * 100_000)
    assert once(3, marks)["c"]["n"] == 3


def loud(case):
    import warnings

    warnings.warn(f"case {case} is odd", UserWarning, stacklevel=1)
    warnings.warn("all of them are", UserWarning, stacklevel=1)
    return {"n": case}


def test_warnings_of_worker_processes_reach_the_user(tmp_path):
    """Each once, whatever the number of processes."""
    with pytest.warns(UserWarning, match="odd|all of them") as told:
        run_batch(loud, cases(a=1, b=2, c=3), tmp_path, jobs=2, progress=False)
    texts = sorted(str(w.message) for w in told if w.category is UserWarning)
    assert texts == ["all of them are", "case 1 is odd", "case 2 is odd", "case 3 is odd"]


def test_a_scheduler_without_its_package_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(TmlatticeError, match=r"pip install 'tmlattice\[dask\]'.*local processes"):
        run_batch(dict, cases(a={}), tmp_path, scheduler="tcp://127.0.0.1:9", progress=False)
    found = run_batch(dict, cases(a={"n": 1}, b={"n": 2}), tmp_path, jobs=2, progress=False)
    assert found == {"a": {"n": 1}, "b": {"n": 2}}


def test_many_measurements_are_diagnosed_with_one_file_each(tmp_path, small_ring):
    """Locally, on a scheduler and here alike; what is done is repeated for other data alone."""
    from distributed import LocalCluster

    for i, name in enumerate(("QD::5", "QF::2")):
        fault = [tmlattice.Cause("quadrupole_gradient", name, 0.05)]
        made = tmlattice.simulate(small_ring, fault, shots=3, amplitude=1e-4, noise=1e-6,
                                  engine="ocelot", seed=i)  # fmt: skip
        made.write(tmp_path / "shift" / str(i), progress=False)
    paths = [*sorted((tmp_path / "shift").iterdir()), tmp_path / "nowhere"]

    def run(out, some=paths, **where):
        where |= {"effects": ["quadrupole_gradient"], "progress": False}
        files = batch.diagnose(small_ring, some, tmp_path / out, **where)
        return {name: json.loads(path.read_text()) for name, path in files.items()}

    local = run("local", jobs=2)
    assert [local[n]["findings"][0]["element"] for n in "01"] == ["QD::5", "QF::2"]
    assert "no measurement folder" in local["nowhere"]["error"]
    with LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        remote = run("remote", paths[:1], scheduler=cluster.scheduler_address)
    here = run("here", jobs=1)
    assert remote["0"]["findings"] == local["0"]["findings"]
    assert [here[n]["findings"] for n in "01"] == [local[n]["findings"] for n in "01"]
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "here").iterdir()}
    run("here", jobs=1)
    same = [path.stem for path, at in times.items() if path.stat().st_mtime_ns == at]
    assert sorted(same) == ["0", "1"]  # what failed is tried again
    (tmp_path / "shift" / "0" / "readings.csv").unlink()
    again = run("here", jobs=1, seed=1)
    assert "error" in again["0"]
    assert again["1"]["provenance"]["seed"] == 1
    with pytest.raises(TmlatticeError, match="one name"):
        batch.diagnose(small_ring, [paths[0], tmp_path / "x" / "0"], tmp_path / "twice")


def suicidal(case):
    if case == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"n": case}


def test_a_killed_worker_fails_its_own_case_and_no_other(tmp_path):
    some = cases(a=1, b="dies", c=3, d=4)
    found = run_batch(suicidal, some, tmp_path, jobs=2, progress=False)
    assert [found[name].get("n") for name in "acd"] == [1, 3, 4]
    assert "a worker process was lost (SIGKILL)" in found["b"]["error"]
