"""The machine file: with it no command needs its lattice again; as data it runs nothing."""

import json
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from command import tmlattice
from conftest import SMALL

import tmlattice as package
from tmlattice.cli.command import tmlattice as command
from tmlattice.errors import MachineFileError, MeasurementError
from tmlattice.lattice import load_ring, save_ring
from tmlattice.machine_file import load_machine_file
from tmlattice.measurement import write_measurement
from tmlattice.observe.calibration import calibrated_response


@pytest.fixture(scope="module")
def machine(tmp_path_factory, small_ring):
    """A ring, a day's readings as a folder and as a control room's file, and a machine file."""
    place = tmp_path_factory.mktemp("machine")
    save_ring(small_ring, place / "ring.json")
    fault = [package.Cause("quadrupole_gradient", "QD::5", -0.1)]
    data = package.simulate(
        small_ring, fault, shots=4, amplitude=3e-4, noise=2e-6, engine="ocelot", seed=3
    ).measurement()
    write_measurement(place / "day", data)
    names = {f"C{i:02d}": name for i, name in enumerate(data.monitors)}
    lines = [",".join(["shot", *(f"{n}:{plane}" for n in names for plane in "XY")])]
    for shot, values in enumerate(1e3 * data.readings[:, 0] * [-1, 1]):
        lines.append(",".join([str(shot), *(f"{v:.9g}" for v in values.ravel())]))
    (place / "room.csv").write_text("\n".join(lines))
    channels = "\n".join(f'{device} = "{name}"' for device, name in names.items())
    (place / "tmlattice.toml").write_text(
        '[lattice]\nfile = "ring.json"\n'
        '[data]\nunit = "mm"\nnoise = "2 um"\nassume = ["x-reversed"]\n'
        f"[channels]\n{channels}\n"
        '[[supplies]]\nknob = "trim"\nkind = "quadrupole"\nmembers = ["QD::5"]\nunit = "A"\n'
        "present = 100.0\nlow = 80\nhigh = 120\nstep = 0.1\ncurve = [[0, 0], [150, -1.35]]\n"
    )
    return place


SAID = "tmlattice: machine file tmlattice.toml\n"


def test_no_command_needs_the_lattice_again(machine, tmp_path):
    """And each says on stderr which machine file it uses."""
    for words in (
        ["info"],
        ["check", "day"],
        ["diagnose", "day", "--lattice-out", tmp_path / "found.json", "--out", tmp_path / "D"],
        ["correct", tmp_path / "found.json", "--target", "tunes"],
        ["predict", "--out", tmp_path / "r.csv"],
        ["simulate", "--shots", 1, "--amplitude", "1e-4", "--out", tmp_path / "S"],
        ["import", "room.csv", "--out", tmp_path / "I"],
    ):
        done = tmlattice(*words, cwd=machine, check=0)
        assert done.stderr == SAID, words
        if words[0] == "diagnose":
            assert "IDENTIFIED: quadrupole QD::5" in done.stdout
        if words[0] == "correct":  # the one supply of the file, in its unit
            assert "trim" in done.stdout
            assert " A" in done.stdout
    assert json.loads((tmp_path / "S" / "measurement.json").read_text())["noise"]["x"] == 2e-6
    assert tmlattice("info", "-q", cwd=machine, check=0).stderr == ""


def test_a_control_rooms_file_is_read_by_what_the_machine_file_states(machine, tmp_path):
    """Names, unit, noise and the sign of x; the folder of `import` is the one that was measured."""
    done = tmlattice("import", "room.csv", "--out", tmp_path / "I", cwd=machine, check=0)
    assert "undone: x-reversed" in done.stdout
    for name in ("check", "diagnose"):
        done = tmlattice(name, "room.csv", "--assume", "x-reversed", cwd=machine, check=2)
        assert "--assume x-reversed is in the machine file too" in done.stderr
    own, data = package.read_measurement(tmp_path / "I"), package.read_measurement(machine / "day")
    np.testing.assert_allclose(
        own.select(monitors=data.monitors).readings, data.readings, rtol=1e-8, atol=1e-12
    )
    assert own.noise == pytest.approx(np.full((len(own.monitors), 2), 2e-6))
    read = load_machine_file(machine / "tmlattice.toml").read(machine / "room.csv")
    np.testing.assert_array_equal(read.readings, own.readings)
    done = tmlattice("diagnose", "room.csv", "--json", tmp_path / "a.json", cwd=machine, check=0)
    (finding,) = json.loads((tmp_path / "a.json").read_text())["findings"]
    assert finding["element"] == "QD::5"
    assert abs(finding["amount"] + 0.1) < 4 * finding["amount_sigma"]


