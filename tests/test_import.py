"""`tmlattice import`: measurements of other programs, against AT, LOCO's own model and README."""

import json
import re
import shutil
import struct

import at
import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from at.load.utils import element_from_dict
from command import tmlattice
from numpy.testing import assert_allclose
from shared import measured_data

import tmlattice as package
from tmlattice import load_ring, read_measurement
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import LatticeError, MeasurementError, TmlatticeError
from tmlattice.harmonics import frequency
from tmlattice.importers import Options, bring_in, write_imported
from tmlattice.lattice import save_ring
from tmlattice.lattice.mat_file import read_mat
from tmlattice.measurement import TurnByTurn
from tmlattice.observe.spectra import lines
from tmlattice.report.plain import report_text

pytestmark = pytest.mark.usefixtures("forked_readers")

ENERGY, CELLS, HARMONIC = 1.5, 8, 88
POLE = {"MaxOrder": 2.0, "NumIntSteps": 20.0, "PassMethod": "StrMPoleSymplectic4Pass"}


def multipole(name, length, k1=0.0, skew=0.0, k2=0.0):
    A, B = np.array([0, skew, 0.0]), np.array([0, k1, k2 / 2])
    return {"FamName": name, "Length": length, **POLE, "KickAngle": np.zeros(2),
            "PolynomA": A, "PolynomB": B}  # fmt: skip


def place(name, pass_method="IdentityPass", length=0.0, **more):
    return {"FamName": name, "Length": length, "PassMethod": pass_method, **more}


def elements():
    """As MATLAB has them: eight FODO cells; correctors of two planes, kicks inside sextupoles."""
    angle = np.pi / CELLS
    bend = {"FamName": "BEND", "Length": 1.2, "BendingAngle": angle, "EntranceAngle": angle / 2,
            "ExitAngle": angle / 2, "PolynomA": np.zeros(3), "PolynomB": np.zeros(3), **POLE,
            "PassMethod": "BndMPoleSymplectic4Pass"}  # fmt: skip
    drift = place("DR", "DriftPass", 0.5)
    cor = place("COR", "CorrectorPass", KickAngle=np.zeros(2))
    cell = [
        place("BPM"), multipole("QF", 0.4, 1.0), drift, multipole("SF", 0.2, skew=0.02, k2=6.0),
        drift, bend, drift, place("BPM"), cor, multipole("QD", 0.4, -1.0), drift,
        multipole("SD", 0.2, k2=-9.0), drift, bend, drift,
    ]  # fmt: skip
    ring = [dict(e) for _ in range(CELLS) for e in cell]
    ring.append(place("CAV", "CavityPass", Voltage=1e6, Frequency=5e8, HarmNumber=HARMONIC,
                      Energy=ENERGY * 1e9))  # fmt: skip
    ring.append(place("AP", "AperturePass", Limits=np.array([-1, 1, -1, 1.0])))
    return ring


def orbit(ring, monitors, **shift):
    """x and y at the monitors of AT's closed orbit at a fixed RF frequency, [monitor, 2]."""
    lattice = at.Lattice(ring, energy=ENERGY * 1e9, periodicity=1)
    lattice.disable_6d()
    _, orbits = at.find_orbit4(lattice, refpts=monitors, **({"dct": 0.0} | shift))
    return orbits[:, [0, 2]]


@pytest.fixture(scope="module")
def simulated():
    """A LOCO file's variables: all numbers from AT's closed orbits, two-sided."""
    fields = elements()
    ring = [element_from_dict(dict(f), quiet=True) for f in fields]
    names = [f["FamName"] for f in fields]
    monitors = [i for i, n in enumerate(names) if n == "BPM"]
    horizontal = [i for i, n in enumerate(names) if n in ("COR", "SF")]
    vertical = [i for i, n in enumerate(names) if n in ("COR", "SD")]
    step, columns = 1e-4, []
    for plane, places in ((0, horizontal), (1, vertical)):
        for i in places:
            sides = []
            for side in (0.5, -0.5):
                ring[i].KickAngle = np.eye(2)[plane] * side * step
                sides.append(orbit(ring, monitors))
            ring[i].KickAngle = np.zeros(2)
            columns.append(sides[0] - sides[1])
    columns = np.array(columns)
    delta_rf, length = 200.0, sum(f["Length"] for f in fields)
    turn = 299792458.0 / length
    frequency = HARMONIC * turn
    paths = [-length * side * delta_rf / frequency / 2 for side in (1, -1)]
    up, down = (orbit(ring, monitors, dct=path) for path in paths)
    xy = [columns[:, :, 0], columns[:, :, 1]]
    return {
        "LocoMeasData": {
            "M": 1e3 * np.concatenate(xy, axis=1).T,
            "Eta": 1e3 * (up - down).T.ravel(),
            "DeltaRF": delta_rf, "RF": frequency, "BPMSTD": np.full(2 * len(monitors), 2e-4),
        },
        "BPMData": {
            "FamName": "BPM", "BPMIndex": np.array(monitors) + 1.0,
            "HBPMIndex": np.arange(len(monitors)) + 1.0,
            "VBPMIndex": np.arange(len(monitors)) + 1.0,
            "HBPMGoodDataIndex": np.arange(len(monitors)) + 1.0,
            "VBPMGoodDataIndex": np.arange(len(monitors)) + 1.0,
        },
        "CMData": {
            "HCMIndex": np.array(horizontal) + 1.0, "VCMIndex": np.array(vertical) + 1.0,
            "HCMKicks": np.full(len(horizontal), 0.1), "VCMKicks": np.full(len(vertical), 0.1),
            "HCMGoodDataIndex": np.arange(len(horizontal)) + 1.0,
            "VCMGoodDataIndex": np.arange(len(vertical)) + 1.0,
        },
        "RINGData": {
            "Lattice": np.array(fields, dtype=object), "CavityFrequency": frequency,
            "CavityHarmNumber": HARMONIC, "Energy": ENERGY,
        },
        "LocoFlags": {"ClosedOrbitType": "FixedPathLength"},
    }  # fmt: skip


