"""Files of a control room: whatever their columns, the readings come out, or a sentence."""

import csv
import json
import re
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from scipy.io import savemat

sys.path.insert(0, str(Path(__file__).parent / "fuzz"))
from measured import write_sdds

from tmlattice import Cause, read_measurement, simulate
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.importers import Options, bring_in
from tmlattice.importers.readings import place_of
from tmlattice.importers.stated import Stated
from tmlattice.machine_file import load_machine_file
from tmlattice.measurement.lost_beam import beam_lost

pytestmark = pytest.mark.usefixtures("forked_readers")


@pytest.fixture(scope="module")
def data(small_ring):
    """Three shots; one reading is missing."""
    made = simulate(
        small_ring, [Cause("quadrupole_gradient", "QD::5", -0.05)], shots=3, amplitude=3e-4,
        noise=2e-6, engine="ocelot", seed=4,
    ).measurement()  # fmt: skip
    made.readings[1, 0, 4, 0] = np.nan
    return made


def wide(path, data, header, scale=1e3, separator=","):
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=separator)
        writer.writerow(["shot", *(header(m, p) for m in data.monitors for p in "xy")])
        for shot, values in enumerate(data.readings[:, 0]):
            row = ["" if np.isnan(v) else repr(float(scale * v)) for v in values.ravel()]
            if separator in ";|":
                row = [v.replace(".", ",") for v in row]
            writer.writerow([str(shot), *row])
    return path


def same(brought, data):
    own = brought.measurement
    readings = own.select(monitors=data.monitors).readings
    np.testing.assert_allclose(readings, data.readings, rtol=1e-6, atol=1e-12)
    assert np.isinf(own.launch_sigma[:, :4]).all()
    return brought


@pytest.mark.parametrize(
    ("header", "scale", "stated"),
    [
        (lambda m, p: f"{m} {p} [mm]", 1e3, "in mm, as the file states"),
        (lambda m, p: f"{m}_{p}_um", 1e6, "in um, as the file states"),
        (lambda m, p: f"{p}_{m}", 1e3, "no unit is given: readings are taken in mm"),
        (lambda m, p: f"SR:{m.upper()}:SA:{p.upper()}", 1e9, "readings are taken in nm"),
        (lambda m, p: f"{m}.Pos{p.upper()} (µm)", 1e6, "in um, as the file states"),
        (lambda m, p: f"{m}/{'H' if p == 'x' else 'V'}", 1.0, "readings are taken in m"),
    ],
)
def test_a_row_a_shot_and_a_column_a_monitor_and_plane(
    small_ring, data, tmp_path, header, scale, stated
):
    path = wide(tmp_path / "a.csv", data, header, scale)
    brought = same(bring_in([path], Options(ring=small_ring)), data)
    assert any(stated in sentence for sentence in brought.assumed), brought.assumed
    assert brought.measurement.noise is None
    assert any("estimates it" in sentence for sentence in brought.assumed)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_read_measurement_reads_what_diagnose_reads(small_ring, data, tmp_path, encoding):
    """With the ring, with its names, and with the names of the file."""
    path = wide(tmp_path / "a.csv", data, lambda m, p: f"{m} {p} (µm)", 1e6)
    path.write_bytes(path.read_text().encode(encoding))
    names = [monitor.name for monitor in small_ring.monitors]
    for options in ({"ring": small_ring}, {"monitors": names}, {}):
        own = read_measurement(path, **options)
        readings = own.select(monitors=data.monitors).readings
        np.testing.assert_allclose(readings, data.readings, rtol=1e-6, atol=1e-12)


def test_read_measurement_reads_the_table_of_the_tutorial(tmp_path):
    page = Path(__file__).parent.parent / "docs" / "tutorials" / "physicist.md"
    text = page.read_text(encoding="utf-8")
    (tmp_path / "readings.csv").write_text(re.search(r"```text\n(shot,.*?)```", text, re.S)[1])
    own = read_measurement(tmp_path / "readings.csv")
    assert own.monitors == ("bpm_1", "bpm_2")
    np.testing.assert_allclose(own.readings[0, 0], [[1.23e-3, -0.45e-3], [0.98e-3, 0.12e-3]])


