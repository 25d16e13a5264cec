"""What an effect is: its name, unit and sizes, where it can sit, and how it acts.

There are three kinds, by what they act on: the ring (a magnet has another map), the readings (a
monitor tells something else than where the beam is), and the launch (the beam starts otherwise).
To add an effect, write a class of one of them and `register` it: see docs/new_effect.md.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects.build import Build, Where
from tmlattice.effects.cause import Cause
from tmlattice.effects.reading import Monitors
from tmlattice.errors import EffectError, UnknownNameError, unknown_name
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.ring import Slopes
from tmlattice.lattice.slices import stem
from tmlattice.speaks import Speaks

Array = NDArray[np.float64]

Group = Literal[
    "quadrupoles", "bends", "correctors", "sextupoles", "insertion devices", "monitors", "beam"
]
"""Effects that a figure draws in one colour."""


LEAST_LEFT = 0.01
"""Share of a strength below which nothing is left of it."""


class Effect(ABC):
    """One imperfection that the project knows.

    Attributes:
        name: in commands, reports and files.
        words: what it is, in the words of a control room: "wrong strength of a quadrupole".
        group: of what it is drawn with.
        unit: of the amount; "relative" and "discrete" have none.
        sign: what a positive amount does.
        background: rms of the amount on a machine in good order, or None where such a machine
            does not have it.
        largest: the largest amount of a fault, by modulus.
        sits_on_text: the elements it can sit on, for people.
        power: readings change as amount ** power to leading order.
        discrete: it is there or not; the amount says in which form.
        forms: what the amounts of a discrete effect stand for, where there are several.
        curved: the square of an amount within the largest fault acts as much as the amount: what
            is linear about none of it misleads.
        one_sign: a fault's amount is positive.
        energy: it needs six coordinates.
        modelled: an amount can be fitted; else it is named from the data alone.
        acts_on_settings: it changes what an element makes of its setting: nothing without one.
        calibrates: a file of calibrations may hold it.
        headline: a short report states how little of it would be seen.
        usual: looked for, and drawn by the challenge, where nobody says which effects to take.
        of_turns: seen in turns of a stored beam alone, and looked for there.
        whole: its amounts on a machine are whole numbers; a fit finds what is near to one.
        responds: a closed orbit's response to a corrector sees it alone, to first order.
        multiplies: two amounts at one place act as (1 + a)(1 + b); else they add up.
        quantity: what the amount is of, as a action says it ("integrated gradient"); else `words`.
        recommended_action: what takes it away, of the element's name in {}: "turn {} upright".
        to_check: what to look at on the machine, one sentence.
        natural: no fault: known physics that the model leaves out, and nothing is to be repaired.
        odds: how often it is the fault where it stands for itself (see `stands_for`), beside an
            ordinary kind of fault: a field that no magnet there makes is rarer than a magnet whose
            own field is wrong.
    """

    name: ClassVar[str]
    words: ClassVar[str]
    group: ClassVar[Group]
    unit: ClassVar[str]
    sign: ClassVar[str]
    background: ClassVar[float | None] = None
    largest: ClassVar[float]
    sits_on_text: ClassVar[str]
    power: ClassVar[int] = 1
    discrete: ClassVar[bool] = False
    forms: ClassVar[Mapping[float, str]] = {}
    curved: ClassVar[bool] = False
    one_sign: ClassVar[bool] = False
    energy: ClassVar[bool] = False
    modelled: ClassVar[bool] = True
    acts_on_settings: ClassVar[bool] = False
    calibrates: ClassVar[bool] = False
    headline: ClassVar[bool] = False
    usual: ClassVar[bool] = True
    of_turns: ClassVar[bool] = False
    whole: ClassVar[bool] = False
    responds: ClassVar[bool] = False
    multiplies: ClassVar[bool] = False
    quantity: ClassVar[str] = ""
    recommended_action: ClassVar[str] = "find out what acts at {}"
    to_check: ClassVar[str] = "Look at what stands there, and at what its record says."
    natural: ClassVar[bool] = False
    odds: ClassVar[float] = 1.0

    @property
    def label(self) -> str:
        """Its name where there is little room."""
        return self.name.replace("_", " ")

    @abstractmethod
    def places(self, ring: Ring) -> list[str | None]:
        """The elements, or families, that it can sit on, in beam order; [None] for the beam."""

    def stands_for(self, element: Element) -> tuple[str, float]:
        """The effect whose action takes this one away too, and its amount for 1 of this one.

        At one element two effects share a action where the same adjustment of the element takes
        both away, to first order in the beam's place: a thin gradient in a quadrupole is undone by
        the quadrupole's own gradient. Most stand for themselves.
        """
        return self.name, 1.0

    def chain(self, amount: float) -> float:
        """d readings / d amount of what is there, over a signature, which is of more on top of it.

        It is one over what is left of a strength, see `some_left`.
        """
        if not self.multiplies:
            return float(self.power * amount ** (self.power - 1))
        return float(1 / (1 + self.some_left(amount)))

    def joined(self, one: float, other: float) -> float:
        """The amount that does what two of them do."""
        return (1 + one) * (1 + other) - 1 if self.multiplies else one + other

    def some_left(self, amount: float) -> float:
        """The amount; of a strength that would be gone, `LEAST_LEFT` is kept.

        Two amounts of it act as (1 + a)(1 + b): at a = -1 more of the effect has nothing to act on.
        """
        left = 1 + amount
        if not self.multiplies or abs(left) >= LEAST_LEFT:
            return amount
        return float(np.copysign(LEAST_LEFT, left) - 1)

    def check(self, ring: Ring, cause: Cause) -> None:
        """Raise where a cause of this effect is impossible in the ring.

        Raises:
            UnknownNameError: no such element.
            EffectError: an element that cannot have it, a missing name, an amount not finite.
        """
        if not np.isfinite(cause.amount):
            raise EffectError(f"{self.name}: the amount is {cause.amount}; give a number")
        if self.discrete and cause.amount not in range(int(self.largest) + 1):
            raise EffectError(f"{self.name} is there or not: {self.sign}; not {cause.amount:g}")
        places = self._allowed(ring)
        if not places:
            raise EffectError(
                f"{self.name} has no place in '{ring.name}'; it sits on: {self.sits_on_text}"
            )
        if None in places:
            if cause.element is not None:
                raise EffectError(f"{self.name} has no element; leave '{cause.element}' out")
            return
        if cause.element is None:
            raise EffectError(f"{self.name} needs an element: {self.sits_on_text}")
        if cause.element.casefold() not in places:
            try:
                kind = ring[cause.element].kind
            except UnknownNameError:
                known = dict.fromkeys([p or "" for p in self.places(ring)])
                known |= dict.fromkeys(element.name for element in ring.elements)
                raise unknown_name("element", cause.element, known) from None
            raise EffectError(
                f"{self.name} cannot sit on '{cause.element}', a {kind}; "
                f"it sits on: {self.sits_on_text}"
            )

    def _named(self, ring: Ring) -> list[str | None]:
        """All names by which somebody may call its places."""
        return self.places(ring)

    def _allowed(self, ring: Ring) -> frozenset[str | None]:
        """Its places without regard to case: found once a ring, for thousands of small errors."""
        key = ("places", self.name)
        if key not in ring.memory:
            ring.memory[key] = frozenset(p and p.casefold() for p in self._named(ring))
        found: frozenset[str | None] = ring.memory[key]
        return found


class RingEffect(Effect):
    """An effect on elements: the given one is copied, never changed."""

    def sits_on(self, element: Element) -> bool:
        """Whether an element can have it."""
        raise NotImplementedError

    def places(self, ring: Ring) -> list[str | None]:
        """Names of the elements that can have it, in beam order."""
        return [element.name for element in ring.elements if self.sits_on(element)]

    def members(self, ring: Ring, place: str | None) -> list[int]:
        """The places in `ring.elements` that a cause at `place` changes."""
        assert place is not None
        return [ring.index(place)]

    @abstractmethod
    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """The element with this much of it more, as the model sees it; energy in GeV."""

    @abstractmethod
    def build(self, it: Build, amount: float) -> None:
        """Put it, all causes at the element added up, into what another engine is to build."""

    def undone(self, element: Element, amount: float) -> Element | None:
        """The element set so that with this much of the effect it acts as designed.

        None where no setting of its own does that: somebody has to move, turn or mend it.
        """
        return None


class ErrorEffect(RingEffect):
    """An effect that is one of the errors which an element can carry.

    Attributes:
        error: its name in `lattice.ring.Errors`, and in `Build`: dx, dy, ds, roll, kick_x
            or kick_y.
    """

    error: ClassVar[str]

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """The element with this much more of the error."""
        return element.with_errors(**{self.error: amount})

    def build(self, it: Build, amount: float) -> None:
        """Add to what an engine calls the same."""
        setattr(it, self.error, getattr(it, self.error) + amount)


class ThinKickEffect(RingEffect):
    """A thin kick that grows with the beam's displacement.

    Attributes:
        slopes: (d px / dx, d px / dy, d py / dx, d py / dy) of amount 1.
        where: "entrance" or "middle" of the element.
    """

    responds = True
    slopes: ClassVar[Slopes]
    where: ClassVar[Where] = "middle"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """The element with this much more of the kick."""
        return element.with_errors(**{self.where: tuple(amount * slope for slope in self.slopes)})

    def build(self, it: Build, amount: float) -> None:
        """The kick as a matrix."""
        it.add_slopes(self.where, *(amount * slope for slope in self.slopes))


class StrengthEffect(RingEffect):
    """An effect that scales what an element is set to.

    Attributes:
        strength: k1, k2, or the angle that a corrector is set to.
    """

    multiplies = True
    strength: ClassVar[str]

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """The strength times 1 + amount; the same element where it has none."""
        strength = getattr(element, self.strength)
        if strength == 0:
            return element
        return element.changed(**{self.strength: strength * (1 + amount)})

    def build(self, it: Build, amount: float) -> None:
        """Scale the whole."""
        it.scale *= 1 + amount

    def undone(self, element: Element, amount: float) -> Element | None:
        """The strength over 1 + amount; None where that is almost no field at all."""
        if abs(1 + amount) < LEAST_FIELD:
            return None
        return self.changed(element, 1 / (1 + amount) - 1, 0.0)


class FamilyEffect(StrengthEffect):
    """The same error of all magnets of a family: their supply's."""

    def places(self, ring: Ring) -> list[str | None]:
        """Families in the order of their first members; where every magnet is a family of its own,
        what several of their names begin with; and those that nothing but the design has alike."""
        powered = [e for e in ring.elements if self.sits_on(e)]
        named = _several(e.family for e in powered)
        return [*(named or _several(stem(e.name) for e in powered)), *self._alike(ring)]

    def _named(self, ring: Ring) -> list[str | None]:
        """And what the names of several families begin with."""
        begin = _several(stem(e.name) for e in ring.elements if self.sits_on(e))
        return [*self.places(ring), *begin]

    def _alike(self, ring: Ring) -> dict[str, list[int]]:
        """Supplies that the design tells alone, and who of each can have the effect."""
        there = {
            name: [i for i in map(ring.index, own) if self.sits_on(ring.elements[i])]
            for name, own in ring.supplies.items()
        }
        return {name: own for name, own in there.items() if own}

    def members(self, ring: Ring, place: str | None) -> list[int]:
        """All magnets of the family; or, where none is called so, those whose names begin so, up
        to an underscore, a dot or a number of their own; or those that the design has alike."""
        name = (place or "").casefold()
        for alike, own in self._alike(ring).items():
            if name == alike.casefold():
                return own
        powered = [i for i, e in enumerate(ring.elements) if self.sits_on(e)]
        family = [i for i in powered if ring.elements[i].family.casefold() == name]
        return family or [i for i in powered if stem(ring.elements[i].name) == name]


