"""Results that are kept: tables, files that are loaded again, pickles, comparisons, signatures."""

import copy
import dataclasses
import inspect
import json
import pickle

import numpy as np
import pytest
from command import refused
from command import tmlattice as command
from conftest import SMALL
from shared import valid

import tmlattice
from tmlattice import Cause, Diagnosis
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.errors import MeasurementError, TmlatticeError, UnknownNameError
from tmlattice.files import write_json
from tmlattice.fitting.adam import fit_adam
from tmlattice.fitting.map_fit import fit_map
from tmlattice.fitting.sparse import fit_sparse
from tmlattice.machine.response import simulate_response
from tmlattice.machine.stored_beam import simulate_orbits, simulate_tunes
from tmlattice.measurement import write_measurement
from tmlattice.report import tables as report_tables
from tmlattice.report.speaking import render

FAULT = Cause("quadrupole_gradient", "QD::5", -0.05)
ALL = {"all": None}


def shots(ring, causes, seed=2):
    return tmlattice.simulate(
        ring, causes, shots=3, amplitude=1e-4, noise=1e-6, engine="ocelot", seed=seed
    ).measurement()


def response(ring, causes=(), seed=3, **more):
    return simulate_response(ring, causes, noise=1e-7, seed=seed, **more).measured


@pytest.fixture(scope="module")
def diagnoses(small_ring):
    """One of each kind."""
    ring = small_ring
    both = {
        "orbit": simulate_orbits(ring, [FAULT], seed=1).measured,
        "tunes": simulate_tunes(ring, [FAULT], seed=1).measured,
    }
    small = response(ring, seed=7, background=ALL, machine_seed=4)
    families = ["quadrupole_gradient", "monitor_gain_x", "corrector_calibration", "monitor_roll"]
    return {
        "first turns": tmlattice.diagnose(ring, shots(ring, [FAULT]), effects=families),
        "none": tmlattice.diagnose(ring, shots(ring, []), effects=families),
        "together": tmlattice.diagnose(ring, both, effects=families),
        "response": tmlattice.diagnose(ring, small, effects=families, missing=True),
        "change": tmlattice.diagnose(
            ring, response(ring, [FAULT]), reference=response(ring, seed=7), effects=families
        ),
    }


KINDS = ("first turns", "none", "together", "response", "change")


FIGURES = ("first turns", "change")
"""Figures take seconds."""


def saved(found, folder, figures=False):
    """As `save` does; the figures only where they are asked for."""
    if figures:
        assert found.save(folder) == folder / "report.html"
        names = {path.name for path in folder.iterdir()}
        drawn = {"plan.png"} if found.by_families else {"plan.png", "scan.png", "gap.png"}
        assert names >= {"report.html", "report.txt", "diagnosis.json"} | drawn
        assert (folder / "report.txt").read_text() == found.report() + "\n"
        return folder
    folder.mkdir(exist_ok=True)
    write_json(folder / "diagnosis.json", found.as_json())
    tmlattice.save_ring(found.ring, folder / "diagnosis.lattice.json")
    return folder


def plain(document):
    """As a file has it."""

    def put(place):
        write_json(place / "a.json", document)
        return json.loads((place / "a.json").read_text(encoding="utf-8"))

    return put


