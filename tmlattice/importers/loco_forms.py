"""LOCO files in other forms than the usual one, brought to it: what other versions and hands save.

The usual form is that of `importers.loco`. What cannot be determined is left as it is, and the
reader rejects it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.importers.imported import LIGHT, is_number, is_positive

Array = NDArray[np.float64]
Fields = Mapping[str, Any]

SAME_RF = 0.02
"""Share by which a frequency may differ from the one that the ring's length and harmonic make."""
TINY_STEP = 1e-9
"""Relative step of the RF that no beam would show: it is written in MHz."""
USUAL_ENERGY = 3.0
"""GeV, where no file states it."""


def usual_form(content: Fields, energy: float | None = None) -> tuple[dict[str, Any], list[str]]:
    """The variables of a LOCO file in the usual form, and what was done; a sentence each.

    Args:
        content: the variables, of `read_mat`.
        energy: GeV, that the user names.
    """
    said: list[str] = []
    new = dict(content)
    if not isinstance(new.get("RINGData"), Mapping | list) and isinstance(new.get("THERING"), list):
        new["RINGData"] = new["THERING"]
        said.append("there is no RINGData: the lattice is THERING")
    ring = new.get("RINGData")
    if isinstance(ring, list) and ring and _first(ring).get("Lattice") is None:
        new["RINGData"] = {"Lattice": ring}  # the ring itself
    for name in ("LocoMeasData", "BPMData", "CMData", "LocoFlags", "RINGData"):
        if isinstance(new.get(name), Mapping | list):
            new[name] = dict(_first(new[name])) or new[name]
    needed = [new.get(n) for n in ("LocoMeasData", "BPMData", "CMData", "RINGData")]
    data, monitors, correctors, _ = (own if isinstance(own, dict) else {} for own in needed)
    if not all(isinstance(own, dict) for own in needed):
        return new, said
    if isinstance(new.get("LocoFlags"), dict):
        new["LocoFlags"] = {k: v for k, v in new["LocoFlags"].items() if np.size(v)}
    _energy(new, energy, said)
    _rf(new, said)
    _monitors(monitors, said)
    _places(correctors, said)
    _good_lists(monitors, correctors, said)
    _shapes(data, monitors, correctors, said)
    return new, said


def _first(value: Any) -> Fields:
    """A structure, or the first of a list by iteration; an empty one where there is none."""
    value = value[0] if isinstance(value, list) and value else value
    return value if isinstance(value, Mapping) else {}


def _elements(ring: Fields) -> list[dict[str, Any]]:
    given = ring.get("Lattice")
    return [e for e in given if isinstance(e, dict)] if isinstance(given, list) else []


def _energy(new: dict[str, Any], energy: float | None, said: list[str]) -> None:
    """`Energy` of RINGData: as the user names it, else what AT 1 has it from."""
    ring = new["RINGData"]
    if energy is not None:
        ring["Energy"] = energy
        return
    if any(is_positive(own.get("Energy")) for own in (ring, *_elements(ring))):
        return
    others = [own.get("E0") for own in (_first(new.get("GLOBVAL")), *_elements(ring))]
    found = next((own for own in others if is_positive(own)), None)
    if found is not None:
        ring["Energy"] = found
        said.append("the energy is E0, of GLOBVAL or of the lattice's elements")
        return
    ring["Energy"] = USUAL_ENERGY
    said.append(
        f"no energy is stated: {USUAL_ENERGY:g} GeV is assumed, for the closed orbits of electrons "
        "hardly depend on it (`energy` in [lattice] of tmlattice.toml names it)"
    )