def test_channels_of_an_orbit_response_are_bpms_and_correctors(tmp_path, small_ring):
    """Of the design's response with other names: the same response, without the bad BPM."""
    _, response = calibrated_response(small_ring, [], ["v1", "v2"])
    monitors = [monitor.name for monitor in small_ring.monitors]
    rows = ["corrector,monitor,x,y,kick"]
    rows += [
        f"PS{c},D{m},{response[c, m, 0]:.9g},{response[c, m, 1]:.9g},1"
        for c in range(2) for m in range(len(monitors))
    ]  # fmt: skip
    (tmp_path / "r.csv").write_text("\n".join(rows))
    names = {"ps0": "v1", "PS1": "V2", **{f"D{m}": name for m, name in enumerate(monitors)}}
    lines = ["[data]", 'bad = ["d3"]', "[channels]", *(f'{d} = "{n}"' for d, n in names.items())]
    (tmp_path / "m.toml").write_text("\n".join(lines))
    machine = load_machine_file(tmp_path / "m.toml")
    read = machine.read(tmp_path / "r.csv", small_ring)
    assert read.correctors == ("v1", "v2")
    assert (read.devices["v1"], read.devices[monitors[0]]) == ("PS0", "D0")
    assert read.monitors == tuple(name for m, name in enumerate(monitors) if m != 3)
    np.testing.assert_allclose(read.response, np.delete(response, 3, axis=1), rtol=1e-8)
    (tmp_path / "a.csv").write_text("shot,D1 x [mm]\n0,1\n")  # correctors' names are in no way
    assert machine.read(tmp_path / "a.csv", small_ring).monitors == (monitors[1],)
    (tmp_path / "m.toml").write_text("\n".join(lines).replace('"d3"', '"bmp*"'))
    with pytest.raises(package.errors.UnknownNameError, match="no BPM 'bmp"):
        load_machine_file(tmp_path / "m.toml").read(tmp_path / "r.csv", small_ring)


def test_supplies_are_knobs_with_limits_and_calibration(machine, small_ring):
    (knob,) = load_machine_file(machine / "tmlattice.toml").knobs(small_ring)
    assert (knob.unit, knob.low, knob.high, knob.step) == ("A", 80.0, 120.0, 0.1)
    assert knob.strength(100.0) == pytest.approx(-0.9)
    assert knob.setting(0.05) == pytest.approx(105.0)


def test_a_lattice_on_the_command_line_is_used_instead(machine, tmp_path, small_ring):
    """Without the energy and the marks of the file's own."""
    other = small_ring.with_changed("QD::5", k1=-0.85)
    save_ring(other, tmp_path / "other.json")
    save_ring(small_ring, tmp_path / "ring.json")
    (tmp_path / "m.toml").write_text('[lattice]\nfile = "ring.json"\nenergy = 2.5\n')
    for words, energy in (([], 2.5), (["ring.json"], 2.5), (["other.json"], 3.0)):
        tmlattice("info", *words, "--machine", "m.toml", "--json", "i.json", cwd=tmp_path, check=0)
        assert json.loads((tmp_path / "i.json").read_text())["energy_gev"] == energy
    for words, name in (
        (["day"], "ring.json"),
        (["ring.json", "day"], "ring.json"),
        ([tmp_path / "other.json", "day"], str(tmp_path / "other.json")),
    ):
        tmlattice("check", *words, "--json", tmp_path / "c.json", cwd=machine)
        provenance = json.loads((tmp_path / "c.json").read_text())["provenance"]
        assert provenance["lattice"] == name


def test_several_measurements_without_a_lattice(machine):
    """The first one is not taken for a lattice."""
    done = tmlattice("diagnose", "day", "nowhere", cwd=machine, check=2)
    assert "no measurement folder 'nowhere'" in done.stderr
    done = tmlattice("diagnose", "no.json", "day", cwd=machine, check=2)
    assert "no lattice file 'no.json'" in done.stderr


