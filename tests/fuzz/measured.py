"""Measured files of every kind, those of other programs too, and what an earlier diagnosis left."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from command import tmlattice

SMALL = Path(__file__).parent.parent / "lattices" / "small_ring.py"


def unsealed(folder):
    """A measurement that does not know its table: else every damaged one is refused at once."""
    own = folder / "measurement.json"
    document = json.loads(own.read_text())
    document.pop("table_sha256", None)
    own.write_text(json.dumps(document))


def write_kinds(ten, folder):
    """A folder of each kind of a stored beam's measurement: {kind: (command, its table)}."""
    from tmlattice.machine.stored_beam import (
        simulate_dispersion,
        simulate_orbits,
        simulate_tunes,
        simulate_turns,
    )
    from tmlattice.measurement import write_measurement

    made = {
        "turn by turn": (simulate_turns(ten, turns=64, amplitude=3e-4, seed=1), "readings.csv"),
        "closed orbit": (simulate_orbits(ten, shots=2, seed=1), "readings.csv"),
        "dispersion": (simulate_dispersion(ten, seed=1), "readings.csv"),
        "tunes": (simulate_tunes(ten, shots=2, seed=1), "tunes.csv"),
    }
    found = {}
    for kind, (simulation, table) in made.items():
        name = kind.replace(" ", "-")
        write_measurement(folder / name, simulation.measured)
        unsealed(folder / name)
        words = ["diagnose", "ring.json", name]
        found[f"{kind}, JSON"] = words, f"{name}/measurement.json"
        found[f"{kind}, table"] = words, f"{name}/{table}"
    return found


def write_known(folder):
    """What a diagnosis leaves known beside the ring that it found, for the next one."""
    words = ["diagnose", "ring.json", "closed-orbit", "--background", "all"]
    tmlattice(*words, "--lattice-out", "twin.json", "-q", cwd=folder, check=0)
    return {"known beside a twin": (["diagnose", "twin.json", "closed-orbit"],
                                    "twin.json.known.json")}  # fmt: skip


def write_network(ten, folder):
    """Weights of a network, beside turns."""
    from tmlattice.network import TaylorNetwork
    from tmlattice.network.network import save_network

    save_network(TaylorNetwork.from_ring(ten), folder / "network.pt")
    words = ["diagnose", "ring.json", "turns", "--network", "network.pt"]
    return {"network.pt": (words, "network.pt")}


def write_sdds(path, monitors, readings):
    """Arrays of one page, one a monitor and plane, in mm, after the format's definition."""
    lines = ["SDDS1", "!# little-endian"]
    names = [f"{m}:{p}" for m in monitors for p in "XY"]
    lines += [f"&array name={n}, type=double, units=mm, dimensions=1, &end" for n in names]
    body = np.int32(0).tobytes()
    for values in 1e3 * readings.reshape(len(readings), -1).T:
        body += np.int32(len(values)).tobytes() + values.astype("<f8").tobytes()
    path.write_bytes("\n".join([*lines, "&data mode=binary, &end", ""]).encode() + body)


def write_control_room(folder):
    """The templates of `import --example`, SDDS, and what reads each."""
    from tmlattice import read_measurement

    words = ["import", "--example", "--lattice", "ring.json", "--out", "room"]
    tmlattice(*words, "-q", cwd=folder, check=0)
    turns = read_measurement(folder / "turns")
    write_sdds(folder / "room/readings.sdds", turns.monitors, turns.readings[:, 0])
    wide = ["diagnose", "room/readings_wide.csv", "--machine", "room/tmlattice.toml"]
    check = lambda name: (["check", "ring.json", name], name)  # noqa: E731
    return {
        "table, a row a shot": (wide, "room/readings_wide.csv"),
        "machine file of a table": (wide, "room/tmlattice.toml"),
        "table, a row a reading": check("room/readings_long.csv"),
        "table, HDF5": check("room/readings.h5"),
        "table, SDDS": check("room/readings.sdds"),
        "table of a response": (
            ["import", "room/response.csv", "--lattice", "ring.json", "--out", "bring", "--force"],
            "room/response.csv",
        ),
    }