# --- tables ---------------------------------------------------------------------------------------
def test_tables_hold_every_amount_with_unit_error_and_place(diagnoses, small_ring):
    found = diagnoses["response"]
    errors = found.tables["errors"]
    assert len(errors) == len(found.causes)
    assert list(errors.effect) == [cause.effect for cause in found.causes]
    assert list(errors.element.fillna("")) == [cause.element or "" for cause in found.causes]
    assert list(errors.amount) == [cause.amount for cause in found.causes]
    assert list(errors.sigma) == list(found.errors)
    gradients = errors.query("effect == 'quadrupole_gradient'")
    assert set(gradients.unit) == {"relative"}
    assert all(small_ring[r.element].s == r.s for r in gradients.itertuples())
    bpms = found.tables["bpms"].set_index("element")
    assert list(bpms.index) == [monitor.name for monitor in small_ring.monitors]
    gains = errors.query("effect == 'monitor_gain_x'").set_index("element")
    np.testing.assert_array_equal(bpms.loc[gains.index, "monitor_gain_x"], gains.amount)
    np.testing.assert_array_equal(bpms.loc[gains.index, "monitor_gain_x_sigma"], gains.sigma)
    assert found.tables["correctors"].attrs["units"]["corrector_calibration"] == "relative"
    assert list(found.tables["steps"].effect) == [step.effect for step in found.steps]
    families = found.tables["families"].set_index("effect")
    needed = families.loc["quadrupole_gradient"]
    assert needed.kept
    assert needed.heldout_rms_in_plane > 2 * found.steps[-1].heldout_rms_in_plane


def test_the_optics_table_is_that_of_the_report(diagnoses, small_ring):
    """Referee: the optics of the ring with the fault in it."""
    found = diagnoses["first turns"]
    optics = found.tables["optics"]
    weak = small_ring.with_changed(
        "QD::5", k1=small_ring["QD::5"].k1 * (1 + found.findings[0].amount)
    )
    for ring, name in ((small_ring, "beta_y_design"), (weak, "beta_y")):
        functions = tmlattice.twiss(tmlattice.TaylorNetwork.from_ring(ring))
        np.testing.assert_allclose(optics[name], functions.beta[:, 1], rtol=1e-6)
        np.testing.assert_allclose(optics.s, functions.s, atol=1e-9)
    beat = 100 * np.sqrt(np.mean((optics.beta_y / optics.beta_y_design - 1) ** 2))
    (row,) = (r for r in report_tables.optics_rows(found) if r[0] == "beta beating, rms [%]")
    assert row[2].endswith(f"/ {beat:.2f}")
    tunes = optics.attrs["tunes"]["estimated"]
    np.testing.assert_allclose(tunes, found.tunes["after"], atol=1e-5)


@pytest.mark.parametrize("kind", ["first turns", "together", "response", "change"])
def test_the_covariance_is_by_name_and_has_the_stated_errors(diagnoses, kind):
    found = diagnoses[kind]
    covariance = found.tables["covariance"]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), found.errors, rtol=1e-9)
    name = (found.causes[0].effect, found.causes[0].element)
    assert covariance.loc[name, name] == pytest.approx(found.errors[0] ** 2)
    sigma = np.array(found.errors)
    assert np.linalg.eigvalsh(covariance.to_numpy() / np.outer(sigma, sigma)).min() > -1e-9
    for pair in found.correlations:
        first, second = ((h[0], h[1] or "") for h in (pair.first, pair.second))
        own = covariance.loc[first, second] / np.sqrt(
            covariance.loc[first, first] * covariance.loc[second, second]
        )
        assert own == pytest.approx(pair.correlation, abs=0.02)


def test_a_table_that_is_not_there_is_a_sentence(diagnoses):
    with pytest.raises(UnknownNameError, match="no table 'error'; did you mean 'errors'"):
        diagnoses["none"].tables["error"]
    assert len(diagnoses["none"].tables["findings"]) == 0
    assert list(diagnoses["none"].tables) == [
        "findings", "errors", "bpms", "correctors", "optics", "steps", "families",
        "covariance",
    ]  # fmt: skip


