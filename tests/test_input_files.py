"""Files of other programs: bounded before they are read, refused by name, never half read."""

import json
import os
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import turn_by_turn
from turn_by_turn import TbtData, TransverseData

from tmlattice.errors import LatticeError, MeasurementError
from tmlattice.importers.columns import read_columns
from tmlattice.importers.hdf5 import read_hdf5, read_mapping
from tmlattice.input_files import check_shape, json_of, yaml_of
from tmlattice.lattice.mat_file import read_mat
from tmlattice.measurement import read_turn_by_turn
from tmlattice.observe.calibration import read_calibration

pytestmark = pytest.mark.usefixtures("forked_readers")

NAMES = [f"bpm{i}" for i in range(6)]


def readings(path):
    """x and y [shot, monitor] in mm, with the monitors' names."""
    values = np.random.default_rng(1).normal(0, 1e-2, (2, 4, 6))
    with h5py.File(path, "w") as file:
        file["monitors"], file["x"], file["y"] = NAMES, *values
        for plane in "xy":
            file[plane].attrs["unit"] = "mm"
    return path


def linked(kind):
    def change(file, folder):
        values = file["x"][()]
        del file["x"]
        with h5py.File(folder / "other.h5", "w") as other:
            other["x"] = values
        file["x"] = h5py.ExternalLink("other.h5", "x") if kind == "external" else (
            h5py.SoftLink("/y"))  # fmt: skip

    return change


def replaced(**options):
    def change(file, folder):
        del file["x"]
        file.create_dataset("x", **options)

    return change


def elsewhere(file, folder):
    """The bytes of any file as doubles."""
    del file["x"]
    (folder / "secret").write_bytes(bytes(192))
    file.create_dataset("x", (4, 6), "f8", external=[(folder / "secret", 0, 192)])


def virtual(file, folder):
    with h5py.File(folder / "other.h5", "w") as other:
        other["x"] = file["x"][()]
    layout = h5py.VirtualLayout((4, 6), "f8")
    layout[:] = h5py.VirtualSource(folder / "other.h5", "x", (4, 6))
    del file["x"]
    file.create_virtual_dataset("x", layout)


def many_states(file, folder):
    """Each of them is small; none was written."""
    for number in range(6):
        file.create_dataset(f"bpm{number} y", (200_000,), "f8", fillvalue=np.nan)


def not_utf8(file, folder):
    """By the low level, which takes bytes."""
    h5py.h5g.create(file.id, b"bpm\xff\xfe")


def in_itself(file, folder):
    group = file.create_group("a")
    group["b"] = group


def partly(fill):
    """Two of four rows are written."""

    def change(file, folder):
        values = file["x"][()]
        del file["x"]
        x = file.create_dataset("x", (4, 6), "f8", chunks=(1, 6), fillvalue=fill)
        x[1:3] = values[1:3]

    return change


def many_groups(file, folder):
    for number in range(10_001):
        file.create_group(f"g{number}")


def grouped(file, folder):
    del file["x"]
    file.create_group("x")


def other_order(file, folder):
    file["bpms"] = NAMES[::-1]


def many_attributes(file, folder):
    for number in range(1001):
        file["y"].attrs[f"a{number}"] = 1.0


def two_units(file, folder):
    file["x"].attrs["units"] = "um"


