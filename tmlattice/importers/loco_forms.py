"""LOCO files in other forms than the usual one, brought to it: what other versions and hands save.

The usual form is that of `importers.loco`. What cannot be determined is left as it is, and the
reader rejects it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.importers.imported import is_number, is_positive
from tmlattice.lattice.ring import LIGHT

Fields = Mapping[str, Any]

SAME_RF = 0.02
"""Share by which a frequency may differ from the one that the ring's length and harmonic make."""
TINY_STEP = 1e-9
"""Relative step of the RF that no beam would show: it is written in MHz."""
SCALARS = ("RF", "DeltaRF", "CavityFrequency", "CavityHarmNumber", "Energy")
HIGHEST_ENERGY = 250.0
"""GeV, of an electron ring; a number above it is in MeV, and above 1e5 in eV."""
LEAST_KICK = 3e-4
"""mrad; such a step moves the beam by micrometres, too little for a response."""
LEAST_NOISE = 5e-6
"""mm; no BPM has less, so it is stated in m."""
HIGHEST_M = 1e3
"""m/rad, of a response."""
USUAL_ENERGY = 3.0
"""GeV, where no file states it."""


def usual_form(content: Fields, energy: float | None = None) -> tuple[dict[str, Any], list[str]]:
    """The variables of a LOCO file in the usual form, and what was done; a sentence each. `energy`:
    GeV, that the user names."""
    said: list[str] = []
    new = dict(content)
    ring = new.get("RINGData")
    if isinstance(ring, list) and ring and _first(ring).get("Lattice") is None:
        ring = {"Lattice": ring}  # the ring itself
    if isinstance(new.get("THERING"), list) and "Lattice" not in _first(ring):
        ring = {**_first(ring), "Lattice": new["THERING"]}
        said.append("there is no RINGData.Lattice: the lattice is THERING")
    new["RINGData"] = ring
    for name in ("LocoMeasData", "BPMData", "CMData", "LocoFlags", "RINGData"):
        if isinstance(new.get(name), Mapping | list):
            new[name] = dict(_first(new[name])) or new[name]
    needed = [new.get(n) for n in ("LocoMeasData", "BPMData", "CMData", "RINGData")]
    data, monitors, correctors, _ = (own if isinstance(own, dict) else {} for own in needed)
    if not all(isinstance(own, dict) for own in needed):
        return new, said
    if isinstance(new.get("LocoFlags"), dict):
        new["LocoFlags"] = {k: v for k, v in new["LocoFlags"].items() if np.size(v)}
    for own in (data, new["RINGData"]):  # one number, repeated
        for name, value in own.items():
            many = _array(value) if name in SCALARS else None
            if many is not None and many.size and (many == many.flat[0]).all():
                own[name] = float(many.flat[0])
    _energy(new, energy, said)
    _rf(new, said)
    _monitors(monitors, said)
    _places(correctors, said)
    _good_lists(monitors, correctors, said)
    _shapes(data, monitors, correctors, said)
    _units(data, correctors, said)
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
    stated = [own.get("Energy") for own in (ring, *_elements(ring))]
    stated = [own for own in stated if is_positive(own)]
    if stated:
        if HIGHEST_ENERGY < stated[0] < 1e5:
            ring["Energy"] = 1e-3 * stated[0]
            said.append(f"the energy of {stated[0]:g} is taken in MeV")
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
    cavities.sort(key=lambda own: own.get("HarmNumber", np.inf))  # the main one first
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
        first = frequencies[0]
        if abs(1e6 * first / (harmonics[0] * turn) - 1) < SAME_RF:
            said.append(f"an RF of {first:g} Hz would be that of another ring: it is taken in MHz")
            data["RF"] = 1e6 * first
        data.setdefault("RF", first)
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


def _step(new: Fields, data: dict[str, Any], said: list[str]) -> None:
    """`DeltaRF`, in Hz."""
    fitted = _first(new.get("FitParameters")).get("DeltaRF")
    if is_number(data.get("DeltaRF")) and data["DeltaRF"] == 0:  # not stepped, or not written down
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
    said.append("BPMIndex names places twice, for x and for y: each is one BPM")


