"""The conclusions of a diagnosis, each computed once, and the sentences that state them.

Text, page, JSON and figures take these sentences from here. `STATEMENTS` is the table of every
sentence with the condition that it requires; `docs/diagnose.md` shows it.

>>> diagnosis.assessment.remainder, diagnosis.assessment.gap
('noise', 'explained')
>>> diagnosis.assessment.sentence("remainder")
'The remaining residual is noise (p = 0.35).'
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from tmlattice.inference import chi2
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.validation import Gap
from tmlattice.speaks import micrometres

MISSING = 1.5
"""Chi-square per degree of freedom above which a significant remainder is a missing effect: a rms
of 1.2 times the expected one, more than the error of a usual noise estimate."""

Remainder = Literal["noise", "above_noise", "effect_missing", "unknown"]
GapState = Literal[
    "not_held_out", "nothing_fitted", "no_amount", "beam_lost", "none", "explained", "share_unknown"
]


_UNEXPLAINED = ("effect_missing", "above_noise")


@dataclass(frozen=True)
class Block:
    """Readings compared with their prediction by the result.

    Attributes:
        name: which readings.
        chi2: sum of squares in the expected covariance: noise, and for held-out readings what the
            fit leaves undetermined.
        freedom: degrees of freedom.
    """

    name: str
    chi2: float
    freedom: float

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square."""
        return float(chi2.sf(self.chi2, self.freedom))

    @property
    def ratio(self) -> float:
        """Rms of the residual over the expected rms."""
        return float(np.sqrt(self.chi2 / max(self.freedom, 1)))

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        return {**vars(self), "p_value": self.p_value, "ratio": self.ratio}


def compared_of(fitted: Block, gap: Gap | None) -> tuple[Block, ...]:
    """Blocks of fitted readings, and of held-out ones with the last model of the gap."""
    square = np.nan if gap is None else gap.readings * gap.misfits[-1].chi2_per_dof
    if gap is None or gap.lost or not square > 0:
        return (fitted,)
    return fitted, Block("held-out readings", square, gap.readings)


def combined_p_value(blocks: Sequence[Block]) -> float:
    """The Bonferroni p-value of the smallest of several p-values; NaN of none."""
    if not blocks:
        return float("nan")
    return min(1.0, len(blocks) * min(block.p_value for block in blocks))


@dataclass(frozen=True, eq=False)
class Assessment:
    """The conclusions of a diagnosis about its own fit.

    Attributes:
        verdict: of the diagnosis.
        blocks: readings compared with what the result predicts.
        held_out: the gap of held-out readings; None: none were held out.
        amounts: whether anything with an amount was put into the model.
        findings: whether there are findings.
        noise_estimated: whether the noise comes from the same readings.
        places: where the remainder is, with `s_from` and `s_to`, m.
        families: whether families of errors were fitted.
        rejected: families that were tried and are not in the result.
        small_errors: whether distributed errors are in the model.
        reference: whether a reference measurement was given.
        change: whether the findings are changes since that reference.
        measured: quantities of the stored beam that were measured.
        model: what the lattice is of the machine, such as "design".
        false_alarm: p-value from which on a remainder is noise.
    """

    verdict: str
    blocks: tuple[Block, ...]
    held_out: Gap | None
    amounts: bool
    findings: bool
    noise_estimated: bool
    places: Sequence[Mapping[str, float]] = ()
    families: bool = False
    rejected: Sequence[str] = ()
    small_errors: bool = False
    reference: bool = False
    change: bool = False
    measured: Sequence[str] = ()
    model: str = "design"
    false_alarm: float = DEFAULT.false_alarm

    @cached_property
    def p_value(self) -> float:
        """P-value of the remainder, over all blocks."""
        return combined_p_value(self.blocks)

    @cached_property
    def significant(self) -> tuple[Block, ...]:
        """The blocks that leave more than expected."""
        count = len(self.blocks)
        return tuple(b for b in self.blocks if count * b.p_value < self.false_alarm)

    @cached_property
    def remainder(self) -> Remainder:
        """Whether the residual of the result is noise."""
        if not self.blocks:
            return "unknown"
        if any(block.ratio**2 > MISSING for block in self.significant):
            return "effect_missing"
        if self.significant:
            return "unknown" if self.noise_estimated else "above_noise"
        return "noise"

    @cached_property
    def gap(self) -> GapState:
        """Whether held-out readings show a gap, and whether it is explained."""
        held_out = self.held_out
        if held_out is None:
            return "not_held_out"
        if held_out.lost:
            return "beam_lost"
        if not self.amounts:
            left = any(block.name.startswith("held-out") for block in self.significant)
            if not left or self.remainder not in _UNEXPLAINED:
                return "none"
            return "no_amount" if self.findings else "nothing_fitted"
        if held_out.explained is not None:
            return "explained"
        return "share_unknown" if held_out.significant(self.false_alarm) else "none"

    @property
    def statements(self) -> tuple["Statement", ...]:
        """The sentences whose condition holds: at most one of each topic."""
        return tuple(one for one in STATEMENTS if one.holds(self))

    def sentence(self, topic: str) -> str:
        """The sentence about a topic; empty where no condition holds."""
        return next((one.text(self) for one in self.statements if one.topic == topic), "")

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        return {
            "remainder": self.remainder,
            "p_value": self.p_value,
            "blocks": [block.as_json() for block in self.blocks],
            "gap": self.gap,
            "reference": self.reference,
            "measured": sorted(self.measured),
            "statements": {one.name: one.text(self) for one in self.statements},
        }