def changed(variables, **fields):
    """With other fields: LocoMeasData_M=... and the like."""
    new = {key: dict(value) for key, value in variables.items()}
    for name, value in fields.items():
        variable, field = name.split("_", 1)
        new[variable][field] = value
    return new


def design(found):
    """The model's orbit changes, [column, monitor, 2], and the RF's."""
    data, model = found.measurement, ResponseModel(found.ring)
    at_monitor = [model.monitors.index(name) for name in data.monitors]
    columns = model.response(data.correctors)[:, at_monitor] * data.kicks[:, None, None]
    return columns, model.rf_change(data.rf.step / data.rf.frequency)[at_monitor]


def with_fit(variables, values, **parameter):
    """With a fit whose iterations gave the gradient of the first QF these values, in 1/m²."""
    first = next(i for i, f in enumerate(variables["RINGData"]["Lattice"]) if f["FamName"] == "QF")
    moved = {"ElemIndex": first + 1.0, "FieldName": "PolynomB", "FieldIndex": np.array([1, 2.0])}
    steps = [{"Params": np.array([moved | parameter], dtype=object), "Values": np.array([value])}
             for value in values]  # fmt: skip
    return {**variables, "FitParameters": np.array(steps, dtype=object)}


@pytest.fixture
def brought(tmp_path):
    def bring(variables, **options):
        path = tmp_path / "simulated.loco.mat"
        scipy.io.savemat(path, variables)
        return bring_in([path], Options(**options))

    return bring


# --- a LOCO file that the test made ---------------------------------------------------------------
def test_names_numbers_and_units_of_a_loco_file(simulated, brought):
    found = brought(simulated)
    data = found.measurement
    M = 1e-3 * simulated["LocoMeasData"]["M"]
    assert data.monitors == tuple(f"bpm::{i}" for i in range(2 * CELLS))
    assert data.correctors[:4] == ("sf_h::0", "cor_h::0", "sf_h::1", "cor_h::1")
    assert data.correctors[-2:] == ("cor_v::7", "sd_v::7")
    assert_allclose(data.response[:, :, 0].T, M[: 2 * CELLS], rtol=1e-12)
    assert_allclose(data.response[:, :, 1].T, M[2 * CELLS :], rtol=1e-12)
    assert_allclose(data.kicks, 1e-4)
    assert_allclose(data.noise, 2e-7)
    assert data.rf.step == 200.0
    assert data.rf.harmonic == HARMONIC
    assert data.energy == found.ring.energy == ENERGY
    assert not found.doubts


def test_ring_answers_as_at_does(simulated, brought):
    """Within 1e-3 of AT: two halves around a thin kick leave 1e-4, edges of bends 4e-4."""
    found = brought(simulated)
    data, (expected, rf) = found.measurement, design(found)
    assert_allclose(data.response, expected, atol=1e-3 * np.abs(expected).max())
    assert_allclose(data.rf.orbit, rf, atol=1e-3 * np.abs(rf).max())


def test_halves_of_a_magnet_that_kicks_are_the_magnet(simulated, brought):
    ring = brought(simulated).ring
    halves = [e for e in ring.elements if e.family in ("sf", "sf_2")]
    assert [e.name for e in halves[:4]] == ["sf::0", "sf_2::0", "sf::1", "sf_2::1"]
    assert_allclose([e.length for e in halves], 0.1)
    assert ring.pieces("sf_2::3") == ("sf::3", "sf_2::3")  # one magnet, one gradient
    assert ring.length == pytest.approx(sum(f["Length"] for f in elements()))
    thin = ring["sf_h::0"]
    assert thin.length == 0
    assert thin.s == pytest.approx(halves[0].s + 0.05)


