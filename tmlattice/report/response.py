"""The HTML report of an orbit response's diagnosis.

>>> html = response_page(result, draw_response(result, folder), provenance)
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tmlattice.diagnosis import response_report
from tmlattice.diagnosis.response import ResponseDiagnosis
from tmlattice.report.page import DPI, Picture, templates


def draw_response(result: ResponseDiagnosis, folder: Path) -> list[Picture]:
    """Every figure as a PNG file in the folder."""
    import matplotlib.pyplot as plt

    from tmlattice.plots.response import response_figures

    pictures = []
    for name, caption, figure in response_figures(result):
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=DPI)
        plt.close(figure)
        pictures.append(Picture(name, caption, path))
    return pictures


def response_page(
    result: ResponseDiagnosis, pictures: Sequence[Picture], provenance: dict[str, Any]
) -> str:
    """The report as HTML."""
    return (
        templates()
        .get_template("response.html")
        .render(
            result=result,
            report=response_report,
            pictures=pictures,
            provenance={
                key: value if isinstance(value, str) else json.dumps(value)
                for key, value in provenance.items()
            },
        )
    )
