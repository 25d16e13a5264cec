"""Files of a diagnosis and of a correction: `diagnosis.save(folder)`."""

from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

from tmlattice.correction import Correction
from tmlattice.correction.result import CODES, FILES, read_correction
from tmlattice.correction.result import DOCUMENT as CORRECTION
from tmlattice.correction.result import LATTICE as CORRECTION_LATTICE
from tmlattice.diagnosis.load import DOCUMENT, LATTICE, load
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.errors import LatticeError
from tmlattice.files import output_folder, write_json
from tmlattice.lattice import load_ring, save_ring
from tmlattice.report.correction_texts import correction_text
from tmlattice.report.page import correction_page, draw, page, pictures_in
from tmlattice.report.plain import report_text


def save(diagnosis: Diagnosis, folder: str | PathLike[str]) -> Path:
    """Write `report.html`, `report.txt`, `diagnosis.json` with its lattice, and the figures.

    Args:
        folder: made where it is not there; files of these names are replaced, all or none, and
            those of a correction are removed.

    Returns:
        The report's path, `report.html`.
    """
    place = Path(folder)
    with output_folder(place, FILES) as temporary:
        write_files(diagnosis, temporary, diagnosis.as_json())
    return place / "report.html"


def write_files(
    diagnosis: Diagnosis,
    folder: Path,
    document: dict[str, Any],
    correction: Correction | None = None,
) -> None:
    """Write the files of `save` for a given document, with the settings of a correction."""
    pictures = draw(diagnosis, folder, correction)
    if correction is not None:
        write_settings(correction, folder)
    _write_report(diagnosis, folder, page(diagnosis, pictures, document["provenance"], correction))
    write_json(folder / DOCUMENT, document)
    with suppress(LatticeError):  # an element that no file holds: `load` then asks for the ring
        save_ring(diagnosis.ring, folder / LATTICE)


def render(
    path: str | PathLike[str], out: str | PathLike[str] | None = None
) -> Diagnosis | Correction:
    """Write report.html and report.txt of a diagnosis.json anew, with its correction.json; or
    report.html of a correction.json alone.

    Figures of the readings and of the scan are those that the folder holds: diagnosis.json does
    not hold what they show.

    Args:
        out: the folder to write to; None: the same.

    Returns:
        The diagnosis, see `Diagnosis.load`; or the correction.
    """
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    place, correction = folder if out is None else Path(out), None
    if (folder / CORRECTION_LATTICE).is_file() and not (folder / DOCUMENT).is_file():
        correction = read_correction(folder / CORRECTION, load_ring(folder / CORRECTION_LATTICE))
        with output_folder(place) as temporary:
            html = correction_page(correction, temporary)
            (temporary / "report.html").write_text(html, encoding="utf-8")
        return correction
    diagnosis = load(Diagnosis, path)
    if (folder / CORRECTION).is_file():
        correction = read_correction(folder / CORRECTION, diagnosis.ring)
    with output_folder(place) as temporary:
        pictures = draw(diagnosis, temporary, correction)
        drawn = {picture.name for picture in pictures}
        pictures += [kept for kept in pictures_in(folder, diagnosis) if kept.name not in drawn]
        _write_report(diagnosis, temporary, page(diagnosis, pictures, correction=correction))
    return diagnosis


def _write_report(diagnosis: Diagnosis, folder: Path, html: str) -> None:
    (folder / "report.html").write_text(html, encoding="utf-8")
    (folder / "report.txt").write_text(report_text(diagnosis) + "\n", encoding="utf-8")


def save_correction(correction: Correction, folder: str | PathLike[str]) -> Path:
    """Write `settings.csv`, statements of MAD-X, AT and elegant, `correction.json` and `.txt`, and
    `report.html`.

    Args:
        folder: made where it is not there; files of these names are replaced, all or none.

    Returns:
        The report's path, `report.html`.
    """
    place = Path(folder)
    with output_folder(place) as temporary:
        write_correction(correction, temporary)
    return place / "report.html"


def write_correction(correction: Correction, folder: Path) -> None:
    """Write the files of `save_correction` into an existing folder."""
    write_settings(correction, folder)
    with suppress(LatticeError):  # an element that no file holds
        save_ring(correction.ring, folder / CORRECTION_LATTICE)
    (folder / "report.html").write_text(correction_page(correction, folder), encoding="utf-8")


def write_settings(correction: Correction, folder: Path) -> None:
    """Write the settings and the expected result."""
    (folder / "settings.csv").write_text(correction.table(), encoding="utf-8")
    (folder / "correction.txt").write_text(correction_text(correction) + "\n", encoding="utf-8")
    for code, name in CODES.items():
        (folder / name).write_text(correction.snippet(code), encoding="utf-8")
    write_json(folder / CORRECTION, correction.as_json())
