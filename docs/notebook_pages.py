"""The executed notebooks of `notebooks/` as pages of the site, outputs and pictures included."""

import base64
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def on_files(files: Files, config: Any) -> Files:
    """Add a page for each notebook, and its pictures."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        pictures: dict[str, bytes] = {}
        page = "\n\n".join(_cell(cell, path.stem, pictures) for cell in cells)
        where = f"notebooks/{path.stem}"
        files.append(File.generated(config, f"{where}.md", content=page))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def _cell(cell: dict[str, Any], stem: str, pictures: dict[str, bytes]) -> str:
    source = "".join(cell["source"])
    if cell["cell_type"] != "code":
        return source.replace(".ipynb)", ".md)")
    parts = [f"```python\n{source}\n```"]
    for output in cell["outputs"]:
        data = output.get("data", {})
        if "image/png" in data:
            name = f"{stem}_{len(pictures)}.png"
            pictures[name] = base64.b64decode("".join(data["image/png"]))
            parts.append(f"![]({name})")
        elif "text/html" in data:
            parts.append("".join(data["text/html"]))
        else:
            text = "".join(output.get("text", data.get("text/plain", "")))
            parts.append(f"```text\n{COLOURS.sub('', text).rstrip()}\n```")
    return "\n\n".join(parts)
