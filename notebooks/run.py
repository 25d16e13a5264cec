"""Execute notebooks and keep their outputs: `python notebooks/run.py [NAME ...]`.

With TMLATTICE_SMALL=1 in the environment they take their small settings; the tests do that, and keep
nothing.
"""

import os
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent
TIMEOUT = 300  # s, of one cell


def execute(path: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs of a fresh kernel, run in its own folder.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; it says which.
    """
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        timeout=TIMEOUT,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
        record_timing=False,
    )
    # tqdm without widgets says so once: true, and nothing to keep
    return client.execute(env={**os.environ, "PYTHONWARNINGS": "ignore:IProgress not found"})


def main(names: list[str]) -> None:
    """Execute those whose names begin so, or all."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and not any(path.name.startswith(name) for name in names):
            continue
        notebook = execute(path)
        notebook.metadata["language_info"] = {"name": "python"}  # not the version that ran it
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
