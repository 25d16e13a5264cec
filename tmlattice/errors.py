"""Errors of the package. Each message is one sentence: what is wrong, where, how to correct it."""

import difflib
import unicodedata
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import TypeVar

Choice = TypeVar("Choice", bound=StrEnum)


def harmless(text: str) -> str:
    """A text without what steers a terminal; its lines stay lines.

    Control characters, and those that turn the direction of writing, become their escapes.
    """
    if text.isprintable():
        return text
    steers = ("Cc", "Cf", "Cs", "Zl", "Zp")
    return "".join(
        repr(c)[1:-1] if c != "\n" and unicodedata.category(c) in steers else c for c in text
    )


def plain(text: str, longest: int | None = None) -> str:
    """A text from a file as it may be shown: in one line, `harmless`.

    Args:
        longest: characters; what is beyond is left out.
    """
    shown = harmless(" ".join(text.split()))
    if longest is None or len(shown) <= longest:
        return shown
    return shown[: longest - 3] + "..."


def first_of(names: Sequence[object], most: int = 5) -> str:
    """The first few of several names, and whether there are more: "a, b, ..."."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


class TmlatticeError(Exception):
    """Input that cannot be used, or a result that does not exist; the message states what to do."""


class LatticeError(TmlatticeError):
    """A lattice that cannot be found, read or modelled."""


class UnknownNameError(LatticeError):
    """A name that the lattice does not have; the message offers the nearest ones."""


class UnstableRingError(TmlatticeError):
    """A one-turn matrix with growing motion: the ring has no tune."""


class BeamLostError(TmlatticeError):
    """A trajectory that leaves the range in which the maps mean anything."""


class TooFewTurnsError(TmlatticeError):
    """A signal too short for a frequency."""


class MeasurementError(TmlatticeError):
    """A measurement that does not fit the ring, or is not a measurement."""


class MachineFileError(TmlatticeError):
    """A machine file that cannot be read, or that names what is not there."""


class OtherFormatError(MeasurementError):
    """A file that is not of the kind that it was read as; it may be of another."""


class ChoiceError(TmlatticeError, ValueError):
    """A word for which there is a list, and that is not on it; the message gives the list."""


class MissingPackageError(TmlatticeError, ImportError):
    """An optional package that is not installed; the message states the extra that installs it."""


class EffectError(TmlatticeError):
    """An effect that cannot be as it was asked for."""


def missing_package(
    error: ImportError, what: str, extra: str, instead: str = ""
) -> MissingPackageError:
    """The error for a package of an extra.

    Args:
        what: needs it, as the subject of the sentence.
        extra: brings it.
        instead: another way, if there is one.
    """
    return MissingPackageError(
        f"{what} the package '{error.name}', which is not installed: "
        f"`pip install 'tmlattice[{extra}]'` brings it (README.md, Install)"
        + (f"; {instead}" if instead else "")
    )


def unknown_choice(kind: str, name: object, known: Iterable[str]) -> ChoiceError:
    """The error for a word that is none of a short list; all of them are named."""
    return ChoiceError(f"no {kind} '{name}'; there are {', '.join(known)}")


def choice(kind: str, name: str, known: type[Choice]) -> Choice:
    """The member of an enumeration; a `ChoiceError` names all of them."""
    try:
        return known(name)
    except ValueError:
        raise unknown_choice(kind, name, known) from None


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """The error for a `name` that is not among the `known` ones, with the nearest of them."""
    known = list(known)
    wanted, original = name.casefold(), {k.casefold(): k for k in known}
    begin = [k for k in original if name and k.startswith(wanted)]
    close = [*begin, *difflib.get_close_matches(wanted, original, 3, 0.5)]
    close = close or [k for k in original if name and wanted in k]
    near = [original[k] for k in dict.fromkeys(close)][:3]
    shown = near or known[:3]
    offer = [f"'{k}'" for k in shown]
    known_are = f"known: {', '.join(offer)}{', ...' * (len(known) > len(offer))}"
    question = f"did you mean {' or '.join(offer)}?" if near else known_are
    return UnknownNameError(f"no {kind} '{name}'; {question}" if shown else f"no {kind} '{name}'")
