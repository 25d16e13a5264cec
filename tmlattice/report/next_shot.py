"""The recommended next measurement, in words."""

import numpy as np

from tmlattice.diagnosis.result import Diagnosis


def next_text(diagnosis: Diagnosis) -> str:
    """The recommended next measurement; empty where none was proposed."""
    shot = diagnosis.next
    if shot is None:
        return ""
    changes = [
        _setting_text(element, name, value)
        for element, setting in shot.settings.items()
        for name, value in setting.items()
    ]
    first, second = shot.parts
    launch = shot.launch
    if launch is None:
        return (
            f"{KIND_WORDS[shot.kind]} ({shot.minutes:.2g} minutes) would separate '{first}' from "
            f"'{second}' by {shot.separation:.1f} standard deviations"
            + _enough(shot.separation, "of them")
        )
    where = (
        f"x = {1e3 * launch['x']:.2f} mm, px = {1e3 * launch['px']:.3f} mrad, "
        f"y = {1e3 * launch['y']:.2f} mm, py = {1e3 * launch['py']:.3f} mrad"
    )
    if launch["delta"]:
        where += f", energy {100 * launch['delta']:+.2f} %"
    how = f"with {' and '.join(changes)}, " if changes else ""
    return (
        f"One more shot, {how}launched at {where}, would separate '{first}' from '{second}' by "
        f"{shot.separation:.1f} standard deviations" + _enough(shot.separation)
    )


KIND_WORDS = {
    "closed_orbit": "A closed orbit",
    "tunes": "Tunes and chromaticities",
    "turn_by_turn": "Turns of the stored beam after a kick",
    "dispersion": "The dispersion",
    "orbit_response": "An orbit response",
}
"""What to measure, as a sentence begins with it."""


def _enough(separation: float, what: str = "such shots") -> str:
    """The number of such measurements that reach 5 standard deviations."""
    if separation >= 5:
        return "."
    return f"; {int(np.ceil((5 / separation) ** 2))} {what} reach 5."


def _setting_text(element: str, name: str, value: float) -> str:
    match name:
        case "k1_relative":
            return f"the strength of {element} changed by {100 * value:+g} %"
        case "k2_relative":
            return f"{element} switched off" if value == -1 else f"{element} {100 * value:+g} %"
        case "kick":
            return f"{element} set to {1e6 * value:+g} µrad"
    return f"{element} {name} = {value:g}"