def test_what_good_lists_leave_out_is_left_out_and_told(simulated, brought):
    bad = changed(
        simulated,
        BPMData_VBPMGoodDataIndex=np.delete(np.arange(2 * CELLS) + 1.0, 4),
        CMData_HCMGoodDataIndex=np.delete(np.arange(2 * CELLS) + 1.0, 1),
    )
    found = brought(bad)
    assert np.isnan(found.measurement.response[:, 4, 1]).all()
    assert np.isfinite(found.measurement.response[:, 4, 0]).all()
    assert "cor_h::0" not in found.measurement.correctors
    told = " ".join(found.assumed)
    assert "'bpm::4'" in told
    assert "'cor_h::0'" in told
    kept = brought(bad, keep_bad=True).measurement
    assert np.isfinite(kept.response).all()
    assert "cor_h::0" in kept.correctors


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        (lambda d: {"LocoMeasData_M": d["M"] * np.repeat([1, -1], len(d["M"]) // 2)[:, None]},
         "--assume y-reversed"),
        (lambda d: {"LocoMeasData_DeltaRF": -d["DeltaRF"]}, "--assume rf-reversed"),
        (lambda d: {"LocoMeasData_M": d["M"] * 1e-3}, "--assume kicks-in-mrad"),
        (lambda d: {"LocoMeasData_M": d["M"] * 1e3 / 2e2, "LocoMeasData_Eta": d["Eta"]},
         "5 times the design's in x"),
        (lambda d: {"LocoMeasData_M": d["M"] / 2}, "--assume kicks-halved"),
        (lambda d: {"LocoMeasData_M": d["M"] / 0.1}, "not the response per mrad"),
        (lambda d: {"LocoMeasData_M": d["M"] / 1e-4}, "not the response per rad"),
        (lambda d: {"LocoMeasData_Eta": -d["Eta"], "LocoMeasData_M": np.concatenate(
            [-d["M"][:16], d["M"][16:]])}, "--assume x-reversed"),
        (lambda d: {"LocoMeasData_M": np.roll(d["M"], 16, axis=0)}, "--assume planes-swapped"),
        (lambda d: {"LocoMeasData_M": d["M"][np.random.default_rng(1).permutation(len(d["M"]))]},
         "the data are not those of"),
        (lambda d: {"LocoMeasData_M": d["M"] * np.where(np.arange(32) == 3, -1, 1)[:, None]},
         "single BPMs of x have the sign against the others: 'bpm::3'"),
        (lambda d: {"LocoMeasData_M": d["M"][[*range(2), 5, 3, 4, 2, *range(6, 32)]]},
         "'bpm::2' and 'bpm::5' read each other's x"),
        (lambda d: {"LocoMeasData_M": d["M"] * np.where(np.arange(32) == 20, 1e-6, 1)[:, None]
                    + 1e-4 * np.random.default_rng(2).standard_normal((32, 32))},
         "single BPMs of y do not correlate with the design: 'bpm::4'"),
    ],
)  # fmt: skip
def test_a_convention_that_the_data_contradict_is_named_and_kept(simulated, brought, fields, told):
    variables = changed(simulated, **fields(simulated["LocoMeasData"]))
    found = brought(variables)
    assert any(told in sentence for sentence in found.doubts), found.doubts
    M = 1e-3 * variables["LocoMeasData"]["M"]
    assert_allclose(found.measurement.response[:, :, 0].T, M[:16], rtol=1e-12)


def test_frequency_or_momentum_is_told_by_the_data(simulated, brought):
    """AT's orbits at a fixed path length, and the same ring's at a fixed momentum."""
    assert any("the data agree that the frequency" in s for s in brought(simulated).assumed)
    found = brought(simulated)
    data, model = found.measurement, ResponseModel(found.ring, dimension=4)
    at_monitor = [model.monitors.index(name) for name in data.monitors]
    flat = model.response(data.correctors)[:, at_monitor] * data.kicks[:, None, None]
    M = 1e3 * np.concatenate([flat[:, :, 0].T, flat[:, :, 1].T])
    found = brought(changed(simulated, LocoMeasData_M=M))
    assert any("the momentum stood still" in sentence for sentence in found.doubts)


def test_lattice_before_the_fit(simulated, brought, tmp_path):
    """FitParameters hold the values of every iteration; the lattice has the last ones'."""
    variables = with_fit(simulated, (0.9, 1.0))
    fitted = brought(variables, iteration="last").ring
    assert (fitted["qf::0"].k1, fitted.model) == (pytest.approx(1.0), "fitted lattice")
    found = brought(variables)
    assert found.ring["qf::0"].k1 == pytest.approx(0.9)
    assert found.ring["qf::1"].k1 == pytest.approx(1.0)
    assert found.ring.model == "model before the fit"
    write_imported(found, tmp_path / "day")
    for _ in range(2):  # the second time from the cache
        ring = load_ring(tmp_path / "day" / "lattice.json")
        assert (ring["qf::0"].k1, ring.model) == (pytest.approx(0.9), found.ring.model)
    told = package.diagnose(ring, tmp_path / "day", effects=["quadrupole_gradient"])
    assert told.as_json()["model"] == ring.model
    heads = [line for line in report_text(told).splitlines() if ring.model in line]
    assert {line.split(ring.model)[0].strip() for line in heads} >= {"readings less model, rms"}
    assert not any("design " in line and "found" in line for line in report_text(told).splitlines())
    found = brought(with_fit(simulated, (0.9, 1.1)))  # the last is not what the lattice has
    assert (found.ring["qf::0"].k1, found.ring.model) == (pytest.approx(1.0), "lattice of the file")
    assert any("those of no iteration of the fit" in s for s in found.assumed)


def test_noise_that_no_file_gives_can_be_told(simulated, brought):
    bare = changed(simulated, LocoMeasData_BPMSTD=np.zeros(0))
    assert brought(bare).measurement.noise is None
    assert_allclose(brought(bare, noise=3e-6).measurement.noise, 3e-6)
    assert_allclose(brought(simulated, noise=3e-6).measurement.noise, 2e-7)  # the file's own


def test_noise_that_single_monitors_lack_is_the_typical_one(simulated, brought):
    given = np.repeat([2e-4, 3e-4], 2 * CELLS)
    given[[3, 20]] = [0.0, np.nan]
    found = brought(changed(simulated, LocoMeasData_BPMSTD=given))
    assert_allclose(found.measurement.noise, np.repeat([[2e-7, 3e-7]], 2 * CELLS, axis=0))
    assert any("'bpm::3', 'bpm::4'" in sentence for sentence in found.assumed)


def test_computed_dispersion_is_told(simulated, brought):
    model = {"Eta": simulated["LocoMeasData"]["Eta"] * (1 + 1e-6)}
    found = brought({**simulated, "LocoModel": model})
    assert any("computed, not measured" in sentence for sentence in found.doubts)


def test_pass_methods_of_a_file_load_nothing(simulated, brought, tmp_path):
    fields = elements()
    fields[2]["PassMethod"] = str(tmp_path / "evilPass")
    found = brought(changed(simulated, RINGData_Lattice=np.array(fields, dtype=object)))
    assert any("no pass method of AT" in sentence for sentence in found.assumed)
    assert found.ring.elements[2].kind == "drift"