@pytest.mark.parametrize("name", ["day.xlsx", "day.csv"])
def test_a_spreadsheet_is_refused_in_a_sentence(small_ring, tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\x03\x04\x14\x00\x06\x00" + bytes(100))
    for options in ({"ring": small_ring}, {}):
        with pytest.raises(MeasurementError, match=f"{name}' is a spreadsheet.*save it as CSV"):
            read_measurement(tmp_path / name, **options)
    done = tmlattice("diagnose", SMALL, tmp_path / name, cwd=tmp_path, check=2)
    assert "save it as CSV" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("separator", [";", "|"])
def test_separators_and_decimal_commas(small_ring, data, tmp_path, separator):
    path = wide(tmp_path / "a.csv", data, lambda m, p: f"{m}:{p} [mm]", separator=separator)
    same(bring_in([path], Options(ring=small_ring)), data)


LONG = {
    "x and y": (["shot", "BPM", "x [mm]", "y [mm]"], lambda s, m, x, y: [[s, m, x, y]]),
    "plane and value": (
        ["time", "monitor", "plane", "value (mm)"],
        lambda s, m, x, y: [[f"t{s}", m, "H", x], [f"t{s}", m, "V", y]],
    ),
    "channels": (
        ["cycle", "pv", "value [mm]"],
        lambda s, m, x, y: [[s, f"R1:{m}:X", x], [s, f"R1:{m}:Y", y]],
    ),
}


@pytest.mark.parametrize("form", LONG)
def test_a_row_a_monitor(small_ring, data, tmp_path, form):
    header, rows = LONG[form]
    lines = [header]
    for shot, values in enumerate(1e3 * data.readings[:, 0]):
        for monitor, xy in zip(data.monitors, values, strict=True):
            x, y = ("" if np.isnan(v) else repr(float(v)) for v in xy)
            lines += rows(str(shot), monitor, x, y)
    path = tmp_path / "a.csv"
    path.write_text("\n".join(",".join(line) for line in lines))
    same(bring_in([path], Options(ring=small_ring)), data)


def test_blanks_under_a_header_that_is_a_comment(small_ring, data, tmp_path):
    lines = ["# orbit of 3 May", "# name x_mm y_mm"]
    for monitor, xy in zip(data.monitors, 1e3 * data.readings[0, 0], strict=True):
        lines.append(f"{monitor} {float(xy[0])!r} {float(xy[1])!r}")
    path = tmp_path / "orbit.txt"
    path.write_text("\n".join(lines))
    brought = bring_in([path], Options(ring=small_ring))
    own = brought.measurement.select(monitors=data.monitors)
    np.testing.assert_allclose(own.readings[0], data.readings[0], rtol=1e-9)


@pytest.mark.parametrize("form", ["matrix", "columns"])
def test_hdf5_with_units_as_attributes(small_ring, data, tmp_path, form):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for i, plane in enumerate("xy"):
            values = 1e6 * data.readings[:, 0, :, i]
            if form == "matrix":
                file[plane] = values
                file[plane].attrs["units"] = "um"
                continue
            for monitor, column in zip(data.monitors, values.T, strict=True):
                file[f"orbit/{monitor}/{plane}"] = column
                file[f"orbit/{monitor}/{plane}"].attrs["unit"] = "um"
        if form == "matrix":
            file["names"] = list(data.monitors)
    brought = same(bring_in([path], Options(ring=small_ring)), data)
    if form == "matrix":  # without the ring the file's own order
        own = read_measurement(path).select(monitors=brought.measurement.monitors)
        np.testing.assert_array_equal(own.readings, brought.measurement.readings)


def test_sdds_arrays(small_ring, data, tmp_path):
    write_sdds(tmp_path / "a.sdds", data.monitors, data.readings[:, 0])
    same(bring_in([tmp_path / "a.sdds"], Options(ring=small_ring)), data)


def test_a_machine_file_states_names_unit_noise_and_bad_bpms(small_ring, data, tmp_path):
    alias = {m: f"P{i:02d}" for i, m in enumerate(data.monitors)}
    path = wide(tmp_path / "a.csv", data, lambda m, p: f"{alias[m]}:{p}")
    with pytest.raises(MeasurementError, match=r"no BPM 'P00'.*\[channels\].*--example"):
        bring_in([path], Options(ring=small_ring))
    names = "\n".join(f'"{alias[m]}" = "{m}"' for m in data.monitors)
    (tmp_path / "tmlattice.toml").write_text(
        f'[data]\nunit = "mm"\nnoise = "2 um"\nbad = ["{data.monitors[2]}", "P03"]\n'
        f"[channels]\n{names}\n"
    )
    stated = load_machine_file(tmp_path / "tmlattice.toml").stated
    brought = bring_in([path], Options(ring=small_ring, stated=stated))
    own = brought.measurement
    left = [m for i, m in enumerate(data.monitors) if i not in (2, 3)]
    assert sorted(own.monitors) == sorted(left)
    kept = data.select(monitors=left)
    np.testing.assert_allclose(own.select(monitors=left).readings, kept.readings, rtol=1e-6)
    assert own.noise == pytest.approx(np.full((len(left), 2), 2e-6))
    assert any("left out as stated" in sentence for sentence in brought.assumed)


def test_a_machine_file_may_state_that_devices_are_in_beam_order(small_ring, data, tmp_path):
    ordered = data.in_order_of([m.name for m in small_ring.monitors])
    alias = {m: f"P{i:02d}" for i, m in enumerate(ordered.monitors)}
    path = wide(tmp_path / "a.csv", ordered, lambda m, p: f"{alias[m]}:{p} [mm]")
    same(bring_in([path], Options(ring=small_ring, stated=Stated(in_order=True))), ordered)
    fewer = ordered.select(monitors=ordered.monitors[1:])
    path = wide(tmp_path / "b.csv", fewer, lambda m, p: f"{alias[m]}:{p} [mm]")
    with pytest.raises(MeasurementError, match="not the same in order"):
        bring_in([path], Options(ring=small_ring, stated=Stated(in_order=True)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: [*rows, ["mean", *rows[1][1:]], ["RMS", *rows[1][1:]]], "rows that sum up"),
        (lambda rows: [[*row, f"{rows[0][1]}_err" if k == 0 else "9"]
                       for k, row in enumerate(rows)], "more words than a BPM's own"),
        (lambda rows: [[rows[0][0], *row[1:]] if k == 0 else [row[0], *(
            v.replace("e-", "D-") for v in row[1:])] for k, row in enumerate(rows)], "unknown"),
    ],
    ids=["sums", "errors", "Fortran"],
)  # fmt: skip
def test_more_than_the_readings(small_ring, data, tmp_path, change, words):
    path = wide(tmp_path / "a.csv", data, lambda m, p: f"{m} {p}")
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join(row) for row in change(rows)) + "\n")
    brought = same(bring_in([path], Options(ring=small_ring, unit="mm")), data)
    assert any(words in sentence for sentence in brought.assumed)


