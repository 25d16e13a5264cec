"""Knobs of a correction: power supplies, magnets and the RF, with their settings and limits.

A knob applies an effect of the catalogue to all of its members alike. Its setting is in the unit of
its supply; an excitation curve gives the strength of a setting.

>>> knobs = default_knobs(ring)
>>> knobs = read_knobs(Path("knobs.yaml"), ring)
"""

import csv
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.beam.rf import rf_of
from tmlattice.effects import Cause, check, find
from tmlattice.errors import EffectError, MeasurementError, plain, unknown_choice
from tmlattice.inference.judgement import BEYOND
from tmlattice.input_files import number, text_of, yaml_of
from tmlattice.lattice import Ring
from tmlattice.lattice.supplies import magnets, supplied_alike
from tmlattice.measurement.rows import not_csv

Curve = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Kind:
    """A kind of knob.

    Attributes:
        effect: of the catalogue, applied to each member; None: the RF frequency.
        strength: OCELOT's attribute that it sets, as in snippets.
        unit: of the strength.
        relative: whether the effect's amount is the relative change of the strength.
        family: the effect on several magnets of one supply.
        error: default relative error of a change: calibration and hysteresis of quadrupoles are
            known to a per cent, a corrector's to the usual size of its error.
    """

    effect: str | None
    strength: str
    unit: str
    relative: bool
    family: str = ""
    error: float = 0.01


CALIBRATED = find("corrector_calibration").background or 0.0
KINDS: dict[str, Kind] = {
    "quadrupole": Kind("quadrupole_gradient", "k1", "1/m2", True, "family_gradient"),
    "skew_quadrupole": Kind("skew_gradient", "k1sl", "1/m", False),
    "sextupole": Kind("sextupole_strength", "k2", "1/m3", True, "family_sextupole"),
    "hcorrector": Kind("corrector_kick_x", "kick", "rad", False, error=CALIBRATED),
    "vcorrector": Kind("corrector_kick_y", "kick", "rad", False, error=CALIBRATED),
    "rf": Kind(None, "frequency", "Hz", True, error=0.0),
}


@dataclass(frozen=True)
class Knob:
    """One device that can be set.

    Attributes:
        name: of the supply or device.
        kind: of `KINDS`.
        members: names of the elements that it powers; none of the RF.
        unit: of its setting.
        present: setting.
        low, high: limits of the setting; infinite: those of `within_range`.
        step: smallest change of the setting; 0: none.
        curve: points (setting, strength) in rising settings; none: the strength is proportional to
            the setting (of an effect that adds, equal to it).
        error: relative error of a change.
        scale: strength over the curve's: a corrector's calibration.
    """

    name: str
    kind: str
    members: tuple[str, ...]
    unit: str
    present: float
    low: float = -math.inf
    high: float = math.inf
    step: float = 0.0
    curve: Curve = ()
    error: float = 0.0
    scale: float = 1.0

    def strength(self, setting: float) -> float:
        """Return the strength by the excitation curve, extrapolated along its last piece."""
        if not self.curve:
            return setting
        x, y = np.array(self.curve).T
        i = int(np.clip(np.searchsorted(x, setting) - 1, 0, len(x) - 2))
        return float(y[i] + (setting - x[i]) * (y[i + 1] - y[i]) / (x[i + 1] - x[i]))

    def setting(self, amount: float) -> float:
        """Return the setting of an amount of the effect."""
        now = self.strength(self.present)
        wanted = now * (1 + amount) if KINDS[self.kind].relative else now + amount / self.scale
        if not self.curve:
            return wanted
        inverse = replace(self, curve=tuple(sorted((y, x) for x, y in self.curve)))
        return inverse.strength(wanted)

    def amount(self, setting: float) -> float:
        """Return the amount of the effect at a setting."""
        now, then = self.strength(self.present), self.strength(setting)
        return then / now - 1 if KINDS[self.kind].relative else self.scale * (then - now)

    def rounded(self, amount: float) -> float:
        """Return the amount at the nearest setting within the limits and the step."""
        setting = self.setting(amount)
        if self.step:
            setting = self.present + self.step * round((setting - self.present) / self.step)
            if setting > self.high:
                setting -= self.step
            if setting < self.low:
                setting += self.step
        return self.amount(setting)

    @property
    def bounds(self) -> tuple[float, float]:
        """Limits of the amount; a present setting beyond its limits may stay."""
        rises = math.copysign(1.0, self.amount(self.present + 1.0))
        ends = (min(self.low, self.present), max(self.high, self.present))
        low, high = sorted(self.amount(e) if math.isfinite(e) else rises * e for e in ends)
        return low, high

    def row(self) -> dict[str, str]:
        """Return the texts of a table's columns, see `COLUMNS`."""
        limits = ["" if math.isinf(end) else f"{end:.9g}" for end in (self.low, self.high)]
        step = f"{self.step:.9g}" if self.step else ""
        curve = " ".join(f"{x:.9g}:{y:.9g}" for x, y in self.curve)
        texts = (self.name, self.kind, " ".join(self.members), self.unit, f"{self.present:.9g}",
                 *limits, step, f"{self.error:g}", curve)  # fmt: skip
        return dict(zip(COLUMNS, texts, strict=True))

    def causes(self, amount: float) -> list[Cause]:
        """Return the causes of an amount in the ring."""
        effect = KINDS[self.kind].effect
        if effect is None or not amount:
            return []
        return [Cause(effect, member, amount) for member in self.members]


