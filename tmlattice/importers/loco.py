"""MATLAB LOCO files: `LocoMeasData`, `BPMData`, `CMData`, `RINGData`, `FitParameters`.

The response `M` is [monitors x then y, correctors H then V], mm, for the steps `HCMKicks`,
`VCMKicks`, mrad, from one side to the other; `Eta`, mm, for a step `DeltaRF`, Hz; `BPMSTD`, mm,
is the rms with which LOCO weighs an entry of `M`, the difference of two orbits. Indices count
from 1. Of the lists by iteration the first states what was measured; gains, kicks and couplings of
later ones are the fit's answer and are not taken.

`RINGData` is the lattice with the parameters of the fit's last iteration, and `FitParameters`
has those of every iteration: `iteration` selects which are used. A diagnosis of what LOCO fitted
would find what LOCO left: by default the model is the one before the fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.errors import MeasurementError
from tmlattice.importers.imported import (
    Imported,
    counted,
    device_names,
    gev,
    is_number,
    is_positive,
    numbers,
)
from tmlattice.importers.loco_forms import usual_form
from tmlattice.importers.matlab_ring import LETTERS, Placed, planes_by, ring_of_elements
from tmlattice.measurement import OrbitResponse
from tmlattice.measurement.orbit_response import RfStep

Fields = Mapping[str, Any]
Iteration = Literal["first", "last"]

FURTHEST = 1e9
"""No list of places goes there."""
SAME = 1e-6
"""Relative difference of the lattice's numbers and an iteration's: they are the same."""
COMPUTED = 1e-4
"""Relative difference of a dispersion and LOCO's first model's: it was computed, not measured. The
measured ones of ten rings differ by 0.04 to 1."""


def bring_loco(
    content: Fields,
    path: Path,
    iteration: Iteration = "first",
    keep_bad: bool = False,
    energy: float | None = None,
) -> Imported:
    """The measurement and the model of a LOCO file.

    Args:
        content: its variables, of `read_mat`.
        iteration: "first": the lattice with the parameters with which the fit began, the model
            before it; "last": the lattice as the file has it, which is as the fit left it.
        keep_bad: take monitors and correctors too that the good lists leave out.
        energy: GeV; None: what the file states.

    Raises:
        MeasurementError: a variable or field is missing, or shapes do not fit.
        LatticeError: the lattice cannot be made.
    """
    content, of_form = usual_form(content, energy)
    data, monitors, correctors, lattice = (
        _structure(content.get(name), f"{name} of '{path}'")
        for name in ("LocoMeasData", "BPMData", "CMData", "RINGData")
    )
    flags = content.get("LocoFlags")
    flags = flags if isinstance(flags, Mapping) else {}
    at_monitor = _index(monitors, "BPMIndex")
    every = dict.fromkeys(("HBPMIndex", "VBPMIndex"), np.arange(len(at_monitor)) + 1)
    reads = {p: _index({**every, **monitors}, f"{k}BPMIndex") for p, k in LETTERS.items()}
    kickers = {plane: _index(correctors, f"{k}CMIndex") for plane, k in LETTERS.items()}
    for plane, index in reads.items():
        if len(index) and not 0 <= index.min() <= index.max() < len(at_monitor):
            raise MeasurementError(
                f"'{path}': a BPM of plane {plane} is not among the {len(at_monitor)} of "
                "BPMIndex; correct BPMData"
            )
    elements, of_lattice, model = _elements(lattice, content.get("FitParameters"), iteration)
    kicks = planes_by((place, plane) for plane, own in kickers.items() for place in own.tolist())
    name, ring_energy = path.name.split(".")[0], _energy(lattice, elements)
    placed = ring_of_elements(elements, name, ring_energy, at_monitor.tolist(), kicks)
    lists = Lists(reads, kickers, placed)
    good, of_lists = _good(monitors, correctors, lists, keep_bad)
    measured = OrbitResponse(
        **_columns(data, correctors, lists, good),
        rf=_rf(data, lattice, lists, good),
        lattice="lattice.json",
        energy=placed.ring.energy,
        devices=_device_names(data, lists),
    )
    unkicked = sum(
        int(np.count_nonzero(_steps(correctors, letter, len(kickers[plane])) == 0))
        for plane, letter in LETTERS.items()
    )
    return Imported(
        measured,
        replace(placed.ring, model=model),
        assumed=(*conventions(flags, measured), *of_form, *of_lists, of_lattice, *placed.messages),
        doubts=(
            *_computed(data, content.get("LocoModel"), good),
            *([f"{unkicked} correctors have a step of 0 and are left out"] if unkicked else []),
        ),
    )


def _structure(value: Any, what: str) -> Fields:
    if not isinstance(value, Mapping):
        raise MeasurementError(
            f"no structure {what}; give the whole LOCO file, and a lattice of its own "
            "(.mat) with it"
        )
    return value


def _field(structure: Fields, name: str) -> Any:
    if name not in structure:
        raise MeasurementError(f"no field {name}; give the whole LOCO file")
    return structure[name]


def _counted(structure: Fields, name: str) -> Indices:
    """A list of whole numbers from 1, counted from 0."""
    index = np.atleast_1d(numbers(_field(structure, name), name))
    if index.ndim > 1:
        raise MeasurementError(
            f"{name} has the shape {list(index.shape)}; a magnet of several elements a row is not "
            "taken: name one element of each"
        )
    if not np.all((np.abs(index) < FURTHEST) & (index == np.round(index))):
        raise MeasurementError(f"{name} is no list of places; correct it in the file")
    return index.astype(np.int64) - 1


def _index(structure: Fields, name: str) -> Indices:
    """Places, each once."""
    index = _counted(structure, name)
    if len(set(index.tolist())) < len(index):
        raise MeasurementError(f"{name} is no list of different places; correct it in the file")
    return index


def _energy(lattice: Fields, elements: Sequence[Fields]) -> float:
    """GeV; LOCO has it in GeV, AT's elements in eV."""
    stated = [own["Energy"] for own in (lattice, *elements) if is_positive(own.get("Energy"))]
    if not stated:
        raise MeasurementError(
            "neither RINGData nor its elements state an energy: name it: `energy` in [lattice] of "
            "tmlattice.toml, GeV"
        )
    return gev(stated[0])


