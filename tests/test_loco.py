"""LOCO files as other versions, hands and laboratories save them."""

import copy
import itertools

import at
import numpy as np
import pytest
import scipy.io
from at.load.utils import element_from_dict
from numpy.testing import assert_allclose
from test_import import ENERGY, brought, design, elements, simulated  # noqa: F401  (fixtures)

from tmlattice.errors import MeasurementError
from tmlattice.importers import Options, bring_in
from tmlattice.optics import ring_tunes

pytestmark = pytest.mark.usefixtures("forked_readers")


def struct_array(elements):
    names = list(dict.fromkeys(name for e in elements for name in e))
    array = np.empty(len(elements), dtype=[(name, object) for name in names])
    for i, element in enumerate(elements):
        for name in names:
            array[i][name] = element.get(name, np.zeros((0, 0)))
    return array


def put(variable, **fields):
    """Fields as functions of what they were; None: gone."""

    def change(v):
        for name, new in fields.items():
            old = v[variable].pop(name, None)
            if new is not None:
                v[variable][name] = new(old)

    return change


def together(*changes):
    return lambda v: [change(v) for change in changes] and None


def thering(v):
    v["THERING"] = v.pop("RINGData")["Lattice"]


def lattice(v):
    return v["RINGData"]["Lattice"]


def families(*names, **fields):
    """Fields put into all elements of some families."""

    def change(v):
        for element in lattice(v):
            if element["FamName"] in names:
                element.update(fields)

    return change


def cavity_without(*names):
    def change(v):
        (cavity,) = (element for element in lattice(v) if element["FamName"] == "CAV")
        for name in names:
            del cavity[name]

    return change


def energy_of_globval(v):
    put("RINGData", Energy=None)(v)
    cavity_without("Energy")(v)
    v["GLOBVAL"] = {"E0": 1.5e9}


def monitors_of_each_plane(v):
    index = v["BPMData"]["BPMIndex"]
    v["BPMData"].update(
        BPMIndex=np.concatenate([index, index]), VBPMIndex=v["BPMData"]["VBPMIndex"] + len(index)
    )


def several_elements(v):
    index = v["CMData"]["HCMIndex"]
    v["CMData"]["HCMIndex"] = np.stack([index, index, np.full(len(index), np.nan)], axis=1)


def list_of_elements(v):
    index, rows = v["CMData"]["HCMIndex"], np.empty(16, dtype=object)
    rows[:] = [np.repeat(place, 1 + k % 3) for k, place in enumerate(index)]
    v["CMData"]["HCMIndex"] = rows


def of_good_ones(v):
    v["BPMData"]["VBPMGoodDataIndex"] = np.arange(16) + 1.0
    v["CMData"]["VCMGoodDataIndex"] = np.delete(np.arange(16) + 1.0, 5)
    data = v["LocoMeasData"]
    data["M"] = np.delete(data["M"], 16 + 5, axis=1)


