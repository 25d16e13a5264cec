"""Reading a table of MAD-X (TFS), as TWISS writes it: a thick lattice, element by element.

Columns that are needed: NAME, KEYWORD, S (at each element's exit, or in its middle), L. Those that
say fields are taken where they are there: ANGLE, E1, E2, HGAP, FINT, FINTX, TILT; the integrated
strengths K0L to K3L and K0SL to K2SL; KS or KSI of a solenoid; HKICK, VKICK; VOLT (MV), FREQ (MHz).
What lies between two elements is a drift. An RBEND's edges are E1 + ANGLE / 2 and E2 + ANGLE / 2.
"""

import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError
from tmlattice.lattice.places import Place, corrector, corrector_pair, place_elements
from tmlattice.lattice.ring import ELECTRON_GEV, Kind, Ring

NEEDED = ("NAME", "KEYWORD", "S", "L")
CLOSE = 1e-6
"""m; two elements may overlap by this much: a table has ten digits."""

Row = dict[str, Any]


def read_tfs(path: Path, name: str, energy: float | None = None) -> Ring:
    """The ring of a table of MAD-X.

    Args:
        path: of the file.
        name: of the ring.
        energy: GeV; else the header's ENERGY, of its particle of rest energy MASS.

    Raises:
        LatticeError: a column is missing, elements overlap, or tfs-pandas is.

    Warns:
        Of what is left out: bending thin multipoles, orders above the octupole.
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
        said = " ".join(str(error).split())
        raise LatticeError(f"'{path}' cannot be read as a table of MAD-X ({said})") from error
    table.columns = [str(column).upper() for column in table.columns]
    missing = [column for column in NEEDED if column not in table.columns]
    if missing:
        raise LatticeError(
            f"'{path}' has no column {', '.join(missing)}; write the table with "
            "select, flag=twiss, column=name,keyword,s,l,angle,k1l,k2l,k1sl,tilt,e1,e2"
        )
    if energy is None:
        energy = _header(table, "ENERGY")
    if energy is None:
        raise LatticeError(f"'{path}' states no ENERGY; say energy= (GeV)")
    rows: list[Row] = table.to_dict("records")
    left_out: Counter[str] = Counter()
    places = _with_drifts(path, rows, _header(table, "LENGTH"), left_out)
    if left_out:
        what = ", ".join(f"{reason} ({count})" for reason, count in left_out.items())
        warnings.warn(f"'{name}': left out of the model: {what}", stacklevel=3)
    families, kinds, sources = zip(*places, strict=True)
    mass = _header(table, "MASS") or ELECTRON_GEV
    mass = ELECTRON_GEV if mass < 2 * ELECTRON_GEV else mass
    return Ring(name, place_elements(families, sources, kinds), energy, mass=mass)


def _header(table: Any, key: str) -> float | None:
    value = {str(k).upper(): v for k, v in table.headers.items()}.get(key)
    return None if value is None else float(value)


def _with_drifts(
    path: Path, rows: list[Row], length: float | None, left_out: Counter[str]
) -> list[Place]:
    """The elements in their order, with drifts where the table has none."""
    from tmlattice.lattice.ocelot import elements

    starts = {share: [r["S"] - share * r["L"] for r in rows] for share in (1.0, 0.5)}
    fits = []
    for share, begin in starts.items():
        before = [0.0, *(s + r["L"] for s, r in zip(begin, rows, strict=True))]
        if all(s > b - CLOSE for s, b in zip(begin, before, strict=False)):
            fits.append(share)
    if not rows or not fits:
        raise LatticeError(
            f"'{path}' has elements that overlap, whether S is at their exits or in their middle; "
            "give a table of all elements in their order"
        )
    places: list[Place] = []
    at = 0.0
    for row, start in zip(rows, starts[fits[0]], strict=True):
        if start - at > CLOSE:
            places.append(("drift", "drift", elements.Drift(l=start - at, eid="drift")))
        places += _places(row, left_out)
        at = start + row["L"]
    if length is not None and length - at > CLOSE:
        places.append(("drift", "drift", elements.Drift(l=length - at, eid="drift")))
    return places


def _places(row: Row, left_out: Counter[str]) -> list[Place]:
    """What one row of the table is in the ring."""
    from tmlattice.lattice.combined import FIELDS, CombinedMultipole
    from tmlattice.lattice.ocelot import elements as ocelot

    name, length = str(row["NAME"]).lower(), float(row["L"])
    tilt = _number(row, "TILT")
    fields = {k: _number(row, f"{k}L".upper()) / (length or 1.0) for k in FIELDS}
    octupole = _number(row, "K3L") / (length or 1.0)
    keyword = str(row["KEYWORD"]).upper()

    def one(kind: Kind, source: Any) -> list[Place]:
        return [(name, kind, source)]

    match keyword:
        case "RBEND" | "SBEND":
            return one("bend", _bend(row, name, length, fields, left_out))
        case "HKICKER" | "VKICKER":
            if keyword == "HKICKER":
                return [corrector(name, "h", length, _number(row, "HKICK"))]
            return [corrector(name, "v", length, _number(row, "VKICK"))]
        case "KICKER" | "TKICKER":
            return corrector_pair(name, length, _number(row, "HKICK"), _number(row, "VKICK"))
        case "MONITOR" | "HMONITOR" | "VMONITOR":
            return one("monitor", ocelot.Monitor(l=length, eid=name))
        case "RFCAVITY":
            voltage, frequency = 1e-3 * _number(row, "VOLT"), 1e6 * _number(row, "FREQ")
            return one("cavity", ocelot.Cavity(l=length, v=voltage, freq=frequency, eid=name))
        case "SOLENOID":
            field = _number(row, "KS") or _number(row, "KSI") / (length or 1.0)
            return one("solenoid", ocelot.Solenoid(l=length, k=field / 2, eid=name))
        case "QUADRUPOLE" | "SEXTUPOLE" | "OCTUPOLE" | "MULTIPOLE":
            kind: Kind = keyword.lower()  # type: ignore[assignment]
            own = {"quadrupole": "k1", "sextupole": "k2"}.get(kind)
            if kind == "octupole" and not any(fields.values()):
                return one(kind, ocelot.Octupole(l=length, k3=octupole, tilt=tilt, eid=name))
            if octupole:
                left_out["octupole fields of other magnets"] += 1
            if kind == "multipole" and _number(row, "ANGLE"):
                left_out["bending of thin multipoles"] += 1
            if own and length and not any(v for k, v in fields.items() if k != own):
                cls = ocelot.Quadrupole if own == "k1" else ocelot.Sextupole
                return one(kind, cls(l=length, **{own: fields[own]}, tilt=tilt, eid=name))
            return one(kind, CombinedMultipole(l=length, **fields, tilt=tilt, eid=name))
    if length:
        return one("drift", ocelot.Drift(l=length, eid=name))
    return one("marker", ocelot.Marker(eid=name))


def _number(row: Row, column: str) -> float:
    value = row.get(column)
    return 0.0 if value is None else float(value)


def _bend(
    row: Row, name: str, length: float, fields: dict[str, float], left_out: Counter[str]
) -> Any:
    from tmlattice.lattice.ocelot import elements as ocelot

    angle = _number(row, "ANGLE")
    half = angle / 2 if str(row["KEYWORD"]).upper() == "RBEND" else 0.0
    if any(fields[key] for key in ("k0s", "k1s", "k2s")):
        left_out["skew fields of bends"] += 1
    fint = _number(row, "FINT")
    fintx = row.get("FINTX")
    return ocelot.SBend(
        l=length,
        angle=angle,
        k1=fields["k1"],
        k2=fields["k2"],
        e1=_number(row, "E1") + half,
        e2=_number(row, "E2") + half,
        tilt=_number(row, "TILT"),
        gap=2 * _number(row, "HGAP"),
        fint=fint,
        fintx=fint if fintx is None or float(fintx) < 0 else float(fintx),
        eid=name,
    )