def chosen_knobs(
    knobs: Sequence["Knob | str"] | str | Path | None, ring: Ring, targets: Collection[str]
) -> list[Knob]:
    """Return knobs that are given in any form.

    Args:
        knobs: devices, or kinds of `default_knobs`; or the path of a table; None: those of the
            targets.
        ring: with the present settings.
        targets: names.

    Raises:
        ChoiceError, MeasurementError, UnknownNameError: knobs that cannot be used.
    """
    if isinstance(knobs, str | Path):
        return read_knobs(Path(knobs), ring)
    if knobs is None:
        orbit = {"closed_orbit", "first_turn"} & set(targets)
        optics = [] if set(targets) <= orbit else ["supplies", "skew_quadrupoles"]
        knobs = [*optics, *["correctors"] * bool(orbit)]
    kinds = [own for own in knobs if isinstance(own, str)]
    every = [*(own for own in knobs if isinstance(own, Knob)), *default_knobs(ring, kinds)]
    check_distinct("the knobs", every)
    return [within_range(own, ring) for own in every]


def within_range(knob: Knob, ring: Ring) -> Knob:
    """Return the knob with limits where it states none: a strength of the design is set as far as
    undoes the largest plausible fault of the supply, or of its one magnet."""
    kind = KINDS[knob.kind]
    if not kind.family:
        return knob
    alone = len({ring.pieces(ring[member].name) for member in knob.members}) == 1
    most = BEYOND * find(str(kind.effect) if alone else kind.family).largest
    low, high = sorted(knob.setting(side * most) for side in (-1, 1))
    return replace(knob, low=knob.low if math.isfinite(knob.low) else low,
                   high=knob.high if math.isfinite(knob.high) else high)  # fmt: skip


def check_distinct(where: str, knobs: Iterable[Knob]) -> None:
    """Raise a MeasurementError if two knobs have one name, or change the same strength of a magnet:
    the new setting of each would undo the other's."""
    names: set[str] = set()
    owners: dict[tuple[str | None, str], str] = {}
    for knob in knobs:
        if knob.name.casefold() in names:
            raise MeasurementError(
                f"{where}: the knob '{plain(knob.name, 40)}' occurs twice (case does not matter)"
            )
        names.add(knob.name.casefold())
        for member in knob.members:
            key = KINDS[knob.kind].effect, member.casefold()
            if key in owners:
                both = " and ".join(f"'{plain(n, 40)}'" for n in (owners[key], knob.name))
                raise MeasurementError(
                    f"{where}: '{plain(member, 40)}' is a member of {both}; keep it in one"
                )
            owners[key] = knob.name