HALF = {
    "one number": (replaced(data=1.0), "'x' is one number"),
    "an empty group": (grouped, "'x' holds no data"),
    "names in two orders": (other_order, "two lists have the names of 'x' in different orders"),
    "two units": (two_units, "'x' has the units um and mm"),
    "more attributes than any file": (many_attributes, "more than 1,000 attributes"),
    "never written": (replaced(shape=(4, 6), dtype="f8"), "all of 'x' was never written"),
    "half written": (partly(0.0), "2 of 4 parts of 'x' was never written"),
    "an enumeration": (replaced(shape=(4, 6), dtype=h5py.enum_dtype({"OK": 0, "BAD": 1})),
                       "'x' holds names of an enumeration"),
    "more groups than any file": (many_groups, "more than 10,000 groups"),
    "complex": (replaced(data=np.ones((4, 6), complex)), "'x' holds complex numbers"),
    "without elements": (replaced(shape=(0, 6), dtype="f8"), "'x' is empty"),
    "null": (replaced(data=h5py.Empty("f8")), "'x' is empty"),
    "compound": (replaced(data=np.zeros((4, 6), "f8,f8")), "'x' holds compound"),
    "text": (replaced(data=np.full((4, 6), b"1.0")), "'x' is a table of texts"),
    "texts": (replaced(data=[b"1.0"] * 4), "'x' holds texts"),
    "lists": (replaced(shape=(4, 6), dtype=h5py.vlen_dtype("f8")), "'x' holds references or lists"),
    "references": (replaced(shape=(4, 6), dtype=h5py.ref_dtype), "'x' holds references or lists"),
    "arrays": (replaced(shape=(4, 6), dtype="3f8"), "'x' (holds|is an array)"),
    "three dimensions": (replaced(data=np.zeros((4, 6, 2))), "'x' is an array of 3 dimensions"),
    "another width": (replaced(data=np.zeros((4, 5))), "'x' has 5 columns"),
    "another length": (replaced(data=np.zeros((3, 6))), "rows"),
    "external link": (linked("external"), "'x' is a link"),
    "soft link": (linked("soft"), "'x' is a link"),
    "external storage": (elsewhere, "'x' are in another file"),
    "virtual": (virtual, "'x' are in another file"),
    "a name that is not UTF-8": (not_utf8, "not UTF-8"),
    "a group in itself": (in_itself, "stands in itself"),
    "many data sets": (many_states, "its data sets state"),
    "a bomb": (replaced(shape=(40_000_000, 6), dtype="f8", chunks=True), "state 1920 MB"),
    "a chunk": (replaced(shape=(4, 6), maxshape=(None, 6), dtype="f8", chunks=(10**6, 6)),
                "state 48 MB"),
}  # fmt: skip


@pytest.mark.parametrize("what", HALF)
def test_hdf5_that_is_not_whole_numbers_of_its_own_is_refused_by_name(tmp_path, what):
    change, words = HALF[what]
    path = readings(tmp_path / "t.h5")
    assert len(read_columns(path)) == 12
    with h5py.File(path, "r+") as file:
        change(file, tmp_path)
    with pytest.raises(MeasurementError, match=words):
        read_columns(path)


def test_what_was_not_written_and_is_filled_with_nan_was_not_read(tmp_path):
    path = readings(tmp_path / "t.h5")
    with h5py.File(path, "r+") as file:
        partly(np.nan)(file, tmp_path)
    column = read_columns(path)[0]
    assert [text == "nan" for text in column.values] == [True, False, False, True]


def test_a_unit_that_is_no_text_is_refused(tmp_path):
    path = readings(tmp_path / "t.h5")
    with h5py.File(path, "r+") as file:
        file["x"].attrs["unit"] = 3.0
    with pytest.raises(MeasurementError, match="the unit of 'x' is no text"):
        read_columns(path)


def cells(path, fill):
    """A MATLAB 7.3 file of a function's own objects."""
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    head = b"MATLAB 7.3 MAT-file".ljust(124) + bytes([0, 2]) + b"IM"
    path.write_bytes(head + path.read_bytes()[len(head) :])
    return path


def doubling(file):
    """2^26 cells in a file of 27."""
    file["#refs#/d0"] = 1.0
    for i in range(1, 27):
        place = f"#refs#/d{i}" if i < 26 else "RING"
        file[place] = np.array([[file[f"#refs#/d{i - 1}"].ref]] * 2, dtype=h5py.ref_dtype)


def ragged(file):
    for name, count in (("a", 3), ("b", 1)):
        one = file.create_dataset(f"#refs#/{name}", data=1.0)
        file[f"s/{name}"] = np.array([[one.ref]] * count, dtype=h5py.ref_dtype)


def wide_text(file):
    file["text"] = np.array([[2**63]], dtype="u8")
    file["text"].attrs["MATLAB_class"] = np.bytes_("char")