def test_turns_that_are_counted_from_another_number(small_ring, data, tmp_path):
    path = wide(tmp_path / "a.csv", data.select(shots=[0]), lambda m, p: f"{m} {p} [mm]")
    head, row = path.read_text().splitlines()
    path.write_text(f"Turn No{head[4:]}\n17{row[1:]}\n18{row[1:]}\n")
    readings = bring_in([path], Options(ring=small_ring)).measurement.readings
    assert readings.shape[:2] == (1, 2)
    np.testing.assert_allclose(readings[0, 0], data.readings[0, 0], atol=1e-12)


def test_a_channel_of_a_bpm_that_is_not_there(small_ring, data, tmp_path):
    path = wide(tmp_path / "a.csv", data, lambda m, p: f"{m} {p}")
    with pytest.raises(UnknownNameError, match="no BPM 'end_99'; did you mean"):
        bring_in([path], Options(ring=small_ring, stated=Stated(names={"a": "end_99"})))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a b\n1 2\n", "no column holds readings"),
        ("shot,end_1 x [mm]\n0,wet\n", "'wet' of 'end_1 x' is no number"),
        ("shot,end_1 x [mm]\n0,1_000\n", "'1_000' of 'end_1 x' is no number"),
        ("shot,end_1 x [inch]\n0,1\n", "no unit 'inch'"),
        ("monitor,x,y\nend_1,0.1,0.1\nend_1,0.2,0.2\n", "stands twice in one shot"),
        ("shot,end_1 x\n0,1,2\n", "line 2: 3 fields where the header has 2"),
        ("monitor,s\nend_1,0.1\n", "names without readings"),
        ("", "empty"),
        ("time,monitor,x [mm]\n0.1,end_1,0.1\n0.2,end_2,0.1\n", "each row is a shot of its own"),
    ],
)
def test_a_table_that_says_too_little_is_a_sentence(small_ring, tmp_path, text, words):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(MeasurementError, match=words):
        bring_in([tmp_path / "a.csv"], Options(ring=small_ring))


