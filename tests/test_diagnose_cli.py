"""`tmlattice diagnose` as a user runs it, its report in words, its figures and its page."""

import dataclasses
import json
import re
import subprocess
import sys
from html.parser import HTMLParser

import jsonschema
import matplotlib.pyplot as plt
import numpy as np
import pytest
from command import refused, tmlattice
from conftest import SMALL
from shared import first_turns, valid

from tmlattice.diagnosis import diagnose
from tmlattice.effects import Cause
from tmlattice.files import write_json
from tmlattice.measurement import OrbitResponse, write_measurement
from tmlattice.plots.diagnosis import figures, gap_axes, plot_gap, plot_scan
from tmlattice.report import interactive
from tmlattice.report.plain import report_text
from tmlattice.report.text import amount_text, least_text, probability_text

WEAK = Cause("quadrupole_gradient", "QD::5", -0.02)
FAINT = Cause("quadrupole_gradient", "QD::5", -0.0025)  # a neighbour explains it nearly as well
CASES = {
    "identified": ([WEAK], {}, {}),
    "ambiguous": ([FAINT], {}, {}),
    "localised": ([WEAK], {}, {"effects": ["monitor_gain_x", "dipole_field"]}),
    "none": ([], {}, {}),
    "distributed": (
        [],
        {"quadrupole_gradient": 0.02, "quadrupole_offset_x": None},
        {"effects": ["quadrupole_roll"], "max_effects": 1},
    ),
}


@pytest.fixture(scope="module")
def diagnoses(small_ring):
    """One diagnosis for each verdict."""
    made = {}
    for verdict, (causes, background, options) in CASES.items():
        data = first_turns(small_ring, causes, background=background)
        made[verdict] = diagnose(small_ring, data, **options)
    return made


@pytest.fixture(scope="module")
def folders(tmp_path_factory, small_ring):
    """Measurement folders: a weak quadrupole, one shot, an orbit response, a strange monitor."""
    place = tmp_path_factory.mktemp("folders")
    data = first_turns(small_ring, [WEAK])
    write_measurement(place / "weak", data)
    write_measurement(place / "before", first_turns(small_ring))
    write_measurement(place / "one", data.select(shots=[0]))
    write_measurement(
        place / "response",
        OrbitResponse(("v1",), ("y",), np.ones(1), ("last_a",), np.zeros((1, 1, 2))),
    )
    (place / "strange").mkdir()
    for file in (place / "weak").iterdir():
        text = file.read_text().replace("last_a", "v1").replace("table_sha256", "_")
        (place / "strange" / file.name).write_text(text)
    return place


class References(HTMLParser):
    """Everything that a page would fetch, or leads to."""

    def __init__(self):
        super().__init__()
        self.found, self.tags = [], []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.found += [
            value for name, value in attributes if name in ("src", "href", "srcset", "data")
        ]