def default_knobs(ring: Ring, kinds: Iterable[str] | None = None) -> list[Knob]:
    """Return the knobs of a lattice: quadrupole supplies, skew quadrupoles, correctors.

    Args:
        ring: with the present settings.
        kinds: instead, any of "supplies", "quadrupoles" (each magnet alone), "skew_quadrupoles",
            "correctors", "sextupoles" (by families), "rf".

    Raises:
        ChoiceError: another kind.
    """
    made = {
        "supplies": lambda: _grouped(ring, "quadrupole", _supplies(ring)),
        "quadrupoles": lambda: _grouped(ring, "quadrupole", {}),
        "skew_quadrupoles": lambda: [
            _knob(own[0].name, "skew_quadrupole", (own[0].name,),
                  sum(p.errors.k1sl + p.k1 * p.length * -math.sin(2 * p.tilt) for p in own))
            for own in magnets(ring, ("quadrupole",)) if not _upright(ring, own[0].name)
        ],
        "correctors": lambda: [
            _knob(e.name, e.kind, (e.name,), e.angle)
            for e in ring.elements if e.is_corrector
        ],
        "sextupoles": lambda: _grouped(
            ring, "sextupole", {e.name: e.family for e in ring.elements if e.kind == "sextupole"}
        ),
        "rf": lambda: [_knob("rf", "rf", (), rf_of(ring).frequency(ring))],
    }  # fmt: skip
    found = []
    for kind in ("supplies", "skew_quadrupoles", "correctors") if kinds is None else kinds:
        if kind not in made:
            raise unknown_choice("kind of knobs", kind, made)
        found += made[kind]()
    return found


def _knob(name: str, kind: str, members: tuple[str, ...], present: float) -> Knob:
    own = KINDS[kind]
    return Knob(name, kind, members, own.unit, present, error=own.error)


def _upright(ring: Ring, name: str) -> bool:
    return abs(abs(ring[name].tilt) - math.pi / 4) > 0.1


def _grouped(ring: Ring, kind: str, owner: Mapping[str, str]) -> list[Knob]:
    """Knobs of powered magnets, those of one owner together, and alone without one."""
    strength = KINDS[kind].strength
    groups: dict[str, list[str]] = {name: [] for name in owner.values()}
    for own in magnets(ring, (kind,)):
        members = [piece.name for piece in own if getattr(piece, strength)]
        if members and (kind != "quadrupole" or _upright(ring, members[0])):
            groups.setdefault(owner.get(own[0].name, own[0].name), []).extend(members)
    return [
        _knob(name, kind, tuple(members), getattr(ring[members[0]], strength))
        for name, members in groups.items()
        if members
    ]


def _supplies(ring: Ring) -> dict[str, str]:
    """Owners of quadrupoles: families, or those of equal design strength."""
    names = [pieces[0].name for pieces in magnets(ring, ("quadrupole",), powered=True)]
    kinds, belongs = supplied_alike(ring)
    owner: dict[str, str] = {}
    for kind, column in zip(kinds, belongs.T, strict=True):
        own = [names[i] for i in np.flatnonzero(column)]
        families = {ring[name].family for name in own}
        owner |= dict.fromkeys(own, families.pop() if len(families) == 1 else kind)
    return owner


# --- tables ---------------------------------------------------------------------------------------
ROUNDING = 1e-6
"""Of settings in a table, relative."""
COLUMNS = (
    "knob", "kind", "members", "unit", "present", "low", "high", "step", "error", "curve",
)  # fmt: skip
"""Columns of a table of knobs; `members` are names separated by spaces, `curve` is points
`setting:strength` separated by spaces. All but the knob may be empty."""


