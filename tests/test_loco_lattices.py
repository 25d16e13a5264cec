"""Lattices of LOCO files as laboratories have them: the model answers as the machine does."""

import copy

import at
import numpy as np
import pytest
import scipy.io
from at.load.utils import element_from_dict
from numpy.testing import assert_allclose
from test_import import ENERGY, design, elements, simulated  # noqa: F401  (a fixture)

from tmlattice.errors import MeasurementError
from tmlattice.importers import Options, bring_in
from tmlattice.lattice.at_file import ring_from_at
from tmlattice.optics import ring_tunes

pytestmark = pytest.mark.usefixtures("forked_readers")


@pytest.fixture
def bring(tmp_path, simulated):  # noqa: F811
    """The file with something changed, brought in."""

    def bring(change):
        variables = copy.deepcopy(simulated)
        change(variables)
        scipy.io.savemat(tmp_path / "simulated.loco.mat", variables)
        return bring_in([tmp_path / "simulated.loco.mat"], Options())

    return bring


def lattice(v):
    return v["RINGData"]["Lattice"]


def families(*names, **fields):
    """Fields put into all elements of some families."""

    def change(v):
        for element in lattice(v):
            if element["FamName"] in names:
                element.update(fields)

    return change


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
} | {
    f"a drift called {name}": (families("DR", FamName=name), "")
    for name in ("WIG", "Wiggler", "RF", "Aperture", "Collimator", "Corrector", "Matrix66")
} | {
    f"a {family} called {name}": (families(family, FamName=name), "")
    for family, name in (("QF", "RF"), ("BEND", "Quad"), ("SF", "M66"), ("CAV", "Drift"))
}  # fmt: skip


@pytest.mark.parametrize("form", LATTICES)
def test_model_answers_as_the_machine(bring, form):
    """Within what the model of the usual file leaves, see `test_ring_answers_as_at_does`."""
    change, said = LATTICES[form]
    found = bring(change)
    data, (expected, rf) = found.measurement, design(found)
    assert len(data.monitors) == 16
    assert_allclose(data.response, expected, atol=1e-3 * np.abs(expected).max())
    assert_allclose(data.rf.orbit, rf, atol=1e-3 * np.abs(rf).max())
    assert any(said in sentence for sentence in found.assumed), found.assumed


def test_a_monitors_place_at_a_magnet_leaves_the_magnet(bring):
    ring = bring(monitors_at_magnets).ring
    families = [element.family for element in ring.elements]
    assert families.count("qf") == 8
    assert families[families.index("qf_bpm") + 1] == "qf"


def test_a_monitor_and_corrector_at_one_place_are_both_there(bring):
    def change(v):
        first = next(i for i, e in enumerate(lattice(v)) if e["FamName"] == "COR")
        v["BPMData"]["BPMIndex"][0] = first + 1.0

    found = bring(change)
    assert found.measurement.monitors[0] == "cor_bpm"
    assert {"cor_h::0", "cor_v::0"} <= set(found.measurement.correctors)


@pytest.mark.parametrize(
    "fields",
    [{"PolynomB": np.array([0.0, 3.0, 80.0]), "PolynomA": np.zeros(3), "MaxOrder": 2},
     {"BendingAngle": 0.1, "EntranceAngle": 0.05, "ExitAngle": 0.05}],
    ids=["multipole", "bend"],
)  # fmt: skip
def test_a_magnet_that_at_passes_as_a_drift_is_one(fields):
    """Tunes are AT's own, whatever its fields say."""
    every = elements()
    off = [own for own in every if own["FamName"] == "DR"][:2]
    for own in off:
        own.update(fields, FamName="OFF")
    made = [element_from_dict(dict(own), quiet=True, check=False) for own in every]
    there = at.Lattice(made, energy=ENERGY * 1e9, periodicity=1)
    there.disable_6d()
    with pytest.warns(UserWarning, match=r"pass method is DriftPass \(2\)"):
        ring = ring_from_at(there, "ring", ENERGY)
    assert [e.kind for e in ring.elements if e.family == "off"] == ["drift", "drift"]
    assert_allclose(np.array(ring_tunes(ring)) % 1, at.get_tune(there), atol=1e-3)


def linear_wiggler(v):
    first = next(e for e in lattice(v) if e["FamName"] == "DR")
    first.update(FamName="ID", PassMethod="WiggLinearPass", InvRho=0.5, KxKz=0.0)


@pytest.mark.parametrize("read", [False, True])
def test_a_linear_wiggler_focuses(bring, read):
    """AT's class of it goes by its length: a drift. Also where a monitor's place is its own."""

    def change(v):
        linear_wiggler(v)
        if read:
            names = [e["FamName"] for e in lattice(v)]
            v["BPMData"]["BPMIndex"][0] = names.index("ID") + 1.0

    plain, found = bring(lambda v: None).ring, bring(change)
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
def test_a_lattice_in_a_file_of_its_own(tmp_path, simulated, energy):  # noqa: F811
    """It states its energy, or the user does."""
    variables = copy.deepcopy(simulated)
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
