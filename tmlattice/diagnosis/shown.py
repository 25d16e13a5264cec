"""What a diagnosis and its findings show of themselves."""

from typing import Any

from tmlattice.late import ClassMethod, Method
from tmlattice.speaks import Speaks, last_part

MOST = 4
"""Findings in the line that a diagnosis shows."""


class ShownFinding(Speaks):
    """A finding's line; the attributes are `Finding`'s."""

    effect: str | None
    element: str | None
    amount: float | None
    amount_sigma: float | None
    unit: str | None
    probability: float
    words: str
    where: tuple[float, float] | None

    def _told(self) -> tuple[str, dict[str, str]]:
        place = "" if self.where is None else f"{self.where[0]:.1f} m to {self.where[1]:.1f} m"
        return self.in_short, {"place": place, "probability": f"{self.probability:.3g}"}

    @property
    def in_short(self) -> str:
        """Effect, element and amount, as the catalogue calls them; else what it is in words."""
        if self.words:
            return self.words
        what = " ".join(word for word in (self.effect or "no known effect", self.element) if word)
        if self.amount is None:
            return what
        error = "" if self.amount_sigma is None else f" ± {self.amount_sigma:.2g}"
        return f"{what} {self.amount:.4g}{error} {self.unit or ''}".rstrip()


class ShownDiagnosis(Speaks):
    """A diagnosis' line, its report and figures; the attributes are `Diagnosis`'."""

    report = Method("tmlattice.report.speaking", "report", "The report as text.")
    save = Method(
        "tmlattice.report.speaking",
        "save",
        "Write report.html, report.txt, diagnosis.json and the figures into a folder.",
    )
    load = ClassMethod(
        "tmlattice.diagnosis.load",
        "load",
        "Return the diagnosis of a folder of `save`, or of a diagnosis.json.",
    )
    plot = Method(
        "tmlattice.plots.speaking",
        "plot_diagnosis",
        "Draw the scan along the ring, or the figure of this name: a matplotlib Figure.",
    )

    def _told(self) -> tuple[str, dict[str, str]]:
        own: Any = self  # its attributes are the dataclass's
        explained = None if own.heldout is None else own.heldout.explained
        rows = {"of": f"{own.kind} of {last_part(own.ring.name)}"}
        for number, finding in enumerate(own.findings[:MOST], 1):
            rows[f"finding {number}"] = finding.in_short
        if len(own.findings) > MOST:
            rows["and"] = f"{len(own.findings) - MOST} more"
        rows["gap explained"] = "" if explained is None else f"{100 * explained:.1f} %"
        return own.verdict, rows