def long(data, header="shot,BPM,x [mm],y [mm]", separator=",", above="", edit=lambda k, text: text):
    """A row a monitor; `edit` takes the number of a reading and its text."""
    lines = [header]
    for k, (shot, i) in enumerate(np.ndindex(data.readings[:, 0, :, 0].shape)):
        x, y = (edit(k, repr(float(1e3 * v))) for v in data.readings[shot, 0, i])
        lines.append(separator.join([str(shot), data.monitors[i], x, y]))
    return above + "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("header", "above", "separator"),
    [
        ("shot,BPM,x/mm,y/mm", "", ","),
        ("shot;BPM;x, mm;y, mm", "", ";"),
        ("shot,BPM,X_mean [mm],Y_mean [mm]", "", ","),
        ("shot,BPM,x pos [millimetres],y pos [millimetres]", "", ","),
        ("shot,BPM,xco [mm],yco [mm]", "% of 3 May, written by MATLAB\n", ","),
        ("shot,BPM,x [mm],y [mm]", "Orbit of 3 May, 12:00\n", ","),
        ("shot,BPM,x [mm],y [mm]", "Device: BPM\nDate: 2024-05-03\n\n", ","),
        ("shot,BPM,x,y\n-,-,mm,mm", "", ","),
        ("shot  BPM  x [mm]  y [mm]", "", "  "),
        ("* SHOT BPM X_MM Y_MM\n$ %d %s %le %le", '@ DATE %s "2024"\n', " "),
    ],
)
def test_headers_of_control_systems(small_ring, data, tmp_path, header, above, separator):
    path = tmp_path / "a.csv"
    path.write_text(long(data, header, separator, above))
    same(bring_in([path], Options(ring=small_ring)), data)


def test_blanks_and_decimal_commas(small_ring, data, tmp_path):
    text = long(data, "shot BPM x[mm] y[mm]", " ", edit=lambda _, text: text.replace(".", ","))
    (tmp_path / "a.txt").write_text(text)
    same(bring_in([tmp_path / "a.txt"], Options(ring=small_ring)), data)


def test_numbers_and_words_that_stand_for_no_reading_are_missing(small_ring, data, tmp_path):
    words = {7: "N/A", 20: "--", 33: "-999", 41: "-999", 50: "-999"}
    path = tmp_path / "a.csv"
    path.write_text(long(data, edit=words.get))
    brought = bring_in([path], Options(ring=small_ring))
    assert any("6 readings are -999, far above all others" in said for said in brought.assumed)
    expected = data.readings.copy()
    expected.reshape(-1, 2)[list(words)] = np.nan
    own = brought.measurement.select(monitors=data.monitors)
    np.testing.assert_allclose(own.readings, expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("share", "text", "read"), [(0.2, "-999", np.nan), (0.7, "-999", np.nan), (0.5, "12.5", 0.0125)]
)
def test_a_number_behind_a_lost_beam_is_no_reading_where_no_beam_gives_it(
    small_ring, data, tmp_path, share, text, read
):
    """Most readings were -999 mm, and the message asked for the unit, which the file states. A
    constant of a possible size is left to the check of lost beams."""
    ordered = data.in_order_of([m.name for m in small_ring.monitors])
    count = len(ordered.monitors)
    first = int(share * count)
    path = tmp_path / "a.csv"
    path.write_text(long(ordered, edit=lambda k, own: text if k % count >= first else own))
    brought = bring_in([path], Options(ring=small_ring))
    named = any("are -999, far above all others" in said for said in brought.assumed)
    assert named == (text == "-999")
    expected = ordered.readings.copy()
    expected[:, :, first:] = read
    own = brought.measurement.select(monitors=ordered.monitors)
    np.testing.assert_allclose(own.readings, expected, rtol=1e-6, atol=1e-12)
    if not named:
        assert beam_lost(brought.measurement).first.tolist() == 3 * [first]


def test_columns_that_are_not_read_are_named(small_ring, data, tmp_path):
    rows = long(data).splitlines()
    rows = [f"{rows[0]},status,Σ", *(f"{row},BAD,1000" for row in rows[1:])]
    (tmp_path / "a.csv").write_text("\n".join(rows), encoding="utf-8")
    assumed = same(bring_in([tmp_path / "a.csv"], Options(ring=small_ring)), data).assumed
    assert any("columns that are not read: 'status'" in said for said in assumed)
    assert any("sum signals are those of a beam" in said for said in assumed)


@pytest.mark.parametrize("form", ["arrays", "structure", "array of structures", "a row a monitor"])
def test_readings_of_matlab(small_ring, data, tmp_path, form):
    x, y = (1e3 * data.readings[:, 0, :, i] for i in range(2))
    names = np.array(data.monitors, object)
    content = {
        "arrays": {"x": x, "y": y, "names": names},
        "structure": {"bpm": {"x": x, "y": y, "name": names, "units": "mm"}},
        "array of structures": {"bpm": np.array(
            list(zip(names, x.T, y.T, strict=True)),
            dtype=[("Name", object), ("X", object), ("Y", object)])},
        "a row a monitor": {"x": x.T, "y": y.T, "names": names},
    }  # fmt: skip
    savemat(tmp_path / "a.mat", content[form])
    same(bring_in([tmp_path / "a.mat"], Options(ring=small_ring)), data)


