"""The result of the data checks: one sentence for each check."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from tmlattice.errors import MeasurementError

Status = Literal["fine", "note", "wrong"]


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        name: what.
        status: "fine"; "note", which a reader should know; "wrong", with which no diagnosis means
            anything.
        sentence: the finding, and its correction.
        before, after: chi-square per reading as stated, and with what is assumed; None where there
            is none.
        assume: with which a diagnosis goes on, the first choice first.
    """

    name: str
    status: Status
    sentence: str
    before: float | None = None
    after: float | None = None
    assume: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """As in the schema `check`."""
        return {
            "name": self.name,
            "status": self.status,
            "sentence": self.sentence,
            "chi2_before": self.before,
            "chi2_after": self.after,
            "assume": list(self.assume),
        }


def fine(name: str, sentence: str) -> Check:
    """A check that passed."""
    return Check(name, "fine", sentence)


def note(name: str, sentence: str, **more: Any) -> Check:
    """A check with a note."""
    return Check(name, "note", sentence, **more)


def wrong(name: str, sentence: str, **more: Any) -> Check:
    """A check that failed."""
    return Check(name, "wrong", sentence, **more)


@dataclass(frozen=True)
class Checkup:
    """All checks of a measurement.

    Attributes:
        kind: of the measurement, as its folder has it.
        checks: in their order.
        provenance: what made it.
    """

    kind: str
    checks: tuple[Check, ...]
    provenance: Mapping[str, Any]

    @property
    def status(self) -> Status:
        """The worst status."""
        found = {check.status for check in self.checks}
        return "wrong" if "wrong" in found else "note" if "note" in found else "fine"

    @property
    def reported(self) -> tuple[Check, ...]:
        """The checks that did not pass, the worst first."""
        order = ("wrong", "note")
        return tuple(c for status in order for c in self.checks if c.status == status)

    def stop(self, where: str = "") -> None:
        """Raise an error if a check failed.

        Args:
            where: the data, named before the sentences.

        Raises:
            MeasurementError: with the sentences.
        """
        bad = [check.sentence for check in self.checks if check.status == "wrong"]
        if bad:
            raise MeasurementError(where + "; ".join(bad))

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-check`, version 1 (see `schemas/`)."""
        return {
            "format": "tmlattice-check",
            "version": 1,
            "kind": self.kind,
            "status": self.status,
            "checks": [check.as_json() for check in self.checks],
            "provenance": dict(self.provenance),
        }