# --- the sentences --------------------------------------------------------------------------------
class Statement(NamedTuple):
    """One sentence of a report.

    Attributes:
        topic: at most one sentence of a topic is stated.
        name: of the sentence.
        requires: its condition in words.
        holds: the condition.
        text: the sentence.
        excludes: names of sentences of other topics that contradict it.
    """

    topic: str
    name: str
    requires: str
    holds: Callable[[Assessment], bool]
    text: Callable[[Assessment], str]
    excludes: tuple[str, ...] = ()


def chance_text(p_value: float) -> str:
    """A p-value in words."""
    return "p < 1e-12" if p_value < 1e-12 else f"p = {p_value:.2g}"


def _noise(own: Assessment) -> str:
    weak = " The noise is estimated from the same readings, which weakens this test."
    text = f"The remaining residual is noise ({chance_text(own.p_value)})."
    return text + (weak if own.noise_estimated else "")


def _more(own: Assessment, the: str, than: str) -> str:
    worst = sorted(own.significant, key=lambda block: -block.ratio)
    blocks = ", ".join(f"{block.name} {block.ratio:.2g}" for block in worst)
    spans = "; ".join(f"{one['s_from']:.1f} m to {one['s_to']:.1f} m" for one in own.places)
    return (
        f"{the} remaining residual is larger than {than} ({chance_text(own.p_value)}; rms over "
        f"expected rms: {blocks})." + (f" It is largest at s = {spans}." if spans else "")
    )


def _missing(own: Assessment) -> str:
    text = f"An effect is missing from the model: {_more(own, 'the', 'expected')}"
    if own.rejected:
        text += f" It can be one of the rejected families: {'; '.join(own.rejected)}."
    return text


def _closed(own: Assessment) -> str:
    gap = own.held_out
    assert gap is not None
    text = f"On {_held(own)} {100 * (gap.explained or 0.0):.1f} % of the gap is explained"
    if gap.interval is not None:
        low, high = gap.interval
        text += f" (95 % interval {100 * low:.1f} to {100 * high:.1f} %)"
    expected = gap.misfits[-1].expected
    if own.small_errors and expected is not None:
        added = (f"the {own.model}", "with distributed errors", "with the findings")
        own_rms = zip(added, (misfit.rms for misfit in gap.misfits), strict=False)
        steps = ", ".join(f"{model} {micrometres(rms)}" for model, rms in own_rms)
        text += f": {steps}; {micrometres(expected)} are expected"
    return text + "."


def _held(own: Assessment) -> str:
    return "held-out in-plane readings" if own.families else "held-out readings"


def _falls(own: Assessment) -> str:
    gap = own.held_out
    assert gap is not None
    before, after = gap.misfits[gap.baseline].rms, gap.misfits[-1].rms
    return (
        f"The rms residual of {_held(own)} falls from {micrometres(before)} to "
        f"{micrometres(after)}; the share of the gap that is explained is not determined by these "
        "readings."
    )


def _asks(own: Assessment) -> bool:
    return own.verdict == "distributed" and not own.families and not own.reference


_LEAVES_MORE = tuple(f"remainder_{name}" for name in _UNEXPLAINED)

Text = Callable[[Assessment], str]


def _verdict(
    requires: str,
    holds: Callable[[Assessment], bool],
    noise: tuple[str, Text],
    more: tuple[str, Text],
) -> tuple[Statement, Statement]:
    """The sentences, each with its name, where the remainder is noise or unknown, and where it is
    more."""
    return (
        Statement(
            "verdict",
            noise[0],
            f"{requires}; the remainder is noise or cannot be tested",
            lambda own: holds(own) and own.remainder not in _UNEXPLAINED,
            noise[1],
            _LEAVES_MORE,
        ),
        Statement(
            "verdict",
            more[0],
            f"{requires}; the remainder is larger than the noise",
            lambda own: holds(own) and own.remainder in _UNEXPLAINED,
            more[1],
            ("remainder_noise",),
        ),
    )