# --- the RF ---------------------------------------------------------------------------------------
def _rf(new: dict[str, Any], said: list[str]) -> None:
    """Frequency, harmonic and step where they are missing; cavities that can be made."""
    data, ring = new["LocoMeasData"], new["RINGData"]
    elements = _elements(ring)
    lengths = [e.get("Length", 0.0) for e in elements]
    if not elements or not all(is_number(own) for own in lengths) or not sum(lengths) > 0:
        return
    turn = LIGHT / sum(lengths)
    cavities = [e for e in elements if _is_cavity(e)]
    for own, names in (
        (data, ("RF",)), (ring, ("CavityFrequency", "CavityHarmNumber")),
        *((cavity, ("Frequency", "HarmNumber")) for cavity in cavities),
    ):  # fmt: skip
        for name in names:  # an empty one, NaN or 0 states nothing
            if not is_positive(own.get(name)):
                own.pop(name, None)
    stated = (data.get("RF"), ring.get("CavityFrequency"), *(e.get("Frequency") for e in cavities))
    frequencies = [own for own in stated if own is not None]
    stated = (ring.get("CavityHarmNumber"), *(e.get("HarmNumber") for e in cavities))
    harmonics = [own for own in stated if own is not None]
    if not harmonics and frequencies and frequencies[0] > turn / 2:
        harmonics = [round(frequencies[0] / turn)]
        said.append(f"no harmonic is given: {harmonics[0]}, by the frequency and the length")
    if not frequencies and harmonics:
        frequencies = [harmonics[0] * turn]
        said.append(f"no frequency is given: {frequencies[0]:.9g} Hz, by harmonic and length")
    if harmonics and frequencies:
        _frequency(data, frequencies, harmonics[0] * turn, said)
        ring.setdefault("CavityHarmNumber", harmonics[0])
    for cavity in cavities:
        if harmonics and frequencies:
            cavity.setdefault("Frequency", frequencies[0])
            cavity.setdefault("HarmNumber", harmonics[0])
            if not is_number(cavity.get("Voltage")):
                cavity["Voltage"] = 0.0
        else:  # no cavity can be made of it, and an orbit at a fixed frequency needs none
            cavity["PassMethod"] = "DriftPass" if cavity.get("Length") else "IdentityPass"
            for name in ("Class", "Frequency", "HarmNumber", "Voltage"):
                cavity.pop(name, None)
    _step(new, data, said)


def _is_cavity(element: Fields) -> bool:
    known = any(is_number(element.get(name)) for name in ("Frequency", "HarmNumber", "Voltage"))
    by_method = "Cavity" in str(element.get("PassMethod"))
    return known or by_method or element.get("Class") == "RFCavity"


def _frequency(
    data: dict[str, Any], given: Sequence[float], expected: float, said: list[str]
) -> None:
    """`RF` in Hz."""
    if abs(1e6 * given[0] / expected - 1) < SAME_RF:
        said.append(f"an RF of {given[0]:g} Hz would be that of another ring: it is taken in MHz")
        data["RF"] = 1e6 * given[0]
    data.setdefault("RF", given[0])


def _step(new: Fields, data: dict[str, Any], said: list[str]) -> None:
    """`DeltaRF`, in Hz."""
    fitted = _first(new.get("FitParameters")).get("DeltaRF")
    if data.get("DeltaRF") == 0:  # not stepped, or not written down
        del data["DeltaRF"]
    if not is_number(data.get("DeltaRF")) and is_number(fitted) and np.size(data.get("Eta", ())):
        data["DeltaRF"] = fitted
        said.append(f"the RF's step is that of FitParameters, {fitted:g} Hz")
    step, frequency = data.get("DeltaRF"), data.get("RF")
    if is_number(step) and is_number(frequency) and 0 < abs(step) < TINY_STEP * frequency:
        data["DeltaRF"] = 1e6 * step
        said.append(f"an RF step of {step:g} Hz would move no beam: it is taken in MHz")


# --- places and good lists ------------------------------------------------------------------------
def _monitors(monitors: dict[str, Any], said: list[str]) -> None:
    """`BPMIndex` with each place once, and `HBPMIndex` and `VBPMIndex` that count in it."""
    index = _array(monitors.get("BPMIndex"))
    if index is None or index.ndim != 1:
        return
    places, first, number = np.unique(index, return_index=True, return_inverse=True)
    if len(places) == len(index):
        return
    order = np.argsort(first)  # as in the list
    number = np.argsort(order)[number]
    for name in ("HBPMIndex", "VBPMIndex"):
        own = _array(monitors.get(name))
        if own is None or own.ndim != 1 or not np.isin(own, np.arange(len(index)) + 1).all():
            return  # for the reader to refuse
        monitors[name] = number[own.astype(np.int64) - 1] + 1.0
    monitors["BPMIndex"] = places[order]
    said.append("BPMIndex names places twice, for x and for y: each is one monitor")