def _several(names: Iterable[str]) -> list[str]:
    """Those that stand more than once, in their order."""
    return [name for name, count in Counter(names).items() if count > 1]


LEAST_FIELD = 0.1
"""Share of its field below which a magnet is broken: no setting makes ten times as much of it."""


class ReadingEffect(Effect):
    """An effect on what one monitor tells."""

    sits_on_text: ClassVar[str] = "monitors"
    group: ClassVar[Group] = "monitors"

    def places(self, ring: Ring) -> list[str | None]:
        """All monitors."""
        return [monitor.name for monitor in ring.monitors]

    @abstractmethod
    def change(self, beam: Array, amount: float) -> Array:
        """What a monitor with this amount alone reads of the beam [..., 2] (x, y), m, less beam."""

    @abstractmethod
    def set(self, monitors: "Monitors", at: int | slice, amount: float) -> None:
        """Put this much more of it into monitor `at` of `monitors`, or into some, in place."""


class LaunchEffect(Effect):
    """An effect on the beam at its start.

    Attributes:
        shifts: the coordinate of (x, px, y, py, tau, p) to which it adds the amount in every shot;
            None where it moves no centroid.
    """

    sits_on_text: ClassVar[str] = "the beam"
    group: ClassVar[Group] = "beam"
    shifts: ClassVar[int | None] = None

    def places(self, ring: Ring) -> list[str | None]:
        """The beam."""
        return [None]

    @abstractmethod
    def beams(self, launches: Array, amount: float) -> tuple[Array, Array]:
        """Launches whose weighted mean reading is the reading: weights [node], [node, shot, 6]."""


