"""The HTML report of a diagnosis: figures inside that can be hovered and zoomed, nothing outside.

>>> html = page(diagnosis, draw(diagnosis, folder))
"""

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from tmlattice.correction import Correction
from tmlattice.diagnosis import Diagnosis
from tmlattice.report import correction_texts, response_text, tables
from tmlattice.report import text as report
from tmlattice.report.interactive import figures, strip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def render(template: str, provenance: Mapping[str, Any], **context: Any) -> str:
    """A page of this folder's template; what the provenance holds beside texts is shown as JSON."""
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
    """What a clock measured is not known to a nanosecond."""
    return round(value, 1) if isinstance(value, float) else value


def save(figures: Iterable[tuple[str, str, "Figure"]], folder: Path) -> list[Picture]:
    """Figures (name, caption, figure) as PNG files in the folder, one open at a time."""
    import matplotlib.pyplot as plt

    pictures = []
    for name, caption, figure in figures:
        path = folder / f"{name}.png"
        _no_formulas(figure)
        figure.savefig(path, dpi=DPI)
        plt.close(figure)
        shrink(path, caption)
        pictures.append(Picture(name, caption, path))
    return pictures


def _no_formulas(figure: "Figure") -> None:
    """Dollar signs of names are no formula, which matplotlib would set, or fail to."""
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
    """A PNG file with a palette, a third as large; a rare colour keeps its place in it. Its caption
    is in it, for a report that is rendered again."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    about = PngInfo()
    about.add_itxt("Description", caption)

    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(
            method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
    few.save(path, optimize=True, pnginfo=about)


def pictures_in(folder: Path) -> list[Picture]:
    """The figures of an earlier report that a folder holds."""
    from PIL import Image, UnidentifiedImageError

    found = []
    for path in sorted(folder.glob("*.png")):
        try:
            with Image.open(path) as picture:
                caption = picture.info.get("Description")
        except (UnidentifiedImageError, OSError, ValueError):
            continue
        if isinstance(caption, str):
            found.append(Picture(path.stem, caption, path))
    return found


def draw(diagnosis: Diagnosis, folder: Path, correction: Correction | None = None) -> list[Picture]:
    """Every figure of a diagnosis, and of its correction, as a PNG file in the folder."""
    from tmlattice.plots import diagnosis as drawn

    return [*save(drawn.figures(diagnosis), folder), *draw_correction(correction, folder)]


def draw_correction(correction: Correction | None, folder: Path) -> list[Picture]:
    """The figure of a correction as a PNG file in the folder."""
    from tmlattice.plots.correction import CAPTION, plot_correction

    if correction is None:
        return []
    return save([("correction", CAPTION, plot_correction(correction))], folder)


def correction_page(correction: Correction, folder: Path) -> str:
    """The report of a correction as HTML; its figure goes into the folder."""
    from tmlattice import __version__

    (picture,) = draw_correction(correction, folder)
    stated = {"lattice": correction.ring.name, "package": __version__, **correction.provenance}
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
    """The report as HTML.

    Args:
        diagnosis: of `diagnose`.
        pictures: of `draw`.
        provenance: where it should state more than the diagnosis' own.
        correction: of the diagnosis, where there is one.
    """
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
        dense=response_text,
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
    """As JSON that may stand between the tags of a script."""
    text = json.dumps(figure, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return text.replace("<", "\\u003c")