# --- the lattice ----------------------------------------------------------------------------------
def _elements(
    lattice: Fields, parameters: Any, iteration: Iteration
) -> tuple[list[dict[str, Any]], str, str]:
    """The elements with an iteration's parameters, a sentence about it, and what they are."""
    given = _field(lattice, "Lattice")
    if not isinstance(given, list) or not all(isinstance(e, Mapping) for e in given):
        raise MeasurementError("RINGData.Lattice is no list of elements; save the ring in it")
    elements = [dict(fields) for fields in given]
    steps = parameters if isinstance(parameters, list) else [parameters]
    steps = [step for step in steps if isinstance(step, Mapping)]
    as_it_is, unknown = "the model is RINGData as it stands", "lattice of the file"
    if not steps:
        return elements, as_it_is, unknown
    try:
        tables = [_settings(step) for step in steps]
        agreed = [k for k, table in enumerate(tables) if _agree(elements, table)]
        if not agreed:
            of_none = f"{as_it_is}: its numbers are those of no iteration of the fit"
            return elements, of_none, unknown
        if iteration == "last":
            return (
                elements,
                f"{as_it_is}, with the {len(tables[agreed[-1]])} parameters that LOCO fitted to "
                f"these data in {agreed[-1]} iterations (--iteration first: the model before the "
                "fit)",
                "fitted lattice",
            )
        for setting in (own for table in reversed(tables) for own in table):
            _put(elements, setting)
    except (ArithmeticError, KeyError, IndexError, TypeError, ValueError):
        return elements, f"{as_it_is}: the fit's parameters cannot be followed", unknown
    return (
        elements,
        f"the model is RINGData with the {len(tables[0])} parameters of FitParameters(1), with "
        f"which the fit began: RINGData itself has those of its iteration {agreed[-1]} "
        "(--iteration last)",
        "model before the fit",
    )


class Setting(NamedTuple):
    """A number of an element as a fit has it.

    Attributes:
        place, field: of the element.
        at: the number within the field.
        value: the number, or the whole field before the fit.
        stated: whether the number is the parameter's; else a function of it (a roll), and `value`
            is that before the fit.
    """

    place: int
    field: str
    at: int
    value: Any
    stated: bool


def _settings(step: Fields) -> list[Setting]:
    values = np.atleast_1d(np.asarray(step["Values"], dtype=float))
    groups = step["Params"]
    groups = groups if isinstance(groups, list) else [groups]
    settings: list[Setting] = []
    for group, value in zip(groups, values.tolist(), strict=True):
        for one in group if isinstance(group, list) else [group]:
            number = np.ravel(np.asarray(one["FieldIndex"], dtype=float))
            at = int(number[-1]) - 1 if len(number) else 0
            places = np.ravel(np.asarray(one["ElemIndex"], dtype=float))
            if at < 0 or not (places >= 1).all():
                raise IndexError("places and fields count from 1")
            function = one.get("Function")
            stated = not isinstance(function, Mapping) or function.get("expr", "x") == "x"
            own = str(one["FieldName"]), at, value if stated else one["SavedValue"], stated
            settings += [Setting(int(place) - 1, *own) for place in places.tolist()]
    return settings


