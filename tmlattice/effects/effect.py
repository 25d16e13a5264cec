"""An effect: its name, unit, size and places, and its action.

There are three kinds: on the ring (a magnet has another map), on readings (a monitor reads another
position), and on the launch (the beam starts differently). To add an effect, write a class of one
of them and `register` it: see docs/new_effect.md.
"""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from tmlattice.arrays import Array
from tmlattice.effects.build import Build
from tmlattice.effects.reading import Monitors
from tmlattice.errors import EffectError, UnknownNameError, unknown_name
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.ring import Slopes
from tmlattice.lattice.slices import stem
from tmlattice.speaks import Speaks

Group = Literal[
    "quadrupoles", "bends", "correctors", "sextupoles", "insertion devices", "monitors", "beam"
]
"""Effects that a figure draws in one colour."""


Hypothesis = tuple[str, str | None]
"""An effect and its place."""

MIN_STRENGTH = 0.01
"""Smallest remaining share of a strength."""


@dataclass(frozen=True)
class Cause:
    """A difference between a machine and its model.

    Attributes:
        effect: a name in the catalogue.
        element: the element, or the family, that it sits on; None for the beam and for effects of
            all elements of a kind.
        amount: in the effect's unit and sign convention.
    """

    effect: str
    element: str | None
    amount: float

    def __str__(self) -> str:
        place = f" {self.element}" if self.element else ""
        return f"{self.effect}{place} {self.amount:g}"


def with_labels(text: str) -> str:
    """Return a text with the labels of effects in place of their names."""
    return re.sub(r"\w+", lambda m: CATALOGUE[m[0]].label if m[0] in CATALOGUE else m[0], text)


class Effect(ABC):
    """One imperfection.

    Attributes:
        name: in commands, reports and files.
        words: description in a control room's terms: "wrong strength of a quadrupole".
        group: effects drawn in one colour.
        unit: of the amount; "relative" and "discrete" have none.
        sign: what a positive amount does.
        background: rms of the amount on a healthy machine; None: absent there.
        largest: largest modulus of a fault's amount.
        sits_on_text: possible elements, in words.
        power: readings change as amount ** power to leading order.
        discrete: present or not; the amount states the form.
        forms: names of a discrete effect's amounts, if there are several.
        curved: within the largest fault the square of the amount acts as much as the amount, so
            that a linearisation at zero misleads.
        one_sign: a fault's amount is positive.
        energy: it needs six coordinates.
        modelled: an amount can be fitted; else it is identified from the data alone.
        acts_on_settings: it scales a setting, and has no effect without one.
        calibrates: allowed in a calibration file.
        headline: a short report states the smallest visible amount.
        usual: searched for, and drawn by the challenge, by default.
        of_turns: visible in turns of a stored beam alone.
        whole: its amounts are whole numbers; a fit starts from each.
        responds: visible to first order in a closed orbit's response to one corrector.
        multiplies: two amounts at one place act as (1 + a)(1 + b); else they add up.
        quantity: what the amount is of, in a report ("integrated gradient"); else `words`.
        recommended_action: recommended action, with the element's name for {}: "turn {} upright".
        to_check: what to check on the machine, one sentence.
        natural: no fault but physics that the model lacks; nothing is to be repaired.
        odds: prior odds against an ordinary fault, if it is corrected as itself (`corrected_as`):
            a field that no magnet there makes is rarer than a wrong field of a magnet.
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
    recommended_action: ClassVar[str] = "find the source of the error at {}"
    to_check: ClassVar[str] = "Check the equipment there, and its records."
    natural: ClassVar[bool] = False
    odds: ClassVar[float] = 1.0

    @property
    def label(self) -> str:
        """Short name."""
        return self.name.replace("monitor_", "BPM_").replace("_", " ")

    @abstractmethod
    def places(self, ring: Ring) -> list[str | None]:
        """Return the elements or families of the effect in beam order; [None] for the beam."""

    def corrected_as(self, element: Element) -> tuple[str, float]:
        """Return the effect whose recommended action also corrects this one, and its amount for 1.

        At one element two effects share an action if the same adjustment corrects both, to first
        order in the beam's position: a quadrupole's own gradient corrects a thin gradient in it.
        Most effects are corrected as themselves.
        """
        return self.name, 1.0

    def chain(self, amount: float) -> float:
        """Return d readings / d amount over the signature, which is of a further amount.

        It is one over the remaining share of a strength, see `floored`.
        """
        if not self.multiplies:
            return float(self.power * amount ** (self.power - 1))
        return float(1 / (1 + self.floored(amount)))

    def joined(self, one: float, other: float) -> float:
        """Return the amount equivalent to two amounts together."""
        return (1 + one) * (1 + other) - 1 if self.multiplies else one + other

    def floored(self, amount: float) -> float:
        """Return the amount, of a strength with at least `MIN_STRENGTH` remaining.

        Two amounts of it act as (1 + a)(1 + b): at a = -1 a further amount has no effect.
        """
        left = 1 + amount
        if not self.multiplies or abs(left) >= MIN_STRENGTH:
            return amount
        return float(np.copysign(MIN_STRENGTH, left) - 1)

    def check(self, ring: Ring, cause: Cause) -> None:
        """Raise if a cause of this effect is impossible in the ring.

        Raises:
            UnknownNameError: no such element.
            EffectError: an unsuitable element, a missing name, an amount that is not finite.
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
        """All names of its places, also those of several families."""
        return self.places(ring)

    def _allowed(self, ring: Ring) -> frozenset[str | None]:
        """Its places in any case, cached with the ring: there are thousands of errors."""
        return ring.remembered(
            ("places", self.name),
            lambda: frozenset(p and p.casefold() for p in self._named(ring)),
        )


