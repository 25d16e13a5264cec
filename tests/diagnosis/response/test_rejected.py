"""What the fit rejected is silent in the prediction from the files that a diagnosis writes."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from command import tmlattice
from shared import gradients, small_steps

from tmlattice import Cause, write_measurement
from tmlattice.lattice import save_ring
from tmlattice.observe.response_data import response_data, split_columns

KICK = 2e-5
BOTH, ONE, SWAPPED, CORRECTOR = "end_3", "end_8", "end_11", "v6"
BEAM = [Cause("energy_spread", None, 1.2e-3), Cause("energy_offset", None, -2e-3)]


@pytest.fixture(scope="module")
def day(ring_kicking_x, tmp_path_factory):
    """A noisy BPM, one noisy in y alone, one with swapped planes, and a noisy corrector."""
    rng = np.random.default_rng(5)
    ring = ring_kicking_x("i % 2")
    causes = gradients(ring, 2e-3, rng)
    causes += [Cause("monitor_gain_x", m.name, 0.02 * rng.standard_normal()) for m in ring.monitors]
    causes += [Cause("monitor_gain_y", m.name, 0.02 * rng.standard_normal()) for m in ring.monitors]
    causes += [Cause("monitor_swap", SWAPPED, 1.0), *BEAM]
    measured = small_steps(ring, causes, kick=KICK, noise=4e-8, seed=3)
    response, at = measured.response.copy(), measured.monitors.index

    def noise(part):
        return float(np.std(part)) * rng.standard_normal(part.shape)

    response[:, at(BOTH)] = noise(response[:, at(BOTH)])
    response[:, at(ONE), 1] = noise(response[:, at(ONE), 1])
    response[measured.correctors.index(CORRECTOR)] = noise(response[0])
    measured = replace(measured, response=response)
    folder = tmp_path_factory.mktemp("day")
    save_ring(ring, folder / "ring.json")
    write_measurement(folder / "day", measured)
    words = ["diagnose", folder / "ring.json", folder / "day", "--lattice-out",
             folder / "found.json", "--json", folder / "found.diagnosis.json", "--effects",
             "quadrupole_gradient,monitor_gain_x,monitor_gain_y,monitor_swap,energy_spread,"
             "energy_offset"]  # fmt: skip
    (folder / "ring.json.known.json").write_text("{}")
    tmlattice(*words, cwd=folder, check=0)
    return ring, measured, folder


def predicted(folder, name="found.json.calibration.json"):
    """{corrector: {monitor: (x, y)}}, m for KICK; NaN of empty fields."""
    words = ["predict", folder / "found.json", "--calibration", folder / name, "--kick", KICK,
             "--out", folder / "predicted.csv"]  # fmt: skip
    tmlattice(*words, cwd=folder, check=0)
    table = {}
    with (folder / "predicted.csv").open() as file:
        for row in csv.DictReader(file):
            own = table.setdefault(row["corrector"], {})
            own[row["monitor"]] = [float(row[plane] or "nan") for plane in "xy"]
    return table


def left(table, measured, split):
    """rms of in-plane residuals, m, as the diagnosis validates: the kick from half of the BPMs."""
    squares = []
    for k in np.flatnonzero(split.held[:-1]):
        p = "xy".index(measured.planes[k])
        own = table[measured.correctors[k]]
        model = np.array([own[name][p] for name in measured.monitors])
        there, read = np.isfinite(model), measured.response[k, :, p]
        near, far = split.half[k] & there, ~split.half[k] & there
        kick = (model[near] @ read[near]) / (model[near] @ model[near])
        squares.append((read - kick * model)[far] ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def test_prediction_of_the_written_files_reproduces_the_held_out_figure(day):
    ring, measured, folder = day
    told = json.loads((folder / "found.diagnosis.json").read_text())
    (said,) = told["provenance"]["assumed_of_files"]  # a response starts from no earlier knowledge
    assert re.search(r"known.json' is not used.*--reference", said)
    figure = told["steps"][-1]["heldout_rms_in_plane"]
    gone = {own["element"] for own in told["rejected_channels"] if own["plane"] is None}
    kept = measured.select(correctors=[c for c in measured.correctors if c not in gone])
    options = told["provenance"]
    rng = np.random.default_rng(options["seed"])
    split = split_columns(response_data(ring, kept), options["options"]["holdout"], rng)
    assert split.held[:-1].sum() > 1
    assert left(predicted(folder), kept, split) == pytest.approx(figure, rel=0.05)
    document = json.loads((folder / "found.json.calibration.json").read_text())
    assert "rejected" in document
    spoken = {**document, "rejected": []}
    (folder / "spoken.json").write_text(json.dumps(spoken))
    assert left(predicted(folder, "spoken.json"), kept, split) > 10 * figure
    written = {own["effect"]: own["amount"] for own in document["effects"]}
    for cause in BEAM:
        assert abs(written[cause.effect] - cause.amount) < 0.1 * abs(cause.amount)


def test_rejected_channels_are_empty_in_the_prediction_and_no_others(day):
    _, measured, folder = day
    told = json.loads((folder / "found.diagnosis.json").read_text())
    rejected = {(own["element"], own["plane"]) for own in told["rejected_channels"]}
    assert (ONE, "y") in rejected
    assert (CORRECTOR, None) in rejected
    assert len(rejected) < 8
    silent = {(name, plane) for name in told["bad_monitors"] for plane in "xy"}
    assert {(BOTH, plane) for plane in "xy"} <= rejected | silent
    for corrector, own in predicted(folder).items():
        for monitor, xy in own.items():
            empty = [
                (corrector, None) in rejected or (monitor, plane) in rejected | silent
                for plane in "xy"
            ]
            assert np.isnan(xy).tolist() == empty, (corrector, monitor)
    # the BPM whose planes are swapped is predicted as it reads
    own = predicted(folder)
    k = next(k for k, name in enumerate(measured.correctors) if name != CORRECTOR)
    both = np.array([own[measured.correctors[k]][SWAPPED], measured.response[k][
        measured.monitors.index(SWAPPED)]])  # fmt: skip
    np.testing.assert_allclose(*both, atol=0.1 * np.abs(both).max())