class Catalogue(dict[str, Effect], Speaks):
    """Effects by name; a name that is not there is answered with the nearest ones."""

    def __missing__(self, name: str) -> Effect:
        """UnknownNameError: no such effect."""
        raise unknown_name("effect", name, self)

    __repr__ = Speaks.__repr__

    def _told(self) -> tuple[str, dict[str, str]]:
        groups: dict[str, list[str]] = {}
        for name, effect in self.items():
            groups.setdefault(effect.group, []).append(name)
        return f"of {len(self)} effects", {g: ", ".join(own) for g, own in groups.items()}


CATALOGUE = Catalogue()
"""Every effect by its name, in the order in which reports list them."""


def register(effect: type[Effect]) -> type[Effect]:
    """Put an effect into the catalogue (a class decorator)."""
    CATALOGUE[effect.name] = effect()
    return effect


def find(name: str) -> Effect:
    """The effect of this name.

    Raises:
        UnknownNameError: with the nearest names.
    """
    for spelling in (name, name.strip().casefold()):
        if spelling in CATALOGUE:
            return CATALOGUE[spelling]
    raise unknown_name("effect", name, CATALOGUE)


def names(chosen: Iterable[str] | None = None) -> list[str]:
    """Names of the chosen effects, checked, in the catalogue's order; all usual ones by default."""
    if chosen is None:
        return [name for name, effect in CATALOGUE.items() if effect.usual]
    wanted = {find(name).name for name in chosen}
    return [name for name in CATALOGUE if name in wanted]


def modelled(chosen: Iterable[str] | None = None, turns: bool = False) -> list[str]:
    """Those of `names` whose amount can be fitted; with what only turns of a stored beam show where
    there are such."""
    if chosen is None and turns:
        chosen = [name for name, effect in CATALOGUE.items() if effect.usual or effect.of_turns]
    effects = [CATALOGUE[name] for name in names(chosen)]
    return [one.name for one in effects if one.modelled and (turns or not one.of_turns)]