def _places(correctors: dict[str, Any], said: list[str]) -> None:
    """`HCMIndex`, `VCMIndex`: of a corrector of several elements the middle one; steps that are no
    numbers are none."""
    for letter in "HV":
        kicks = _array(correctors.get(f"{letter}CMKicks"))
        if kicks is not None and np.isnan(kicks).any():
            correctors[f"{letter}CMKicks"] = np.nan_to_num(kicks)
        index = _array(correctors.get(f"{letter}CMIndex"))
        if index is None or index.ndim != 2 or kicks is None:
            continue
        if index.shape[0] != kicks.size and index.shape[1] == kicks.size:
            index = index.T
        if index.shape[0] != kicks.size:
            continue
        there = [row[np.isfinite(row) & (row > 0)] for row in index]
        if all(len(row) for row in there):
            correctors[f"{letter}CMIndex"] = np.array([row[len(row) // 2] for row in there])
            said.append(f"of {letter}CMIndex, of several elements a corrector, the middle is taken")


def _good_lists(monitors: dict[str, Any], correctors: dict[str, Any], said: list[str]) -> None:
    """Lists of places: an empty one selects all, flags are distinguished from places."""
    for structure, kind in ((monitors, "BPM"), (correctors, "CM")):
        for letter in "HV":
            name = f"{letter}{kind}GoodDataIndex"
            good, count = _array(structure.get(name)), _count(structure, letter, kind)
            if good is None or not count:
                continue
            if not good.size:
                del structure[name]
                said.append(f"{name} is empty: all are taken")
            elif good.size == count > 1 and np.isin(good, (0, 1)).all():
                structure[name] = np.flatnonzero(good) + 1.0


def _count(structure: Fields, letter: str, kind: str) -> int:
    own = structure.get(f"{letter}{kind}Index", structure.get(f"{kind}Index", ()))
    return int(np.size(own))


# --- shapes ---------------------------------------------------------------------------------------
def _shapes(data: dict[str, Any], monitors: Fields, correctors: Fields, said: list[str]) -> None:
    """`M`, `Eta` and `BPMSTD` of all monitors, x then y, in one row."""
    x, y = (_count(monitors, letter, "BPM") for letter in "HV")
    shape = x + y, sum(_count(correctors, letter, "CM") for letter in "HV")
    rows, columns = _goods(monitors, "BPM"), _goods(correctors, "CM")
    M = _array(data.get("M"))
    if M is not None and M.ndim == 2 and M.shape != shape:
        if M.shape == shape[::-1]:
            data["M"] = M.T
            said.append("M stands as [correctors, monitors] and is turned")
        elif M.shape == (len(rows), len(columns)):
            data["M"] = np.full(shape, np.nan)
            data["M"][np.ix_(rows, columns)] = M
            said.append("M has the rows and columns of the good lists alone")
    for name in ("Eta", "BPMSTD"):
        given = _array(data.get(name))
        if given is None or given.size in (0, 1):
            continue
        if name == "BPMSTD" and given.ndim == 2 and given.shape == np.shape(data.get("M", ())):
            given = np.sqrt(np.nanmean(given**2, axis=1))
            said.append("BPMSTD is of every entry of M: the rms of each monitor is taken")
        given = given.ravel(order="F" if given.shape != (2, x) else "C")  # x, then y
        if given.size == len(rows) < x + y:
            every = np.full(x + y, np.nan)
            every[rows] = given
            given = every
        elif given.size == x < x + y:
            given = np.append(given, np.full(y, np.nan))
            said.append(f"{name} is that of x alone")
        if given.size != x + y:
            said.append(f"{name} has {given.size} numbers, not {x + y}, and is left out")
            given = np.zeros(0)
        elif not np.nan_to_num(given).any():
            said.append(f"{name} is zero everywhere, and is left out")
            given = np.zeros(0)
        data[name] = given


def _goods(structure: Fields, kind: str) -> NDArray[np.int64]:
    """Places of the good ones among those of both planes."""
    places, first = [], 0
    for letter in "HV":
        count = _count(structure, letter, kind)
        good = _array(structure.get(f"{letter}{kind}GoodDataIndex"))
        own = np.arange(count) if good is None else good.ravel() - 1
        places.append(first + own[(own >= 0) & (own < count)].astype(np.int64))
        first += count
    return np.concatenate(places)


def _array(value: Any) -> Array | None:
    """As numbers, if it is some."""
    try:
        array = np.atleast_1d(np.asarray(value))
        return (
            array.astype(float) if array.dtype.kind in "fiub" or isinstance(value, list) else None
        )
    except (TypeError, ValueError):
        return None
