"""Reading a table of MAD-X (TFS), as TWISS writes it: a thick lattice, element by element.

Columns that are needed: NAME, KEYWORD, S (at each element's exit, or in its middle), L. Those that
hold fields are read where they are there: ANGLE, E1, E2, H1, H2, HGAP, FINT, FINTX, TILT; the
integrated strengths K0L to K3L and K0SL to K3SL; LRAD; KS, KSI; HKICK, VKICK; VOLT (MV), FREQ
(MHz); of a DIPEDGE, H1 is its H. What lies between two elements is a drift. Recent versions of
MAD-X write an RBEND's E1 and E2 with the half angle, earlier ones without: the header's tunes
decide. Without the column LRAD thin bends have none, as in MAD-X, or the one bending radius that
gives the header's tunes.
"""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError, plain
from tmlattice.lattice.lines import with_gaps
from tmlattice.lattice.madx_beam import Beam
from tmlattice.lattice.parts import MODELLED, Part, Report, ring_of_parts
from tmlattice.lattice.places import MAIN_ORDER
from tmlattice.lattice.ring import Ring
from tmlattice.lattice.stated import Stated, contradiction, curvatures

NEEDED = ("NAME", "KEYWORD", "S", "L")
CLOSE, DIGITS = 1e-6, 2e-9
"""Two elements may overlap by `CLOSE` (m) and `DIGITS` of the table's length: S has ten digits."""
NUMBERS = (
    "angle", "e1", "e2", "h1", "h2", "hgap", "fint", "fintx", "tilt", "hkick", "vkick", "volt",
    "freq", "lrad", "ks", "ksi",
)  # fmt: skip
ORDERS = range(7)
STRENGTHS = {"knl": "K{}L", "ksl": "K{}SL"}
_NUMERIC = frozenset({
    "S", "L", *(key.upper() for key in NUMBERS),
    *(column.format(n) for column in STRENGTHS.values() for n in ORDERS),
})  # fmt: skip

Row = dict[str, Any]


