"""An AT element of the fields that a MATLAB file has of it.

A pass method of the file chooses nothing that is loaded: one that AT does not ship becomes the one
of AT that the element's fields are of, and a drift where they are of none.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError
from tmlattice.importers.imported import is_number
from tmlattice.lattice.at_child import shipped_methods
from tmlattice.lattice.checks import LONGEST
from tmlattice.lattice.expressions import check_order, of_fields

EMPTY = ("DriftPass", "IdentityPass")
"""Of what has no field."""
NO_ORBIT = ("AperturePass", "EAperturePass", "LongtAperturePass", "QuantDiffPass")
"""Of what moves no orbit: it is a marker."""
TURNED_BY_AT = ("dx", "dy", "dz", "pitch", "yaw", "tilt", "reference")
"""Names that AT's Python has for displacements which a MATLAB file keeps in T1, T2, R1 and R2: its
constructors would take a file's own use of them for these."""


def at_element(fields: Mapping[str, Any], place: int, energy: float, messages: Counter[str]) -> Any:
    """Return the element; LatticeError: AT cannot make it.

    Args:
        place: in the lattice, from 0, for errors.
        energy: of the ring, GeV.
        messages: what was done, counted; added to.
    """
    if not isinstance(fields, Mapping):
        raise LatticeError(f"element {place + 1} of the lattice is no structure; save it again")
    kept = {key: value for key, value in fields.items() if _is_data(value)}
    length = kept.get("Length", 0.0)
    if not is_number(length) or abs(length) > LONGEST:
        raise LatticeError(f"element {place + 1} of the lattice has the length {length!r:.40}")
    name, method = kept.get("FamName"), kept.get("PassMethod")
    kept["FamName"] = name if isinstance(name, str) and name else f"element_{place + 1}"
    if not isinstance(method, str) or method not in shipped_methods():
        kept["PassMethod"] = _method_of(kept)
        empty = kept["PassMethod"] in EMPTY
        as_what = "a drift" if empty else f"{kept['PassMethod']}, by its fields"
        messages[f"'{str(method)[:40]}' is no pass method of AT: {as_what}"] += 1
        if empty:
            kept = {key: kept[key] for key in ("FamName", "PassMethod")} | {"Length": length}
    if kept["PassMethod"] in NO_ORBIT:
        kept = {"FamName": kept["FamName"], "Class": "Marker", "PassMethod": "IdentityPass"}
    check_order(kept)
    _one_gradient(kept)
    _complete(kept, energy)
    try:
        return of_fields(kept, index=place, check=False, quiet=True)
    except LatticeError as error:
        raise LatticeError(f"element {place + 1} of the lattice: {error}") from error


def _is_data(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "fiub" and value.size > 0
    return isinstance(value, int | float | str)


def _method_of(fields: Mapping[str, Any]) -> str:
    """AT's own pass method of such fields."""
    if np.shape(fields.get("M66", 0)) == (6, 6):
        return "Matrix66Pass"
    multipole = any(np.size(fields.get(name, ())) for name in ("PolynomA", "PolynomB"))
    if is_number(fields.get("BendingAngle")):
        return "BndMPoleSymplectic4Pass" if multipole else "BendLinearPass"
    if multipole:
        return "StrMPoleSymplectic4Pass" if fields.get("Length") else "ThinMPolePass"
    if is_number(fields.get("K")) and fields.get("Length"):
        return "QuadLinearPass"
    if np.size(fields.get("KickAngle", ())) == len("xy"):
        return "CorrectorPass"
    return "DriftPass" if fields.get("Length") else "IdentityPass"


def _one_gradient(fields: dict[str, Any]) -> None:
    """`K` and `PolynomB` both state the gradient; a linear pass method follows `K`."""
    if "PolynomB" in fields and "K" in fields:
        gradient = fields.pop("K")
        if "Linear" in str(fields.get("PassMethod")):
            given = np.ravel(fields["PolynomB"]).astype(float)
            orders = np.pad(given, (0, max(0, 2 - len(given))))
            orders[1] = float(np.ravel(gradient)[0])
            fields["PolynomB"] = orders
            fields["MaxOrder"] = max(1, int(fields.get("MaxOrder", 1)))


def _complete(fields: dict[str, Any], energy: float) -> None:
    """What AT's constructors want and older files have not, or have otherwise."""
    for name in TURNED_BY_AT:
        fields.pop(name, None)
    if "Frequency" in fields:  # a cavity cannot be made without
        fields.setdefault("Energy", energy * 1e9)
    if "KickAngle" in fields and np.size(fields["KickAngle"]) == 1:
        fields["KickAngle"] = np.array([float(np.ravel(fields["KickAngle"])[0]), 0.0])
    if fields["PassMethod"] == "IdTablePass":  # before AT 2 a table of kicks had no first order
        fields.setdefault("Normalization_energy", energy)
        fields.setdefault("Filename_in", "")
        fields.setdefault("Nslice", 1.0)
        for plane in "xy":
            if f"{plane}kick" in fields:
                fields.setdefault(f"{plane}kick1", np.zeros_like(fields[f"{plane}kick"]))