FORMS = {
    "a structure array": (lambda v: v["RINGData"].update(
        Lattice=struct_array(v["RINGData"]["Lattice"])), ""),
    "THERING": (thering, "the lattice is THERING"),
    "THERING beside a RINGData without it": (
        lambda v: v.update(THERING=v["RINGData"].pop("Lattice")), "the lattice is THERING"),
    "energy in MeV": (put("RINGData", Energy=lambda e: 1e3 * e), "is taken in MeV"),
    "everything in m and rad": (together(
        put("LocoMeasData", **dict.fromkeys(("M", "Eta", "BPMSTD"), lambda m: 1e-3 * m)),
        put("CMData", **dict.fromkeys(("HCMKicks", "VCMKicks"), lambda k: 1e-3 * k))),
        "they are taken in rad"),
    "BPMSTD in m": (put("LocoMeasData", BPMSTD=lambda s: 1e-3 * s), "it is taken in m"),
    "DeltaRF twice": (put("LocoMeasData", DeltaRF=lambda f: np.full(2, f)), ""),
    "a list of elements a corrector": (list_of_elements, "the middle is taken"),
    "energy of GLOBVAL": (energy_of_globval, "the energy is E0"),
    "no harmonic": (together(put("RINGData", CavityHarmNumber=None), cavity_without("HarmNumber")),
                    "no harmonic is given: 88"),
    "no frequency": (together(put("RINGData", CavityFrequency=None), cavity_without("Frequency"),
                              put("LocoMeasData", RF=None)), "no frequency is given"),
    "RF in MHz": (put("LocoMeasData", RF=lambda f: 1e-6 * f, DeltaRF=lambda f: 1e-6 * f),
                  "it is taken in MHz"),
    "Eta in two columns": (put("LocoMeasData", Eta=lambda e: e.reshape(2, -1).T), ""),
    "BPMSTD of each entry": (put("LocoMeasData", BPMSTD=lambda s: np.tile(s[:, None], 32)),
                             "the rms of each BPM"),
    "flags of good ones": (put("BPMData", HBPMGoodDataIndex=lambda g: np.ones(16, dtype=bool)), ""),
    "an empty good list": (put("CMData", HCMGoodDataIndex=lambda g: np.zeros((0, 0))),
                           "HCMGoodDataIndex is empty"),
    "M turned": (together(put("LocoMeasData", M=lambda m: m[:, :30].T), put(
        "CMData", VCMIndex=lambda i: i[:14], VCMKicks=lambda k: k[:14], VCMGoodDataIndex=None)),
        "M is [correctors, BPMs]"),
    "several elements a corrector": (several_elements, "the middle is taken"),
    "an RF of no number": (together(put("LocoMeasData", RF=lambda f: np.nan), put(
        "RINGData", CavityHarmNumber=lambda h: np.zeros((0, 0)))), ""),
    "an RF of 0": (put("LocoMeasData", RF=lambda f: 0.0), ""),
    "a cavity of empty fields": (families(
        "CAV", Frequency=np.zeros(0), HarmNumber=np.nan, Voltage=np.zeros((0, 0))), ""),
    "monitors for x and for y": (monitors_of_each_plane, "each is one BPM"),
    "flags that say nothing": (put("LocoFlags", ResponseMatrixMeasurement=lambda f: np.zeros(0)),
                               "no LocoFlags state it"),
}  # fmt: skip


@pytest.fixture
def variables(simulated):  # noqa: F811
    """Of the usual file; a test may change them."""
    return copy.deepcopy(simulated)


@pytest.fixture(scope="module")
def usual(simulated, tmp_path_factory):  # noqa: F811
    """What the usual file holds."""
    path = tmp_path_factory.mktemp("usual") / "usual.loco.mat"
    scipy.io.savemat(path, simulated)
    return bring_in([path], Options())


@pytest.fixture
def with_change(variables, brought):  # noqa: F811
    """The file with something changed, brought in."""

    def with_change(change):
        change(variables)
        return brought(variables)

    return with_change


@pytest.mark.parametrize("form", FORMS)
def test_other_forms_are_the_usual_one(usual, with_change, form):
    change, said = FORMS[form]
    found = with_change(change)
    assert any(said in sentence for sentence in found.assumed), found.assumed
    if form != "M turned":  # of fewer correctors
        assert [e.name for e in found.ring.elements] == [e.name for e in usual.ring.elements]
    data, same = found.measurement, usual.measurement
    kept = [same.correctors.index(name) for name in data.correctors]
    assert len(kept) == (30 if form == "M turned" else 32)
    assert np.allclose(data.response, same.response[kept], rtol=1e-12, atol=0)
    assert np.allclose(data.noise, same.noise, rtol=1e-12)
    assert np.allclose(data.rf.orbit, same.rf.orbit, rtol=1e-12, atol=0)
    assert data.rf.step == pytest.approx(same.rf.step)
    assert data.rf.frequency == pytest.approx(same.rf.frequency)
    assert data.rf.harmonic == same.rf.harmonic
    assert found.ring.energy == pytest.approx(usual.ring.energy)


def test_what_is_not_measured_is_left_out_and_said(variables, brought):  # noqa: F811
    data = variables["LocoMeasData"]
    data["Eta"], data["BPMSTD"] = 0 * data["Eta"], data["BPMSTD"][:7]
    variables["CMData"]["HCMKicks"][3] = np.nan
    of_good_ones(variables)
    found = brought(variables)
    assert found.measurement.rf is None
    assert found.measurement.noise is None
    assert len(found.measurement.correctors) == 30
    for said in (
        "Eta is zero everywhere",
        "BPMSTD has 7 numbers, not 32",
        "of the good lists alone",
    ):
        assert any(said in sentence for sentence in found.assumed), found.assumed