# --- files ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
def test_a_diagnosis_is_loaded_as_it_was_saved(diagnoses, kind, tmp_path):
    found = diagnoses[kind]
    saved(found, tmp_path / "result", figures=kind in FIGURES)
    document = valid(tmp_path / "result" / "diagnosis.json", "diagnosis")
    again = Diagnosis.load(tmp_path / "result")
    assert Diagnosis.load(tmp_path / "result" / "diagnosis.json").report() == again.report()
    assert again.report() == found.report()
    assert plain(again.as_json())(tmp_path) == document
    assert repr(again) == repr(found)
    for name in found.tables:
        if name != "covariance":
            one, other = found.tables[name], again.tables[name]
            assert one.astype(str).equals(other.astype(str)), name
    if kind not in FIGURES:
        return
    page = tmp_path / "result" / "report.html"
    old = page.read_text(encoding="utf-8")
    render(tmp_path / "result")
    new = page.read_text(encoding="utf-8")
    assert new.count("<img") == old.count("<img")
    bodies = [text[text.index("<h1>") : text.index("<script")] for text in (old, new)]
    without = [[line for line in text.splitlines() if "<img" not in line and "data-figure" not in
                line] for text in bodies]  # fmt: skip
    assert without[0] == without[1]


def test_what_the_file_lacks_is_said(diagnoses, tmp_path):
    saved(diagnoses["first turns"], tmp_path)
    again = Diagnosis.load(tmp_path)
    for call in (
        lambda: again.explanation,
        lambda: again.trajectories,
        lambda: tmlattice.correct(again),
        lambda: again.tables["covariance"],
    ):
        with pytest.raises(MeasurementError, match=r"diagnosis.json does not hold"):
            call()
    other = (tmp_path / "diagnosis.lattice.json").rename(tmp_path / "other.json")
    with pytest.raises(MeasurementError, match="is Python code, which would be run"):
        Diagnosis.load(tmp_path)
    path = tmp_path / "diagnosis.json"
    document = json.loads(path.read_text())

    def names(lattice):
        moved = document["provenance"] | {"lattice": lattice}
        path.write_text(json.dumps(document | {"provenance": moved}))

    names(str(other))
    assert Diagnosis.load(tmp_path).verdict == again.verdict
    names("away.json")
    with pytest.raises(MeasurementError, match=r"needs its lattice 'away.json'.*give the lattice"):
        Diagnosis.load(tmp_path)
    assert Diagnosis.load(tmp_path, SMALL_RING()).verdict == "identified"
    with pytest.raises(MeasurementError, match="has no element 'QD::5'"):
        Diagnosis.load(tmp_path, tmlattice.load_ring("petra3"))
    del document["gap"]["readings_noise"]
    names(str(other))
    with pytest.raises(MeasurementError, match="does not hold 'readings_noise'; diagnose again"):
        Diagnosis.load(tmp_path, SMALL_RING())
    path.unlink()
    with pytest.raises(MeasurementError, match="name a folder that `tmlattice diagnose --out`"):
        Diagnosis.load(tmp_path)


def SMALL_RING():
    return tmlattice.load_ring(SMALL)


