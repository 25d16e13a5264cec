"""Execute notebooks and keep their outputs: `python notebooks/run.py [NAME ...]`.

With TMLATTICE_SMALL=1 in the environment they take their small settings; the tests do that, and
keep nothing.
"""

import base64
import io
import os
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parent
TIMEOUT = 1800  # s, of one cell: what PETRA III lacks takes ten minutes beside other work


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


def shrink(notebook: nbformat.NotebookNode) -> None:
    """Pictures with a palette, in place: less than half of the size."""
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", {}):
                picture = Image.open(io.BytesIO(base64.b64decode(output.data["image/png"])))
                smaller = io.BytesIO()
                few = picture.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
                few.save(smaller, "PNG", optimize=True)
                output.data["image/png"] = base64.b64encode(smaller.getvalue()).decode()


def main(names: list[str]) -> None:
    """Execute those whose names begin so, or all."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and not any(path.name.startswith(name) for name in names):
            continue
        notebook = execute(path)
        notebook.metadata["language_info"] = {"name": "python"}  # not the version that ran it
        shrink(notebook)
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
