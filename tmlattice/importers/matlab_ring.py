"""A ring out of the MATLAB structures of AT's elements, with monitors and correctors as a
measurement has them.

A measurement names elements by their place in the lattice. What stands there becomes a monitor or a
corrector whatever its class, and keeps its name:

- a corrector of one plane stays one element;
- where one place kicks in both planes, all of its family become two thin correctors in the middle
  of it, `name_h` and `name_v`: to first order a thick corrector is no other;
- a corrector that the measurement does not use is of the planes of its family;
- a magnet that kicks (a corrector inside a sextupole) becomes two halves, `name` and `name_2`, with
  the thin correctors in its middle;
- where a monitor's place is a magnet or a corrector, the orbit at its entrance is meant: a monitor,
  `name_bpm`, stands before it.
"""

import warnings
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tmlattice.errors import LatticeError
from tmlattice.importers.at_element import at_element
from tmlattice.importers.imported import gev, is_positive
from tmlattice.lattice import Ring
from tmlattice.lattice.at_file import passes_freely, ring_from_at
from tmlattice.lattice.checks import check_ring
from tmlattice.lattice.mat_file import lattice_in
from tmlattice.lattice.ring import number_names

LETTERS = {"x": "H", "y": "V"}
"""Of the planes, in names of MAD and LOCO."""


@dataclass(frozen=True)
class Elements:
    """A lattice as AT's elements, before anything of it is a monitor or a corrector.

    Attributes:
        name: of the ring.
        fields: of each element, in beam order.
        energy: GeV.
        harmonic: number, and frequency, Hz, of the RF where the lattice states it.
        frequency: Hz.
    """

    name: str
    fields: list[dict[str, Any]]
    energy: float
    harmonic: int | None = None
    frequency: float | None = None


def elements_of(
    content: Mapping[str, Any],
    path: Path,
    sequence: str | None = None,
    energy: float | None = None,
) -> Elements:
    """The lattice among a MATLAB file's variables.

    Args:
        sequence: the variable, where several are lattices.
        energy: GeV; None: what the elements state.

    Raises:
        LatticeError: none is one, or more than one are, or no energy is stated.
    """
    elements = content[lattice_in(content, path, sequence)]
    fields = [dict(e) for e in elements if str(e.get("Class", "")).lower() != "ringparam"]
    stated = [e["Energy"] for e in elements if is_positive(e.get("Energy"))]
    if energy is None and not stated:
        raise LatticeError(f"the lattice of '{path}' states no energy; name it: --energy, in GeV")
    cavities = [
        e for e in fields if is_positive(e.get("Frequency")) and is_positive(e.get("HarmNumber"))
    ]
    main = min(cavities, key=lambda e: e["Frequency"], default=None)
    return Elements(
        name=path.name.split(".")[0],
        fields=fields,
        energy=gev(stated[0]) if energy is None else energy,
        harmonic=None if main is None else round(main["HarmNumber"]),
        frequency=None if main is None else float(main["Frequency"]),
    )


@dataclass(frozen=True)
class Placed:
    """A ring and the names of the places that a measurement knows.

    Attributes:
        ring: the model.
        monitors: names of the monitors, in the order of their places.
        correctors: names by place and plane.
        messages: what was done to the lattice; sentences.
    """

    ring: Ring
    monitors: tuple[str, ...]
    correctors: Mapping[tuple[int, str], str]
    messages: tuple[str, ...]


Key = TypeVar("Key", int, str)


def planes_by(pairs: Iterable[tuple[Key, str]]) -> dict[Key, frozenset[str]]:
    """The planes of each place, or family, of pairs with one plane."""
    planes: dict[Key, frozenset[str]] = {}
    for key, plane in pairs:
        planes[key] = planes.get(key, frozenset()) | {plane}
    return planes