def one(array, value, place=1):
    array = np.array(array, dtype=float)
    array.flat[place] = value
    return array


def test_parameters_of_no_place_are_not_followed(simulated, brought):
    """Counted from 1; place 0 would be the last element."""
    length = {"FieldName": "Length", "FieldIndex": np.array([1.0])}
    variables = with_fit(simulated, (0.0, 0.0), ElemIndex=0.0, **length)
    found = brought(variables, iteration="first")
    assert any("cannot be followed" in sentence for sentence in found.assumed)


def test_command_writes_a_folder_that_reads_back(simulated, tmp_path):
    scipy.io.savemat(tmp_path / "a.loco.mat", simulated)
    done = tmlattice("import", "a.loco.mat", "--out", "m", cwd=tmp_path, check=0)
    assert "steps are two-sided" in done.stdout
    ring = load_ring(tmp_path / "m" / "lattice.json")
    data = read_measurement(tmp_path / "m", monitors=[e.name for e in ring.monitors])
    again = bring_in([tmp_path / "a.loco.mat"])
    assert np.array_equal(data.response, again.measurement.response)
    assert [e.name for e in ring.elements] == [e.name for e in again.ring.elements]
    refused = tmlattice("import", "a.loco.mat", "--out", "m", cwd=tmp_path, check=2)
    assert "--force" in refused.stderr
    tmlattice("import", "a.loco.mat", "--out", "m", "--force", "-q", cwd=tmp_path, check=0)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "lattice.json").write_text("another ring")
    refused = tmlattice("import", "a.loco.mat", "--out", "other", cwd=tmp_path, check=2)
    assert "lattice.json" in refused.stderr
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["lattice.json"]


def element(place, **fields):
    """The lattice with other fields of one element."""
    ring = elements()
    ring[place].update(fields)
    return np.array(ring, dtype=object)


@pytest.mark.parametrize(
    "change", [element(2, PassMethod=3.0), element(3, FamName=np.full(5, np.nan))]
)
def test_fields_that_are_not_needed_may_be_anything(simulated, brought, change):
    found = brought(changed(simulated, RINGData_Lattice=change, LocoFlags_ClosedOrbitType=3.0))
    assert len(found.measurement.correctors) == 32