def _state(
    topic: str, state: str, requires: str, text: Text, excludes: tuple[str, ...] = ()
) -> Statement:
    """The sentence about one state of the remainder, or of the gap."""
    return Statement(
        topic,
        f"{topic}_{state}",
        requires,
        lambda own: getattr(own, topic) == state,
        text,
        excludes,
    )


STATEMENTS = (
    *_verdict(
        "verdict none; the findings are changes since a reference",
        lambda own: own.verdict == "none" and own.change,
        ("no_change", lambda own: "Nothing changed since the reference beyond the usual drifts of "
         "BPMs, correctors and magnets."),
        ("change_not_located", lambda own: "No change since the reference is localised, but drifts "
         "do not explain all readings within their noise."),
    ),
    *_verdict(
        "verdict none, no reference",
        lambda own: own.verdict == "none" and not own.change,
        ("no_error", lambda own: f"No error is detected: the {own.model} explains the readings "
         "within their noise."),
        ("not_located", lambda own: f"No error is localised, but the {own.model} does not explain "
         "all readings within their noise."),
    ),
    *_verdict(
        "verdict distributed; distributed errors are in the model",
        lambda own: own.verdict == "distributed" and own.small_errors and not own.families,
        ("small_errors_explain", lambda own: "Distributed errors explain the readings; no single "
         "fault is detected among them."),
        ("small_errors_explain_part", lambda own: "Distributed errors explain a part of the "
         "readings; no single fault is detected among them."),
    ),
    Statement(
        "verdict", "no_sparse_solution",
        "verdict distributed; neither distributed errors nor families of errors are in the model",
        lambda own: own.verdict == "distributed" and not own.small_errors and not own.families,
        lambda own: "The readings differ from the model all along the ring; no sparse set of "
        "errors explains them.",
        ("gap_explained",),
    ),
    _state(
        "remainder", "noise", "p-value over all blocks of readings at the false-alarm "
        "level or above",
        _noise,
        _LEAVES_MORE,
    ),
    _state(
        "remainder", "above_noise",
        f"p-value below the false-alarm level, chi² per degree of freedom {MISSING} at most, the "
        "noise is stated",
        lambda own: _more(own, "The", "the noise"),
    ),
    _state(
        "remainder", "effect_missing",
        f"p-value below the false-alarm level in a block whose chi² per degree of freedom is above "
        f"{MISSING}",
        _missing,
    ),
    _state(
        "remainder", "unknown",
        f"p-value below the false-alarm level, chi² per degree of freedom {MISSING} at most, the "
        "noise is estimated from the same readings; or no reading was compared",
        lambda own: "Whether the remaining residual is noise is unknown: the noise is estimated "
        "from the same readings.",
    ),
    _state(
        "gap", "not_held_out", "no reading was held out",
        lambda own: "No reading was held out: the reduction of the gap is not validated.",
    ),
    _state(
        "gap", "none",
        "held-out readings before the correction are not significantly above the noise",
        lambda own: f"{_held(own).capitalize()} show no gap beyond the noise.",
    ),
    _state(
        "gap", "explained", "a gap on held-out readings, five standard errors or more; the "
        "share that is explained is determined",
        _closed,
    ),
    _state(
        "gap", "share_unknown", "a gap on held-out readings that is significant in chi²; its "
        "size is determined to less than five standard errors",
        _falls,
    ),
    _state(
        "gap", "nothing_fitted", "a gap on held-out readings; nothing was put into the model",
        lambda own: f"Nothing was put into the model, so the gap of {_held(own)} stays.",
        ("no_error", "small_errors_explain"),
    ),
    _state(
        "gap", "no_amount", "a gap on held-out readings; the findings have no effect of the "
        "catalogue, and no amount",
        lambda own: "A finding without an effect of the catalogue has no amount, so the gap of "
        "held-out readings stays.",
        ("no_error", "small_errors_explain"),
    ),
    _state(
        "gap", "beam_lost", "the beam of held-out readings is lost in one of the models",
        lambda own: "The beam of held-out shots is lost in one of the models, so they do not "
        "validate the result.",
    ),
    Statement(
        "reference", "reference_shows_faults",
        "verdict distributed, with distributed errors in the model; no reference was given",
        lambda own: _asks(own) and own.small_errors,
        lambda own: "A measurement of this machine from before the fault (--reference) shows "
        "faults that distributed errors hide.",
    ),
    Statement(
        "reference", "reference_or_background",
        "verdict distributed without distributed errors in the model; no reference was given",
        lambda own: _asks(own) and not own.small_errors,
        lambda own: "Distributed errors look like this: state them (--background all), or "
        "give a measurement of this machine from before the fault (--reference).",
    ),
)  # fmt: skip
"""Every sentence about the fit as a whole, with its condition; text, page and JSON state the first
of a topic that holds."""