def read_knobs(path: Path, ring: Ring) -> list[Knob]:
    """Knobs of a table: .csv with the header `COLUMNS`, or .yaml with a list of such mappings; see
    `knobs_of`. Of the settings.csv of a correction, its new settings are the present ones.

    Raises:
        MeasurementError: a table that cannot be read, with the knob.
        UnknownNameError: a member that is not in the ring.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        rows = yaml_of(path, MeasurementError)
    else:
        rows = _table(path)
        if rows and {"device", "new"} <= rows[0].keys():
            return [replace(knob, present=new) for knob, new in read_settings(path, ring)]
    return knobs_of(rows, path, ring)


def _table(path: Path) -> list[dict[str, Any]]:
    reader = csv.DictReader(StringIO(text_of(path, MeasurementError)), restkey="", strict=True)
    try:
        columns = list(reader.fieldnames or ())
        if twice := [name for name in columns if columns.count(name) > 1]:
            raise MeasurementError(f"{path}: the column '{plain(twice[0], 40)}' stands twice")
        rows = []
        for row in reader:
            if any(row.pop("", ())):
                raise MeasurementError(
                    f"{path}, line {reader.line_num}: more than the {len(columns)} fields of the "
                    "header"
                )
            rows.append(row)
    except csv.Error as error:
        raise not_csv(path, reader.reader.line_num, error) from error
    return rows


def read_settings(path: Path, ring: Ring) -> list[tuple[Knob, float]]:
    """Return devices and their new settings, from the settings.csv of a correction.

    Args:
        path: of the table.
        ring: whose strengths are the present settings.

    Raises:
        MeasurementError, UnknownNameError: a table that cannot be read, or a device that the ring
            does not have.
    """
    rows: list[dict[str, Any]] = []
    new: list[float] = []
    for row in _table(path):
        try:
            there, then = number(str(row["present"])), number(str(row.pop("new")))
            change = number(row.get("change") or str(then - there))
            if not (math.isfinite(then) and math.isfinite(there)):
                raise ValueError
            rows.append({**row, "knob": row.pop("device"), "present": there})
            new.append(then)
        except (KeyError, TypeError, ValueError):
            raise MeasurementError(
                f"{path}: a row has no device, present or new; give the settings.csv of a "
                f"correction (found: {plain(str(row), 80)})"
            ) from None
        if not abs(then - there - change) <= ROUNDING * max(abs(then), abs(there)):
            raise MeasurementError(
                f"{path}: the change of '{plain(str(rows[-1]['knob']), 40)}' is {change:.9g}, but "
                f"its new setting less the present one is {then - there:.9g}; correct the row"
            )
        for derived in ("device", "change", "gain"):
            rows[-1].pop(derived, None)
    if not rows:
        raise MeasurementError(f"{path}: it contains no setting")
    return list(zip(knobs_of(rows, path, ring), new, strict=True))


def knobs_of(rows: Any, path: Path, ring: Ring) -> list[Knob]:
    """Knobs of rows of a table, each a mapping with the keys `COLUMNS`.

    A knob that the lattice shows too takes from there what the row leaves out.

    Args:
        rows: of the table.
        path: of the file that holds them, for messages.
        ring: whose strengths are the present settings.

    Raises:
        MeasurementError, UnknownNameError: as of `read_knobs`.
    """
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows) or not rows:
        raise MeasurementError(f"{path}: it contains no list of knobs; `--example` writes one")
    every = ("supplies", "quadrupoles", "skew_quadrupoles", "correctors", "sextupoles", "rf")
    shown = {knob.name.casefold(): knob for knob in reversed(default_knobs(ring, every))}
    knobs = [_read(path, row, ring, shown) for row in rows]
    check_distinct(str(path), knobs)
    return knobs


def _read(path: Path, row: Mapping[str, Any], ring: Ring, shown: Mapping[str, Knob]) -> Knob:
    given = {key: value for key, value in row.items() if value not in (None, "", [])}
    name = str(given.pop("knob", "")).strip()
    where = f"{path}: knob '{plain(name, 40)}'"
    if not name or (strange := set(given) - set(COLUMNS)):
        what = f"{path}: a row without a knob"
        if name:
            what = f"{where}: unknown column {plain(str(min(map(str, strange))), 40)}"
        raise MeasurementError(f"{what}; the columns are {', '.join(COLUMNS)}")
    members = given.pop("members", ())
    names = members.split() if isinstance(members, str) else list(members)
    if not all(isinstance(member, str) for member in names):
        raise MeasurementError(f"{where}: its members are no list of names")
    kind = str(given.pop("kind", "")).strip()
    known = shown.get(name.casefold())
    if kind and kind not in KINDS:
        raise MeasurementError(f"{where}: no kind '{plain(kind, 40)}'; {', '.join(KINDS)}")
    if names:
        first = ring[names[0]]
        kind = kind or (first.kind if first.kind in KINDS else "")
        if not kind:
            raise MeasurementError(f"{where}: state its kind: {', '.join(KINDS)}")
        pieces = tuple(piece for member in names for piece in ring.pieces(ring[member].name))
        if effect := KINDS[kind].effect:
            try:
                check(ring, [Cause(effect, piece, 0.0) for piece in pieces])
            except EffectError as error:
                raise MeasurementError(f"{where}: {error}") from error
        attribute = {"kick": "angle"}.get(KINDS[kind].strength, KINDS[kind].strength)
        known = _knob(name, kind, pieces, float(getattr(first, attribute, 0.0)))
    if known is None or (kind and kind != known.kind):
        raise MeasurementError(f"{where}: the lattice has none of this name; state its members")
    curve = given.pop("curve", ())
    unit = str(given.pop("unit", known.unit))
    try:
        numbers: dict[str, Any] = {key: number(str(value)) for key, value in given.items()}
        points = curve.split() if isinstance(curve, str) else list(curve)
        pairs = [p.split(":") if isinstance(p, str) else p for p in points]
        read = tuple(sorted((number(str(x)), number(str(y))) for x, y in pairs))
    except (TypeError, ValueError):
        raise MeasurementError(
            f"{where}: a value is not a number; a curve is 'setting:strength setting:strength'"
        ) from None
    if unit != known.unit and "present" not in numbers:
        raise MeasurementError(f"{where}: its unit is {plain(unit, 20)}; state its present setting")
    knob = replace(known, name=name, unit=unit, curve=read, **numbers)
    _check(where, knob)
    return knob


def _check(where: str, knob: Knob) -> None:
    numbers = [knob.present, knob.step, knob.error, *(v for pair in knob.curve for v in pair)]
    if not all(map(math.isfinite, numbers)) or knob.step < 0 or knob.error < 0:
        raise MeasurementError(f"{where}: its numbers must be finite, its step and error not < 0")
    if not knob.low < knob.high:
        raise MeasurementError(f"{where}: its limits are {knob.low:g} and {knob.high:g}")
    x, y = (np.array(v) for v in zip(*knob.curve, strict=True)) if knob.curve else (None, None)
    if x is not None and y is not None:
        falls = np.diff(y) * (y[-1] - y[0])
        if len(x) < 2 or (np.diff(x) <= 0).any() or (falls <= 0).any():
            raise MeasurementError(f"{where}: its curve must rise, or fall, from point to point")
    if KINDS[knob.kind].relative and knob.strength(knob.present) == 0:
        raise MeasurementError(
            f"{where}: its present strength is 0, of which no change is relative; state its "
            "present setting"
        )


def write_knobs(path: Path, knobs: Iterable[Knob]) -> None:
    """Write a table of knobs for `read_knobs`, .csv."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(knob.row() for knob in knobs)