WRONG = {
    "a field is missing": (lambda v: {"CMData_HCMIndex": None}, "HCMIndex holds no numbers"),
    "numbers are complex": (lambda v: {"LocoMeasData_M": 1j * v["LocoMeasData"]["M"]}, "complex"),
    "a place is no number": (
        lambda v: {"CMData_HCMIndex": one(v["CMData"]["HCMIndex"], np.nan)}, "list of places"),
    "a good list beyond its monitors": (
        lambda v: {"BPMData_HBPMGoodDataIndex": np.array([1.0, 99.0])}, "counts beyond the 16"),
    "a step without bounds": (
        lambda v: {"CMData_HCMKicks": one(v["CMData"]["HCMKicks"], 1e300)}, "has a step of"),
    "no orbit change": (
        lambda v: {"LocoMeasData_M": np.nan * v["LocoMeasData"]["M"]}, "no corrector's orbit"),
    "a magnet of negative length": (
        lambda v: {"RINGData_Lattice": element(1, Length=-0.4)}, "has the negative length -0.4 m"),
    "an RF without bounds": (lambda v: {"LocoMeasData_RF": 9e299}, "cannot be"),
    "a harmonic without bounds": (lambda v: {"RINGData_CavityHarmNumber": 1e299}, "cannot be"),
    "an order of a field that would fill the memory": (
        lambda v: {"RINGData_Lattice": element(1, MaxOrder=1e9)}, "MaxOrder 1e"),
    "M of another shape": (
        lambda v: {"LocoMeasData_M": np.zeros((3, 4))}, "LocoMeasData.M has the shape [3, 4]"),
    "beyond the lattice's": (
        lambda v: {"BPMData_BPMIndex": np.arange(16) + 900.0}, "beyond the lattice's"),
    "not among the 16": (lambda v: {"BPMData_HBPMIndex": np.arange(16) + 9.0}, "not among the 16"),
    "several elements a row": (
        lambda v: {"CMData_HCMIndex": np.zeros((2, 8))}, "several elements a row"),
    "different places": (lambda v: {"CMData_HCMIndex": np.ones(16)}, "different places"),
    "HCMKicks has 3 steps": (lambda v: {"CMData_HCMKicks": np.ones(3)}, "HCMKicks has 3 steps"),
    "no list of elements": (lambda v: {"RINGData_Lattice": 3.0}, "no list of elements"),
    "holds no numbers": (lambda v: {"LocoMeasData_M": "no numbers"}, "holds no numbers"),
    "a length without bounds": (
        lambda v: {"RINGData_Lattice": element(2, Length=1e300)}, "has the length 1e+300"),
    "several lengths": (
        lambda v: {"RINGData_Lattice": element(2, Length=np.ones(3))}, "has the length"),
    "fields of text": (
        lambda v: {"RINGData_Lattice": element(1, PolynomB="much")},
        "element 2 of the lattice: the element 'QF'"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_variables_that_are_wrong_are_refused_in_one_sentence(simulated, brought, what):
    change, word = WRONG[what]
    fields = {k: "" if v is None else v for k, v in change(simulated).items()}
    with pytest.raises(TmlatticeError, match=re.escape(word)):
        brought(changed(simulated, **fields))


@pytest.mark.parametrize("name", ["LocoMeasData", "BPMData", "CMData", "RINGData"])
def test_missing_variable_is_named(simulated, brought, name):
    with pytest.raises(TmlatticeError, match=name):
        brought({key: value for key, value in simulated.items() if key != name})


def save_as_hdf5(path, variables):
    """A MATLAB 7.3 file, as MATLAB writes it: transposed arrays, cells of references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        references = file.create_group("#refs#")

        def write(place, name, value):
            if isinstance(value, dict):
                group = place.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for key, item in value.items():
                    write(group, key, item)
            elif isinstance(value, np.ndarray) and value.dtype == object:
                cells = []
                for item in value:
                    key = f"c{len(references)}"
                    write(references, key, item)
                    cells.append(references[key].ref)
                place[name] = np.array(cells, dtype=h5py.ref_dtype)[:, None]
                place[name].attrs["MATLAB_class"] = np.bytes_("cell")
            elif isinstance(value, str):
                place[name] = np.array([[ord(c)] for c in value], dtype=np.uint16)
                place[name].attrs["MATLAB_class"] = np.bytes_("char")
            else:
                place[name] = np.atleast_2d(np.asarray(value, dtype=float)).T
                place[name].attrs["MATLAB_class"] = np.bytes_("double")

        for key, value in variables.items():
            write(file, key, value)
    head = b"MATLAB 7.3 MAT-file".ljust(124) + bytes([0, 2]) + b"IM"
    path.write_bytes(head + path.read_bytes()[len(head) :])


def test_matlabs_file_of_version_7_3_is_the_same(simulated, brought, tmp_path):
    same = brought(simulated)
    save_as_hdf5(tmp_path / "simulated.mat", simulated)
    found = bring_in([tmp_path / "simulated.mat"])
    assert np.array_equal(found.measurement.response, same.measurement.response)
    assert found.measurement.correctors == same.measurement.correctors
    assert [e.name for e in found.ring.elements] == [e.name for e in same.ring.elements]
    assert np.array_equal([e.k1 for e in found.ring.elements], [e.k1 for e in same.ring.elements])


# --- other files ----------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def esrf(simulated, tmp_path_factory):
    """The same response as the ESRF's files: inputs by name, kicks inside sextupoles."""
    place = tmp_path_factory.mktemp("esrf")
    data, correctors = simulated["LocoMeasData"], simulated["CMData"]
    places = [*correctors["HCMIndex"].astype(int) - 1, *correctors["VCMIndex"].astype(int) - 1]
    names = [f"sr/{'hv'[i >= 16]}st/{i}" for i in range(len(places))]
    M = 1e-3 * data["M"]
    with h5py.File(place / "orm.h5", "w") as file:
        file["matrix"] = M / 1e-4
        file["inputs_delta"] = np.full(32, 1e-4)
        file["input_names"] = names
        file["raw_up"], file["raw_down"] = 3e-4 + M / 2, 3e-4 - M / 2
        file["bipolar"] = True
    (place / "cut.h5").write_bytes((place / "orm.h5").read_bytes()[:900])
    shutil.copy(place / "orm.h5", place / "two_sizes.h5")
    with h5py.File(place / "two_sizes.h5", "r+") as file:
        del file["raw_down"]
        file["raw_down"] = np.zeros((31, 32))
    with h5py.File(place / "eta.h5", "w") as file:
        x, y = 1e-3 * data["Eta"].reshape(2, -1)
        file["measured_eta_x"], file["measured_eta_y"] = x, y
        file.attrs["rf_full_step"] = 200
    with h5py.File(place / "noise.h5", "w") as file:
        for plane in "xy":
            file[f"Noise_BPM{plane}"] = np.full(16, 3e-7)
    mapping = {
        f"{i}/{'BA'[k >= 16]}1L": name
        for k, (i, name) in enumerate(zip(places, names, strict=True))
    }
    (place / "names.json").write_text(json.dumps({**mapping, "3/B3L": "sr/m-sf/1"}))
    fields = elements()
    for element in fields:
        if element["FamName"] == "BPM":
            element["Class"] = "Monitor"
        if element["FamName"] == "CAV":
            element["Frequency"] = data["RF"]
    head = {"FamName": "sr", "Class": "RingParam", "PassMethod": "IdentityPass", "Length": 0.0,
            "Energy": ENERGY * 1e9}  # fmt: skip
    scipy.io.savemat(place / "ring.mat", {"ring": np.array([head, *fields], dtype=object)})
    return place


def test_hdf5_files_of_the_esrf(simulated, esrf):
    parts = ("orm.h5", "eta.h5", "noise.h5", "names.json", "ring.mat")
    found = bring_in([esrf / name for name in parts])
    data, M = found.measurement, 1e-3 * simulated["LocoMeasData"]["M"]
    assert data.correctors[:2] == ("sr/hst/0", "sr/hst/1")
    assert data.planes == ("x",) * 16 + ("y",) * 16
    assert_allclose(data.response[:, :, 0].T, M[:16], atol=1e-15)
    assert_allclose(data.kicks, 1e-4)
    assert_allclose(data.noise, np.sqrt(2) * 3e-7)  # of an orbit; two make a change
    assert data.rf.step == 200
    assert not found.doubts
    columns, rf = design(found)
    assert_allclose(data.response, columns, atol=1e-3 * np.abs(columns).max())
    assert_allclose(data.rf.orbit, rf, atol=1e-3 * np.abs(rf).max())


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        (("orm.h5",), "give the lattice"),
        (("eta.h5", "names.json", "ring.mat"), "holds no 'matrix'"),
        (("names.json",), "no measurement that is known"),
        (("ring.mat",), "no measurement that is known"),
        (("orm.h5", "names.json", "nothing.mat"), "No such file"),
        (("cut.h5", "names.json", "ring.mat"), "cannot be read as HDF5"),
        (("two_sizes.h5", "names.json", "ring.mat"), "raw_down has the shape"),
    ],
)
def test_parts_that_are_missing_or_damaged_are_named(esrf, parts, told):
    with pytest.raises(TmlatticeError, match=told):
        bring_in([esrf / name for name in parts])