def test_paths_are_from_the_folder_of_the_file(machine, tmp_path):
    done = tmlattice("info", "--machine", machine / "tmlattice.toml", cwd=tmp_path, check=0)
    assert f"machine file {machine / 'tmlattice.toml'}" in done.stderr
    assert load_machine_file(machine / "tmlattice.toml").ring().length > 100


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[latice]", 'it has the key "latice"; did you mean "lattice"?'),
        ('[data]\ncolumns = {bpm = "x"}', 'data.columns has the key "bpm"; known are monitor'),
        ("[lattice]\nenergy = 0", "lattice.energy is 0; it should be above 0"),
        ("[lattice]\nenergy = " + "9" * 400, "nan, inf and 10"),
        ('[lattice]\nmonitors = "BPM*"', "lattice.monitors is"),
        ('[data]\nnoise = "loud"', "data.noise is 'loud'; give a length"),
        ('[lattice]\nfile = "no"', "no lattice file 'no'"),
        ("[data]", "before it the LATTICE where no machine file does"),
        ("a = 1\na = 2", "no TOML that is read"),
        ("a = " + "[" * 30 + "]" * 30, "nested more than 20 deep"),
        ("a = " + "[" * 100_000, "no TOML that is read"),
        (".".join("a" * 100_000) + " = 1", "a key of more than 20 parts"),
        ("[" + ".".join("a" * 100_000) + "]", "a key of more than 20 parts"),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path, text, words):
    (tmp_path / "tmlattice.toml").write_text(text)
    done = tmlattice("check", "day", cwd=tmp_path, check=2)
    assert words in done.stderr
    assert len(done.stderr.removeprefix(SAID).strip().splitlines()) == 1
    assert len(done.stderr) < 600


def test_two_files_or_none_are_one_sentence(machine):
    files = ["--machine", "a.toml", "--machine=b.toml"]
    for words, said in (
        (files, "--machine is given twice, 'a.toml' and 'b.toml'"),
        (files[:2], "cannot read 'a.toml': No such file"),
        (["--machine"], "--machine needs a value, FILE"),
    ):
        done = tmlattice("info", *words, cwd=machine, check=2)
        assert said in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_a_file_that_was_found_runs_no_code(tmp_path):
    """A neighbour may have put it there. One that is named is trusted, as its lattice is."""
    code = f"open({str(tmp_path / 'MARK')!r}, 'w').write('run')\n"
    (tmp_path / "ring.py").write_text(code + SMALL.read_text())
    for name in ("ring.py", "RING.PY", "./ring.py", str(tmp_path / "ring.py")):
        (tmp_path / "tmlattice.toml").write_text(f'[lattice]\nfile = "{name}"\n')
        for words in (["info"], ["simulate", "--out", "S"], ["diagnose", "day"],
                      ["import", "a.csv", "--out", "I"]):  # fmt: skip
            (tmp_path / "a.csv").write_text("shot,end_1 x [mm]\n0,1\n")
            done = tmlattice(*words, cwd=tmp_path, check=2)
            assert "is Python code, which would be run; if you trust that file, and" in done.stderr
            assert not (tmp_path / "MARK").exists()
    tmlattice("info", "--machine", "tmlattice.toml", cwd=tmp_path, check=0)
    assert (tmp_path / "MARK").exists()


@pytest.mark.skipif(os.name == "nt", reason="POSIX files")
def test_a_pipe_or_a_folder_of_its_name_is_one_sentence(tmp_path):
    os.mkfifo(tmp_path / "tmlattice.toml")
    assert "a pipe or a device" in tmlattice("info", cwd=tmp_path, check=2).stderr
    (tmp_path / "tmlattice.toml").unlink()
    (tmp_path / "tmlattice.toml").mkdir()
    assert "it is a folder" in tmlattice("info", cwd=tmp_path, check=2).stderr


def test_nothing_is_written_over_what_the_file_names(machine):
    before = {path: path.read_bytes() for path in machine.glob("*.*")}
    for out in ("ring.json", "tmlattice.toml"):
        done = tmlattice("info", "--json", out, cwd=machine, check=2)
        assert "is read, and would be written over" in done.stderr
    assert before == {path: path.read_bytes() for path in machine.glob("*.*")}