# --- pickles --------------------------------------------------------------------------------------
def test_every_public_result_is_pickled_and_copied(diagnoses, small_ring, small_network, tmp_path):
    """What it says of itself, and its JSON, are the same; a class without a case fails."""
    measured = shots(small_ring, [FAULT])
    found = diagnoses["first turns"]
    orbits = simulate_orbits(small_ring, seed=1).measured
    optics = tmlattice.one_turn_optics(small_network)
    states = small_network.track([[1e-5, 0, 1e-5, 0]], turns=64)
    quick = {"epochs": 3, "progress": False}
    step = tmlattice.RfStep(5e8, 100, 10.0, orbits.orbit[0])
    machine = tmp_path / "tmlattice.toml"
    machine.write_text(f'[lattice]\nfile = "{SMALL}"\n')
    results = [
        small_ring, small_ring.magnets[0], FAULT, *diagnoses.values(), *found.findings,
        measured, response(small_ring), orbits, simulate_tunes(small_ring).measured, step,
        tmlattice.Dispersion((step,), orbits.monitors),
        tmlattice.TurnByTurn(np.ones((1, 16, 1, 2)) * 1e-6, ("a",)),
        tmlattice.correct(found), small_network, optics, tmlattice.tunes(states, optics),
        tmlattice.fine_tune(small_network, measured, **quick),
        tmlattice.fine_tune(small_network, measured, method="map"),
        tmlattice.tune_fit(small_ring, "QD::5", -0.02, launch=(1e-4, 0, 1e-4, 0), **quick),
        tmlattice.element_map(small_ring.magnets[0], small_ring.map_energy),
        tmlattice.simulate(small_ring, [FAULT]), tmlattice.Machine(small_ring),
        check_data(small_ring, measured), tmlattice.compare(small_ring, small_ring),
        tmlattice.import_data(measured.to_dataframe(), ring=small_ring),
        tmlattice.load_machine_file(machine),
    ]  # fmt: skip
    for one in results:
        for other in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
            assert type(other) is type(one)
            if hasattr(one, "as_json"):
                assert json.dumps(other.as_json(), default=str) == (
                    json.dumps(one.as_json(), default=str)
                )
            if "0x" not in repr(one):
                assert repr(other) == repr(one)
    classes = {
        value for name in tmlattice.__all__ if inspect.isclass(value := getattr(tmlattice, name))
    } - {TmlatticeError}  # fmt: skip
    assert classes <= {type(one) for one in results}
    estimated = dataclasses.replace(small_ring, model="estimated")
    assert pickle.loads(pickle.dumps(estimated)).model == "estimated"
    other = pickle.loads(pickle.dumps(found))
    assert other.report() == found.report()
    assert other.plot("scan") is not None
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(small_network))([[1e-3, 0, 0, 0]]).detach(),
        small_network([[1e-3, 0, 0, 0]]).detach(),
    )


# --- comparisons ----------------------------------------------------------------------------------
def test_two_diagnoses_differ_by_amounts_with_errors(diagnoses, tmp_path):
    one, other = diagnoses["first turns"], diagnoses["together"]
    frame = tmlattice.compare(one, other).to_dataframe().set_index("quantity")
    row = frame.loc["quadrupole_gradient"]
    assert row.difference == other.causes[0].amount - one.causes[0].amount
    assert row.sigma == pytest.approx(np.hypot(one.errors[0], other.errors[0]))
    assert abs(row.pull) < 4  # both are of the same fault
    assert frame.loc["tune y"].difference == other.tunes["after"][1] - one.tunes["after"][1]
    saved(one, tmp_path / "a")
    saved(other, tmp_path / "b")
    same = tmlattice.compare(tmp_path / "a", tmp_path / "b" / "diagnosis.json").to_dataframe()
    assert same.drop(columns="pull").equals(frame.reset_index().drop(columns="pull"))


def test_two_lattices_differ_by_what_was_changed(small_ring):
    weak = small_ring.with_changed("QD::5", k1=0.95 * small_ring["QD::5"].k1)
    found = tmlattice.compare(small_ring, weak)
    frame = found.to_dataframe().set_index("quantity")
    assert list(frame.element.dropna()) == ["QD::5"]
    assert frame.loc["k1"].difference == pytest.approx(-0.05 * small_ring["QD::5"].k1)
    assert frame.loc["k1"].unit == "1/m2"
    tunes = [tmlattice.twiss(tmlattice.TaylorNetwork.from_ring(r)).total_tunes
             for r in (small_ring, weak)]  # fmt: skip
    assert frame.loc["tune y"].difference == pytest.approx(tunes[1][1] - tunes[0][1])
    assert "do not differ" in tmlattice.compare(small_ring, str(SMALL)).report()


def test_two_responses_differ_by_calibrations(small_ring):
    """One corrector gives 10 % more; the kicks of the second are half as large."""
    one = response(small_ring)
    strong = Cause("corrector_calibration", "v3", 0.1)
    other = response(small_ring, [strong], seed=9, kick=5e-5)
    frame = tmlattice.compare(one, other).to_dataframe()
    ratio = frame.query("quantity.str.startswith('response')").set_index("element")
    assert ratio.index[0] == "v3"
    assert ratio.loc["v3"].difference == pytest.approx(0.1, abs=4 * ratio.loc["v3"].sigma)
    assert (ratio.drop("v3").pull.abs() < 4).all()
    orbits = frame.query("quantity == 'orbit, rms'").set_index("element")
    assert orbits.drop("v3").pull.between(0.7, 1.4).all()
    assert orbits.loc["v3"].pull > 10