def middle_layer(variables):
    """Response, dispersion and noise of the same numbers, devices in another order."""
    data = variables["LocoMeasData"]
    monitors, hcm, vcm = (np.stack([np.arange(n) + 1, np.ones(n)], 1) for n in (16, 16, 16))
    loco = changed(
        variables,
        LocoMeasData_HBPM={"DeviceList": monitors}, LocoMeasData_VBPM={"DeviceList": monitors},
        LocoMeasData_HCM={"DeviceList": hcm}, LocoMeasData_VCM={"DeviceList": vcm},
        LocoMeasData_DeltaHCMHardware=np.full(16, 2.0),
        LocoMeasData_DeltaVCMHardware=np.full(16, 4.0),
    )  # fmt: skip
    order = np.arange(16)[::-1]
    M = data["M"].reshape(2, 16, 2, 16)
    ampere = (1.0, 2.0)  # half of LOCO's step in each plane

    def block(r, p):
        return {
            "Data": M[r][:, p][order][:, order] / 2 / ampere[p], "UnitsString": "mm/Ampere",
            "ActuatorDelta": np.full(16, ampere[p]),
            "Monitor": {"DeviceList": monitors[order]}, "Actuator": {"DeviceList": hcm[order]},
        }  # fmt: skip

    Rmat = np.empty((2, 2), dtype=object)
    for r in range(2):
        for p in range(2):
            Rmat[r, p] = block(r, p)
    eta = data["Eta"].reshape(2, 16)
    beside = {}
    for p, plane in enumerate("xy"):
        beside[f"BPM{plane}Disp"] = {
            "Data": eta[p][order] / 1e-3 * 1e-3, "UnitsString": "meter/(dp/p)", "dp": 1e-3,
            "ActuatorDelta": 200.0, "Monitor": {"DeviceList": monitors[order]},
            "Actuator": {"UnitsString": "Hz"},
        }  # fmt: skip
        beside[f"BPM{plane}Data"] = {
            "Sigma": np.full(16, 2e-4),
            "UnitsString": "mm",
            "DeviceList": monitors,
        }
    return loco, {"Rmat": Rmat}, beside


@pytest.mark.parametrize(
    ("variable", "field", "value", "words"),
    [
        ("BPMxDisp", "Actuator", "x", "BPMxDisp.Actuator should be a structure"),
        ("BPMxDisp", "dp", "x", "BPMxDisp.dp holds no numbers"),
        ("BPMxDisp", "dp", np.ones(3), "dp has the shape"),
        ("BPMyDisp", "UnitsString", 3.0, "BPMyDisp.UnitsString should be a text"),
        ("BPMxData", "DeviceList", np.full((16, 2), np.nan), "of no device"),
        ("BPMxData", None, "x", "BPMxData should be a structure"),
        ("Rmat", "Actuator", "x", "Rmat.Actuator should be a structure"),
        ("Rmat", "ActuatorDelta", np.ones(3), "ActuatorDelta has the shape"),
        ("Rmat", "Data", np.ones((3, 5)), "Rmat.Data has the shape"),
    ],
)
def test_fields_of_the_middle_layer_of_other_types_are_named(
    simulated, tmp_path, variable, field, value, words
):
    for name, variables in zip("abc", middle_layer(simulated), strict=True):
        if variable in variables:
            own = variables[variable]
            own = own[0, 0] if variable == "Rmat" else own
            if field is None:
                variables[variable] = value
            else:
                own[field] = value
        scipy.io.savemat(tmp_path / f"{name}.mat", variables)
    with pytest.raises(MeasurementError, match=words):
        bring_in([tmp_path / f"{name}.mat" for name in "abc"])


def test_middle_layers_files_are_read_by_the_loco_file(simulated, tmp_path):
    """Its devices in another order, half the step: half the orbit change, half the kick."""
    paths = []
    for name, variables in zip("abc", middle_layer(simulated), strict=True):
        paths.append(tmp_path / f"{name}.mat")
        scipy.io.savemat(paths[-1], variables)
    found, loco = bring_in(paths), bring_in(paths[:1])
    data, same = found.measurement, loco.measurement.select(correctors=found.measurement.correctors)
    assert data.correctors[:2] == ("cor_h::7", "sf_h::7")
    assert_allclose(data.response, same.response / 2, atol=1e-15)
    assert_allclose(data.kicks, same.kicks / 2)
    assert_allclose(data.noise, np.sqrt(2) * 2e-7)
    assert_allclose(data.rf.orbit, same.rf.orbit, atol=1e-15)
    assert data.rf.step == 200.0
    assert not found.doubts
    with pytest.raises(TmlatticeError, match="LOCO file with it"):
        bring_in(paths[1:])


@pytest.fixture(scope="module")
def lattice(simulated, tmp_path_factory):
    place = tmp_path_factory.mktemp("lattice")
    scipy.io.savemat(place / "a.loco.mat", simulated)
    found = bring_in([place / "a.loco.mat"])
    save_ring(found.ring, place / "ring.json")
    return str(place / "ring.json"), found.measurement