class RingEffect(Effect):
    """An effect on elements: the given one is copied, never changed."""

    def sits_on(self, element: Element) -> bool:
        """Whether an element can have it."""
        raise NotImplementedError

    def places(self, ring: Ring) -> list[str | None]:
        """Return the names of possible elements in beam order."""
        return [element.name for element in ring.elements if self.sits_on(element)]

    def members(self, ring: Ring, place: str | None) -> list[int]:
        """Indices in `ring.elements` that a cause at `place` changes."""
        assert place is not None
        return [ring.index(place)]

    @abstractmethod
    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Return the element with a further amount, as the model sees it; energy in GeV."""

    @abstractmethod
    def build(self, it: Build, amount: float) -> None:
        """Add the sum of all causes at the element to what another engine builds."""

    def compensated(self, element: Element, amount: float) -> Element | None:
        """Return the element with a setting that compensates this amount.

        None if no setting of its own does: it must be moved, turned or repaired.
        """
        return None


class ErrorEffect(RingEffect):
    """An effect that is one of the errors which an element can carry.

    Attributes:
        error: its name in `lattice.ring.Errors`, and in `Build`.
    """

    error: ClassVar[str]

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Return the element with a further amount of the error."""
        return element.with_errors(**{self.error: amount})

    def build(self, it: Build, amount: float) -> None:
        """Add to the engine's error of the same name."""
        it.add(self.error, amount)


class OffsetX(ErrorEffect):
    """A horizontal misalignment of a magnet."""

    error = "dx"
    unit = "m"
    sign = "x of the magnet's centre"
    quantity = "horizontal displacement"
    recommended_action = "move {} back horizontally"
    background = 1e-4


class OffsetY(ErrorEffect):
    """A vertical misalignment of a magnet."""

    error = "dy"
    unit = "m"
    sign = "y of the magnet's centre"
    quantity = "vertical displacement"
    recommended_action = "move {} back vertically"
    background = 1e-4


class ThinKickEffect(RingEffect):
    """A thin kick that grows with the beam's displacement.

    Attributes:
        slopes: (d px / dx, d px / dy, d py / dx, d py / dy) of amount 1.
        where: "entrance" or "middle" of the element.
    """

    responds = True
    slopes: ClassVar[Slopes]
    where: ClassVar[Literal["entrance", "middle"]] = "middle"

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Return the element with a further amount of the kick."""
        return element.with_errors(**{self.where: tuple(amount * slope for slope in self.slopes)})

    def build(self, it: Build, amount: float) -> None:
        """Add the kick as a matrix."""
        it.add(self.where, tuple(amount * slope for slope in self.slopes))


class StrengthEffect(RingEffect):
    """An effect that scales a setting of an element.

    Attributes:
        strength: k1, k2, or the angle that a corrector is set to.
    """

    multiplies = True
    unit = "relative"
    strength: ClassVar[str]

    def changed(self, element: Element, amount: float, energy: float) -> Element:
        """Return the element with its strength times 1 + amount; the same one without strength."""
        strength = getattr(element, self.strength)
        if strength == 0:
            return element
        return element.changed(**{self.strength: strength * (1 + amount)})

    def build(self, it: Build, amount: float) -> None:
        """Scale the strength."""
        it.scale *= 1 + amount

    def compensated(self, element: Element, amount: float) -> Element | None:
        """Return the element with strength / (1 + amount); None if hardly any field is left."""
        if abs(1 + amount) < MIN_FIELD:
            return None
        return self.changed(element, 1 / (1 + amount) - 1, 0.0)


class FamilyEffect(StrengthEffect):
    """The same error of all magnets of a family: of their power supply."""

    recommended_action = "set or repair the supply of the family {}"
    to_check = (
        "Read back the current of the family's common supply with a second instrument; compare its "
        "setting with the lattice file."
    )

    def places(self, ring: Ring) -> list[str | None]:
        """Return families in the order of their first members; common prefixes of names where each
        magnet is a family; and groups of equal design strength."""
        powered = [e for e in ring.elements if self.sits_on(e)]
        named = _repeated(e.family for e in powered)
        return [*(named or _repeated(stem(e.name) for e in powered)), *self._alike(ring)]

    def _named(self, ring: Ring) -> list[str | None]:
        """Add the common prefixes of several families' names."""
        begin = _repeated(stem(e.name) for e in ring.elements if self.sits_on(e))
        return [*self.places(ring), *begin]

    def _alike(self, ring: Ring) -> dict[str, list[int]]:
        """Groups of equal design strength, and the possible members of each."""
        there = {
            name: [i for i in map(ring.index, own) if self.sits_on(ring.elements[i])]
            for name, own in ring.supplies.items()
        }
        return {name: own for name, own in there.items() if own}

    def members(self, ring: Ring, place: str | None) -> list[int]:
        """Indices of all magnets of the family; or of those whose names begin with it, up to an
        underscore, a dot or a number; or of those with equal design strength."""
        name = (place or "").casefold()
        for alike, own in self._alike(ring).items():
            if name == alike.casefold():
                return own
        powered = [i for i, e in enumerate(ring.elements) if self.sits_on(e)]
        family = [i for i in powered if ring.elements[i].family.casefold() == name]
        return family or [i for i in powered if stem(ring.elements[i].name) == name]


