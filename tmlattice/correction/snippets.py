"""New strengths of magnets as statements of MAD-X, AT and elegant.

A statement is for all magnets of a name if all of them get the same; else for one occurrence. In
MAD-X an occurrence has the name that `save_ring` gives it: `qd..12` for `qd::12`.
"""

import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from tmlattice.correction.knobs import KINDS, Knob
from tmlattice.errors import plain
from tmlattice.lattice import Element, Ring

_LEGAL = re.compile(r"[A-Za-z_][A-Za-z0-9_.$:+/-]*")
"""Of names that MAD-X and elegant take as they are."""


class New(NamedTuple):
    """Attribute (k1, k2, k1s in 1/m2 and 1/m3, kick in rad), value and length in m."""

    element: Element
    attribute: str
    value: float


def snippet(ring: Ring, changes: Sequence[tuple[Knob, float]], code: str) -> str:
    """Return statements, one per line.

    Args:
        ring: with the present settings.
        changes: of knobs, with the amounts of their effects.
        code: "madx", "at" (Python, of a lattice `ring`) or "elegant".
    """
    comment, statement = _CODES[code]
    lines = []
    for knob, amount in changes:
        if not knob.members:
            lines.append(f"{comment} {plain(knob.name)}: relative change {amount:.9g}")
            continue
        new = [_new(ring, ring[member], knob, amount) for member in knob.members]
        families: dict[str, list[New]] = {}
        for one in new:
            families.setdefault(one.element.family, []).append(one)
        for family, own in families.items():
            if code != "at" and not _LEGAL.fullmatch(family):  # a name may hold statements
                lines.append(f"{comment} {plain(family)}: no name of this code; set it by hand")
                continue
            every = [e for e in ring.elements if e.family == family]
            if len(every) == len(own) and len({one.value for one in own}) == 1:
                lines.append(statement(own[0], None))
            else:
                lines += [statement(one, every.index(one.element)) for one in own]
    return "".join(f"{line}\n" for line in lines)


def _new(ring: Ring, element: Element, knob: Knob, amount: float) -> New:
    kind = KINDS[knob.kind]
    own = knob.unit == kind.unit and not knob.curve  # its setting is the lattice's strength
    if kind.relative:
        design = getattr(element, kind.strength)
        first = getattr(ring[knob.members[0]], kind.strength)
        ratio = knob.setting(amount) / first if own and first else 1 + amount
        return New(element, kind.strength, design * ratio)
    if kind.strength == "kick":
        kick = knob.setting(amount) if own else element.angle + amount / knob.scale
        return New(element, "kick", kick)
    length = element.length or 1.0
    turned = math.sin(2 * element.tilt)
    if element.kind == "quadrupole" and abs(turned) > 0.5:
        return New(element, "k1", element.k1 - amount / length / turned)
    return New(element, "k1s", (element.errors.k1sl + amount) / length)


def _madx(new: New, place: int | None) -> str:
    name = new.element.family.casefold() + ("" if place is None else f"..{place}")
    return f"{name}->{new.attribute} = {new.value:.12g};"


def _at(new: New, place: int | None) -> str:
    index = f"ring.get_uint32_index({new.element.family!a})"
    which = index if place is None else f"{index}[{place}:{place + 1}]"
    plane = int(new.element.kind == "vcorrector")
    set_to = {
        "k1": f"PolynomB[1] = {new.value:.12g}",
        "k2": f"PolynomB[2] = {new.value / 2:.12g}",
        "k1s": f"PolynomA[1] = {new.value:.12g}",
        "kick": f"KickAngle[{plane}] = {new.value:.12g}",
    }[new.attribute]
    return f"for i in {which}: ring[i].{set_to}"


def _elegant(new: New, place: int | None) -> str:
    if new.attribute == "k1s":
        return f"! {plain(new.element.name)}: skew gradient {new.value:.12g} 1/m2"
    where = "" if place is None else f", start_occurence={place + 1}, end_occurence={place + 1}"
    return (
        f"&alter_elements name={new.element.family.upper()}, item={new.attribute.upper()}, "
        f"value={new.value:.12g}{where} &end"
    )


_CODES: dict[str, tuple[str, Callable[[New, int | None], str]]] = {
    "madx": ("!", _madx),
    "at": ("#", _at),
    "elegant": ("!", _elegant),
}
