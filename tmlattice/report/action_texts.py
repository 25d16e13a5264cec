"""What is to be done about a finding, in the words of a control room."""

from collections.abc import Sequence

from tmlattice.diagnosis.consequences import Beam, Consequences
from tmlattice.diagnosis.recommended_actions import RecommendedAction, leading, pieces_of
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Cause, ReadingEffect, RingEffect, find
from tmlattice.lattice import Ring
from tmlattice.report.amounts import amount_text, probability_text, words

_KINDS = {
    "bend": "bending magnet",
    "hcorrector": "horizontal corrector",
    "vcorrector": "vertical corrector",
}
"""Kinds of elements that a control room calls otherwise."""

SETTLED = Beam((1e-5, 1e-5), (1e-4, 1e-4), (1e-4, 1e-4), (1e-5, 1e-5), (1e-7, 1e-7))
"""A beam that differs from the design's by less is as designed."""


def subject(recommended_action: RecommendedAction) -> str:
    """What it is about: "quadrupole qd::12"."""
    if recommended_action.element is None or recommended_action.kind is None:
        return "the beam"
    kind = _KINDS.get(recommended_action.kind, recommended_action.kind)
    family = " family" if recommended_action.effect.startswith("family") else ""
    others = [name for name in recommended_action.pieces if name != recommended_action.element]
    magnet = f" (one magnet with {', '.join(others)})" if others else ""
    device = f" [{recommended_action.device}]" if recommended_action.device else ""
    return f"{kind}{family} {recommended_action.element}{device}{magnet}"


def action_text(recommended_action: RecommendedAction) -> str:
    """What is wrong there, as a line of a logbook."""
    effect = find(recommended_action.effect)
    amount = amount_text(
        recommended_action.effect, recommended_action.amount, recommended_action.amount_sigma
    )
    if effect.discrete and amount:
        what = amount  # "no signal"
    else:
        what = f"{effect.quantity or effect.words} {amount}".rstrip()
    told = ""
    if recommended_action.strength is not None:
        own = recommended_action.strength
        told = f" ({own.name} {own.before:.4g} -> {own.after:.4g} {own.unit})"
    return f"{subject(recommended_action)}, {what}{told}"


def title(finding: Finding) -> str:
    """A finding in one line."""
    if finding.recommended_action is None:
        return finding.words or "something that no effect of the catalogue explains"
    return action_text(finding.recommended_action)


LIKELY = 0.01
"""Share of a recommended action's probability from which on a mechanism is told."""


def mechanism_text(recommended_action: RecommendedAction) -> str:
    """Which explanations share a recommended action, and how likely each is."""
    likely = [
        m for m in recommended_action.mechanisms if m[1] >= LIKELY * recommended_action.probability
    ]
    if len(likely) == 1:
        effect = likely[0][0]
        return f"{words(effect)} ({effect}: {find(effect).sign})"
    told = (f"{words(e)} ({e}) {probability_text(p)}" for e, p in likely)
    return "; or ".join(told) + ": the action is the same"


def or_text(finding: Finding, most: int) -> str:
    """What else it may be that has another place or another recommended action."""
    others = finding.recommended_actions[1:]
    shown = [f"{probability_text(r.probability)} {action_text(r)}" for r in others[:most]]
    if len(others) > most:
        rest = sum(r.probability for r in others[most:])
        shown.append(f"{len(others) - most} more ({probability_text(rest)} together)")
    return "\n".join(shown)


SAID = 4
"""Places that a sentence names."""


def by_hand_text(ring: Ring, causes: Sequence[Cause]) -> str:
    """What no setting mends, in a sentence; empty where nothing is left."""
    todo: dict[str, list[str]] = {}  # what to do -> where
    for cause in causes:
        lead = leading(ring, cause)
        place = " + ".join(pieces_of(ring, lead.element)) or "the ring"
        places = todo.setdefault(find(lead.effect).recommended_action, [])
        places += [place] * (place not in places)
    if not todo:
        return ""
    said = []
    for recommended_action, places in todo.items():
        more = f" and {len(places) - SAID} more" if len(places) > SAID else ""
        said.append(recommended_action.replace("{}", ", ".join(places[:SAID]) + more))
    return f"no setting in it mends what is left to do: {'; '.join(said)}"


# --- what it does to the stored beam --------------------------------------------------------------
def consequence_text(finding: Finding) -> str:
    """What a finding does to the stored beam, and what is left of it after the repair."""
    if finding.effect is None:
        return ""
    effect, told = find(finding.effect), finding.consequences
    if told is None:
        if effect.natural or not isinstance(effect, RingEffect):
            nothing = "the stored beam does not feel it"
            reads = "; its readings are wrong" if isinstance(effect, ReadingEffect) else ""
            return "" if effect.natural else nothing + reads
        return "none while it is set to zero" if effect.acts_on_settings else ""
    return f"as found: {_beam_text(told.found, told)}\nafter the repair: {_after_text(told)}"


def _after_text(told: Consequences) -> str:
    beam = told.corrected
    if beam is None or told.design is None:
        return _beam_text(beam, told)
    off = [abs(a - b) for a, b in zip(beam.tunes, told.design, strict=True)]
    settled = max(off) < SETTLED.tunes[0] and all(
        max(getattr(beam, name)) < getattr(SETTLED, name)[0]
        for name in ("beta_beat_rms", "beta_beat_max", "dispersion_rms", "orbit_rms")
    )
    return "as designed" if settled else _beam_text(beam, told)


def _beam_text(beam: Beam | None, told: Consequences) -> str:
    if told.design is None:
        return "the model itself is unstable"
    if beam is None:
        return "unstable: no beam can be stored"
    x, y = beam.tunes
    said = [f"tunes {x:.4f}, {y:.4f} (model {told.design[0]:.4f}, {told.design[1]:.4f})"]
    if max(beam.beta_beat_max) > SETTLED.beta_beat_max[0]:
        rms, most = _pair(beam.beta_beat_rms, 100, 2), _pair(beam.beta_beat_max, 100, 2)
        said.append(f"beta beating {rms} % rms, {most} % at most")
    if max(beam.dispersion_rms) > SETTLED.dispersion_rms[0]:
        said.append(f"dispersion changed by {_pair(beam.dispersion_rms, 1e3, 1)} mm rms")
    if max(beam.orbit_rms) > SETTLED.orbit_rms[0]:
        said.append(f"closed orbit {_pair(beam.orbit_rms, 1e6, 1)} µm rms")
    return "; ".join(said)


def _pair(values: tuple[float, float], factor: float, digits: int) -> str:
    """x and y."""
    return " and ".join(f"{factor * value:.{digits}f}" for value in values)
