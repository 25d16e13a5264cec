"""A ring: named elements in beam order, each with the OCELOT object that it stands for."""

import json
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, Literal, TypeVar, get_args

from tmlattice.errors import LatticeError, first_of, unknown_name
from tmlattice.late import Method
from tmlattice.lattice.slices import Supplies, alike_by_design, slices_of
from tmlattice.speaks import Speaks, last_part

Kind = Literal[
    "drift",
    "quadrupole",
    "bend",
    "hcorrector",
    "vcorrector",
    "sextupole",
    "octupole",
    "multipole",
    "solenoid",
    "wiggler",
    "monitor",
    "marker",
    "cavity",
    "matrix",
]

PASSIVE: frozenset[str] = frozenset({"drift", "monitor", "marker", "cavity"})
"""Kinds that are no magnets: they belong to the way between two magnets."""


Made = TypeVar("Made")

Slopes = tuple[float, ...]
"""Of a thin kick: (d px / dx, d px / dy, d py / dx, d py / dy), 1/m."""


@dataclass(frozen=True)
class Errors:
    """How one magnet differs from its design, beyond its strengths: what OCELOT has no name for.

    The maps feel them in this order: the way to where the field is; the entrance kick; the shift
    and the turn of the body, inside which the kicks and the loss sit at its middle; all of it back.

    Attributes:
        dx, dy: offset of the magnet's centre, m.
        ds: of its field along the beam, m; positive further down. Its neighbours stay.
        roll: about the beam axis, rad; positive turns x towards y.
        kick_x, kick_y: px and py gain these at the middle, rad; in a bend they are spread over it.
        k1l, k1sl: thin quadrupole at the middle: px -= k1l x, py += k1l y; thin skew quadrupole:
            px += k1sl y, py += k1sl x; 1/m.
        entrance_k1l: thin quadrupole at the entrance, 1/m.
        loss: relative energy loss at the middle (six coordinates only).
        entrance, middle: any other thin kicks there that are linear in the beam's place.
    """

    dx: float = 0.0
    dy: float = 0.0
    ds: float = 0.0
    roll: float = 0.0
    kick_x: float = 0.0
    kick_y: float = 0.0
    k1l: float = 0.0
    k1sl: float = 0.0
    entrance_k1l: float = 0.0
    loss: float = 0.0
    entrance: Slopes = (0.0, 0.0, 0.0, 0.0)
    middle: Slopes = (0.0, 0.0, 0.0, 0.0)

    def plus(self, **amounts: float | Slopes) -> "Errors":
        """These errors and more of the named ones."""
        return _copy(self, **{n: summed(getattr(self, n), a) for n, a in amounts.items()})


def _copy(one: Made, **changed: Any) -> Made:
    """`replace` without its checks, which take longer than the rest: each round of a fit sets the
    errors of thousands of elements."""
    other = object.__new__(type(one))
    vars(other).update(vars(one), **changed)
    return other


def summed(old: Any, more: Any) -> Any:
    """The sum of two amounts of an error, or of each of its slopes."""
    if isinstance(old, tuple):
        return tuple(a + b for a, b in zip(old, more, strict=True))
    return old + more


NO_ERRORS = Errors()


@dataclass(frozen=True)
class Source:
    """What an OCELOT element is, as data; the element itself is made when it is asked for.

    Attributes:
        text: JSON of its class and of those numbers that are not the class's defaults.
    """

    text: str

    @cached_property
    def element(self) -> Any:
        """The OCELOT element; one object, as long as this lives."""
        from tmlattice.lattice.source import source_of

        return source_of(*json.loads(self.text))


PHYSICS = "_physics"
"""Of an element: a key of its source's numbers, remembered by the maps with the element."""