def write_loco(folder):
    """A LOCO file, whose variables the tests of the importer make, with a fit of two iterations."""
    import scipy.io
    from test_import import simulated, with_fit

    variables = with_fit(simulated.__wrapped__(), (0.9, 1.0))
    variables["LocoModel"] = {"Eta": 1.1 * variables["LocoMeasData"]["Eta"]}
    scipy.io.savemat(folder / "loco.mat", variables)
    words = ["import", "loco.mat", "--out", "loco", "--force"]
    last = [*words, "--iteration", "last"]
    return {"LOCO .mat": (words, "loco.mat"), "LOCO .mat, first": (last, "loco.mat")}


def write_matlab_and_hdf5(folder):
    """LOCO as MATLAB 7.3 writes it, and the ESRF's files, which the tests of the importer make."""
    import scipy.io
    import test_import

    simulated = test_import.simulated.__wrapped__()
    test_import.save_as_hdf5(folder / "seven.mat", simulated)
    seven = ["import", "seven.mat", "--out", "loco73", "--force"]
    for name, variables in zip("abc", test_import.middle_layer(simulated), strict=True):
        scipy.io.savemat(folder / f"{name}.mat", variables)
    layer = ["import", "a.mat", "b.mat", "c.mat", "--out", "layer", "--force"]
    (folder / "esrf").mkdir()
    factory = SimpleNamespace(mktemp=lambda name: folder / "esrf")
    test_import.esrf.__wrapped__(simulated, factory)
    parts = ["orm.h5", "eta.h5", "noise.h5", "names.json", "ring.mat"]
    esrf = ["import", *(f"esrf/{part}" for part in parts), "--out", "brought", "--force"]
    return {"LOCO .mat 7.3": (seven, "seven.mat"),
            "Middle Layer, response": (layer, "b.mat"), "Middle Layer, others": (layer, "c.mat"),
            **{f"ESRF {part}": (esrf, f"esrf/{part}") for part in parts}}  # fmt: skip


def write_turns_of_others(folder):
    """Turn-by-turn files of the kinds that the tests write."""
    import test_input_files

    found = {}
    for kind in ("superkekb", "madng", "trackone"):
        name = f"turns.{kind}"
        getattr(test_input_files, kind)(folder / name)
        words = ["import", name, "--turns", kind, "--unit", "m", "--out", f"of_{kind}", "--force"]
        found[f"turns of {kind}"] = words, name
    return found


def write_together(folder):
    """Several measurements at once, one before, and settings of shots."""
    joint = ["diagnose", "ring.json", "closed-orbit", "dispersion", "tunes"]
    before = ["diagnose", "ring.json", "closed-orbit", "--reference", "earlier"]
    shutil.copytree(folder / "closed-orbit", folder / "earlier")
    (folder / "settings.json").write_text('[{"qf::0": {"k1_relative": 0.01}}, {}]')
    simulate = ["simulate", "ring.json", "--shots", "2", "--settings", "settings.json", "--engine",
                "ocelot", "--out", "simulated", "--force", "-q"]  # fmt: skip
    return {
        "joint, JSON": (joint, "dispersion/measurement.json"),
        "joint, table": (joint, "tunes/tunes.csv"),
        "reference, JSON": (before, "earlier/measurement.json"),
        "reference, table": (before, "earlier/readings.csv"),
        "settings": (simulate, "settings.json"),
        "names in a lattice": (["diagnose", "own.json", "closed-orbit"], "own.json"),
    }


def write_calibration(folder):
    """What monitors and correctors do, of `predict`."""
    from tmlattice.effects import Cause
    from tmlattice.observe import calibration

    causes = [Cause("monitor_gain_x", "m::0", 0.01), Cause("corrector_calibration", "ch::0", 0.02)]
    own = calibration.Calibration(causes)
    calibration.write_calibration(folder / "calibration.json", own)
    words = ["predict", "ring.json", "--calibration", "calibration.json", "--out", "told.csv"]
    return {"calibration": (words, "calibration.json")}


