"""Reading a MAD-X sequence or line, a line of elegant, or one of Xsuite, through AT's readers."""

import json
import re
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError, first_of, plain, unknown_name
from tmlattice.lattice.at_file import quiet_at, ring_from_at
from tmlattice.lattice.madx_parsers import parser_of
from tmlattice.lattice.ring import Ring

_BEAM = re.compile(r"(?:^|;)\s*beam\b[^;]*\b(energy|pc|gamma|beta|brho)\b", re.I | re.M)


def read_madx(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a MAD-X or elegant file.

    Args:
        path: `.seq`, `.madx` or elegant's `.lte`; files that it calls are read too.
        name: of the ring.
        sequence: of the file's sequences or lines; else `ring`, else the only one
            that stands in no other.
        energy: GeV; else the file's BEAM (elegant's files have none).

    Raises:
        LatticeError: no sequence, several without a choice, no energy, or AT cannot read it.
    """
    elegant = path.suffix.lower() == ".lte"
    parser = parser_of(elegant)
    try:
        with redirect_stdout(StringIO()), quiet_at():
            parser.parse_files(str(path))
    except Exception as error:
        raise _unreadable(path, error) from error
    found = [str(s) for s in parser.sequences]
    use = _chosen(path, found, sequence, _outermost(parser, found))
    if elegant:
        stated = False
    else:
        beams = [dict(v) for k, v in parser.items() if str(k).startswith("beam%")]
        text = path.read_text(encoding="utf-8", errors="replace")
        stated = bool(_BEAM.search(text)) or beams != [dict(parser_of(False)["beam%"])]
    if energy is None and not stated:
        lacks = "no beam energy" if elegant else "no BEAM with an energy"
        raise LatticeError(f"'{path}' has {lacks}; say energy= (GeV)")
    try:
        with redirect_stdout(StringIO()), quiet_at():
            lattice = parser.lattice(use=use)
    except Exception as error:
        raise _unreadable(path, error) from error
    if parser.undefined:
        names = parser.undefined
        warnings.warn(
            f"'{path}' does not define {first_of(names)} ({len(names)}): taken for 0, as by MAD-X",
            stacklevel=2,
        )
    return ring_from_at(lattice, name, energy)


def _outermost(parser: Any, found: Sequence[str]) -> list[str]:
    """Sequences and lines that stand in no other one."""
    inside: set[str] = set()
    by_id = {id(parser[name]): name for name in found}
    for name in found:
        for item in parser[name]:
            named = isinstance(item, tuple) and item and isinstance(item[0], str)
            what = parser.get(item[0]) if named else item
            if id(what) in by_id:
                inside.add(by_id[id(what)].casefold())
    return [name for name in found if name.casefold() not in inside]


def _chosen(
    path: Path, found: Sequence[str], wanted: str | None, outermost: Sequence[str] = ()
) -> str:
    """Of the sequences and lines of a file the one that is the ring."""
    if not found:
        raise LatticeError(f"'{path}' has no SEQUENCE and no LINE; give a file with one")
    names = {name.casefold(): name for name in found}
    if not wanted and "ring" not in names and outermost:
        found = outermost
    use = wanted.casefold() if wanted else "ring" if "ring" in names else found[-1].casefold()
    if use not in names:
        raise unknown_name(f"sequence in '{path}' named", wanted or "", found)
    if not wanted and "ring" not in names and len(found) > 1:
        raise LatticeError(
            f"'{path}' has the sequences {', '.join(found)}; name one with sequence="
        )
    return names[use]


def read_xsuite(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a JSON file of Xsuite: a line, or an environment with lines.

    Args:
        path: `.json`.
        name: of the ring.
        sequence: of an environment's lines; else `ring`, else the only one.
        energy: GeV; else that of the line's reference particle.

    Raises:
        LatticeError: no line, several without a choice, no energy, or AT cannot read it.
    """
    import at

    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    options, line = {}, content
    if "lines" in content:
        options["use"] = _chosen(path, list(content["lines"]), sequence)
        line = content["lines"][options["use"]]
    if energy is None and not line.get("particle_ref"):
        raise LatticeError(f"'{path}' has no reference particle; say energy= (GeV)")
    try:
        with quiet_at():
            lattice = at.load_xsuite(str(path), **options)
    except Exception as error:
        raise _unreadable(path, error, "Xsuite's JSON") from error
    return ring_from_at(lattice, name, energy)


def _unreadable(path: Path, error: Exception, what: str = "MAD-X") -> LatticeError:
    what = "elegant's lattice" if path.suffix.lower() == ".lte" else what
    said = plain("; ".join(map(str, error.args)), 300) or type(error).__name__
    return LatticeError(f"'{path}' cannot be read as {what} ({said}); mend that statement")