@dataclass(frozen=True)
class Element:
    """One place in the ring.

    Attributes:
        name: unique in the ring; `family::k` where the family stands there more than once.
        family: the name without its number: the magnets that share it share a power supply.
        kind: what it is, see `Kind`.
        s: position of its middle from the start of the sequence, m.
        length: m.
        k1, k2: normal quadrupole and sextupole strength, 1/m2 and 1/m3 (0 where it has none).
        angle: bend angle, or the kick of a corrector, rad.
        tilt: rotation about the beam axis, rad.
        source: the OCELOT element; shared by all places of one object, so never change it
            (`changed` copies).
        errors: how it differs from what `source` can express.
    """

    name: str
    family: str
    kind: Kind
    s: float
    length: float
    k1: float
    k2: float
    angle: float
    tilt: float
    source: Any = field(repr=False, compare=False)
    errors: Errors = NO_ERRORS

    @property
    def data(self) -> Source | None:
        """The source as data, where it was read as such: equal for elements with equal maps."""
        source = self.__dict__["source"]
        return source if isinstance(source, Source) else None

    @property
    def is_magnet(self) -> bool:
        """True for everything that is not a drift, a monitor, a marker or a cavity."""
        return self.kind not in PASSIVE

    @property
    def is_corrector(self) -> bool:
        """Whether it kicks the beam, in either plane."""
        return self.kind in ("hcorrector", "vcorrector")

    @property
    def bending(self) -> float:
        """The angle by which the design orbit turns here, rad; a corrector's kick is no such."""
        return self.angle if self.kind in ("bend", "multipole") else 0.0

    def changed(self, **attributes: float) -> "Element":
        """A copy with other strengths; this one, and others of its family, stay as they are.

        Args:
            attributes: OCELOT's names and units: k1=, k2=, angle=, tilt=, ...

        Raises:
            LatticeError: it has no such attribute, or its length would change.
        """
        from tmlattice.lattice.source import copied

        source = copied(self.source)  # the object may stand in many places
        for attribute, amount in attributes.items():
            if attribute == "l" or not hasattr(source, attribute):
                raise LatticeError(
                    f"'{attribute}' of {self.kind} '{self.name}' cannot be changed; "
                    "strengths and angles can (k1, k2, angle, tilt)"
                )
            setattr(source, attribute, amount)
        known: dict[str, Any] = {
            k: v for k, v in attributes.items() if k in ("k1", "k2", "angle", "tilt")
        }
        other = _copy(self, source=source, **known)
        vars(other).pop(PHYSICS, None)
        return other

    def with_errors(self, **amounts: float | Slopes) -> "Element":
        """A copy with these amounts added to its `errors`."""
        return _copy(self, errors=self.errors.plus(**amounts))


class _Made:
    """The field `source`: an element that was read as data asks OCELOT when it is first used."""

    def __get__(self, element: Element | None, owner: type) -> Any:
        if element is None:
            return self
        source = element.__dict__["source"]
        return source.element if isinstance(source, Source) else source

    def __set__(self, element: Element, source: Any) -> None:
        element.__dict__["source"] = source


Element.source = _Made()


ELECTRON_GEV = 0.51099895069e-3
PROTON_GEV = 0.93827208943
"""Rest energies, GeV. Source: CODATA 2022."""
PARTICLES = {"electron": ELECTRON_GEV, "proton": PROTON_GEV}
LIGHT = 299792458.0
"""Velocity of light, m/s."""