def test_zeros_that_no_bpm_reads_are_not_measured(variables, brought):  # noqa: F811
    """A block that was not recorded, a corrector, and the vertical dispersion."""
    data = variables["LocoMeasData"]
    data["M"][:16, 16:] = data["M"][:, 3] = data["Eta"][16:] = 0.0
    found = brought(variables)
    assert any("were not measured" in sentence for sentence in found.assumed)
    unread = np.isnan(found.measurement.response)
    vertical = np.array(found.measurement.planes) == "y"
    assert unread[vertical][..., 0].all()
    assert unread[3].all()
    assert unread.sum() == 16 * 16 + 32
    assert np.isnan(found.measurement.rf.orbit).sum(axis=0).tolist() == [0, 16]


def test_weights_are_no_noise(variables, brought):  # noqa: F811
    variables["LocoMeasData"]["BPMSTD"] = np.ones(32)
    found = brought(variables)
    assert found.measurement.noise is None
    assert any("it holds weights" in sentence for sentence in found.assumed)


def parameter(place, field, number, before, function="x"):
    return {
        "ElemIndex": place + 1.0, "FieldName": field, "FieldIndex": np.array(number),
        "Function": {"expr": function}, "SavedValue": before,
    }  # fmt: skip


def cells(things):
    array = np.empty(len(things), dtype=object)
    array[:] = things
    return array


@pytest.mark.parametrize("at_iteration", [0, 1, 2])
def test_every_parameter_of_a_fit_is_as_before_it(variables, brought, at_iteration):  # noqa: F811
    """Gradients, rolls, and skew gradients of a later iteration; saved after any of them."""
    lattice = variables["RINGData"]["Lattice"]
    for element in lattice:
        if element["FamName"] == "BEND":
            element.update(R1=np.eye(6), R2=np.eye(6))
    usual = brought(variables)
    places = {name: [i for i, e in enumerate(lattice) if e["FamName"] == name]
              for name in ("QF", "BEND", "SF")}  # fmt: skip
    steps = []
    for k in range(3):
        table = [(parameter(i, "PolynomB", [1.0, 2.0], 1.0), 1 + 0.01 * k) for i in places["QF"]]
        table += [
            (cells([parameter(i, "R1", [6.0, 6.0], np.eye(6), "mksrollmat(x)"),
                    parameter(i, "R2", [6.0, 6.0], np.eye(6), "mksrollmat(-x)")]), 1e-3 * k)
            for i in places["BEND"]
        ]  # fmt: skip
        if k:
            table += [(parameter(i, "PolynomA", [1.0, 2.0], 0.02), 0.01 + 0.01 * k)
                      for i in places["SF"]]  # fmt: skip
        steps.append({"Params": cells([p for p, _ in table]),
                      "Values": np.array([value for _, value in table])})  # fmt: skip
    for i in places["QF"]:
        lattice[i]["PolynomB"] = np.array([0, 1 + 0.01 * at_iteration, 0])
    for i in places["SF"]:
        lattice[i]["PolynomA"] = np.array([0, 0.01 + 0.01 * max(at_iteration, 1), 0])
    cosine, sine = np.cos(1e-3 * at_iteration), np.sin(1e-3 * at_iteration)
    roll = np.kron(np.array([[cosine, sine], [-sine, cosine]]), np.eye(2))
    for i in places["BEND"]:
        lattice[i]["R1"][:4, :4], lattice[i]["R2"][:4, :4] = roll, roll.T
    found = brought({**variables, "FitParameters": cells(steps)})
    assert found.ring.model == "model before the fit"
    assert found.ring.elements == usual.ring.elements
    fitted = brought({**variables, "FitParameters": cells(steps)}, iteration="last").ring
    assert fitted["qf::0"].k1 == pytest.approx(1 + 0.01 * at_iteration)