def outside(file):
    file["v"] = h5py.ExternalLink("/etc/passwd", "v")


@pytest.mark.parametrize(
    ("fill", "words"),
    [(doubling, "read already"), (ragged, "have 1 to 3 elements"), (wide_text, "stated as a text"),
     (outside, "is a link")],
)  # fmt: skip
def test_cells_and_links_of_matlab_7_3_are_bounded(tmp_path, fill, words):
    with pytest.raises(LatticeError, match=words):
        read_mat(cells(tmp_path / "a.mat", fill))


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (yaml_of, "a: &a [x]\nnames: *a", "an alias"),
        (yaml_of, "names: &a {x: y}\nbad: [*a]", "an alias"),
        (yaml_of, "names: {x: &a [*a]}", "an alias"),
        (yaml_of, "names: " + "[" * 500, "too deep"),
        (yaml_of, "unit: mm\nunit: m", "stands twice"),
        (yaml_of, "names: {a: b, a: c}", "stands twice"),
        (yaml_of, "? [a, b]\n: c", "a key is a text"),
        (yaml_of, "a: [1", "is no YAML"),
        (json_of, '{"a": 1, "a": 2}', "stands twice"),
        *((json_of, text, "a.text") for text in ("[" * 10**5, "1" * 5000, '{"a": NaN}', "{")),
    ],
)
def test_text_that_is_no_document_is_one_sentence(tmp_path, read, text, words):
    path = tmp_path / "a.text"
    path.write_text(text)
    with pytest.raises(MeasurementError, match=words) as told:
        read(path, MeasurementError)
    assert "a.text" in str(told.value)
    assert len(str(told.value)) < 500


def test_a_document_has_texts_where_no_type_is_run_and_values_of_its_types(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: !!python/object/apply:os.mkdir [MARK]\nb: 2001-01-01\nc: 1e3\nd: yes")
    texts = {"a": ["MARK"], "b": "2001-01-01", "c": "1e3", "d": "yes"}
    assert yaml_of(path, MeasurementError) == texts
    assert not Path("MARK").exists()
    with pytest.raises(MeasurementError, match=r"data\.unit is"):
        check_shape(path, {"data": {"unit": ["mm"]}}, "machine", MeasurementError)


@pytest.mark.parametrize("table", [{"x/B1L": "a"}, {"3/B1L": 3}, {"3/B1L": ["a"]}, ["3/B1L"]])
def test_a_table_of_names_of_other_types_is_refused(tmp_path, table):
    path = tmp_path / "names.json"
    path.write_text(json.dumps(table))
    with pytest.raises(MeasurementError, match="is no entry such as"):
        read_mapping(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("shots_per_orbit", "ten"), ("shots_per_orbit", [1, 2]), ("rf_full_step", np.nan),
     ("matrix", "x"), ("input_names", np.zeros(3)), ("bipolar", "yes")],
)  # fmt: skip
def test_parts_of_a_response_of_other_types_are_refused(tmp_path, name, value):
    with h5py.File(tmp_path / "orm.h5", "w") as file:
        file["matrix"] = np.zeros((2, 3))
        if name in file:
            del file[name]
        file[name] = value
    with pytest.raises(MeasurementError, match=f"{name} should be"):
        read_hdf5(tmp_path / "orm.h5")


def test_a_cause_that_stands_twice_in_a_calibration_is_refused(tmp_path, small_ring):
    cause = {"effect": "monitor_gain_x", "element": small_ring.monitors[0].name, "amount": 0.01}
    path = tmp_path / "calibration.json"
    for names, whole in (([cause["element"]], True), ([cause["element"]] * 2, False),
                         ([cause["element"], cause["element"].upper()], False)):  # fmt: skip
        effects = [{**cause, "element": name} for name in names]
        path.write_text(
            json.dumps({"format": "tmlattice-calibration", "version": 1, "effects": effects})
        )
        if whole:
            assert len(read_calibration(path, small_ring).causes) == 1
            continue
        with pytest.raises(Exception, match="occurs twice"):
            read_calibration(path, small_ring)


