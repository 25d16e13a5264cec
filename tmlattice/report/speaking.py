"""A diagnosis that is asked for its report: `diagnosis.report()`, `diagnosis.save(folder)`."""

from os import PathLike
from pathlib import Path
from typing import Any

from tmlattice.diagnosis.result import Diagnosis
from tmlattice.files import output_folder, write_json
from tmlattice.report.page import draw, page
from tmlattice.report.plain import WIDTH, report_text


def report(diagnosis: Diagnosis, width: int = WIDTH) -> str:
    """The report as plain text, as `tmlattice diagnose` prints it."""
    return report_text(diagnosis, width)


def save(diagnosis: Diagnosis, folder: str | PathLike[str]) -> Path:
    """Write `report.html`, `report.txt`, `diagnosis.json` and the figures.

    Args:
        diagnosis: of `diagnose`.
        folder: made where it is not there; files of these names are replaced, all or none.

    Returns:
        The report's path, `report.html`.

    Raises:
        OutputError: it cannot be written.
    """
    place = Path(folder)
    with output_folder(place) as temporary:
        write_files(diagnosis, temporary, diagnosis.as_json())
    return place / "report.html"


def write_files(diagnosis: Diagnosis, folder: Path, document: dict[str, Any]) -> None:
    """The files of `save`, of a document that may state more than the diagnosis' own."""
    html = page(diagnosis, draw(diagnosis, folder), document["provenance"])
    (folder / "report.html").write_text(html, encoding="utf-8")
    (folder / "report.txt").write_text(report_text(diagnosis) + "\n", encoding="utf-8")
    write_json(folder / "diagnosis.json", document)
