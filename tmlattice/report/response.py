"""The HTML report of an orbit response's diagnosis.

>>> html = response_page(result, draw_response(result, folder), provenance)
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tmlattice.diagnosis.response_result import ResponseDiagnosis
from tmlattice.report import response_text as response_report
from tmlattice.report.page import Picture, render, save


def draw_response(result: ResponseDiagnosis, folder: Path) -> list[Picture]:
    """Every figure as a PNG file in the folder."""
    from tmlattice.plots.response import response_figures

    return save(response_figures(result), folder)


def response_page(
    result: ResponseDiagnosis, pictures: Sequence[Picture], provenance: dict[str, Any]
) -> str:
    """The report as HTML."""
    return render(
        "response.html", provenance, result=result, report=response_report, pictures=pictures
    )