def _repeated(names: Iterable[str]) -> list[str]:
    """Names that occur more than once, in their order."""
    return [name for name, count in Counter(names).items() if count > 1]


MIN_FIELD = 0.1
"""Share of its field below which a magnet is broken: no setting compensates a factor of ten."""


STEP = 1e-4
"""Step of central differences by a monitor's error over the largest fault; no effect is of higher
than second order there."""


class ReadingEffect(Effect):
    """An effect on one monitor's readings."""

    sits_on_text: ClassVar[str] = "BPMs"
    group: ClassVar[Group] = "monitors"

    def places(self, ring: Ring) -> list[str | None]:
        """Return all monitors."""
        return [monitor.name for monitor in ring.monitors]

    @abstractmethod
    def set(self, monitors: Monitors, at: int | slice, amount: float) -> None:
        """Add this amount to one or some of `monitors`, in place."""

    def slopes(self, monitors: Monitors) -> tuple[Array, Array]:
        """Return the change of each monitor per amount that joins the errors that it has.

        Args:
            monitors: with their errors.

        Returns:
            d matrix / d amount, [monitor, 2, 2], and d constant / d amount, [monitor, 2], see
            `Monitors`; of a discrete effect both changes, NaN where the signal vanishes.
        """
        high = 1.0 if self.discrete else STEP * self.largest
        low = 0.0 if self.discrete else -high
        up, down = monitors.copy(), monitors.copy()
        self.set(up, slice(None), high)
        if low:
            self.set(down, slice(None), low)
        constant = up.constant() - down.constant()
        constant[up.silent & ~down.silent] = np.nan
        return (up.matrix() - down.matrix()) / (high - low), constant / (high - low)


ENERGY = 5
"""Index of the energy among the coordinates of a launch."""


class LaunchEffect(Effect):
    """An effect on the beam at its start.

    Attributes:
        shifts: the coordinate of (x, px, y, py, tau, p) to which it adds the amount in every shot;
            None if it moves no centroid.
    """

    sits_on_text: ClassVar[str] = "the beam"
    group: ClassVar[Group] = "beam"
    shifts: ClassVar[int | None] = None

    def places(self, ring: Ring) -> list[str | None]:
        """Return [None], the beam."""
        return [None]

    @abstractmethod
    def beams(self, launches: Array, amount: float) -> tuple[Array, Array]:
        """Return weights [node] and launches [node, shot, 6] whose weighted mean is the reading."""


class Catalogue(dict[str, Effect], Speaks):
    """Effects by name; an unknown name is an error with the nearest ones."""

    def __missing__(self, name: str) -> Effect:
        """Raise UnknownNameError: no such effect."""
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
    """Add an effect to the catalogue (a class decorator)."""
    CATALOGUE[effect.name] = effect()
    return effect


def find(name: str) -> Effect:
    """Return the effect of this name.

    Raises:
        UnknownNameError: with the nearest names.
    """
    for spelling in (name, name.strip().casefold()):
        if spelling in CATALOGUE:
            return CATALOGUE[spelling]
    raise unknown_name("effect", name, CATALOGUE)


def names(chosen: Iterable[str] | None = None) -> list[str]:
    """Return the chosen effects' names, checked, in the catalogue's order; default: all usual."""
    if chosen is None:
        return [name for name, effect in CATALOGUE.items() if effect.usual]
    wanted = {find(name).name for name in chosen}
    return [name for name in CATALOGUE if name in wanted]


def modelled(chosen: Iterable[str] | None = None, turns: bool = False) -> list[str]:
    """Return those of `names` whose amount can be fitted, and those of turn-by-turn readings if
    there are any."""
    if chosen is None and turns:
        chosen = [name for name, effect in CATALOGUE.items() if effect.usual or effect.of_turns]
    effects = [CATALOGUE[name] for name in names(chosen)]
    return [one.name for one in effects if one.modelled and (turns or not one.of_turns)]


def is_energy(name: str) -> bool:
    """Whether an effect is the mean energy of a beam: of a launch, or of the stored beam."""
    effect = find(name)
    return isinstance(effect, LaunchEffect) and effect.shifts == ENERGY


def changes_beam(name: str) -> bool:
    """Whether an effect changes the stored beam of a ring with these settings."""
    effect = find(name)
    return isinstance(effect, RingEffect) and not (effect.calibrates or effect.acts_on_settings)