def test_long_table_with_units(lattice, tmp_path):
    path, data = lattice
    lines = ["Corrector,monitor,x [mm],y (um),kick [mrad]"]
    for name, kick, orbit in zip(data.correctors, data.kicks.tolist(), data.response, strict=True):
        lines += [f"{name},{m},{1e3 * x!r},{1e6 * y!r},{1e3 * kick!r}"
                  for m, (x, y) in zip(data.monitors, orbit.tolist(), strict=True)]  # fmt: skip
    lines += [f"RF,{m},{1e3 * x!r},,200"
              for m, (x, _) in zip(data.monitors, data.rf.orbit.tolist(), strict=True)]  # fmt: skip
    table = tmp_path / "response.csv"
    table.write_text("\n".join(lines))
    with pytest.raises(TmlatticeError, match="--lattice"):
        bring_in([table])
    found = bring_in([table], Options(lattice=path))
    again = found.measurement
    assert (again.correctors, again.planes) == (data.correctors, data.planes)
    assert_allclose(again.response, data.response, atol=1e-15)
    assert_allclose(again.kicks, data.kicks)
    assert again.rf.harmonic == data.rf.harmonic
    assert again.rf.step == 200
    assert not found.doubts


def test_wide_table(lattice, tmp_path):
    path, data = lattice
    names = data.correctors[::3]
    part = data.select(correctors=names)
    lines = ["monitor,plane," + ",".join(f"{name} [mm/mrad]" for name in names)]
    for i, monitor in enumerate(data.monitors):
        for p, plane in enumerate("xy"):
            values = part.response[:, i, p] / part.kicks
            lines.append(f"{monitor},{plane}," + ",".join(map(repr, values.tolist())))
    table = tmp_path / "wide.csv"
    table.write_text("\n".join(lines))
    found = bring_in([table], Options(lattice=path))
    assert_allclose(found.measurement.response, part.response, atol=1e-15)
    assert any("1e-04" in s or "0.0001" in s for s in found.assumed)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("corrector,monitor,x,y\ncor_h::0,bpm::0,1e-4,0", "no column 'kick'"),
        ("corrector,monitor,x [furlong],y,kick\ncor_h::0,bpm::0,1e-4,0,1e-4", "furlong"),
        ("corrector,monitor,x,y,kick\ncor_h::0,bpm::0,1_0,0,1e-4", "row 2: '1_0' is no number"),
        ("corrector,monitor,x,y,kick\ncor_h::0,bpm::0,1e-4,0", "line 2: 4 fields"),
        ("corrector,monitor,x,y,kick\nqf::0,bpm::0,1e-4,0,1e-4", "no corrector"),
        ("corrector,monitor,x,y,kick\ncor_h::0,bpm::77,1e-4,0,1e-4", "bpm::77"),
        ("monitor,plane,cor_h::0\nbpm::0,z,1.0", "plane 'z'"),
        ("", "the file is empty"),
    ],
)
def test_damaged_tables_are_a_sentence(lattice, tmp_path, text, told):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(TmlatticeError, match=re.escape(told)):
        bring_in([tmp_path / "a.csv"], Options(lattice=lattice[0]))


def test_turns_of_the_beam(lattice, tmp_path, rng):
    import turn_by_turn as tbt

    turns = rng.standard_normal((20, 3, 2))
    names = ["bpm::0", "bpm::5", "bpm::6"]
    x, y = (pd.DataFrame(turns[..., p].T, index=names) for p in range(2))
    tbt.write(tmp_path / "a.sdds", tbt.TbtData([tbt.TransverseData(X=x, Y=y)], 20), datatype="lhc")
    done = tmlattice("import", "a.sdds", "--lattice", lattice[0], "--out", "m", cwd=tmp_path,
                     check=0)  # fmt: skip
    assert "readings are in mm" in done.stdout
    data = read_measurement(tmp_path / "m")
    assert data.monitors == tuple(names)
    assert_allclose(data.readings[0], 1e-3 * turns, rtol=1e-6)
    assert isinstance(data, TurnByTurn)
    assert "20 turns are those of a stored beam" in done.stdout
    x, y = (frame.rename(index={"bpm::5": "BPM.OF.ANOTHER"}) for frame in (x, y))
    tbt.write(tmp_path / "c.sdds", tbt.TbtData([tbt.TransverseData(X=x, Y=y)], 20), datatype="lhc")
    found = bring_in([tmp_path / "c.sdds"], Options(lattice=lattice[0]))
    assert found.measurement.monitors == ("bpm::0", "bpm::6")
    assert "'BPM.OF.ANOTHER'" in " ".join(found.doubts)
    big = tbt.TbtData([tbt.TransverseData(X=1e3 * x, Y=1e3 * y)], 20)
    tbt.write(tmp_path / "um.sdds", big, datatype="lhc")
    whole = (tmp_path / "a.sdds").read_bytes()
    (tmp_path / "19.sdds").write_bytes(whole.replace(struct.pack(">i", 20), struct.pack(">i", 19)))
    for name, why in (("um", r"are above 0\.2 m"), ("19", r"into shape \(3,1,19\)")):
        with pytest.raises(TmlatticeError, match=why):
            bring_in([tmp_path / f"{name}.sdds"], Options(lattice=lattice[0]))
    (tmp_path / "b.sdds").write_text("nothing")
    unknown = "is no file that is known: for its columns name the lattice"
    for path, why in ((tmp_path / "b.sdds", unknown), (tmp_path, "is a folder; give a file")):
        with pytest.raises(TmlatticeError, match=why):
            bring_in([path])


