"""A ring with monitors and correctors that its file has as something else.

Many lattice files have their monitors as plain markers, and correctors as coils on other magnets.

>>> load_ring("ring.mat", monitors="BPM*")
>>> load_ring("ring.mat", correctors=["COR*", "S[FD]*"])      # coils in the sextupoles too
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from tmlattice.errors import LatticeError
from tmlattice.lattice.places import Place, corrector_pair, halves, place_elements
from tmlattice.lattice.ring import NO_ERRORS, Element, Errors, Ring

_WAY = frozenset({"marker", "drift"})
_CORRECTORS = frozenset({"hcorrector", "vcorrector"})
_SPLIT = frozenset({"quadrupole", "bend", "sextupole", "octupole", "multipole"})


def marked(
    ring: Ring,
    monitors: str | Sequence[str] | None = None,
    correctors: str | Sequence[str] | None = None,
) -> Ring:
    """The ring with more monitors and correctors.

    A marker or drift becomes a monitor, read in its middle, under its own name. A marker, drift or
    monitor gets a corrector of each plane in its place, NAME_h and NAME_v; a magnet is cut
    into halves NAME and NAME_2 with them in between, so that the coil kicks in its middle. What is
    a monitor or corrector already stays as it is.

    Args:
        ring: as it was read.
        monitors, correctors: patterns of names or families, with *, ? and [], or lists of them;
            one text may hold several, separated by commas. Case does not matter.

    Raises:
        UnknownNameError: a pattern that nothing matches.
        LatticeError: an element that can be neither.
    """
    wanted_monitors, wanted_correctors = (_patterns(text) for text in (monitors, correctors))
    if not wanted_monitors and not wanted_correctors:
        return ring
    read = _matched(ring, wanted_monitors, "BPM", _WAY | {"monitor"})
    coils = _matched(ring, wanted_correctors, "corrector", _WAY | _CORRECTORS | _SPLIT)
    places: list[Place] = []
    errors: list[Errors] = []
    for element in ring.elements:
        made = _made(element, element.name in read, element.name in coils)
        places += made
        errors += [element.errors] + [NO_ERRORS] * (len(made) - 1)
    families, kinds, sources = zip(*places, strict=True)
    placed = place_elements(families, sources, kinds)
    kept = (replace(e, errors=own) for e, own in zip(placed, errors, strict=True))
    return replace(ring, elements=tuple(kept), known_supplies=None)


def _patterns(text: str | Sequence[str] | None) -> list[str]:
    given = [text] if isinstance(text, str) else list(text or ())
    return [part.strip() for one in given for part in one.split(",") if part.strip()]


def _matched(ring: Ring, patterns: Iterable[str], what: str, kinds: frozenset[str]) -> set[str]:
    """Names of the elements that a pattern means: of all that it matches, those that can be one."""
    found: set[str] = set()
    for pattern in patterns:
        matched = ring.matching(pattern, what)
        able = [e for e in matched if e.kind in kinds]
        if not able:
            raise LatticeError(
                f"'{pattern}' matches {matched[0].kind} '{matched[0].name}', which cannot be a "
                f"{what}; name elements of the kinds {', '.join(sorted(kinds))}"
            )
        found.update(e.name for e in able)
    return found


def _made(element: Element, monitor: bool, coil: bool) -> list[Place]:
    from tmlattice.lattice.ocelot import elements

    family, kind, length = element.family, element.kind, element.length
    own: Place = (family, kind, element.source)
    if monitor and kind in _WAY:
        kind = "monitor"
        own = (family, kind, elements.Monitor(l=length, eid=family))
    if not coil or kind in _CORRECTORS:
        return [own]
    if length == 0 or kind == "monitor":
        return [own, *corrector_pair(family, 0.0)]
    if element.errors != NO_ERRORS:
        raise LatticeError(f"'{element.name}' has errors, and cannot be cut for a corrector's coil")
    if kind == "drift":
        return corrector_pair(family, length)
    first, second = halves(element.source)
    return [
        (family, kind, first),
        *corrector_pair(family, 0.0),
        (f"{family}_2", kind, second),
    ]
