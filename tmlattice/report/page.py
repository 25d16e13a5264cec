"""The HTML report of a diagnosis: figures inside, no link to anything outside.

>>> html = page(diagnosis, draw(diagnosis, folder))
"""

import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from tmlattice.diagnosis import Diagnosis, report

DPI = 130


@dataclass(frozen=True)
class Picture:
    """A figure in a file, and the words under it."""

    name: str
    caption: str
    path: Path

    @property
    def source(self) -> str:
        """As an image's source in a page."""
        return f"data:image/png;base64,{b64encode(self.path.read_bytes()).decode('ascii')}"


def templates() -> Environment:
    """Where the pages' templates are."""
    return Environment(
        loader=PackageLoader("tmlattice.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def draw(diagnosis: Diagnosis, folder: Path) -> list[Picture]:
    """Every figure of a diagnosis as a PNG file in the folder."""
    import matplotlib.pyplot as plt

    from tmlattice.plots.diagnosis import figures

    pictures = []
    for name, caption, figure in figures(diagnosis):
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=DPI)
        plt.close(figure)
        pictures.append(Picture(name, caption, path))
    return pictures


def page(
    diagnosis: Diagnosis, pictures: Sequence[Picture], provenance: dict[str, Any] | None = None
) -> str:
    """The report as HTML.

    Args:
        diagnosis: of `diagnose`.
        pictures: of `draw`.
        provenance: where it should state more than the diagnosis' own.
    """
    stated = diagnosis.provenance if provenance is None else provenance
    return (
        templates()
        .get_template("diagnosis.html")
        .render(
            diagnosis=diagnosis,
            report=report,
            pictures={picture.name: picture for picture in pictures},
            provenance={
                key: value if isinstance(value, str) else json.dumps(value)
                for key, value in stated.items()
            },
        )
    )
