"""The recommended action for a finding, and the recommended next measurement, as text."""

from collections.abc import Sequence

import numpy as np

from tmlattice.diagnosis.consequences import Beam, Consequences
from tmlattice.diagnosis.kinds import KINDS
from tmlattice.diagnosis.recommended_actions import RecommendedAction, leading, pieces_of
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.effects import Cause, ReadingEffect, RingEffect, find
from tmlattice.lattice import Ring
from tmlattice.report.amounts import amount_text, probability_text, words
from tmlattice.speaks import listed

_KINDS = {
    "monitor": "BPM",
    "bend": "bending magnet",
    "hcorrector": "horizontal corrector",
    "vcorrector": "vertical corrector",
}
"""Names of kinds of elements in a report, where they differ from those of the lattice."""

SETTLED = Beam((1e-5, 1e-5), (1e-4, 1e-4), (1e-4, 1e-4), (1e-5, 1e-5), (1e-7, 1e-7))
"""Changes of the beam below which it is as designed."""


def subject(action: RecommendedAction) -> str:
    """The element, its family and its device: "quadrupole qd::12"."""
    if action.element is None or action.kind is None:
        return "the beam"
    kind = _KINDS.get(action.kind, action.kind)
    family = " family" if action.effect.startswith("family") else ""
    others = [name for name in action.pieces if name != action.element]
    magnet = f" (one magnet with {', '.join(others)})" if others else ""
    device = f" [{action.device}]" if action.device else ""
    return f"{kind}{family} {action.element}{device}{magnet}"


def action_text(action: RecommendedAction) -> str:
    """The finding in a line: element, quantity, amount."""
    effect = find(action.effect)
    amount = amount_text(action.effect, action.amount, action.amount_sigma)
    if effect.discrete and amount:
        what = amount  # "no signal"
    else:
        what = f"{effect.quantity or effect.words} {amount}".rstrip()
    strength = ""
    if action.strength is not None:
        own = action.strength
        strength = f" ({own.name} {own.before:.4g} -> {own.after:.4g} {own.unit})"
    return f"{subject(action)}, {what}{strength}"


def title(finding: Finding) -> str:
    """A finding in one line."""
    if finding.recommended_action is None:
        return finding.words or "something that no effect of the catalogue explains"
    return action_text(finding.recommended_action)


LIKELY = 0.01
"""Share of an action's probability above which a mechanism is reported."""


def mechanism_text(action: RecommendedAction) -> str:
    """The mechanisms that share an action, with their probabilities."""
    likely = [m for m in action.mechanisms if m[1] >= LIKELY * action.probability]
    if len(likely) == 1:
        effect = likely[0][0]
        return f"{words(effect)} ({effect}: {find(effect).sign})"
    shares = (f"{words(e)} ({e}) {probability_text(p)}" for e, p in likely)
    return "; or ".join(shares) + ": the action is the same"


def or_text(finding: Finding, most: int) -> str:
    """The alternatives: other places or other actions, one a line."""
    others = finding.recommended_actions[1:]
    shown = [f"{probability_text(r.probability)} {action_text(r)}" for r in others[:most]]
    if len(others) > most:
        rest = sum(r.probability for r in others[most:])
        shown.append(f"{len(others) - most} more ({probability_text(rest)} together)")
    return "\n".join(shown)


NAMED = 4
"""Places that a sentence names."""


def by_hand_text(ring: Ring, causes: Sequence[Cause]) -> str:
    """A sentence about what no setting can correct; empty where nothing remains."""
    todo: dict[str, list[str]] = {}  # what to do -> where
    for cause in causes:
        lead = leading(ring, cause)
        place = " + ".join(pieces_of(ring, lead.element)) or "the ring"
        places = todo.setdefault(find(lead.effect).recommended_action, [])
        places += [place] * (place not in places)
    if not todo:
        return ""
    parts = []
    for recommended_action, places in todo.items():
        parts.append(recommended_action.replace("{}", listed(places, NAMED)))
    return f"no setting in it corrects the rest: {'; '.join(parts)}"


