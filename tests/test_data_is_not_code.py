"""Files that would run something: each carries a harmless mark, which must not appear."""

import ast
import json
import os
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import at
import h5py
import numpy as np
import pytest
import scipy.io
import torch
from at_ring import at_lattice
from command import tmlattice
from conftest import SMALL
from test_lattice_files import write
from test_madx_decks import PLAIN

from tmlattice import Diagnosis, load_ring, read_measurement
from tmlattice.challenge import make, run
from tmlattice.correction.knobs import default_knobs, read_knobs
from tmlattice.correction.snippets import snippet
from tmlattice.errors import LatticeError, TmlatticeError, harmless
from tmlattice.importers.columns import read_columns
from tmlattice.input_files import content_of
from tmlattice.lattice.mat_file import read_mat
from tmlattice.machine_file import load_machine_file
from tmlattice.network import TaylorNetwork
from tmlattice.network.network import load_network, save_network
from tmlattice.report.interactive import as_plain

BEAM, RING = PLAIN.split("\n", 1)

MADX = {
    "reaches the interpreter": 'x = sin.__self__.__loader__.load_module("os").mkdir("MARK");',
    "reaches names of a function": "x := sinc.__globals__; qq: quadrupole, l=x, k1=0;",
    "calls a class": "x = qf->update; qf2: qf, l=x;",
    "leaves a bracket open": "x = (1+2;",
    "loops": "while (1==1) { x = 1; };",
    "has a tower of powers": "x = 9^9^9^9;",
    "repeats without end": "l1: line=(999999999*(qf));",
    "has a line of lines": "a0: line=(qf,qf);"
    + " ".join(f"a{i}: line=(a{i - 1},a{i - 1});" for i in range(1, 60)),
    "calls itself": 'call, file="ring.seq";',
    "calls a device": 'call, file="/dev/zero";',
    "calls a pipe": 'call, file="pipe";',
    "has a number of 5000 digits": f"x = {'9' * 5000};",
    "goes round in a circle": "a := b; b := c; c := a; q3: quadrupole, l=a, k1=0; ring: line=(q3);",
    "is nested": f"x = {'(' * 300}1{')' * 300};",
    "has no end of a statement": "x\n" * 20_000,
}


@pytest.mark.parametrize("what", MADX)
def test_madx_text_that_runs_or_never_ends(tmp_path, monkeypatch, what):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tmlattice.lattice.madx_file.MOST_WORK", 400_000)  # in a tenth of the time
    os.mkfifo("pipe")
    path = write(tmp_path, "ring.seq", MADX[what] + "\n" + PLAIN)
    sequence = "a59" if "a59" in MADX[what] else "ring"
    if what == "reaches names of a function":  # what nothing asks for is not looked at
        assert load_ring(path).counts()["quadrupole"] == 16
    else:
        with pytest.raises(LatticeError) as told:
            load_ring(path, sequence=sequence)
        assert len(str(told.value)) < 600
    assert not Path("MARK").exists()


def test_called_files_are_read_like_the_first(tmp_path):
    path = write(tmp_path, "ring.seq", 'call, file="beam.seq";\n' + RING)
    write(tmp_path, "beam.seq", BEAM)
    assert load_ring(path).energy == pytest.approx(3.0)
    write(tmp_path, "beam.seq", f"{BEAM} x = 9^9^9^9;")
    with pytest.raises(LatticeError, match="x = 9"):
        load_ring(path)


def small_at(small_ring, *more):
    """The small ring as AT has it, and further elements."""
    return at.Lattice([*at_lattice(small_ring), *more], energy=3e9, periodicity=1, name="ring")


SOLENOID = {"Length": 0.5, "K": 0.2, "PassMethod": "SolenoidLinearPass"}