# --- the command ----------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def outcome(folders, tmp_path_factory):
    """A run as a user starts it, and its folder."""
    folder = tmp_path_factory.mktemp("run")
    done = subprocess.run(
        [sys.executable, "-m", "tmlattice", "diagnose", str(SMALL), str(folders / "weak"), "--out",
         "day", "--json", "extra.json"],
        cwd=folder, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder, done


def test_command_reports_writes_and_draws(outcome, folders):
    folder, done = outcome
    assert done.stderr == ""
    assert "\x1b" not in done.stdout
    for words in ("QD::5", "between bpm::5 and end_5", "±", "held out", "fractional tunes",
                  "The remaining residual is noise", "written: day/"):  # fmt: skip
        assert words in done.stdout
    document = valid(folder / "day" / "diagnosis.json", "diagnosis")
    assert json.loads((folder / "extra.json").read_text()) == document
    assert document["findings"][0]["element"] == "QD::5"
    assert document["provenance"]["measurement"] == str(folders / "weak")
    names = {path.name for path in (folder / "day").iterdir()}
    assert names == {
        "diagnosis.json", "report.html", "report.txt", "plan.png", "readings.png", "scan.png",
        "scan-near.png", "gap.png", "diagnosis.lattice.json", "estimated.json",
    }  # fmt: skip
    for name in names:
        if name.endswith(".png"):
            assert (folder / "day" / name).read_bytes().startswith(b"\x89PNG")
    assert (folder / "day" / "report.txt").read_text().splitlines()[0] in done.stdout


def test_page_holds_its_figures_and_leads_nowhere(outcome):
    """What a browser makes of it is in test_report_page.py."""
    html = (outcome[0] / "day" / "report.html").read_text(encoding="utf-8")
    assert len(html.encode()) < 3e6
    parser = References()
    parser.feed(html)
    pictures = [source for source in parser.found if source.startswith("data:image/png;base64,")]
    assert len(pictures) == parser.tags.count("img") == 5
    inside = [source for source in parser.found if source not in pictures]
    assert all(source.startswith(("#", "data:,")) for source in inside)
    assert not {"iframe", "object"} & set(parser.tags)
    for words in ("QD::5", "identified", "Set or repair the gradient of QD::5", "as designed",
                  "the action is the same", "The gap", "Provenance", "false_alarm"):  # fmt: skip
        assert words in html


def test_quiet_prints_nothing_and_json_alone_writes_one_file(folders, tmp_path):
    path = tmp_path / "a.json"
    done = tmlattice(
        "diagnose", SMALL, folders / "weak", "--quiet", "--json", path, "--effects",
        "quadrupole_gradient, quadrupole_roll", "--background", "monitor_offset_x=1e-7",
        "--seed", 3, "--max-effects", 2, "--radiation", cwd=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == [path]
    document = valid(path, "diagnosis")
    options = document["provenance"]["options"]
    assert options["effects"] == ["quadrupole_gradient", "quadrupole_roll"]
    assert options["background"] == {"monitor_offset_x": 1e-7}
    assert options["max_effects"] == 2
    assert options["radiation"] is True
    assert document["provenance"]["seed"] == 3


def test_reference_and_single_shot(folders, tmp_path):
    path = tmp_path / "a.json"
    done = tmlattice(
        "diagnose", SMALL, folders / "one", "--reference", folders / "before", "--json", path,
        "--background", "quadrupole_gradient=1e-4", cwd=tmp_path, check=0,
    )  # fmt: skip
    assert "No reading was held out" in done.stdout
    document = valid(path, "diagnosis")
    assert document["provenance"]["options"]["reference"] is True
    assert document["gap"]["heldout"] is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([SMALL], "MEASUREMENT"),
        ([SMALL, "nowhere"], "no measurement folder"),
        (["petra4", "weak"], "no lattice 'petra4'; did you mean 'petra3'"),
        (["nowhere/ring.py", "weak"], "no lattice file"),
        ([SMALL, "response"], "the noise of the readings is not stated"),
        ([SMALL, "weak", "--reference", "response"], "give a reference of the same kind"),
        ([SMALL, "weak", "--reference", "nowhere"], "no measurement folder"),
        ([SMALL, "weak", "--reference", "weak"], "is the measurement and its --reference"),
        ([SMALL, "strange"], "no BPM 'v1'; "),
        ([SMALL, "weak", "--effects", "quadrupole_gradiant"], "did you mean 'quadrupole_gradient'"),
        ([SMALL, "weak", "--effects", ","], "--effects"),
        ([SMALL, "weak", "--background", "quadrupole_roll=a"], "is no rms"),
        ([SMALL, "weak", "--background", "gradient_absolute"], "has no usual size"),
        ([SMALL, "weak", "--background", "nothing=1"], "no effect 'nothing'"),
        ([SMALL, "weak", "--max-effects", "0"], "--max-effects"),
        ([SMALL, "weak", "--json", "/no/such/folder/a.json"], "cannot write"),
    ],
)
def test_wrong_input_ends_in_one_sentence_and_leaves_out_untouched(
    folders, tmp_path, arguments, words
):
    out = tmp_path / "out"
    out.mkdir()
    (out / "diagnosis.json").write_text("of yesterday")
    local = {path.name: path for path in folders.iterdir()}
    words_of_it = (local.get(word, word) for word in arguments)
    refused("diagnose", *words_of_it, "--out", out, cwd=tmp_path, says=words)


# --- the result -----------------------------------------------------------------------------------
@pytest.mark.parametrize("verdict", list(CASES))
def test_json_of_every_verdict_is_valid(diagnoses, tmp_path, verdict):
    diagnosis = diagnoses[verdict]
    assert diagnosis.verdict == verdict
    write_json(tmp_path / "a.json", diagnosis.as_json())
    valid(tmp_path / "a.json", "diagnosis")