def read_tfs(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a table of MAD-X.

    Args:
        path: of the file.
        name: of the ring.
        sequence: passed over; a table is one ring.
        energy: GeV; else that of the header, by its ENERGY, PC or GAMMA.

    Raises:
        LatticeError: a column is missing, elements overlap, an element that a table does not
            describe, a ring that contradicts the header, or tfs-pandas is missing.

    Warns:
        Of what is left out.
    """
    try:
        import tfs
    except ImportError as error:
        raise LatticeError(
            f"'{path}' is a table of MAD-X; install tfs-pandas to read it (pip install tfs-pandas)"
        ) from error
    try:
        table = tfs.read(str(path))
    except Exception as error:  # its own errors, and pandas'
        reason = " ".join(str(error).split())
        raise LatticeError(f"'{path}' cannot be read as a table of MAD-X ({reason})") from error
    table.columns = [str(column).upper() for column in table.columns]
    missing = [column for column in NEEDED if column not in table.columns]
    if missing:
        raise LatticeError(
            f"'{path}' has no column {', '.join(missing)}; write the table with select, "
            "flag=twiss, column=name,keyword,s,l,angle,k0l,k1l,k2l,k0sl,k1sl,tilt,e1,e2,lrad"
        )
    header = {str(k).upper(): v for k, v in table.headers.items()}
    numbers = {k: _number(header, k.upper()) for k in ("mass", "charge", "energy", "pc", "gamma")}
    beam = Beam({k: v for k, v in numbers.items() if v})
    if "PARTICLE" in header and "mass" not in beam.given:
        beam.given["particle"] = str(header["PARTICLE"]).strip()
    if energy is None and not beam.has_energy:
        raise LatticeError(f"'{path}' states no ENERGY; give energy= (GeV)")
    try:
        mass, charge, energy = beam.mass, beam.charge, beam.energy if energy is None else energy
    except LatticeError as error:
        raise LatticeError(f"'{path}': {error}") from error
    rows: list[Row] = table.to_dict("records")
    if _number(header, "BV_FLAG") == -1:  # all but faces and rotations are of the reversed fields
        rows = [
            row | {e: -row[e] for e in _FACES.get(str(row["KEYWORD"]).upper(), ()) if row.get(e)}
            for row in rows
        ]
    stated = Stated.of_header(header, rows)
    columns = frozenset(table.columns)
    _check_columns(path, rows, columns)
    thin = "LRAD" not in columns and any(map(_bends_thinly, rows))

    def read(half: bool, curvature: float) -> tuple[Ring, list[warnings.WarningMessage]]:
        own = [
            row | {"LRAD": abs(_first_strength(row)) / curvature}
            if curvature and _bends_thinly(row) else row for row in rows
        ]  # fmt: skip
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            report = Report()
            parts = _with_drifts(path, own, stated.length, half, report)
            if curvature:
                warnings.warn(
                    f"'{path}' has thin bends and no column LRAD: the header's tunes give them a "
                    f"bending radius of {1 / curvature:.6g} m",
                    stacklevel=4,
                )
            return ring_of_parts(parts, name, energy, mass, charge, report), caught

    first = ""
    for half in _readings(rows):
        ring, caught = read(half, 0.0)
        found = contradiction(ring, stated)
        if found is not None and thin:
            others = [read(half, curvature) for curvature in curvatures(ring, stated)]
            agreeing = [other for other in others if contradiction(other[0], stated) is None]
            if len(agreeing) == 1:
                (ring, caught), found = agreeing[0], None
        if found is None:
            for w in caught:
                warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)
            return ring
        first = first or found
    raise LatticeError(f"'{path}' contradicts its header: {first}; {_advice(table.columns, rows)}")


def _readings(rows: list[Row]) -> list[bool]:
    """Whether half of the angle is added to an RBEND's E1 and E2; the more probable first."""
    bends = [row for row in rows if str(row["KEYWORD"]).upper() == "RBEND" and row.get("ANGLE")]
    if not bends:
        return [False]
    whole = any(abs(float(row.get("E1") or 0.0)) > abs(float(row["ANGLE"])) / 4 for row in bends)
    return [not whole, whole]


def _first_strength(row: Row) -> float:
    return float(row.get("K0L") or row.get("ANGLE") or 0.0)


def _bends_thinly(row: Row) -> bool:
    return str(row["KEYWORD"]).upper() == "MULTIPOLE" and _first_strength(row) != 0


_FACES = {"SBEND": ("E1", "E2"), "RBEND": ("E1", "E2"), "SROTATION": ("ANGLE",)}
NEEDED_BY = {
    "QUADRUPOLE": ("K1L",), "SEXTUPOLE": ("K2L",), "SBEND": ("ANGLE", "K0L"),
    "RBEND": ("ANGLE", "K0L"), "SOLENOID": ("KS", "KSI"), "MULTIPOLE": ("K1L", "K2L"),
}  # fmt: skip
"""Without any of these columns the elements of a class would be read as drifts."""


def _check_columns(path: Path, rows: list[Row], columns: frozenset[str]) -> None:
    """Raises a LatticeError where an element's fields are in none of the columns, or no number."""
    for row in rows:
        keyword = str(row["KEYWORD"]).upper()
        for column in _NUMERIC & columns:
            if not math.isfinite(row[column]):
                raise LatticeError(
                    f"'{path}' has no number in the column {column} of "
                    f"'{plain(str(row['NAME']), 60)}'; write the table again"
                )
        needed = NEEDED_BY.get(keyword, ())
        if needed and not columns & set(needed):
            raise LatticeError(
                f"'{path}' has the {keyword} '{plain(str(row['NAME']), 60)}' and no column "
                f"{' or '.join(needed)}; write the table with it"
            )


def _advice(columns: Any, rows: list[Row]) -> str:
    if any(map(_bends_thinly, rows)) and "LRAD" not in columns:
        return "its thin bends focus by their length, which it does not state: add the column LRAD"
    start, end = (
        np.array([rows[k].get(key, 0.0) for key in ("BETX", "BETY")], dtype=float) for k in (0, -1)
    )
    if not np.allclose(start, end, rtol=1e-3):
        return "BETX and BETY are not periodic: write it of the whole ring, without initial values"
    known = ("ANGLE", "K0L", "K1L", "K2L", "K0SL", "K1SL", "K2SL", "TILT", "E1", "E2", "H1", "H2",
             "FINT", "FINTX", "HGAP", "HKICK", "VKICK")  # fmt: skip
    lacks = [column for column in known if column not in columns]
    rest = f" and the columns {', '.join(lacks)}" if lacks else ""
    return f"write it of the whole ring, with all elements{rest}"


def _number(header: dict[str, Any], key: str) -> float | None:
    value = header.get(key)
    return None if value is None else float(value)


def _with_drifts(
    path: Path, rows: list[Row], length: float | None, half: bool, report: Report
) -> list[Part | float]:
    """The elements in their order, and the gaps between them."""
    close = CLOSE + DIGITS * (length or float(rows[-1]["S"]) if rows else 0.0)
    starts = {share: [r["S"] - share * r["L"] for r in rows] for share in (1.0, 0.5)}
    fits = []
    for share, begin in starts.items():
        before = [0.0, *(s + r["L"] for s, r in zip(begin, rows, strict=True))]
        if all(s > b - close for s, b in zip(begin, before, strict=False)):
            fits.append(share)
    if not rows or not fits:
        raise LatticeError(
            f"'{path}' has elements that overlap, whether S is at their exits or in their middle; "
            "give a table of each element once, in their order and without SELECT, FLAG=INTERPOLATE"
        )
    listed = any(str(row["KEYWORD"]).upper() == "DRIFT" for row in rows)
    begins = [*zip((str(row["NAME"]) for row in rows), starts[fits[0]], strict=True)]
    ends = [0.0, *(start + row["L"] for row, (_, start) in zip(rows, begins, strict=True))]
    for (name, start), end in zip([*begins, ("its end", length or ends[-1])], ends, strict=True):
        if listed and start - end > close:
            raise LatticeError(
                f"'{path}' has nothing from {end:.6g} m to {start:.6g} m, before "
                f"'{plain(name, 60)}', and lists its drifts: a row is missing; write it again"
            )
    placed = [
        (_part(path, row, half, report), name, start, float(row["L"]))
        for row, (name, start) in zip(rows, begins, strict=True)
    ]
    return with_gaps(placed, f"'{path}'", length, close, close)


def _part(path: Path, row: Row, half: bool, report: Report) -> Part:
    """One row of the table as an element."""
    name, keyword = str(row["NAME"]).lower(), str(row["KEYWORD"]).lower()
    length = float(row["L"])
    own: dict[str, Any] = {"l": length}
    for attribute in NUMBERS:
        value = row.get(attribute.upper())
        if value is not None:
            own[attribute] = float(value)
    thin_solenoid = keyword == "solenoid" and own.get("ksi") and not (length or own.get("ks"))
    if keyword == "matrix" or thin_solenoid:
        raise LatticeError(
            f"'{path}' has the {keyword.upper()} '{plain(name, 60)}', whose numbers a table does "
            "not hold; give the sequence instead"
        )
    if keyword == "dipedge":
        own["h"] = own.get("h1", 0.0)
        if not own["h"] and (own.get("e1", 1.0) or own.get("fint")):
            raise LatticeError(
                f"'{path}' has the DIPEDGE '{plain(name, 60)}' without its H, which MAD-X 5.09 "
                "writes into H1; write the table with E1 and H1"
            )
    if keyword == "beambeam":  # no column has its charge; the header's tunes have what it does
        own["charge"] = 0.0
        report.left_out("what the BEAMBEAM does", name)
    if keyword in ("sbend", "rbend") and "ANGLE" not in row:  # of early versions
        own["angle"] = float(row.get("K0L") or 0.0)
    if keyword == "rbend":
        keyword = "sbend"
        if half:
            own |= {e: own.get(e, 0.0) + own.get("angle", 0.0) / 2 for e in ("e1", "e2")}
    if keyword == "multipole" and not own.get("angle"):
        own.pop("angle", None)
    for attribute, column in STRENGTHS.items():
        values = [float(row.get(column.format(n)) or 0.0) for n in ORDERS]
        if keyword in MAIN_ORDER:
            own_order = MAIN_ORDER[keyword] if length else None
            acting = [v if n == own_order else 0.0 for n, v in enumerate(values)]
            if acting != values:
                what = f"fields of the {keyword.upper()} beyond its own (as in MAD-X's TWISS)"
                report.left_out(what, name)
            values = acting
        if keyword == "sbend" and attribute == "knl":
            field, values[0] = values[0], 0.0
            if field and "ANGLE" in row:  # the whole field, where it is not that of the angle
                own["k0"] = field / length
        elif keyword == "sbend" and any(values):
            report.left_out("skew fields of the SBEND (as in MAD-X's TWISS)", name)
            continue
        if any(values):
            own[attribute] = values
    kept = MODELLED.get(keyword)
    return Part(name, keyword, own if kept is None else {
        k: v for k, v in own.items() if k in kept or k == "l"
    })  # fmt: skip