def test_commands_render_and_compare(diagnoses, small_ring, tmp_path):
    saved(diagnoses["first turns"], tmp_path / "a")
    saved(diagnoses["together"], tmp_path / "b")
    before = diagnoses["first turns"].report() + "\n"
    done = command("report", tmp_path / "a", cwd=tmp_path, check=0)
    assert (tmp_path / "a" / "report.txt").read_text() == before
    assert before.splitlines()[0] in done.stdout
    done = command("compare", "a", "b", "--json", "c.json", cwd=tmp_path, check=0)
    assert "quadrupole_gradient" in done.stdout
    document = valid(tmp_path / "c.json", "comparison")
    assert document["rows"][0]["unit"] == "relative"
    write_measurement(tmp_path / "m", response(small_ring))
    write_measurement(tmp_path / "t", shots(small_ring, []))
    (tmp_path / "x.json").write_text('{"format": "something"}')
    for arguments, said in (
        (("report", "x.json"), "x.json"),
        (("report", tmp_path), "diagnosis.json"),
        (("compare", SMALL, "m"), "is a lattice and 'm' is an orbit response"),
        (("compare", "t", "t"), "is first turns: two diagnoses"),
        (("compare", "a", "b", "--json", "b/diagnosis.json"), "would be written over"),
    ):
        refused(*arguments, cwd=tmp_path, says=said)


# --- signatures -----------------------------------------------------------------------------------
def test_public_functions_state_all_their_arguments():
    """An editor completes them: no **options, a type for each, and a default or a place."""
    for name in tmlattice.__all__:
        function = getattr(tmlattice, name)
        if inspect.isclass(function) or not callable(function):
            continue
        signature = inspect.signature(function)
        for parameter in signature.parameters.values():
            assert parameter.kind is not parameter.VAR_KEYWORD, name
            assert parameter.annotation is not parameter.empty, (name, parameter.name)
        assert signature.return_annotation is not signature.empty, name


def test_defaults_of_fine_tune_are_those_of_its_methods():
    stated = inspect.signature(tmlattice.fine_tune).parameters
    recipe = inspect.signature(tmlattice.tune_fit).parameters
    for method in (fit_adam, fit_sparse, fit_map):
        for name, parameter in inspect.signature(method).parameters.items():
            if parameter.kind is parameter.KEYWORD_ONLY:
                assert stated[name].default == parameter.default, name
            if method is fit_adam and name in recipe and name not in ("noise",):
                assert recipe[name].default == parameter.default, name


def test_an_option_without_meaning_for_the_method_is_refused(small_network, small_ring):
    measured = shots(small_ring, [FAULT])
    with pytest.raises(ValueError, match="'epochs' has no meaning for method 'sparse'"):
        tmlattice.fine_tune(small_network, measured, method="sparse", epochs=5)
    with pytest.raises(MeasurementError, match="'missing' has no meaning for first turns"):
        tmlattice.diagnose(small_ring, measured, missing=True)


def test_a_diagnosis_of_the_command_is_loaded(diagnoses, tmp_path):
    """With what `diagnose --lattice-out`, a file of readings and --settings add to its source."""
    found = diagnoses["first turns"]
    source = {
        "lattice_out": "found.json",
        "assumed_of_files": ["readings are in mm"],
        "applied": [],
    }
    made = dataclasses.replace(found, provenance={**found.provenance, **source})
    saved(made, tmp_path / "result")
    assert Diagnosis.load(tmp_path / "result").provenance == made.provenance