def test_schema_refuses_a_missing_key_and_a_finding_under_nothing(diagnoses):
    document = valid(diagnoses["identified"].as_json(), "diagnosis")
    for key in document:
        with pytest.raises(jsonschema.ValidationError):
            valid({k: v for k, v in document.items() if k != key}, "diagnosis")
    with pytest.raises(jsonschema.ValidationError):
        valid({**document, "verdict": "none"}, "diagnosis")


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("identified", ["IDENTIFIED: quadrupole QD::5, integrated gradient -1.9",
                   "(k1 -0.9 -> -0.88",
                   "set or repair the gradient of QD::5", "Read back the current", "> 99.9 %",
                   "between bpm::5 and end_5", "beta beat", "after the correction: as designed",
                   "the action is the same"]),
        ("ambiguous", ["alternatives: sextupole sd::5"]),
        ("localised", ["no effect of the catalogue fits", "Next: Inspect this section",
                     "(bpm::5, QD::5, end_5)", "the gap of held-out readings stays"]),
        ("none", ["No error is detected", "detection limit",
                     "wrong strength of a quadrupole"]),
        ("distributed", ["Distributed errors", "that distributed errors hide", "--reference"]),
    ],
)  # fmt: skip
def test_report_says_what_a_control_room_needs(diagnoses, verdict, words):
    text = report_text(diagnoses[verdict])
    flat = " ".join(text.split())
    assert text.startswith(verdict.upper())
    for word in words:
        assert word in flat
    assert "held out (shots" in flat
    assert "noise of a reading" in flat
    assert "nan" not in flat
    assert "detection limit" not in flat or verdict == "none"
    assert max(map(len, text.splitlines())) <= 100


def test_report_says_how_much_is_closed_and_how_surely(diagnoses):
    text = " ".join(report_text(diagnoses["identified"]).split())
    found = re.search(r"([\d.]+) % of the gap .* \(95 % interval ([\d.]+) to ([\d.]+) %\)", text)
    closed, low, high = map(float, found.groups())
    assert 80 < low < closed <= high <= 100  # a gap of three times the noise
    assert closed == pytest.approx(100 * diagnoses["identified"].gap["explained"], abs=0.06)


def test_dead_monitor_in_report_and_json(small_ring, tmp_path):
    turns = first_turns(small_ring, [Cause("monitor_dead", "end_3", 1.0)])
    diagnosis = diagnose(small_ring, turns)
    text = report_text(diagnosis)
    assert "IDENTIFIED: BPM end_3, no signal." in text
    assert "no effect on the stored beam" in text
    write_json(tmp_path / "a.json", diagnosis.as_json())
    document = valid(tmp_path / "a.json", "diagnosis")
    assert document["findings"][0]["detection"]["statistic"] is None


@pytest.mark.parametrize(
    ("effect", "amount", "sigma", "text"),
    [
        ("quadrupole_gradient", -0.2, 5.4e-4, "-20.000 ± 0.054 %"),
        ("quadrupole_roll", 0.0104, 3.3e-4, "+10.40 ± 0.33 mrad"),
        ("corrector_kick_x", 5e-5, 1.2e-6, "+50.0 ± 1.2 µrad"),
        ("monitor_offset_x", -4e-4, 6e-6, "-400.0 ± 6.0 µm"),
        ("quadrupole_offset_y", 1.5e-3, 2e-5, "+1.500 ± 0.020 mm"),
        ("gradient_absolute", 0.0339, 2e-4, "+0.03390 ± 0.00020 1/m"),
        ("energy_offset", 1e-3, None, "0.1 %"),
        ("monitor_swap", 1.0, 0.0, ""),
        ("monitor_dead", 2.0, 0.0, "frozen readings"),
    ],
)
def test_amounts_read_in_the_units_of_the_field(effect, amount, sigma, text):
    assert amount_text(effect, amount, sigma) == text


def test_what_cannot_be_seen_is_not_given_a_number():
    assert least_text("corrector_roll", 1.2e14) == "not even the largest fault, 100 mrad"
    assert probability_text(0.99999) == "> 99.9 %"


# --- the figures ----------------------------------------------------------------------------------
@pytest.mark.parametrize("verdict", list(CASES))
def test_every_verdict_has_its_figures(diagnoses, verdict):
    names = []
    for name, caption, figure in figures(diagnoses[verdict]):
        names.append(name)
        assert caption.endswith(".")
        figure.canvas.draw()
        plt.close(figure)
    assert names[:3] == ["plan", "readings", "scan"]
    assert "gap" in names
    assert ("credible-set-1" in names) == (verdict == "ambiguous")
    assert ("scan-near" in names) == bool(diagnoses[verdict].findings)