# --- what it does to the stored beam --------------------------------------------------------------
def consequence_text(finding: Finding) -> str:
    """The effect of a finding on the stored beam, and the beam after the correction."""
    if finding.effect is None:
        return ""
    effect, consequences = find(finding.effect), finding.consequences
    if consequences is None:
        if effect.natural:
            return ""
        if not isinstance(effect, RingEffect):
            reads = "; its readings are wrong" if isinstance(effect, ReadingEffect) else ""
            return f"no effect on the stored beam{reads}"
        return "none while it is set to zero" if effect.acts_on_settings else ""
    found, corrected = _beam_text(consequences.found, consequences), _after_text(consequences)
    return f"estimated: {found}\nafter the correction: {corrected}"


def _after_text(consequences: Consequences) -> str:
    beam = consequences.corrected
    if beam is None or consequences.design is None:
        return _beam_text(beam, consequences)
    off = [abs(a - b) for a, b in zip(beam.tunes, consequences.design, strict=True)]
    settled = max(off) < SETTLED.tunes[0] and all(
        max(getattr(beam, name)) < getattr(SETTLED, name)[0]
        for name in ("beta_beat_rms", "beta_beat_max", "dispersion_rms", "orbit_rms")
    )
    return "as designed" if settled else _beam_text(beam, consequences)


def _beam_text(beam: Beam | None, consequences: Consequences) -> str:
    if consequences.design is None:
        return "the model itself is unstable"
    if beam is None:
        return "unstable: no beam can be stored"
    x, y = beam.tunes
    design = f"model {consequences.design[0]:.4f}, {consequences.design[1]:.4f}"
    parts = [f"tunes {x:.4f}, {y:.4f} ({design})"]
    if max(beam.beta_beat_max) > SETTLED.beta_beat_max[0]:
        rms, most = _pair(beam.beta_beat_rms, 100, 2), _pair(beam.beta_beat_max, 100, 2)
        parts.append(f"beta beating {rms} % rms, {most} % at most")
    if max(beam.dispersion_rms) > SETTLED.dispersion_rms[0]:
        parts.append(f"dispersion changed by {_pair(beam.dispersion_rms, 1e3, 1)} mm rms")
    if max(beam.orbit_rms) > SETTLED.orbit_rms[0]:
        parts.append(f"closed orbit {_pair(beam.orbit_rms, 1e6, 1)} µm rms")
    return "; ".join(parts)


def _pair(values: tuple[float, float], factor: float, digits: int) -> str:
    """The values of x and y."""
    return " and ".join(f"{factor * value:.{digits}f}" for value in values)


# --- the next measurement -------------------------------------------------------------------------
def next_text(diagnosis: Diagnosis) -> str:
    """The recommended next measurement; empty where none was proposed."""
    proposed = diagnosis.next
    if proposed is None:
        return ""
    launch, separation = proposed.launch, proposed.separation
    if launch is None:
        what = f"{KINDS[proposed.kind].words} ({proposed.minutes:.2g} minutes)"
        again = "of them"
    else:
        changes = [
            _setting_text(element, name, value)
            for element, setting in proposed.settings.items()
            for name, value in setting.items()
        ]
        how = f"with {' and '.join(changes)}, " if changes else ""
        where = (
            f"x = {1e3 * launch['x']:.2f} mm, px = {1e3 * launch['px']:.3f} mrad, "
            f"y = {1e3 * launch['y']:.2f} mm, py = {1e3 * launch['py']:.3f} mrad"
        )
        if launch["delta"]:
            where += f", energy {100 * launch['delta']:+.2f} %"
        what, again = f"One more shot, {how}launched at {where},", "such shots"
    first, second = proposed.parts
    number = f"; {int(np.ceil((5 / separation) ** 2))} {again} reach 5" if separation < 5 else ""
    return (
        f"{what} would separate '{first}' from '{second}' by {separation:.1f} standard "
        f"deviations{number}."
    )


def _setting_text(element: str, name: str, value: float) -> str:
    match name:
        case "k1_relative":
            return f"the strength of {element} changed by {100 * value:+g} %"
        case "k2_relative":
            return f"{element} switched off" if value == -1 else f"{element} {100 * value:+g} %"
        case "kick":
            return f"{element} set to {1e6 * value:+g} µrad"
    return f"{element} {name} = {value:g}"