def test_an_energy_that_no_file_states_is_assumed_and_can_be_named(variables, brought):  # noqa: F811
    energy_of_globval(variables)
    del variables["GLOBVAL"]
    found = brought(variables)
    assert found.ring.energy == pytest.approx(3.0)
    assert any("no energy is stated" in sentence for sentence in found.assumed)
    assert brought(variables, energy=1.5).ring.energy == pytest.approx(1.5)


# --- lattices of LOCO files as laboratories have them: the model answers as the machine does ------
def unused_correctors(v):
    """All of one plane, under a name that says none; one of them is not in the list."""
    families("COR", FamName="CORX")(v)
    data, correctors = v["LocoMeasData"], v["CMData"]
    kept = {}
    for letter in "HV":
        index = correctors[f"{letter}CMIndex"].astype(int) - 1
        own = [lattice(v)[i]["FamName"] == "CORX" for i in index]
        others = [k for k, here in enumerate(own) if not here]
        kept[letter] = sorted([*others, *np.flatnonzero(own)[1:]]) if letter == "H" else others
    count = len(correctors["HCMIndex"])
    data["M"] = data["M"][:, [*kept["H"], *(count + k for k in kept["V"])]]
    for letter, own in kept.items():
        del correctors[f"{letter}CMGoodDataIndex"]
        for name in ("Index", "Kicks"):
            correctors[f"{letter}CM{name}"] = correctors[f"{letter}CM{name}"][own]


def monitors_at_magnets(v):
    """Some monitors' places are those of the magnets behind them."""
    index = v["BPMData"]["BPMIndex"]
    behind = [lattice(v)[int(i)]["FamName"] for i in index]  # counted from 0
    assert "QF" in behind
    v["BPMData"]["BPMIndex"] = index + np.array([name == "QF" for name in behind])


def noise_of_radiation(v):
    last = {"FamName": "QDIFF", "Length": 0.0, "PassMethod": "QuantDiffPass",
            "Lmatp": 1e-7 * np.eye(6)}  # fmt: skip
    v["RINGData"]["Lattice"] = np.array([*lattice(v), last], dtype=object)


def table_of_kicks(v):
    grid = np.linspace(-0.02, 0.02, 3)
    fields = {"xtable": grid, "ytable": grid, "xkick": np.zeros((3, 3)), "ykick": np.zeros((3, 3))}
    first = next(e for e in lattice(v) if e["FamName"] == "DR")
    first.update(fields, FamName="EPU", PassMethod="IdTablePass")


def matrix_of_a_laboratory(v):
    """In place of a drift; its pass method is no one's."""
    matrix = np.eye(6)
    matrix[[0, 2], [1, 3]] = 0.5
    first = next(e for e in lattice(v) if e["FamName"] == "DR")
    first.update(FamName="ID", PassMethod="MyMatrixPass", M66=matrix)


def drifts_called(*names):
    """One drift after the other has the next of the names."""

    def change(v):
        every = itertools.cycle(names)
        for element in lattice(v):
            if element["FamName"] == "DR":
                element["FamName"] = next(every)

    return change


NONE = "is no pass method of AT: "
LATTICES = {
    "a laboratory's own quadrupoles": (families("QF", "QD", PassMethod="StrMPoleNew4Pass"),
                                       f"{NONE}StrMPoleSymplectic4Pass, by its fields"),
    "a laboratory's own bends": (families("BEND", PassMethod="BndMPoleSymplectic4FrgFPass"),
                                 f"{NONE}BndMPoleSymplectic4Pass, by its fields"),
    "a laboratory's own sextupoles": (families("SF", "SD", PassMethod="StrCorrMPolePass"),
                                      f"{NONE}StrMPoleSymplectic4Pass, by its fields"),
    "a laboratory's own correctors": (families("COR", PassMethod="MyCorrectorPass"),
                                      f"{NONE}CorrectorPass, by its fields"),
    "a corrector that is not used": (unused_correctors, ""),
    "monitors at magnets": (monitors_at_magnets, ""),
    "a field that is a word of AT's": (families("QF", tilt=0.0, dx=0.0), ""),
    "one kick of a corrector": (families("COR", KickAngle=0.0), ""),
    "a laboratory's own matrix": (matrix_of_a_laboratory, f"{NONE}Matrix66Pass, by its fields"),
    "noise of the radiation": (noise_of_radiation, ""),
    "a table of kicks": (table_of_kicks, "InsertionDeviceKickMap"),
    "drifts with names of AT's classes": (drifts_called(
        "WIG", "Wiggler", "RF", "Aperture", "Collimator", "Corrector", "Matrix66"), ""),
    "magnets with names of AT's classes": (together(
        families("QF", FamName="RF"), families("BEND", FamName="Quad"),
        families("SF", FamName="M66"), families("CAV", FamName="Drift")), ""),
}  # fmt: skip