def _agree(elements: Sequence[Fields], table: Sequence[Setting]) -> bool:
    """Whether the elements have an iteration's numbers."""
    pairs = [
        (float(np.ravel(elements[own.place][own.field])[own.at]), own.value)
        for own in table if own.stated
    ]  # fmt: skip
    return all(abs(a - b) <= SAME * max(abs(a), abs(b)) for a, b in pairs)


def _put(elements: Sequence[dict[str, Any]], setting: Setting) -> None:
    place, field, at, value, _ = setting
    old = elements[place][field]
    if isinstance(old, np.ndarray) and np.size(value) == 1:
        new = old.astype(float)
        new.ravel()[at] = value
        elements[place][field] = new
    else:
        elements[place][field] = value


# --- the measurement ------------------------------------------------------------------------------
class Lists(NamedTuple):
    """Monitors and correctors as the file lists them.

    Attributes:
        reads: places of the BPMs of each plane among the monitors of `placed`.
        kickers: places of the correctors of each plane in the lattice.
        placed: the ring, with their names.
    """

    reads: Mapping[str, Indices]
    kickers: Mapping[str, Indices]
    placed: Placed

    def monitors(self, plane: str) -> list[str]:
        """Names of the BPMs of a plane."""
        return [self.placed.monitors[k] for k in self.reads[plane]]

    def correctors(self, plane: str) -> list[str]:
        """Names of the correctors of a plane."""
        return [self.placed.correctors[place, plane] for place in self.kickers[plane].tolist()]

    @property
    def rows(self) -> int:
        """Number of BPMs of both planes."""
        return sum(map(len, self.reads.values()))


def _good(
    monitors: Fields, correctors: Fields, lists: Lists, keep_bad: bool
) -> tuple[dict[str, Flags], list[str]]:
    """Flags of the good lists by list ("x" and "y" of monitors, "H" and "V" of correctors)."""
    good, said = {}, []
    for plane, letter in LETTERS.items():
        for key, structure, every, kind, what in (
            (plane, monitors, lists.monitors(plane), "BPM", "BPMs in"),
            (letter, correctors, lists.correctors(plane), "CM", "correctors of"),
        ):
            name = f"{letter}{kind}GoodDataIndex"
            flags = np.full(len(every), name not in structure)
            if name in structure:
                there = _counted(structure, name)
                if len(there) and not 0 <= there.min() <= there.max() < len(every):
                    raise MeasurementError(
                        f"{name} counts beyond the {len(every)} of its list; correct it in the file"
                    )
                flags[there] = True
            if not flags.all():
                names = [every[k] for k in np.flatnonzero(~flags)]
                done = "kept" if keep_bad else "left out"
                said.append(f"{what} {plane} that {name} calls bad, {done}: {counted(names)}")
            good[key] = np.ones_like(flags) if keep_bad else flags
    return good, said


def _columns(
    data: Fields, correctors: Fields, lists: Lists, good: Mapping[str, Flags]
) -> dict[str, Any]:
    """Correctors, planes, kicks, monitors, response and noise of the measurement."""
    rows, columns = lists.rows, sum(map(len, lists.kickers.values()))
    M = 1e-3 * numbers(_field(data, "M"), "LocoMeasData.M", (rows, columns))
    names, planes, kicks, kept = [], [], [], []
    for plane, letter in LETTERS.items():
        own = lists.correctors(plane)
        names += own
        planes += [plane] * len(own)
        kicks += (1e-3 * _steps(correctors, letter, len(own))).tolist()
        kept += good[letter].tolist()
    response = np.stack([_spread(column, lists, good) for column in M.T])
    noise = None
    if np.size(data.get("BPMSTD", ())):
        given = 1e-3 * numbers(data["BPMSTD"], "LocoMeasData.BPMSTD")
        given = numbers(np.repeat(given, rows if given.size == 1 else 1), "BPMSTD", (rows,))
        every = {plane: np.ones_like(flags) for plane, flags in good.items()}
        noise = _spread(np.where(given > 0, given, np.nan), lists, every)
    take = np.array(kept, dtype=bool) & (np.array(kicks) != 0)
    return {
        "correctors": [n for n, t in zip(names, take, strict=True) if t],
        "planes": [p for p, t in zip(planes, take, strict=True) if t],
        "kicks": np.array(kicks)[take],
        "monitors": lists.placed.monitors,
        "response": response[take],
        "noise": noise,
    }