def test_scan_figure_shows_the_scan_that_saw_the_fault(diagnoses):
    diagnosis = diagnoses["identified"]
    figure = plot_scan(diagnosis)
    ax = figure.axes[0]
    lines = {line.get_label(): line for line in ax.lines}
    points = lines["quadrupoles"]
    best = int(np.argmax(points.get_ydata()))
    assert points.get_xdata()[best] == pytest.approx(diagnosis.findings[0].s)
    statistic = diagnosis.findings[0].detection.statistic
    assert points.get_ydata()[best] == pytest.approx(statistic)
    threshold = diagnosis.findings[0].detection.threshold
    assert lines[f"threshold {threshold:.1f}"].get_ydata()[0] == pytest.approx(threshold)
    assert diagnosis.explanation.scan.statistic.max() < threshold  # the last one saw nothing
    plt.close(figure)


def test_gap_figure_has_a_bar_for_each_step_and_the_noise(diagnoses):
    diagnosis = diagnoses["identified"]
    ax = plot_gap(diagnosis)
    lengths = [bar.get_width() for bar in ax.patches]
    assert lengths == pytest.approx([1e6 * m.rms for m in diagnosis.heldout.misfits])
    assert ax.lines[0].get_xdata()[0] == pytest.approx(2.0)
    plt.close(ax.figure)


def test_a_gap_of_a_model_that_loses_the_beam_is_drawn(diagnoses):
    """In the page, too, whose numbers are JSON."""
    diagnosis = diagnoses["identified"]
    first, *others = diagnosis.heldout.misfits
    lost = dataclasses.replace(first, rms=np.nan, chi2_per_dof=np.nan)
    heldout = dataclasses.replace(diagnosis.heldout, misfits=(lost, *others))
    diagnosis = dataclasses.replace(diagnosis, heldout=heldout)
    ax = plot_gap(diagnosis)
    ax.figure.canvas.draw()
    assert np.isfinite(ax.get_xlim()).all()
    assert "nan" in [text.get_text() for text in ax.texts]
    plt.close(ax.figure)
    json.dumps(interactive.gap(diagnosis), allow_nan=False)


@pytest.mark.parametrize("count", [1, 3, 8])
def test_names_under_the_bars_of_the_gap_do_not_overlap(diagnoses, count):
    """Long names of many findings, each beside its own bar."""
    diagnosis = diagnoses["identified"]
    (cause,), (error,) = diagnosis.causes, diagnosis.errors
    long = Cause("corrector_kick_x", "steerer_of_the_long_straight_section_north_supply_17", 1e-5)
    steps = diagnosis.heldout.misfits
    many = dataclasses.replace(
        diagnosis,
        causes=(cause, *[long] * (count - 1)),
        errors=(error,) * count,
        heldout=dataclasses.replace(
            diagnosis.heldout, misfits=(*steps, *[steps[-1]] * (count - 1))
        ),
    )
    ax = plot_gap(many, gap_axes(many))
    ax.figure.canvas.draw()
    boxes = [label.get_window_extent() for label in ax.get_yticklabels()]
    assert len(boxes) == count + 1
    for i, one in enumerate(boxes):
        assert one.x0 >= 0
        assert not any(one.overlaps(other) for other in boxes[i + 1 :])
    plt.close(ax.figure)


def test_a_fine_tuned_network_is_read_as_physics(folders, tmp_path):
    fitted = tmlattice(
        "tune-fit", SMALL, "--measurement", folders / "weak", "--method", "sparse", "--out", "fit",
        cwd=tmp_path, check=0,
    )  # fmt: skip
    assert "network.pt" in fitted.stdout
    for network, code, words in (
        ("fit/network.pt", 0, "the network's weights changed most at"),
        ("fit/tune-fit.json", 2, "does not hold the weights of a network"),
        ("nowhere.pt", 2, "nowhere.pt"),
    ):
        done = tmlattice(
            "diagnose", SMALL, folders / "weak", "--effects", "quadrupole_gradient", "--network",
            network, "--out", f"out-{code}", cwd=tmp_path, check=code,
        )  # fmt: skip
        assert words in done.stdout + done.stderr
    reading = json.loads((tmp_path / "out-0" / "weights.json").read_text())
    assert reading
    assert (tmp_path / "out-0" / "weights.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "out-2").exists()
