"""Readings from elsewhere: plain CSV tables and the files that turn_by_turn reads."""

import numpy as np
import pandas as pd
import pytest

from tmlattice.errors import MeasurementError
from tmlattice.measurement import read_measurement, read_table, read_turn_by_turn

pytestmark = pytest.mark.usefixtures("forked_readers")


@pytest.fixture
def table(tmp_path):
    def make(*lines):
        path = tmp_path / "table.csv"
        path.write_text("\n".join(lines))
        return path

    return make


def test_shortest_table_is_one_shot_of_one_turn(table):
    m = read_table(table("monitor,x,y", "b,1e-3,2e-3", "a,3e-3,"), launches=[[1e-3, 0, 0, 0]])
    assert m.monitors == ("b", "a")
    assert m.shots == (0,)
    np.testing.assert_array_equal(m.readings[0, 0], [[1e-3, 2e-3], [3e-3, np.nan]])
    assert m.launches[0, 0] == 1e-3


def test_columns_in_any_order_with_others_between(table):
    path = table("S [m],Y,Monitor,turn,X,shot", "0.1,2,a,1,1,9", "0.1,4,A::0,0,3,4", "1,6,b,0,5,4")
    m = read_table(path, unit="mm", monitors=["b", "a"], noise=(1e-5, 1e-5))
    assert m.shots == (4, 9)
    assert m.monitors == ("b", "a")
    np.testing.assert_allclose(m.readings[0, 0], [[5e-3, 6e-3], [3e-3, 4e-3]], rtol=1e-15)
    np.testing.assert_allclose(m.readings[1, 1, 1], [1e-3, 2e-3], rtol=1e-15)
    assert np.isnan(m.readings[1, 0]).all()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (("monitor,x", "a,1"), "line 1: no column 'y'"),
        (("monitor,x,y,X", "a,1,1,1"), "line 1: two columns 'x'"),
        (("monitor,x,y", "a,1e-3,1e-3", "a,1e-3,1e-3"), "line 3: monitor a stands"),
        (("monitor,x,y", "a,3,1"), "line 2: x = 3 m is above 0.2 m"),
        (("monitor,x,y", "a,3,1mm"), "line 2: y is '1mm'"),
        (("monitor,x,y", "c,1e-3,1e-3"), "line 2: no BPM 'c'"),
        (("monitor,x,y", "a,,"), "every reading is missing"),
        ((), "line 1: the file is empty"),
    ],
)
def test_damaged_table_names_its_line(table, lines, words):
    path = table(*lines)
    with pytest.raises(MeasurementError, match=words) as found:
        read_measurement(path, ["a", "b"])
    assert str(found.value).startswith(str(path))


@pytest.fixture
def ring_data(rng):
    """Two bunches, 30 turns, three monitors, in mm as a control system has them."""
    return rng.standard_normal((2, 30, 3, 2))


def written(path, data, datatype):
    import turn_by_turn as tbt

    names = ["BPM.C", "BPM.A", "BPM.B"]
    bunches = [
        tbt.TransverseData(
            X=pd.DataFrame(bunch[..., 0].T, index=names),
            Y=pd.DataFrame(bunch[..., 1].T, index=names),
        )
        for bunch in data
    ]
    tbt.write(path, tbt.TbtData(bunches, data.shape[1], bunch_ids=[3, 8]), datatype=datatype)


def test_turn_by_turn_file_written_by_its_own_package(tmp_path, ring_data):
    path = tmp_path / "bunches.sdds"
    written(path, ring_data, "lhc")
    launches = np.full((2, 4), 1e-4)
    m = read_turn_by_turn(path, unit="mm", launches=launches, noise=(1e-5, 1e-5))
    assert m.monitors == ("BPM.C", "BPM.A", "BPM.B")
    assert m.shots == (3, 8)
    np.testing.assert_allclose(m.readings, 1e-3 * ring_data, rtol=1e-7)  # SDDS keeps single floats
    np.testing.assert_array_equal(m.states(4), launches)
    ring = read_turn_by_turn(path, unit="mm", monitors=["bpm.a", "bpm.b", "bpm.c"])
    assert ring.monitors == ("bpm.a", "bpm.b", "bpm.c")
    np.testing.assert_array_equal(ring.readings, m.readings[:, :, [1, 2, 0]])


def test_millimetres_taken_for_metres_are_refused(tmp_path, ring_data):
    written(tmp_path / "b.sdds", ring_data, "lhc")
    with pytest.raises(MeasurementError, match="state the unit of the file"):
        read_turn_by_turn(tmp_path / "b.sdds")
    written(tmp_path / "small.sdds", 1e-3 * ring_data, "lhc")
    m = read_measurement(tmp_path / "small.sdds", turn_by_turn="lhc")
    np.testing.assert_allclose(m.readings, 1e-3 * ring_data, rtol=1e-7)


def test_more_turns_than_a_file_states_are_read(tmp_path, ring_data):
    """As of the SPS: a turn more than is stated; monitors of one plane each."""
    import turn_by_turn as tbt

    x = pd.DataFrame(ring_data[0, :, :2, 0].T, index=["BPH.1", "BPH.2"])
    y = pd.DataFrame(ring_data[0, :, 2:, 1].T, index=["BPV.1"])
    stated = tbt.TbtData([tbt.TransverseData(X=x, Y=y)], 29, bunch_ids=[0])
    tbt.write(tmp_path / "a.sdds", stated, datatype="sps")
    m = read_turn_by_turn(tmp_path / "a.sdds", "sps", unit="mm")
    assert m.readings.shape == (1, 30, 3, 2)
    np.testing.assert_allclose(m.readings[0, :, 2, 1], 1e-3 * ring_data[0, :, 2, 1])
    assert np.isnan(m.readings[0, :, 2, 0]).all()


def test_turn_by_turn_files_that_cannot_be_read(tmp_path, ring_data):
    with pytest.raises(MeasurementError, match="No such file"):
        read_turn_by_turn(tmp_path / "nothing.sdds")
    path = tmp_path / "a.sdds"
    path.write_text("no such thing")
    with pytest.raises(MeasurementError, match="cannot be read as 'lhc'"):
        read_turn_by_turn(path)
    with pytest.raises(MeasurementError, match="no kind 'lhd'"):
        read_turn_by_turn(path, "lhd")
    written(path, 1e-3 * ring_data, "lhc")
    with pytest.raises(MeasurementError, match=r"a.sdds: no BPM 'BPM.C'"):
        read_turn_by_turn(path, monitors=["bpm.a", "bpm.b"])
    with pytest.raises(MeasurementError, match="no unit 'cm'"):
        read_turn_by_turn(path, unit="cm")
