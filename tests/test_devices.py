"""Names of the control system: from the files of a machine to text, page and JSON."""

from dataclasses import replace

import pytest
from shared import measured_data, valid

from tmlattice import Cause, diagnose, read_measurement, simulate
from tmlattice.importers.bring_in import Options, bring_in
from tmlattice.importers.imported import write_imported
from tmlattice.measurement import write_measurement
from tmlattice.report.page import page

DEVICES = {"end_3": "BPMx(3,2), BPMy(3,2)", "v5": "HCM(5,1)"}
GAIN = Cause("monitor_gain_x", "end_3", -0.4)


@pytest.fixture(scope="module")
def measured(small_ring, tmp_path_factory):
    """First turns with a wrong gain, through a measurement folder."""
    data = simulate(small_ring, [GAIN], shots=4, seed=1, engine="ocelot", amplitude=3e-4,
                    noise=2e-6).measurement()  # fmt: skip
    folder = tmp_path_factory.mktemp("devices") / "day"
    write_measurement(folder, replace(data, devices=DEVICES))
    return read_measurement(folder)


def test_a_folder_keeps_them(measured):
    assert measured.devices == DEVICES
    assert measured.select(shots=[0, 1]).devices == DEVICES


def test_text_page_and_json_show_them(small_ring, measured):
    found = diagnose(small_ring, measured)
    (finding,) = found.findings
    assert finding.element == "end_3"
    document = valid(found.as_json(), "diagnosis")
    assert document["devices"] == DEVICES
    assert document["findings"][0]["device"] == DEVICES["end_3"]
    assert document["findings"][0]["recommended_action"]["device"] == DEVICES["end_3"]
    (row,) = [row for row in document["errors"] if row["element"] == "end_3"]
    assert row["device"] == DEVICES["end_3"]
    for said in (found.report(), page(found, [])):
        assert "end_3 [BPMx(3,2), BPMy(3,2)]" in " ".join(said.split())


def test_channels_of_a_table_are_kept(small_ring, tmp_path):
    names = [element.name for element in small_ring.monitors]
    table = tmp_path / "day.csv"
    channels = [f"SR:{name.replace('::', '-')}:{plane} [mm]" for name in names for plane in "XY"]
    table.write_text("shot," + ",".join(channels) + "\n0," + ",".join(["0.1"] * len(channels)))
    brought = bring_in([table], Options(ring=small_ring))
    assert brought.measurement.devices["end_3"] == "SR:end_3"
    write_imported(brought, tmp_path / "day")
    assert read_measurement(tmp_path / "day").devices == brought.measurement.devices


@pytest.mark.parametrize(
    ("file", "monitor", "corrector"),
    [("siam_2007-09-25", "BPMx(1,1), BPMy(1,1)", "VCM(4,3)"),
     ("soleil_2012-01-20", "BPMx(1,2), BPMz(1,2)", "VCOR(16,6)")],
)  # fmt: skip
def test_device_lists_of_loco(file, monitor, corrector):
    data = bring_in([measured_data("real_rings", f"{file}.loco.mat")]).measurement
    assert data.devices[data.monitors[0]] == monitor
    assert corrector in data.devices.values()
    assert set(data.devices) == {*data.monitors, *data.correctors}