# --- the files of real rings ----------------------------------------------------------------------
# file: monitors x, y; correctors H, V; noise of an orbit; measured in-plane rms; what the lattice
# in the file leaves, all in micrometres: the table of the folder's README
README = {
    "als_2005-06-13": (121, 121, 97, 73, 0.49, 238, 23.5),
    "spear3_2006-01-09": (53, 53, 54, 54, 0.17, 690, 84),
    "soleil_2012-01-20": (122, 122, 57, 57, 0.13, 76, 9.3),
    "pls_2009-03-01_0713": (102, 102, 68, 70, 0.36, 136, 42.5),
    "siam_2007-09-25": (20, 20, 16, 12, 16, 284, 106),
    "lnls_2014-07-17_before": (24, 24, 18, 24, 0.33, 154, 23),
}


def in_plane(values, planes):
    return np.stack([v[:, int(plane == "y")] for v, plane in zip(values, planes, strict=True)])


def rms(values):
    return 1e6 * np.sqrt(np.nanmean(values**2))


@pytest.mark.parametrize("name", README)
def test_a_real_ring_is_that_of_its_readme_and_its_model_is_locos_own(name):
    """LOCO's own model before its first iteration, by MATLAB's AT, to a thousandth."""
    x, y, horizontal, vertical, noise, measured, left = README[name]
    path = measured_data("real_rings", f"{name}.loco.mat")
    data = bring_in([path], Options(keep_bad=True)).measurement
    assert len(data.monitors) == x == y
    assert [data.planes.count(plane) for plane in "xy"] == [horizontal, vertical]
    assert 1e6 * np.nanmedian(data.noise) == pytest.approx(noise, rel=0.03, abs=0.005)
    found = bring_in([path], Options(iteration="last"))
    data, (columns, _) = found.measurement, design(found)
    assert rms(in_plane(data.response, data.planes)) == pytest.approx(measured, abs=0.51)
    gap = rms(in_plane(data.response - columns, data.planes))
    assert gap == pytest.approx(left, rel=0.01)

    found = bring_in([path], Options(iteration="first"))
    own = read_mat(path, ["LocoModel"])["LocoModel"][0]
    columns, rf = design(found)
    read = [np.isfinite(found.measurement.response[:, :, k]).any(axis=0) for k in (0, 1)]
    M = np.split(1e-3 * own["M"].T, [read[0].sum()], axis=1)
    for k, plane in enumerate("xy"):
        kicked = np.array(found.measurement.planes) == plane
        there = M[k][kicked]
        assert rms(there - columns[kicked][:, read[k], k]) < 1e-3 * rms(there)
    eta = 1e-3 * own["Eta"][: read[0].sum()]
    assert rms(eta - rf[read[0], 0]) < 1e-3 * rms(eta)
    doubts = " ".join(found.doubts)
    assert ("computed" in doubts) == name.startswith("siam")
    assert not any(word in doubts for word in ("assume", "momentum", "is not that of"))


def test_middle_layers_files_of_a_real_ring_are_its_loco_file():
    parts = ("loco", "response", "dispersion", "bpm")
    paths = [measured_data("real_rings", f"lnls_2014-07-17_before.{p}.mat") for p in parts]
    found, loco = bring_in(paths).measurement, bring_in(paths[:1]).measurement
    assert found.correctors == loco.correctors
    assert_allclose(found.response, loco.response, atol=1e-15)
    assert_allclose(found.kicks, loco.kicks, rtol=1e-3)  # its calibration is not quite straight
    assert_allclose(found.noise, loco.noise)
    assert_allclose(found.rf.orbit, loco.rf.orbit, atol=1e-15)


def test_esrf_ebs():
    place = measured_data("real_rings", "esrf_ebs")
    found = bring_in([*place.glob("*.h5"), place / "name_mapping.json", place / "betamodel.mat"])
    data, (columns, rf) = found.measurement, design(found)
    assert len(data.monitors) == 320
    assert [data.planes.count(plane) for plane in "xy"] == [32, 32]
    assert 1e6 * np.median(data.noise[:, 0]) / np.sqrt(2) == pytest.approx(0.46, abs=0.005)
    assert found.ring.length == pytest.approx(843.977, abs=1e-3)
    assert rms(in_plane(data.response - columns, data.planes)) < 0.1 * rms(
        in_plane(data.response, data.planes)
    )
    assert rms((data.rf.orbit - rf)[:, 0]) < 0.1 * rms(rf[:, 0])
    assert not found.doubts


def test_turns_of_the_sps():
    found = bring_in([measured_data("real_rings", "sps", "sps_200turns.sdds")])
    assert found.measurement.readings.shape[1] == 201
    assert "201 of one plane" in " ".join(found.assumed)
    spectrum = lines(found.measurement)
    for plane in (0, 1):  # each monitor's own strongest line, by NAFF
        read = found.measurement.readings[0, ..., plane].T
        own = [frequency((v - v.mean()).astype(complex))[0] for v in read if np.ptp(v) > 0]
        own = np.median(np.minimum(own, 1 - np.array(own)))
        assert abs(spectrum.tune[0, plane] - own) < 2e-4


def test_a_reader_that_does_not_come_back_is_one_sentence(tmp_path, monkeypatch):
    """A quarter of a million references to one number: 2 MB, and many seconds."""
    monkeypatch.setattr("tmlattice.lattice.mat_file.SECONDS", 1)
    monkeypatch.setattr("tmlattice.lattice.mat_file.RATE", np.inf)
    monkeypatch.setattr("tmlattice.lattice.mat_file.BUSY", 100)  # the processor's seconds end it
    path = tmp_path / "cells.mat"
    save_as_hdf5(path, {"one": 1.0})
    with h5py.File(path, "r+") as file:
        file["many"] = np.array([file["one"].ref] * 250_000, dtype=h5py.ref_dtype)
        file["many"].attrs["MATLAB_class"] = np.bytes_("cell")
    with pytest.raises(LatticeError, match="is not read within 1 s; save it again"):
        read_mat(path)