def _device_names(data: Fields, lists: Lists) -> dict[str, str]:
    """Names of the Middle Layer, family and device such as `HCM(1,2)`, by names of the lattice;
    lists that are missing, or of another length, are passed over."""
    pairs: list[tuple[str, str]] = []
    for names, *known in (
        (lists.monitors("x"), "HBPM", "BPMx"), (lists.monitors("y"), "VBPM", "BPMy"),
        (lists.correctors("x"), "HCM"), (lists.correctors("y"), "VCM"),
    ):  # fmt: skip
        found = (data[name] for name in known if isinstance(data.get(name), Mapping))
        own: Fields = next(found, {})
        devices = np.atleast_2d(np.asarray(own.get("DeviceList", ()), dtype=float))
        if devices.shape != (len(names), 2) or not np.isfinite(devices).all():
            continue
        family = str(own.get("FamilyName") or known[0])
        for name, (sector, number) in zip(names, devices.astype(int).tolist(), strict=True):
            pairs.append((name, f"{family}({sector},{number})"))
    return device_names(pairs)


def _steps(correctors: Fields, letter: str, count: int) -> Array:
    steps = np.ravel(numbers(_field(correctors, f"{letter}CMKicks"), f"{letter}CMKicks"))
    steps = np.repeat(steps, count) if steps.size == 1 else steps
    if len(steps) != count:
        raise MeasurementError(f"{letter}CMKicks has {len(steps)} steps, not {count}")
    return steps


def _spread(column: Array, lists: Lists, good: Mapping[str, Flags]) -> Array:
    """Readings x then y as [monitor, 2], NaN where there is none or it is bad."""
    spread = np.full((len(lists.placed.monitors), 2), np.nan)
    first = len(lists.reads["x"])
    for k, (plane, part) in enumerate((("x", column[:first]), ("y", column[first:]))):
        spread[lists.reads[plane], k] = np.where(good[plane], part, np.nan)
    return spread


def _rf(data: Fields, lattice: Fields, lists: Lists, good: Mapping[str, Flags]) -> RfStep | None:
    step, eta = data.get("DeltaRF"), np.asarray(data.get("Eta", ()))
    cavity: Fields = next((e for e in lattice["Lattice"] if is_number(e.get("HarmNumber"))), {})
    frequency = lattice.get("CavityFrequency", cavity.get("Frequency"))
    frequency = data.get("RF", frequency)
    harmonic = lattice.get("CavityHarmNumber", cavity.get("HarmNumber"))
    if not (is_number(step) and is_number(frequency) and is_number(harmonic) and eta.size):
        return None
    eta = 1e-3 * numbers(eta, "LocoMeasData.Eta", (lists.rows,))
    orbit = _spread(eta, lists, good)
    return RfStep(float(frequency), round(harmonic), float(step), orbit)


def _computed(data: Fields, models: Any, good: Mapping[str, Flags]) -> list[str]:
    """A dispersion that is LOCO's own model's."""
    first = models[0] if isinstance(models, list) and models else models
    if not isinstance(first, Mapping) or not np.size(data.get("Eta", ())):
        return []
    eta = numbers(data["Eta"], "LocoMeasData.Eta").ravel()
    model = numbers(first.get("Eta", ()), "LocoModel.Eta").ravel()
    if model.size < eta.size:  # of the monitors of the good lists
        eta = eta[np.concatenate([good["x"], good["y"]])]
    if model.size != eta.size or not np.nan_to_num(eta).any():
        return []
    apart = np.nanmax(np.abs(eta - model)) / np.nanmax(np.abs(eta))
    if apart > COMPUTED:
        return []
    return [
        f"LocoMeasData.Eta is the dispersion of LOCO's own first model to {apart:.0e}: it was "
        "computed, not measured"
    ]


def conventions(flags: Fields, measured: OrbitResponse) -> list[str]:
    """How the numbers of a LOCO file are taken; a sentence each."""
    two = "one" not in str(flags.get("ResponseMatrixMeasurement", "")).lower()
    said = [
        "M and Eta are in mm, HCMKicks and VCMKicks in mrad from one side of the step to the other",
        "steps are two-sided"
        + ("" if "ResponseMatrixMeasurement" in flags else " (no LocoFlags state it)") if two
        else "steps are one-sided, as LocoFlags states; the diagnosis takes them as two-sided",
        "the RF frequency stood still while correctors were stepped",
    ]  # fmt: skip
    if str(flags.get("ClosedOrbitType", "")).lower() == "fixedmomentum":
        said[-1] += ": LOCO's own model kept the momentum (ClosedOrbitType)"
    if measured.noise is None:
        said.append("no noise is given (BPMSTD)")
    else:
        said.append("BPMSTD is the rms of an orbit change, as LOCO weighs it")
    if measured.rf is None:
        said.append("no response to the RF's step is given (Eta, DeltaRF)")
    return said