@pytest.mark.parametrize("form", LATTICES)
def test_model_answers_as_the_machine(with_change, form):
    """Within what the model of the usual file leaves, see `test_ring_answers_as_at_does`."""
    change, said = LATTICES[form]
    found = with_change(change)
    data, (expected, rf) = found.measurement, design(found)
    assert len(data.monitors) == 16
    assert_allclose(data.response, expected, atol=1e-3 * np.abs(expected).max())
    assert_allclose(data.rf.orbit, rf, atol=1e-3 * np.abs(rf).max())
    assert any(said in sentence for sentence in found.assumed), found.assumed


def test_a_monitors_place_at_a_magnet_leaves_the_magnet(with_change):
    ring = with_change(monitors_at_magnets).ring
    families = [element.family for element in ring.elements]
    assert families.count("qf") == 8
    assert families[families.index("qf_bpm") + 1] == "qf"


def test_a_monitor_and_corrector_at_one_place_are_both_there(with_change):
    def change(v):
        first = next(i for i, e in enumerate(lattice(v)) if e["FamName"] == "COR")
        v["BPMData"]["BPMIndex"][0] = first + 1.0

    found = with_change(change)
    assert found.measurement.monitors[0] == "cor_bpm"
    assert {"cor_h::0", "cor_v::0"} <= set(found.measurement.correctors)


def linear_wiggler(v):
    first = next(e for e in lattice(v) if e["FamName"] == "DR")
    first.update(FamName="ID", PassMethod="WiggLinearPass", InvRho=0.5, KxKz=0.0)


@pytest.mark.parametrize("read", [False, True])
def test_a_linear_wiggler_focuses(with_change, read):
    """AT's class of it goes by its length: a drift. Also where a monitor's place is its own."""

    def change(v):
        linear_wiggler(v)
        if read:
            names = [e["FamName"] for e in lattice(v)]
            v["BPMData"]["BPMIndex"][0] = names.index("ID") + 1.0

    plain, found = with_change(lambda v: None).ring, with_change(change)
    own = next(e for e in found.ring.elements if e.family == "id")
    assert own.kind == "wiggler"
    made = elements()
    linear_wiggler({"RINGData": {"Lattice": made}})
    there = at.Lattice([element_from_dict(dict(e), quiet=True) for e in made],
                       energy=ENERGY * 1e9, periodicity=1)  # fmt: skip
    tunes = at.get_tune(there.disable_6d(copy=True))
    assert_allclose(np.array(ring_tunes(found.ring)) % 1, tunes, atol=1e-4)
    assert abs(ring_tunes(found.ring)[1] - ring_tunes(plain)[1]) > 1e-3


@pytest.mark.parametrize("energy", [None, ENERGY])
def test_a_lattice_in_a_file_of_its_own(tmp_path, variables, energy):
    """It states its energy, or the user does."""
    own = variables.pop("RINGData")["Lattice"]
    if energy:
        del own[-2]["Energy"]
    scipy.io.savemat(tmp_path / "loco.mat", variables)
    scipy.io.savemat(tmp_path / "ring.mat", {"THERING": own.reshape(-1, 1)})
    both = [tmp_path / "loco.mat", tmp_path / "ring.mat"]
    found = bring_in(both, Options(energy=energy))
    assert found.ring.energy == ENERGY
    assert_allclose(found.measurement.response, design(found)[0], atol=2e-7)
    with pytest.raises(MeasurementError, match=r"a lattice of its own \(.mat\) with it"):
        bring_in(both[:1], Options())
    scipy.io.savemat(tmp_path / "loco.mat", {**variables, "RINGData": {"Lattice": own}})
    with pytest.raises(MeasurementError, match="holds a lattice, and"):
        bring_in(both, Options())