@pytest.mark.parametrize("suffix", [".json", ".mat", ".m", ".repr"])
@pytest.mark.parametrize("method", ["../evilPass", "evilPass", "x" * 100_000])
def test_pass_methods_are_at_s_own(tmp_path, monkeypatch, small_ring, suffix, method):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "evilPass.py", "open('MARK', 'w')\ndef trackFunction(*a, **k): pass\n")
    path = tmp_path / f"ring{suffix}"
    evil = at.Element("evil", Length=0.0, PassMethod=method)
    at.save_lattice(small_at(small_ring, evil), path)
    with pytest.raises(LatticeError) as told:
        load_ring(path)
    assert len(str(told.value)) < 600
    assert not Path("MARK").exists()


def test_counts_that_do_not_fit_end_no_process(tmp_path, small_ring):
    path = tmp_path / "ring.json"
    at.save_lattice(small_at(small_ring, at.Element("solenoid", **SOLENOID)), path)
    assert "solenoid" in load_ring(path).counts()
    content = json.loads(path.read_text())
    content["elements"][-1] |= {
        "PassMethod": "GWigSymplecticPass", "Class": "Element", "Energy": 3e9, "Lw": 0.1,
        "Bmax": 1.0, "Nstep": 5, "Nmeth": 4, "NHharm": 1000000, "NVharm": 3, "By": [1.0], "Bx": [],
    }  # fmt: skip
    path.write_text(json.dumps(content))
    with pytest.raises(LatticeError, match="AT cannot track the element 'solenoid'"):
        load_ring(path)


def test_modules_of_the_working_directory_are_not_loaded(tmp_path, monkeypatch, small_ring):
    """By the processes that read a MATLAB file and that track an element."""
    monkeypatch.chdir(tmp_path)
    for module in ("scipy", "numpy", "at", "h5py", "pickle"):
        write(tmp_path, f"{module}.py", "open('MARK', 'w')\n")
    lattice = small_at(small_ring, at.Element("solenoid", **SOLENOID))
    at.save_lattice(lattice, tmp_path / "ring.mat")
    assert "solenoid" in load_ring(tmp_path / "ring.mat").counts()
    with h5py.File("a.h5", "w") as file:
        file["bpm1 x"] = np.zeros(3)
    assert len(read_columns(Path("a.h5"))) == 1
    assert not Path("MARK").exists()


def test_what_reads_a_binary_file_has_limits_of_memory_and_time(tmp_path):
    """1 MB that is 640 MB: the process that reads it may not have as much."""
    scipy.io.savemat(tmp_path / "a.mat", {"a": np.zeros(80 * 2**20)}, do_compression=True)
    with pytest.raises(LatticeError, match="more than 512 MB of memory"):
        read_mat(tmp_path / "a.mat")