@dataclass(frozen=True, repr=False)
class Ring(Speaks):
    """Elements in beam order, and the beam: its energy and its particle's mass.

    Attributes:
        name: the name or the path that it was loaded by.
        elements: in beam order from the start of the sequence.
        energy: of a particle, rest energy included, GeV.
        changes: what was changed since it was loaded, by element name.
        mass: rest energy of a particle, GeV; an electron's unless the lattice states another.
        known_supplies: those of the design that this ring was changed from; None: it is one.
        model: what the lattice is of the machine, as reports call it: "design", or what its file
            states ("fitted lattice", "model before the fit").
    """

    name: str
    elements: tuple[Element, ...]
    energy: float
    changes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mass: float = ELECTRON_GEV
    known_supplies: Supplies | None = field(default=None, compare=False)
    model: str = field(default="design", compare=False)

    plot = Method(
        "tmlattice.plots.speaking",
        "plot_ring",
        "Draw its betas and its magnets: a matplotlib Figure; span=(from, to) in m for a part.",
    )

    to_at = Method("tmlattice.lattice.write", "to_at", "Return it as an `at.Lattice`.")
    to_ocelot = Method(
        "tmlattice.lattice.write", "to_ocelot", "Return it as OCELOT's `MagneticLattice`."
    )
    to_xtrack = Method("tmlattice.lattice.write", "to_xtrack", "Return it as an `xtrack.Line`.")
    to_madx = Method("tmlattice.lattice.write", "to_madx", "Return it as the text of a sequence.")
    to_dataframe = Method(
        "tmlattice.lattice.write", "to_dataframe", "Return a pandas DataFrame, a row an element."
    )
    twiss = Method("tmlattice.optics", "twiss", "Return its optical functions: a `Twiss`.")

    def _told(self) -> tuple[str, dict[str, str]]:
        correctors = sum(e.is_corrector for e in self.elements)
        return last_part(self.name), {
            "length": f"{self.length:.3f} m",
            "energy": f"{self.energy:g} GeV",
            "magnets": str(len(self.magnets)),
            "monitors": str(len(self.monitors)),
            "correctors": str(correctors),
            "changed": first_of(list(self.changes), 3),
            "model": self.model,
        }

    def __post_init__(self) -> None:
        if not self.energy > self.mass > 0:
            raise LatticeError(
                f"'{self.name}' has the energy {self.energy:g} GeV, which is not above its "
                f"particle's rest energy of {self.mass:g} GeV; give energy= (GeV)"
            )

    @property
    def gamma(self) -> float:
        """Energy over rest energy."""
        return self.energy / self.mass

    @property
    def beta(self) -> float:
        """Velocity over that of light."""
        return math.sqrt(1 - 1 / self.gamma**2)

    @property
    def radiates(self) -> bool:
        """Whether its particles are light enough to lose energy in bends."""
        return self.mass < 2 * ELECTRON_GEV

    @property
    def map_energy(self) -> float:
        """GeV; the energy that OCELOT receives: that of an electron that is as fast. Maps of given
        normalised strengths depend on the velocity alone."""
        return self.energy * (ELECTRON_GEV / self.mass)

    @cached_property
    def memory(self) -> dict[Any, Any]:
        """What was worked out for this ring and is worth keeping as long as it lives: its maps."""
        return {}

    def remembered(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """What `make` returns, worked out once for this ring."""
        if key not in self.memory:
            self.memory[key] = make()
        found: Made = self.memory[key]
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Only the fields travel: what is worked out from them can be worked out again."""
        return {own.name: self.__dict__[own.name] for own in fields(self)}

    @cached_property
    def length(self) -> float:
        """Circumference, m."""
        return sum(element.length for element in self.elements)

    @cached_property
    def monitors(self) -> tuple[Element, ...]:
        """The beam position monitors in beam order."""
        return tuple(e for e in self.elements if e.kind == "monitor")

    @cached_property
    def magnets(self) -> tuple[Element, ...]:
        """The magnets in beam order: one layer of the network each."""
        return tuple(e for e in self.elements if e.is_magnet)

    @cached_property
    def _index(self) -> dict[str, int]:
        index = {element.name.casefold(): i for i, element in enumerate(self.elements)}
        for i, element in enumerate(self.elements):  # a name that stands once is also name::0
            index.setdefault(f"{element.name.casefold()}::0", i)
        return index

    def index(self, name: str) -> int:
        """Place of the element of this name in `elements`; case does not matter.

        Raises:
            UnknownNameError: with the nearest names.
        """
        try:
            return self._index[name.strip().casefold()]
        except KeyError:
            raise unknown_name("element", name, (e.name for e in self.elements)) from None

    def __getitem__(self, name: str | int) -> Element:
        """The element of a name (case does not matter) or a place in `elements`; of a pattern with
        *, ? or [...], such as "qd*", the list of all elements whose name or family matches (typed
        as one element, which is what nearly every name means).

        Raises:
            UnknownNameError: with the nearest names.
            IndexError: a place behind the last.
        """
        if not isinstance(name, str):
            return self.elements[name]
        if name.strip().casefold() in self._index or not any(c in name for c in "*?["):
            return self.elements[self.index(name)]
        return self.matching(name, "element")  # type: ignore[return-value]

    def matching(self, pattern: str, what: str) -> list[Element]:
        """The elements whose name or family a pattern matches; `what` they are, for the error.

        Raises:
            UnknownNameError: none is.
        """
        low = pattern.strip().casefold()
        found = [
            e for e in self.elements
            if fnmatchcase(e.name.casefold(), low) or fnmatchcase(e.family.casefold(), low)
        ]  # fmt: skip
        if not found:
            families = dict.fromkeys(e.family for e in self.elements)
            raise unknown_name(f"{what} like", pattern, families)
        return found

    def __contains__(self, name: object) -> bool:
        """Whether it has an element of this name."""
        return isinstance(name, str) and name.strip().casefold() in self._index

    def __iter__(self) -> Iterator[Element]:
        """Its elements in beam order."""
        return iter(self.elements)

    def __len__(self) -> int:
        """Number of elements."""
        return len(self.elements)

    def __bool__(self) -> bool:
        """True, as of all objects: a ring is there, however many elements it has."""
        return True

    @cached_property
    def slices(self) -> dict[int, tuple[int, ...]]:
        """Magnets that stand in pieces: the place of the longest, and those of all; see
        `lattice.slices`."""
        return slices_of(self.elements)

    @cached_property
    def whole(self) -> dict[int, tuple[int, ...]]:
        """Of each piece of a magnet the places of all its pieces."""
        return {i: pieces for pieces in self.slices.values() for i in pieces}

    @cached_property
    def supplies(self) -> Supplies:
        """Quadrupoles that share no name with others and are alike in the design, see
        `lattice.slices`."""
        if self.known_supplies is not None:
            return self.known_supplies
        return alike_by_design(self.elements, self.whole)

    def pieces(self, name: str) -> tuple[str, ...]:
        """Names of all pieces of the magnet that an element is a piece of; else its own.

        Raises:
            UnknownNameError: no such element.
        """
        place = self.index(name)
        return tuple(self.elements[i].name for i in self.whole.get(place, (place,)))

    def counts(self) -> dict[str, int]:
        """Number of elements by kind."""
        return dict(Counter(element.kind for element in self.elements))

    def with_changed(self, name: str, **attributes: float) -> "Ring":
        """A new ring in which one element has other attributes; this one stays as it is.

        Args:
            name: the element.
            attributes: OCELOT's names and units: k1=, k2=, angle=, tilt=, ...

        Raises:
            UnknownNameError: no such element.
            LatticeError: the element has no such attribute, or its length would change.
        """
        place = self.index(name)
        old = self.elements[place]
        changed = {**self.changes, old.name: {**self.changes.get(old.name, {}), **attributes}}
        return replace(self.with_elements({place: old.changed(**attributes)}), changes=changed)

    def with_elements(self, elements: Mapping[int, Element]) -> "Ring":
        """A new ring with other elements at these places of `elements`."""
        new = list(self.elements)
        for place, element in elements.items():
            new[place] = element
        return replace(self, elements=tuple(new), known_supplies=self.supplies)


def number_names(names: Iterable[str]) -> list[str]:
    """Names made unique: one that stands more than once becomes name::0, name::1, ... in order.

    Names that differ only in case are the same name.
    """
    names = list(names)
    total = Counter(name.casefold() for name in names)
    seen: Counter[str] = Counter()
    numbered = []
    for name in names:
        key = name.casefold()
        numbered.append(f"{name}::{seen[key]}" if total[key] > 1 else name)
        seen[key] += 1
    return numbered


KEPT = ("kept",)
"""Where a ring's `memory` has the key under which it is kept in the cache, if it is."""

KINDS: tuple[str, ...] = get_args(Kind)