# --- files that are cut off -----------------------------------------------------------------------
TURNS, COUNT = 8, 3


def tables():
    rng = np.random.default_rng(1)
    return [pd.DataFrame(rng.normal(0, 1e-4, (COUNT, TURNS)), index=["BPM1", "BPM2", "BPM3"])
            for _ in "xy"]  # fmt: skip


def superkekb(path):
    x, y = tables()
    rows = [
        f'("{name}"->{{{{{",".join(map(str, x.loc[name]))}}},{{{",".join(map(str, y.loc[name]))}}},'
        "{0,0}})"
        for name in x.index
    ]
    path.write_text("{" + ",\n".join(rows) + "}\n")


def madng(path, kind="madng"):
    x, y = tables()
    data = TbtData([TransverseData(X=x, Y=y)], bunch_ids=[0], nturns=TURNS)
    turn_by_turn.write(path, data, datatype=kind)


def trackone(path):
    x, y = tables()
    lines = ["@ NAME %05s", "* NUMBER TURN X PX Y PY T PT S E", "$ %d %d %le"]
    lines += [f"#segment 1 {TURNS + 1} 1 0 start", " 1 0 0 0 0 0 0 0 0 1"]
    for turn in range(TURNS):
        for name in x.index:
            lines.append(f"#segment 2 {TURNS + 1} 1 1 {name}")
            lines.append(f" 1 {turn + 1} {x.loc[name, turn]} 0 {y.loc[name, turn]} 0 0 0 1 1")
    path.write_text("\n".join(lines) + "\n")


def test_turns_that_were_never_written_are_refused(tmp_path):
    path = tmp_path / "turns.h5"
    madng(path, "doros")
    assert read_turn_by_turn(path, "doros").readings.shape[1] == TURNS
    with h5py.File(path, "r+") as file:
        name = f"{tables()[0].index[0]}/horOscillationData"
        del file[name]
        file.create_dataset(name, (TURNS,), "f8")
    with pytest.raises(MeasurementError, match="horOscillationData' was never written"):
        read_turn_by_turn(path, "doros")


@pytest.mark.parametrize("write", [superkekb, madng, trackone])
def test_turns_that_are_cut_off_are_refused(tmp_path, write):
    path = tmp_path / "turns.tfs"
    write(path)
    x, y = tables()
    whole = read_turn_by_turn(path, write.__name__).readings[0]
    np.testing.assert_allclose(whole[..., 0].T, x, atol=1e-15)
    np.testing.assert_allclose(whole[..., 1].T, y, atol=1e-15)
    text = path.read_text()
    for share in (0.4, 0.7, 0.97):
        path.write_text(text[: int(share * len(text))])
        with pytest.raises(MeasurementError, match=r"cut off|cannot be read"):
            read_turn_by_turn(path, write.__name__)


@pytest.mark.parametrize(
    ("family", "plane", "words"),
    [("quadrupole", "x", "is rejected as a BPM"), ("monitor", None, "is rejected as a corrector")],
)
def test_only_bpms_and_correctors_are_rejected_channels(tmp_path, small_ring, family, plane, words):
    element = next(e.name for e in small_ring.elements if e.kind == family)
    document = {"format": "tmlattice-calibration", "version": 1, "effects": [],
                "rejected": [{"element": element, "plane": plane}]}  # fmt: skip
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(document))
    with pytest.raises(MeasurementError, match=words):
        read_calibration(path, small_ring)


# --- what is no regular file ----------------------------------------------------------------------
@pytest.mark.parametrize("name", ["knobs.yaml", "t.h5", "t.csv", "a.json", "a.mat"])
def test_pipes_and_devices_are_not_read(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    readers = {
        "yaml": lambda path: yaml_of(path, MeasurementError), "h5": read_columns,
        "csv": read_columns, "json": lambda path: json_of(path, MeasurementError), "mat": read_mat,
    }  # fmt: skip
    for target in (tmp_path / "pipe", Path("/dev/zero")):
        link = tmp_path / name
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        with pytest.raises((MeasurementError, LatticeError), match="a pipe or a device"):
            readers[name.rsplit(".", 1)[1]](link)
