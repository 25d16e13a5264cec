"""Every notebook runs top to bottom, and stands in the repository with outputs of such a run."""

import importlib.util
import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 400_000  # bytes, pictures included


@pytest.fixture(scope="module")
def run():
    pytest.importorskip("nbclient", reason="nbclient is not installed: pip install '.[test]'")
    spec = importlib.util.spec_from_file_location("run_notebooks", FOLDER / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def names(path):
    return path.stem


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=names)
def test_kept_outputs_are_of_one_run_in_order(path):
    assert path.stat().st_size < LARGEST
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [c for c in cells if c["cell_type"] == "code"]
    assert [c["execution_count"] for c in code] == list(range(1, len(code) + 1))
    outputs = [o for c in code for o in c["outputs"]]
    assert not [o for o in outputs if o["output_type"] == "error" or o.get("name") == "stderr"]
    assert sum("image/png" in o.get("data", {}) for o in outputs) >= 2
    assert not any(str(FOLDER.parent) in str(o) for o in outputs), "a path of one computer"


@pytest.mark.parametrize("path", NOTEBOOKS[1:], ids=names)
def test_runs_with_small_settings(path, monkeypatch):
    """Here, as a kernel for each takes longer than its cells do."""
    monkeypatch.setenv("TMLATTICE_SMALL", "1")
    monkeypatch.chdir(FOLDER)
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    known = {"__name__": "__main__"}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), known)
    plt.close("all")


def test_a_kernel_runs_the_first_with_small_settings(run, monkeypatch):
    monkeypatch.setenv("TMLATTICE_SMALL", "1")
    run.execute(NOTEBOOKS[0])


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=names)
def test_runs(path, run, monkeypatch):
    monkeypatch.delenv("TMLATTICE_SMALL", raising=False)
    run.execute(path)