def ring_of_elements(
    elements: Sequence[Mapping[str, Any]],
    name: str,
    energy: float,
    monitors: Sequence[int],
    kicks: Mapping[int, frozenset[str]],
    own_names: Mapping[tuple[int, str], str] | None = None,
) -> Placed:
    """The ring of AT's elements as structures.

    Args:
        elements: the fields of each, in beam order; energy: GeV.
        monitors: their places, from 0.
        kicks: planes in which a place kicks.
        own_names: of thin correctors, by place and plane, where they have names of their own.

    Raises:
        LatticeError: an element that AT cannot make, or a place that is not there.
    """
    import at

    places = [*monitors, *kicks]
    if not elements:
        raise LatticeError("the lattice has no elements; nothing can be compared with it")
    if places and not (min(places) >= 0 and max(places) < len(elements)):
        wrong = max(places) if max(places) >= len(elements) else min(places)
        raise LatticeError(
            f"place {wrong + 1} is beyond the lattice's {len(elements)} elements; the file's "
            "lattice is not that of its measurement"
        )
    messages: Counter[str] = Counter()
    with warnings.catch_warnings():  # AT's own, of what it finds in old files
        warnings.simplefilter("ignore")
        made = [at_element(fields, i, energy, messages) for i, fields in enumerate(elements)]
    of_family = planes_by(
        (_family(made[i]), plane)
        for i, own in kicks.items()
        if isinstance(made[i], at.Corrector)
        for plane in own
    )
    sequence: list[Any] = []
    where: dict[tuple[int, str], int] = {}  # (place, "" or plane) -> in the sequence
    for i, element in enumerate(made):
        planes = kicks.get(i, frozenset())
        parts = _parts(element, planes, of_family, messages)
        if i in monitors:
            parts = _read(element, parts)
            where[i, ""] = len(sequence)
        for k, part in enumerate(parts):
            if plane := getattr(part, "Plane", ""):
                where[i, plane] = len(sequence) + k
                part.FamName = (own_names or {}).get((i, plane), part.FamName)
        sequence += parts
    lattice = at.Lattice(sequence, name=name, energy=energy * 1e9, periodicity=1)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            ring = ring_from_at(lattice, name, energy)
            check_ring(ring)
        except (ArithmeticError, AttributeError, IndexError, TypeError, ValueError) as error:
            raise LatticeError(f"the lattice cannot be taken over ({error}); correct it") from error
    names = _names(ring, [_family(element) for element in sequence], where.values())
    return Placed(
        ring=ring,
        monitors=tuple(names[where[i, ""]] for i in monitors),
        correctors={
            (i, plane): names[where[i, plane]] for i, planes in kicks.items() for plane in planes
        },
        messages=(
            *(f"{what} ({count})" for what, count in messages.items()),
            *(str(warning.message) for warning in told),
        ),
    )


def _names(ring: Ring, families: Sequence[str], places: Collection[int]) -> dict[int, str]:
    """Names in the ring of places in the sequence that it was made of: of each family the first is
    the first, whatever became of other families (slices of a wiggler are merged)."""
    there = Counter(element.family for element in ring.elements)
    here = Counter(families)
    names = number_names(families)
    for family in (families[place] for place in places):
        if there[family] != here[family]:
            raise LatticeError(
                f"'{family}' of the lattice is a BPM or corrector here and a wiggler's slice "
                "there; give them names of their own"
            )
    return {place: names[place] for place in places}


def _family(element: Any) -> str:
    return str(element.FamName).strip().lower()


def _kicker(family: str, length: float, plane: str) -> Any:
    import at

    mad = f"{LETTERS[plane]}KICKER"
    return at.Corrector(family, length, [0.0, 0.0], MADType=mad, Plane=plane)


def _thin(element: Any, planes: Iterable[str]) -> list[Any]:
    family = _family(element)
    return [_kicker(f"{family}_{LETTERS[p].lower()}", 0.0, p) for p in sorted(planes)]


def _parts(
    element: Any,
    planes: frozenset[str],
    of_family: Mapping[str, frozenset[str]],
    messages: Counter[str],
) -> list[Any]:
    """An element as it kicks."""
    import at

    if isinstance(element, at.Corrector):
        if np.any(np.asarray(element.KickAngle, dtype=float)):
            messages["kicks of correctors in the lattice are taken as 0"] += 1
        return _corrector(element, of_family.get(_family(element), frozenset()))
    if planes:
        messages["magnets that kick stand as two halves with thin correctors between"] += 1
        return _magnet(element, planes)
    return [element]


def _read(element: Any, parts: list[Any]) -> list[Any]:
    """With a monitor: what only fills the place becomes one, others have it before them."""
    import at

    fills = isinstance(element, at.Monitor | at.Marker | at.Drift)
    if fills and passes_freely(element) and parts == [element]:
        return [at.Monitor(_family(element), Length=float(getattr(element, "Length", 0.0)))]
    return [at.Monitor(f"{_family(element)}_bpm"), *parts]


def _corrector(element: Any, planes: frozenset[str]) -> list[Any]:
    import at

    length = float(element.Length)
    if not planes:
        return [at.Corrector(_family(element), length, [0.0, 0.0])]
    if len(planes) == 1:
        (plane,) = planes
        return [_kicker(_family(element), length, plane)]
    way = [at.Drift("drift", length / 2)] if length else []
    return [*way, *_thin(element, planes), *way]


def _magnet(element: Any, planes: frozenset[str]) -> list[Any]:
    """A magnet with thin correctors in its middle."""
    thin = _thin(element, planes)
    long = float(getattr(element, "Length", 0.0)) != 0
    halves = element.divide([0.5, 0.5]) if long else [element]
    if len(halves) == 1:  # also where AT cannot divide it
        return [element, *thin]
    first, second = halves
    second.FamName = f"{_family(element)}_2"
    return [first, *thin, second]
