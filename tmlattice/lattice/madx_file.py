"""Reading a MAD-X sequence or line, through AT's own reader of that language."""

import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

from tmlattice.errors import LatticeError, unknown_name
from tmlattice.lattice.at_file import quiet_at, ring_from_at
from tmlattice.lattice.ring import Ring

_BEAM = re.compile(r"(?:^|;)\s*beam\b[^;]*\b(energy|pc|gamma|beta|brho)\b", re.I | re.M)


def read_madx(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a MAD-X file.

    Args:
        path: `.seq` or `.madx`; files that it calls are read too.
        name: of the ring.
        sequence: of the file's sequences or lines; else `ring`, else the only one.
        energy: GeV; else the file's BEAM.

    Raises:
        LatticeError: no sequence, several without a choice, no energy, or AT cannot read it.
    """
    import at

    parser = at.MadxParser(verbose=False)
    try:
        with redirect_stdout(StringIO()), quiet_at():
            parser.parse_files(str(path))
    except Exception as error:
        raise _unreadable(path, error) from error
    found = [str(s) for s in parser.sequences]
    if not found:
        raise LatticeError(f"'{path}' has no SEQUENCE and no LINE; give a MAD-X file with one")
    use = sequence.casefold() if sequence else "ring" if "ring" in found else found[-1]
    if sequence and use not in found:
        raise unknown_name(f"sequence in '{path}' named", sequence, found)
    if not sequence and "ring" not in found and len(found) > 1:
        raise LatticeError(
            f"'{path}' has the sequences {', '.join(found)}; name one with sequence="
        )
    beams = [dict(v) for k, v in parser.items() if str(k).startswith("beam%")]
    stated = _BEAM.search(path.read_text(encoding="utf-8", errors="replace"))
    if energy is None and not stated and beams == [dict(at.MadxParser()["beam%"])]:
        raise LatticeError(f"'{path}' has no BEAM with an energy; say energy= (GeV)")
    try:
        with redirect_stdout(StringIO()), quiet_at():
            lattice = parser.lattice(use=use)
    except Exception as error:
        raise _unreadable(path, error) from error
    return ring_from_at(lattice, name, energy)


def _unreadable(path: Path, error: Exception) -> LatticeError:
    said = "; ".join(" ".join(str(a).split()) for a in error.args) or type(error).__name__
    return LatticeError(f"'{path}' cannot be read as MAD-X ({said}); mend that statement")
