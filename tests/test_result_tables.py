"""Tables of the results' pages are those of the stored JSON; benchmarks run."""

import json
import logging
import re
import runpy
import sys
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
PAGES = sorted(RESULTS.glob("*.md"))
SHOWN = {name for page in PAGES for name in re.findall(r"<!-- table (\w+) -->", page.read_text())}
TABLES = runpy.run_path(str(ROOT / "benchmarks" / "tables.py"), run_name="imported")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_shows_stored_tables_alone(page):
    text = page.read_text(encoding="utf-8")
    assert TABLES["filled"](text) == text, "run `python benchmarks/tables.py`"
    by_hand = re.sub(r"<!-- table \w+ -->.*?<!-- end -->", "", text, flags=re.DOTALL)
    assert not re.search(r"^\|", by_hand, re.MULTILINE)
    assert len(text.splitlines()) <= 100


@pytest.mark.parametrize("name", sorted(SHOWN))
def test_a_stored_table_states_how_it_was_made(name):
    stored = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    assert all(stored[key] for key in ("command", "seed", "version", "machine"))
    script = re.search(r"python ((?:benchmarks|tests)/\S+\.py)", stored["command"])
    assert script is None or (ROOT / script[1]).exists()
    assert len({len(row) for row in stored.get("rows", [[]])}) == 1


def test_a_changed_figure_changes_the_page(tmp_path, monkeypatch):
    page = RESULTS / "speed.md"
    changed = json.loads((RESULTS / "gpu_raw.json").read_text())
    changed["4-D: training step 100000"] *= 2
    for path in RESULTS.glob("*.json"):
        (tmp_path / path.name).write_text(path.read_text())
    (tmp_path / "gpu_raw.json").write_text(json.dumps(changed))
    monkeypatch.setitem(TABLES["filled"].__globals__, "FOLDER", tmp_path)
    before, after = page.read_text(), TABLES["filled"](page.read_text())
    differ = [b for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]
    (row,) = differ
    assert row.split(" | ")[1:] == ["28", "951 (34)", " |"]


def test_the_picture_of_the_blind_table_is_drawn(tmp_path, monkeypatch):
    main = runpy.run_path(str(ROOT / "docs" / "pictures.py"), run_name="imported")["main"]
    monkeypatch.setitem(main.__globals__, "FOLDER", tmp_path)
    main(["tables"])
    drawn = (tmp_path / "blind-rates.png").read_bytes()
    assert drawn.startswith(b"\x89PNG")
    assert len(drawn) < 150_000


def test_what_a_benchmark_prints_is_stored_with_its_command(tmp_path):
    code = "print('| a | b |\\n|---|---|\\n| 1 | 2 |\\n\\nmedian 3, \\N{MICRO SIGN}m')"
    command = [sys.executable, "-c", code, "--seed", "7"]
    TABLES["store"]("tried", command, tmp_path)
    stored = json.loads((tmp_path / "tried.json").read_text())
    assert (stored["rows"], stored["seed"]) == ([["a", "b"], ["1", "2"]], "7")
    assert stored["lines"][-1] == "median 3, µm"
    assert "commit" in stored["version"]


def test_a_benchmark_that_fails_stores_nothing(tmp_path):
    with pytest.raises(SystemExit, match="3: nothing is stored"):
        TABLES["store"]("tried", [sys.executable, "-c", "raise SystemExit(3)"], tmp_path)
    assert not list(tmp_path.iterdir())


# --- nobody else runs `benchmarks/` between two studies -------------------------------------------
FOLDER = ROOT / "benchmarks"
RING = str(ROOT / "tests" / "lattices" / "small_ring.py")
SMALLEST = {
    "healthy": "--rings small --kinds first_turns --errors none --out rows",
    "several_faults": f"{RING} --faults 1 --cases 1",
    "small_errors": f"{RING} --cases 1 --shots 3",
    "supply_range": f"{RING} --out rows",
    "turns_amplitude": "--rings small --amplitudes 2e-4 --seeds 1 --out rows",
}
"""Arguments of a second or two; the types of all are checked by `make check`."""


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.py")))
def test_a_benchmark_runs_or_finds_what_it_imports(name, monkeypatch, tmp_path, capsys):
    logger = logging.getLogger("tmlattice")
    level = logger.level
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    monkeypatch.setattr(sys, "argv", [name, *SMALLEST.get(name, "").split()])
    run_name = "__main__" if name in SMALLEST else "imported"
    with warnings.catch_warnings():
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name=run_name)
    logger.setLevel(level)
    assert bool(capsys.readouterr().out) == (name in SMALLEST)
    if "rows" in sys.argv:
        rows = (tmp_path / "rows").read_text().splitlines()
        assert all("refused" not in json.loads(row) for row in rows)