def _places(correctors: dict[str, Any], said: list[str]) -> None:
    """`HCMIndex`, `VCMIndex`: of a corrector of several elements the middle one; steps that are no
    numbers are none."""
    for letter in "HV":
        kicks = _array(correctors.get(f"{letter}CMKicks"))
        if kicks is not None and np.isnan(kicks).any():
            correctors[f"{letter}CMKicks"] = np.nan_to_num(kicks)
        index = correctors.get(f"{letter}CMIndex")
        rows = index if isinstance(index, list) else _array(index)
        if rows is None or kicks is None or (isinstance(rows, np.ndarray) and rows.ndim != 2):
            continue
        if isinstance(rows, np.ndarray) and len(rows) != kicks.size:
            rows = rows.T
        if len(rows) != kicks.size:
            continue
        rows = [np.ravel(np.asarray(row, dtype=float)) for row in rows]
        there = [row[np.isfinite(row) & (row > 0)] for row in rows]
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
            said.append("M is [correctors, BPMs] and is transposed")
        elif M.shape == (len(rows), len(columns)):
            data["M"] = np.full(shape, np.nan)
            data["M"][np.ix_(rows, columns)] = M
            said.append("M has the rows and columns of the good lists alone")
    if (M := _array(data.get("M"))) is not None and M.shape == shape:
        _unread(data, x, _count(correctors, "H", "CM"), said)
    for name in ("Eta", "BPMSTD"):
        given = _array(data.get(name))
        if given is None or given.size in (0, 1):
            continue
        if name == "BPMSTD" and given.ndim == 2 and given.shape == np.shape(data.get("M", ())):
            given = np.sqrt(np.nanmean(given**2, axis=1))
            said.append("BPMSTD is of every entry of M: the rms of each BPM is taken")
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
        elif name == "Eta" and (zeros := np.count_nonzero(given == 0)):
            said.append(f"{zeros} numbers of Eta are zero: they were not measured")
        data[name] = np.where(given == 0, np.nan, given)


def _unread(data: dict[str, Any], x: int, horizontal: int, said: list[str]) -> None:
    """NaN where all that a BPM read of one plane's correctors, or all that was read of a corrector
    in one plane, is exactly zero: no reading is."""
    M = np.array(data["M"], dtype=float)
    for rows in (slice(x), slice(x, None)):
        for columns in (slice(horizontal), slice(horizontal, None)):
            block = M[rows, columns]
            zero = block == 0
            block[zero.all(axis=1)[:, None] | zero.all(axis=0)] = np.nan
    if count := np.count_nonzero(np.isnan(M) & (np.asarray(data["M"]) == 0)):
        data["M"] = M
        said.append(
            f"{count} numbers of M are zero for a whole BPM or corrector: they were not measured"
        )


def _units(data: dict[str, Any], correctors: dict[str, Any], said: list[str]) -> None:
    """Orbits in mm and kicks in mrad, where both are in m and rad; `BPMSTD` that is a noise."""
    M, noise = _array(data.get("M")), _array(data.get("BPMSTD"))
    if M is None or not np.isfinite(M).any():
        return
    kicks = {name: _array(correctors.get(name)) for name in ("HCMKicks", "VCMKicks")}
    largest = max((np.abs(k).max(initial=0) for k in kicks.values() if k is not None), default=0)
    if 0 < largest < LEAST_KICK and np.nanmax(np.abs(M)) < HIGHEST_M * largest:
        for structure, names in ((data, ("M", "Eta", "BPMSTD")), (correctors, tuple(kicks))):
            for name in names:
                if (own := _array(structure.get(name))) is not None:
                    structure[name] = 1e3 * own
        said.append("kicks are below 1 µrad: they are taken in rad; M, Eta, BPMSTD in m")
    elif noise is not None and np.isfinite(noise).any():
        typical = np.nanmedian(noise)
        if 0 < typical < LEAST_NOISE:
            data["BPMSTD"] = 1e3 * noise
            said.append(f"a BPMSTD of {1e6 * typical:.2g} nm is that of no BPM: it is taken in m")
        elif typical > np.sqrt(np.nanmean(M**2)) / 2:
            data["BPMSTD"] = np.zeros(0)
            said.append(
                f"a BPMSTD of {typical:g} mm is as large as the response: it holds weights, and is "
                "left out"
            )


def _goods(structure: Fields, kind: str) -> Indices:
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