def test_a_file_is_read_only_if_it_is_regular_and_up_to_its_stated_size(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MARK", "stop;")
    os.mkfifo("pipe")
    for place in ("pipe", "/dev/zero", "."):
        with pytest.raises(TmlatticeError, match="give a file"):
            content_of(Path(place), TmlatticeError)
    assert content_of(Path("/proc/self/environ"), TmlatticeError) == b""
    path = write(tmp_path, "ring.seq", f'{BEAM} call, file="/proc/self/environ";\n' + RING)
    assert load_ring(path).counts()["quadrupole"] == 16


def test_archives_of_arrays_are_not_compressed(tmp_path, small_ring):
    path = tmp_path / "network.pt"
    save_network(TaylorNetwork.from_ring(small_ring), path)
    load_network(small_ring, path)
    with ZipFile(path) as whole, ZipFile(tmp_path / "b.pt", "w", ZIP_DEFLATED) as other:
        for name in whole.namelist():
            other.writestr(name, whole.read(name))
    with pytest.raises(TmlatticeError, match="compressed archive"):
        load_network(small_ring, tmp_path / "b.pt")


@pytest.mark.parametrize("name", ["q'): pass\nopen('MARK', 'w')\n#", 'q;system,"touch MARK";'])
def test_statements_of_settings_run_nothing_that_a_name_holds(tmp_path, monkeypatch, name):
    """`settings.at.py`, `.madx` and `.ele` are code, which the user runs."""
    monkeypatch.chdir(tmp_path)
    ring = load_ring(write(tmp_path, "ring.seq", PLAIN))
    family = next(e.family for e in ring.elements if e.kind == "quadrupole")
    evil = replace(ring, elements=tuple(
        replace(e, family=name) if e.family == family else e for e in ring.elements
    ))  # fmt: skip
    changes = [(knob, 0.01) for knob in default_knobs(evil, ["quadrupoles"])]
    called = [node.args[0] for node in ast.walk(ast.parse(snippet(evil, changes, "at")))
              if isinstance(node, ast.Call)]  # fmt: skip
    assert name in [ast.literal_eval(argument) for argument in called]
    for code in ("madx", "elegant"):
        lines = snippet(evil, changes, code).splitlines()
        assert all(line.startswith("!") for line in lines if "MARK" in line)


class Evil:
    """Makes a folder where it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("MARK",)


def test_pickles_are_read_from_no_file(tmp_path, monkeypatch, small_ring):
    """Bare, or as torch and NumPy pack them, whatever the file is called."""
    monkeypatch.chdir(tmp_path)
    torch.save({"state": Evil()}, "packed.pt")
    np.savez("packed.npz", x=np.array([Evil()], dtype=object))
    readers = {
        ".json": [load_ring, Diagnosis.load, read_measurement], ".toml": [load_machine_file],
        ".mat": [load_ring, read_mat], ".m": [load_ring], ".repr": [load_ring],
        ".h5": [read_columns], ".sdds": [read_columns], ".csv": [read_columns],
        ".yaml": [lambda path: read_knobs(path, small_ring)],
        ".pt": [lambda path: load_network(small_ring, path)],
    }  # fmt: skip
    for content in (pickle.dumps(Evil()), Path("packed.pt").read_bytes(),
                    Path("packed.npz").read_bytes()):  # fmt: skip
        for suffix, some in readers.items():
            path = tmp_path / f"a{suffix}"
            path.write_bytes(content)
            for read in some:
                with pytest.raises(TmlatticeError):
                    read(path)
    assert not Path("MARK").exists()


def test_what_a_file_says_is_shown_without_control_characters_and_escaped():
    evil = "\x1b[2J\u202e<!--</script>%{x}<b>"
    assert harmless(evil) == r"\x1b[2J\u202e<!--</script>%{x}<b>"
    assert not set("<>%@") & set(as_plain(evil))


@pytest.mark.parametrize(
    "line", ["__import__('os').system('touch MARK')", "Drift('d', (lambda: 1)())"]
)
def test_at_s_texts_are_not_evaluated(tmp_path, monkeypatch, small_ring, line):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "ring.repr"
    at.save_lattice(small_at(small_ring), path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(LatticeError, match="cannot be read as an AT lattice"):
        load_ring(path)
    at.save_lattice(small_at(small_ring), tmp_path / "ring.m")
    text = (tmp_path / "ring.m").read_text().replace("'bpm_start'", line, 1)
    write(tmp_path, "ring.m", text)
    with pytest.raises(LatticeError, match="cannot be read as an AT lattice"):
        load_ring(tmp_path / "ring.m")
    assert not Path("MARK").exists()


def test_a_case_runs_no_lattice_that_is_not_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SMALL, "small_ring.py")
    make("A", 1, 1, Path("set"), lattice="small_ring.py", shots=2, progress=False)
    Path("evil.py").write_text(Path("small_ring.py").read_text() + "\nopen('MARK', 'w')\n")
    case = Path("set/cases/0000/case.json")
    case.write_text(case.read_text().replace("small_ring.py", "evil.py"))
    told = run(Path("set"), jobs=1, progress=False, lattice="small_ring.py")
    assert "give --lattice evil.py" in told["0000"]["error"]
    with pytest.raises(TmlatticeError, match="is Python code, which would be run"):
        run(Path("set"), jobs=1, progress=False)
    done = tmlattice("dev", "challenge", "run", "set", "-q", cwd=tmp_path, check=2)
    assert "give --lattice small_ring.py" in done.stderr
    assert not Path("MARK").exists()