def test_init_writes_what_lattice_and_data_state(machine, tmp_path):
    """Channels that the reader finds by itself, and the unit that it took from their size."""
    save_ring(load_ring(machine / "ring.json"), tmp_path / "ring.json")
    monitor = load_ring(machine / "ring.json").monitors[3].name
    (tmp_path / "a.csv").write_text(f"shot,SR:{monitor}:X,SR:{monitor}:Y\n0,0.5,0.25\n")
    words = ["init", "ring.json", "a.csv", "--energy", "2.5"]
    done = tmlattice(*words, cwd=tmp_path, check=0)
    assert "35 BPMs, 17 correctors" in done.stdout
    text = (tmp_path / "tmlattice.toml").read_text()
    stated = tomllib.loads(text)
    assert stated == {
        "lattice": {"file": "ring.json", "energy": 2.5},
        "data": {"unit": "mm"},
        "channels": {f"SR:{monitor}": monitor},
    }
    tmlattice("info", cwd=tmp_path, check=0)
    done = tmlattice(*words, cwd=tmp_path, check=2)
    assert "'tmlattice.toml' is there already; --force replaces it" in done.stderr
    assert (tmp_path / "tmlattice.toml").read_text() == text
    (tmp_path / "sub").mkdir()
    tmlattice("init", "ring.json", "--machine", "sub/m.toml", "-q", cwd=tmp_path, check=0)
    tmlattice("info", "--machine", "sub/m.toml", cwd=tmp_path, check=0)


def test_the_comments_of_init_are_a_file_that_is_read(tmp_path, small_ring):
    """Every line with a key, its mark taken away, is known and of the right type."""
    save_ring(small_ring, tmp_path / "ring.json")
    tmlattice("init", "ring.json", cwd=tmp_path, check=0)
    lines = (tmp_path / "tmlattice.toml").read_text().splitlines()
    keys = [s for s in lines if s.startswith("# [[") or (" = " in s and "Or a table" not in s)]
    assert len(keys) > 20
    text = "\n".join(line.removeprefix("# ") if line in keys else line for line in lines)
    (tmp_path / "all.toml").write_text(text)
    made = load_machine_file(tmp_path / "all.toml")
    assert made.options["energy"] == small_ring.energy
    assert made.stated.noise == pytest.approx(2e-5)
    (knob,) = made.knobs(small_ring)
    assert knob.strength(knob.present) == pytest.approx(small_ring[knob.members[0]].k1, rel=1e-5)


def test_init_lists_channels_that_the_lattice_does_not_have(machine, tmp_path):
    done = tmlattice("init", machine / "ring.json", machine / "room.csv", cwd=tmp_path, check=0)
    assert "none of its 35 channels is a BPM of the lattice: fill in [channels]" in done.stdout
    assert '# "C07" = ""' in (tmp_path / "tmlattice.toml").read_text()
    tmlattice("info", cwd=tmp_path, check=0)


def test_init_asks_on_a_terminal_and_nowhere_else(machine, tmp_path, monkeypatch):
    done = tmlattice("init", cwd=tmp_path, check=2)
    assert "name the LATTICE" in done.stderr
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tmlattice.cli.init.on_a_terminal", lambda: True)
    done = CliRunner().invoke(command, ["init"], input=f"{machine / 'ring.json'}\n\n")
    assert done.exit_code == 0, done.output
    assert "written: tmlattice.toml" in done.output
    assert load_machine_file().ring().length > 100


def test_what_python_code_is_told_of_a_wrong_file(tmp_path):
    path = tmp_path / "m.toml"
    path.write_text('[data]\nassume = ["x-revers"]\n')
    (tmp_path / "a.csv").write_text("shot,end_1 x [mm]\n0,1\n")
    machine = load_machine_file(path)
    with pytest.raises(MachineFileError, match="names no lattice; add `file`"):
        machine.ring()
    with pytest.raises(package.TmlatticeError, match="no assumption 'x-revers'; did you mean"):
        machine.read(tmp_path / "a.csv", load_ring(SMALL))
    path.write_text('supplies = "no.csv"\n')
    with pytest.raises(MeasurementError, match="cannot read"):
        load_machine_file(path).knobs(load_ring(SMALL))
    assert isinstance(Path(machine.path), Path)


def test_the_command_line_states_the_lattice_too(machine, tmp_path):
    """Anywhere on it, and over the machine file."""
    for words in (["--energy", "2.5", "info"], ["info", "--energy=2.5"]):
        out = tmp_path / "info.json"
        tmlattice(*words, "--json", out, cwd=machine, check=0)
        assert json.loads(out.read_text())["energy_gev"] == 2.5
    done = tmlattice("effects", "--energy", "3", cwd=tmp_path, check=2)
    assert "--energy has no meaning for effects" in done.stderr