@pytest.mark.parametrize("name", ["a.sdds", "ring.clo", "a.txt"])
@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_columns_of_sdds_are_refused_in_a_sentence(small_ring, tmp_path, name, mode):
    """By any name: elegant writes closed orbits, centroids and watch points so."""
    head = f"SDDS1\n&column name=x, type=double, &end\n&data mode={mode}, &end\n"
    rows = b"1\n0.1\n" if mode == "ascii" else bytes([1, 0, 0, 0]) + np.float64(0.1).tobytes()
    (tmp_path / name).write_bytes(head.encode() + rows)
    with pytest.raises(MeasurementError, match=r"columns such as 'x' of SDDS .* write them as CSV"):
        bring_in([tmp_path / name], Options(ring=small_ring))


def test_many_turns_are_those_of_a_stored_beam(small_ring, tmp_path, rng):
    readings = 1e-4 * rng.standard_normal((20, 3, 2))
    names = ["end_1", "end_2", "end_3"]
    lines = [",".join(["turn", *(f"{m} {p} [mm]" for m in names for p in "xy")])]
    for turn, values in enumerate(1e3 * readings):
        lines.append(",".join([str(turn), *(repr(float(v)) for v in values.ravel())]))
    (tmp_path / "a.csv").write_text("\n".join(lines))
    brought = bring_in([tmp_path / "a.csv"], Options(ring=small_ring))
    assert type(brought.measurement).__name__ == "TurnByTurn"
    np.testing.assert_allclose(brought.measurement.readings[0], readings, rtol=1e-9)
    (tmp_path / "b.csv").write_text("\n".join(lines[:6]))
    brought = bring_in([tmp_path / "b.csv"], Options(ring=small_ring))
    assert type(brought.measurement).__name__ == "Measurement"  # five turns have no line
    assert np.isinf(brought.measurement.launch_sigma[0, :4]).all()


def test_a_plane_is_a_word_of_its_own():
    assert place_of("SR:C01-BPM:1:X-I").plane == 0
    assert place_of("bpm_3_ver").plane == 1
    assert place_of("x_bpm7").device == "bpm7"
    for name in ("yBPM", "x", "temperature", "phy_3"):
        assert place_of(name) is None, name


def test_spellings_are_matched_and_a_part_of_a_name_is_not(small_ring, data, tmp_path):
    """'bpm::1' is 'BPM 1'; 'end_1' is not in 'end_11'."""
    path = wide(tmp_path / "a.csv", data, lambda m, p: f"{m.replace('::', ' ').upper()} {p} [mm]")
    same(bring_in([path], Options(ring=small_ring)), data)
    part = data.select(monitors=["end_1", "end_2"])
    path = wide(tmp_path / "b.csv", part, lambda m, p: f"{m}7 {p} [mm]")
    with pytest.raises(MeasurementError, match="no BPM 'end_17'"):
        bring_in([path], Options(ring=small_ring))


def test_from_templates_to_a_name(tmp_path):
    """`import --example`, and each of its readings diagnosed as it stands."""
    tmlattice("import", "--example", "--lattice", SMALL, "--out", "ex", cwd=tmp_path, check=0)
    named = set()
    for name, more in (
        ("readings_wide.csv", ["--machine", "ex/tmlattice.toml"]),
        ("readings_long.csv", []),
        ("readings.h5", []),
    ):
        words = ["diagnose", SMALL, f"ex/{name}", *more, "--json", "a.json"]
        done = tmlattice(*words, cwd=tmp_path, check=0)
        document = json.loads((tmp_path / "a.json").read_text())
        assert "readings are in mm" in done.stdout
        assert document["provenance"]["assumed_of_files"]
        assert document["verdict"] == "identified"
        named.add(tuple(finding["element"] for finding in document["findings"]))
    assert len(named) == 1
    words = ["import", "ex/response.csv", "--lattice", SMALL, "--out", "r"]
    assert "orbit response" in tmlattice(*words, cwd=tmp_path, check=0).stdout
    assert "readings are in mm" in tmlattice(
        "check", SMALL, "ex/readings_long.csv", cwd=tmp_path
    ).stdout  # fmt: skip
    done = tmlattice("import", "--out", "x", cwd=tmp_path, check=2)
    assert "--example" in done.stderr
