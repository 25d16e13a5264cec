"""The HTML report of a diagnosis: one file with interactive figures and no external resources.

>>> html = page(diagnosis, draw(diagnosis, folder))
"""

import json
import logging
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from tmlattice.correction import Correction
from tmlattice.diagnosis import Diagnosis
from tmlattice.errors import TmlatticeError
from tmlattice.input_files import content_of
from tmlattice.report import correction_texts, response_text, tables
from tmlattice.report import text as report
from tmlattice.report.interactive import figures, strip

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image

log = logging.getLogger(__name__)

DPI = 130


@dataclass(frozen=True)
class Picture:
    """A figure's file and its caption."""

    name: str
    caption: str
    path: Path

    @property
    def source(self) -> str:
        """The image as a data URL."""
        return f"data:image/png;base64,{b64encode(self.path.read_bytes()).decode('ascii')}"


def render(template: str, provenance: Mapping[str, Any], **context: Any) -> str:
    """A page from a template of this folder; other provenance than texts is shown as JSON."""
    environment = Environment(
        loader=PackageLoader("tmlattice.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    stated = {
        key: value if isinstance(value, str) else json.dumps(_rounded(value))
        for key, value in provenance.items()
    }
    return environment.get_template(template).render(provenance=stated, **context)


def _rounded(value: Any) -> Any:
    """A value of the provenance, seconds to one digit."""
    return round(value, 1) if isinstance(value, float) else value


def save(
    figures: Iterable[tuple[str, str, "Figure"]], folder: Path, source: str = ""
) -> list[Picture]:
    """Figures (name, caption, figure) as PNG files in the folder, one open at a time; each with
    its caption and its `source`, see `_source`."""
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    pictures = []
    for name, caption, figure in figures:
        path = folder / f"{name}.png"
        _no_formulas(figure)
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(DPI)
        canvas.draw()  # type: ignore[no-untyped-call]  # `savefig` draws twice
        drawn = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
        _write(Image.fromarray(np.asarray(drawn)), path, caption, source)
        plt.close(figure)
        pictures.append(Picture(name, caption, path))
    return pictures


def _no_formulas(figure: "Figure") -> None:
    """Escape dollar signs in names, which matplotlib would read as formulas."""
    from matplotlib.text import Text
    from matplotlib.ticker import FixedFormatter

    for text in figure.findobj(Text):
        if isinstance(text, Text) and "$" in text.get_text().replace(r"$\mathdefault", ""):
            text.set_parse_math(False)
    for axis in (a for axes in figure.axes for a in (axes.xaxis, axes.yaxis)):
        formatter = axis.get_major_formatter()
        if isinstance(formatter, FixedFormatter):  # its texts come when it is drawn
            formatter.seq = [str(text).replace("$", r"\$") for text in formatter.seq]


def shrink(path: Path, caption: str) -> None:
    """Write a PNG file with a palette, a third as large, and its caption."""
    from PIL import Image

    with Image.open(path) as picture:
        _write(picture, path, caption, "")


def _write(picture: "Image", path: Path, caption: str, source: str) -> None:
    """Write a PNG file with a palette, and with texts for a report that is rendered again; rare
    colours are kept."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    about = PngInfo()
    about.add_itxt("Description", caption)
    about.add_itxt("Source", source)
    few = picture.convert("RGB").quantize(
        method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
    )
    few.save(path, optimize=True, pnginfo=about)


def _source(diagnosis: Diagnosis) -> str:
    """A text that only figures of the same diagnosis have: its misfits."""
    fits = (diagnosis.fit_before, diagnosis.fit_after)
    return " ".join(repr(float(value)) for fit in fits for value in (fit.rms, fit.chi2_per_dof))


def pictures_in(folder: Path, diagnosis: Diagnosis) -> list[Picture]:
    """The figures of a diagnosis that a folder holds."""
    from PIL import Image

    found = []
    for path in sorted(folder.glob("*.png")):
        try:
            with Image.open(BytesIO(content_of(path, TmlatticeError))) as picture:
                about = picture.info
        except Exception:  # another program's, or damaged
            log.info("%s is no figure", path, exc_info=True)
            continue
        if about.get("Source") == _source(diagnosis):
            found.append(Picture(path.stem, str(about.get("Description")), path))
    return found


def draw(diagnosis: Diagnosis, folder: Path, correction: Correction | None = None) -> list[Picture]:
    """Draw every figure of a diagnosis and of its correction as a PNG file in the folder."""
    from tmlattice.plots import diagnosis as drawn

    own = save(drawn.figures(diagnosis), folder, _source(diagnosis))
    return [*own, *draw_correction(correction, folder)]


def draw_correction(correction: Correction | None, folder: Path) -> list[Picture]:
    """Draw the figure of a correction as a PNG file in the folder."""
    from tmlattice.plots.readings import CAPTION, plot_correction

    if correction is None:
        return []
    return save([("correction", CAPTION, plot_correction(correction))], folder)


def correction_page(correction: Correction, folder: Path) -> str:
    """The report of a correction as HTML; its figure is written into the folder."""
    from tmlattice import __version__

    (picture,) = draw_correction(correction, folder)
    stated = {"package": __version__, **correction.provenance}
    return render(
        "correction.html",
        stated,
        correction=correction,
        texts=correction_texts,
        picture=picture,
        interactive={},
        strip=_inlined(strip(correction.ring)),
        library="",
        script="",
    )


def page(
    diagnosis: Diagnosis,
    pictures: Sequence[Picture],
    provenance: dict[str, Any] | None = None,
    correction: Correction | None = None,
) -> str:
    """The report as HTML."""
    parts = files("tmlattice.report")
    stated = diagnosis.provenance if provenance is None else provenance
    return render(
        "diagnosis.html",
        stated,
        diagnosis=diagnosis,
        correction=correction,
        texts=correction_texts,
        notes=list(tables.notes(diagnosis, stated)),
        report=report,
        fit=response_text,
        tables=tables,
        pictures={picture.name: picture for picture in pictures},
        interactive={name: _inlined(one) for name, one in figures(diagnosis).items()},
        strip=_inlined(strip(diagnosis.ring)),
        library=(parts / LIBRARY).read_text(encoding="utf-8"),
        script=(parts / "page.js").read_text(encoding="utf-8"),
    )


LIBRARY = "vendor/plotly-basic.min.js"
"""plotly.js 4.1.1, the bundle of lines, markers and bars; MIT, see `vendor/plotly-LICENSE`."""


def _inlined(figure: Any) -> str:
    """JSON that is safe between the tags of a script."""
    text = json.dumps(figure, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return text.replace("<", "\\u003c")
