"""Recommendation of one method of `tune_fit`, in sentences."""

from collections.abc import Sequence

import numpy as np

from tmlattice.fitting.method_fit import MethodFit, trusted
from tmlattice.network.network import TaylorNetwork

ALIKE = 3.0
"""Joint standard errors within which two methods' tunes are the same."""


def advice(methods: Sequence[MethodFit]) -> str:
    """Return a few sentences: the recommended method, and why the others differ."""
    best = trusted(methods)
    sentences = [_recommended(methods, best)]
    for method in methods:
        if method.method != "adam" and method is not best and best is not None:
            sentences.append(_compared(method, best))
        elif method.method == "adam":
            sentences.append(_recipe(method))
    return " ".join(one for one in sentences if one)


def _recommended(methods: Sequence[MethodFit], best: MethodFit | None) -> str:
    if best is not None:
        why = f"it {_residual(best)}"
        if best.method == "map":
            return f"Trust map: {why}, most strengths nearly right and a few far off."
        if not best.named:
            return (
                f"Trust {best.method}: {why} without any changed magnet, so that no fault is seen; "
                "the effect of a smaller fault on the tunes is unknown."
            )
        who = f"Trust {best.method}: {why} with {changes(best)} alone"
        return f"{who}, and states the error of its tunes."
    others = [m for m in methods if m.method != "adam" and m.fit is not None]
    if not others:
        return "No method here is reliable: add --method sparse, which identifies magnets."
    least = min(others, key=lambda m: m.rms)
    return (
        f"Trust none: {least.method} has the smallest residual, and it {_residual(least)}, so "
        "other errors than strengths of quadrupoles and sextupoles are present, or launches and "
        "noise are misstated; `tmlattice diagnose` tests every effect with free launches."
    )


def _compared(method: MethodFit, best: MethodFit) -> str:
    if method.tunes is None:
        return f"{method.method.capitalize()} has no tunes."
    if not method.explains:
        return f"{method.method.capitalize()} {_residual(method)}."
    if best.tunes is None or best.tune_sigma is None or method.tune_sigma is None:
        return ""
    away = np.abs((method.tunes - best.tunes + 0.5) % 1.0 - 0.5)
    same = bool((away <= ALIKE * np.hypot(method.tune_sigma, best.tune_sigma)).all())
    name = method.method.capitalize()
    if same:
        return f"{name} agrees within the errors."
    return f"{name} differs by {away.max():.2g}, more than its error."


def _recipe(method: MethodFit) -> str:
    weights = free_weights(method)
    why = (
        f"The recipe (adam) cannot do it: {method.readings} readings do not determine {weights:,} "
        "free weights, nor which change is the ring's, and they have no error"
    )
    if method.chi2 is None or method.explains:
        return f"{why}."
    return f"{why}; it {_residual(method)}."


def _residual(method: MethodFit) -> str:
    """Residual of a method compared with the noise of the readings."""
    if method.explains:
        return f"leaves the readings' noise ({1e6 * method.rms:.3g} of {1e6 * method.noise:.3g} µm)"
    return f"leaves {1e6 * method.rms:.3g} µm, more than the noise of {1e6 * method.noise:.3g} µm"


def changes(method: MethodFit) -> str:
    """Return the magnets that a method identifies, each with its change and its error."""
    return ", ".join(
        f"{name} by {100 * amount:+.2f} ± {100 * error:.2f} %"
        for name, (amount, error) in method.named.items()
    )


def free_weights(method: MethodFit) -> int:
    """Return the number of weights that the recipe changed."""
    assert method.fit is not None
    network, free = method.fit.network, set(method.fit.options["free"])
    assert isinstance(network, TaylorNetwork)
    return sum(p.numel() for name, p in network.named_parameters() if name in free)