def write_results(folder):
    """Diagnoses with all that they leave: read again, compared, corrected with a table of knobs."""
    for kind in ("response", "closed-orbit"):
        words = ["diagnose", "ring.json", kind, "--background", "all"][: 3 if kind[0] == "r" else 5]
        tmlattice(*words, "--out", f"of {kind}", "--lattice-out", f"{kind}.json", "-q",
                  cwd=folder, check=0)  # fmt: skip
    estimated = ["correct", "response.json", "--design", "ring.json"]
    tmlattice(*estimated, "--example", "knobs.csv", cwd=folder, check=0)
    (folder / "knobs.yaml").write_text(
        "- {knob: qf, unit: A, present: 100, low: 80, high: 120, step: 0.1,\n"
        "   curve: ['0:0', '150:1.35']}\n- {knob: new, members: ['qd::1'], step: 1e-5}\n"
    )
    (folder / "supplies.toml").write_text(SUPPLIES)
    settle = [*estimated, "--out", "settled", "-q"]
    of_folder = ["correct", "of response", "--out", "settled", "-q"]
    report = ["report", "of response"]
    compare = ["compare", "of response", "of closed-orbit"]
    change = ["diagnose", "ring.json", "closed-orbit", "--reference", "earlier", "--settings",
              "asked.csv"]  # fmt: skip
    (folder / "asked.csv").write_text(
        "device,present,new,change,unit,low,high,gain\nch::0,0,0.0001,0.0001,rad,,,1\n"
    )
    init = ["init", "ring.json", "room/readings.h5", "--machine", "new.toml", "--force", "-q"]
    shutil.copytree(folder / "response", folder / "other")
    return {
        "report": (report, "of response/diagnosis.json"),
        "report, lattice": (report, "of response/diagnosis.lattice.json"),
        "compare, diagnoses": (compare, "of closed-orbit/diagnosis.json"),
        "compare, responses": (["compare", "response", "other"], "other/response.csv"),
        "compare, lattices": (["compare", "own.json", "response.json"], "own.json"),
        "correct, diagnosis": (of_folder, "of response/diagnosis.json"),
        "correct, known": (settle, "response.json.known.json"),
        "correct, calibration": (settle, "response.json.calibration.json"),
        "knobs .csv": ([*settle, "--knobs", "knobs.csv"], "knobs.csv"),
        "knobs .yaml": ([*settle, "--knobs", "knobs.yaml"], "knobs.yaml"),
        "supplies": ([*of_folder, "--machine", "supplies.toml"], "supplies.toml"),
        "settings of a correction": (change, "asked.csv"),
        "init": (init, "room/readings.h5"),
    }


SUPPLIES = """
[lattice]
file = "ring.json"
energy = 3.0
particle = "electron"
monitors = ["m*"]
correctors = ["c*"]
[data]
unit = "mm"
noise = "20 um"
bad = ["m::5"]
in_order = true
assume = ["x-reversed"]
columns = {monitor = "pv", shot = "cycle"}
[channels]
"SR:1" = "m::0"
[[supplies]]
knob = "qf"
unit = "A"
present = 100.0
low = 80
high = 120
step = 0.1
curve = [[0, 0], [150, 1.35]]
error = 0.01
[[supplies]]
knob = "trim"
kind = "quadrupole"
members = ["qd::1"]
step = 1e-5
"""


def write_lattices(ten, folder):
    """MAD-X's TWISS table, and OCELOT's code, which is run: what is wrong in it is a sentence."""
    from test_other_codes import table

    table(ten, folder)
    shutil.copy(SMALL, folder / "small.py")
    return {"TFS": (["info", "twiss.tfs"], "twiss.tfs"),
            "OCELOT .py": (["info", "small.py"], "small.py")}  # fmt: skip


def write_measured(ten, folder):
    """All of them, in a folder that has `ring.json` and first turns: {format: (command, file)}."""
    return {
        **write_kinds(ten, folder),
        **write_known(folder),
        **write_network(ten, folder),
        **write_control_room(folder),
        **write_loco(folder),
        **write_matlab_and_hdf5(folder),
        **write_turns_of_others(folder),
        **write_together(folder),
        **write_calibration(folder),
        **write_results(folder),
        **write_lattices(ten, folder),
    }
