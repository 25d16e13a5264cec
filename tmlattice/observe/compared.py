"""Global errors of data that are compared with the design's, column by column.

>>> search = compared(ring, measured)
>>> search.verdict()

An orbit response, orbit changes, dispersion and betatron lines are the design's to a tenth or so,
tunes to a few hundredths. A wrong sign, unit or order of all readings makes nearly all columns
unrelated to the design. A single bad corrector is one column, a single bad BPM a small part of all.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import TINY, Array, ComplexArray, Flags
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.effects import modelled
from tmlattice.errors import MeasurementError, first_of
from tmlattice.inference.judgement import FEW, GROSS, MISSTATED
from tmlattice.lattice import Ring
from tmlattice.measurement import ClosedOrbit, Dispersion, OrbitResponse, TuneReading, TurnByTurn
from tmlattice.measurement.assume import assume, read_of
from tmlattice.measurement.shots import FEWEST
from tmlattice.observe.global_errors import Names, Search, Verdict
from tmlattice.observe.orbits import closed_orbits, dispersion
from tmlattice.observe.response_data import NO_RF
from tmlattice.observe.response_data import read as read_rf
from tmlattice.observe.sections import mean_pass
from tmlattice.observe.stored import NOTHING
from tmlattice.observe.turn_by_turn import LINES, ManyTurns, many_turns
from tmlattice.optics import ring_tunes, short_way

USUAL = 0.1
"""Relative misfit of a column by usual errors; distance of a tune from the design's that counts as
a misfit of 1, of which usual errors leave a third."""
GAIN = 2.5
"""Mean fall of the log misfit that the changed columns need."""
OF_RF = 1.4
"""The same for the RF's one orbit, whose size follows from the ring's length."""
UNRELATED, RESEMBLING = 1.5, 0.5
"""Or: typical misfits before and after, of columns that were unrelated and now resemble the
design."""
SCALES = {f"{what}-{by}": factor for what in ("kicks", "rf")
          for by, factor in (("doubled", 2.0), ("halved", 0.5))}  # fmt: skip
NEAR, SIMILAR = 0.15, 0.8
"""Or: ratio of the typical column to the design's, tolerance of its logarithm, and smallest
correlation with the design."""
RESIZED, SAME = 1.7, 0.99
"""Ratio to the design, or its inverse, from which the orbits in a plane have another size; and
correlation from which the optics does not make it: a tune next to an integer that doubles all
orbits shifts their phases so far that less is left."""
ALIKE, APART = 0.95, 0.2
"""Correlation of what was read at a BPM, or by a corrector, with the design's of another one, and
by how much more than with its own, from which it has the name of that one."""
MOST = 0.1
"""Share of them that may be unlike each: in a design far off some are alike by chance, not all."""
LABELS = 2
"""Names that a diagnosis finds swapped by itself, at most."""
LATE, TURNED = (0, 1, -1, 2, -2, 3, -3), 0.3
"""Turns by which BPMs may count otherwise; rad, to which the phases of their lines are those of the
design, where usual errors leave 0.1."""
MOVED = 0.75
"""Quantile of the readings of a column that are those of the plane that is moved."""
SEEN = 1e-3
"""Smallest share of the design's square at the monitors that read a column."""
SHARE = 0.8
"""Share of the changed columns that an assumption must improve."""
ANOTHER = 1.2
"""Misfit of the typical column above which the data are of another ring. That of unrelated ones is
the root of 2, 1.34 to 1.41 with BPMs in random order; next to an integer usual errors make 1.08."""


@dataclass(frozen=True)
class Compared(Search):
    """Search for global errors of one measurement.

    Attributes:
        what: a column.
        least: columns that an assumption must change, at least.
        usual: misfit that usual errors leave.
    """

    what: ClassVar[str]
    least: ClassVar[int] = 1
    usual: ClassVar[float] = USUAL**2

    @property
    def of(self) -> str:
        """What `shown` shows."""
        return f"the typical {self.what} differs from the design's by"

    def shown(self, misfit: float) -> str:
        """A misfit for a sentence."""
        return f"{100 * np.sqrt(misfit):.0f} % of its size"

    @property
    def warnings(self) -> Sequence[str]:
        """Data that could not be used; a sentence each."""
        return ()

    @property
    def tunes(self) -> Sequence[str]:
        """The measured tunes, if there are any; a sentence."""
        return ()

    def other_order(self) -> list[str]:
        """Sentences about single names, or counts of turns, that are in another order."""
        return []

    @abstractmethod
    def misfit(self, names: Names = ()) -> Array:
        """Misfit of each column with assumptions corrected. 0: equal, 2: unrelated to the design,
        4: wrong sign, NaN: no reading of what the design does."""

    def is_scale(self, name: str) -> bool:
        """Whether the typical column's size shows this factor, whatever other errors there are."""
        return False

    def improving(self) -> list[Verdict]:
        """Return the assumptions that improve the data far."""
        stated = self.misfit()
        found = []
        for names in self.candidates():
            other, of_rf = self.misfit(names), names[0].startswith("rf")
            change = np.log((other + self.usual) / (stated + self.usual))
            moved = np.abs(np.nan_to_num(change)) > np.log(2.0)
            few = moved.sum() < (1 if of_rf else self.least)
            if few or (change[moved] < 0).mean() < SHARE:
                continue
            gain = -float(change[moved].sum())
            before, after = (float(np.median(own[moved])) for own in (stated, other))
            corrected = before > UNRELATED and after < RESEMBLING
            corrected |= self.is_scale(names[0])
            if corrected or gain > (OF_RF if of_rf else GAIN) * moved.sum():
                found.append(Verdict(names, gain, before, after, self.of))
        return found

    def corrected(self, names: Names) -> Self:
        """Return the search with assumptions corrected in the data."""
        return replace(self, data=self.assumed(names))


@dataclass(frozen=True)
class OfColumns(Compared):
    """Columns of readings [column, monitor, 2], of the design's size too."""

    @abstractmethod
    def pairs(self, data: Any) -> tuple[Any, Any, Any]:
        """Columns as read, and as the design makes them, [column, monitor, 2], and the squares of
        the noise of their difference."""

    def scale(self) -> float:
        """Ratio of the typical corrector's column to the design's; NaN without one, or if they are
        unrelated."""
        return float("nan")

    def rf_scale(self) -> float:
        """Ratio of the RF's orbit to the design's; NaN without one, or if they are unrelated."""
        return float("nan")

    def is_scale(self, name: str) -> bool:
        """See `Compared`."""
        scale = self.rf_scale() if name.startswith("rf-") else self.scale()
        return name in SCALES and abs(np.log(scale / SCALES[name])) < NEAR

    def sizes(self) -> list[str]:
        """Sentences about columns of another size than the design's, which no assumption has."""
        scale = self.rf_scale()
        if not max(abs(scale), 1 / abs(scale)) > MISSTATED:
            return []
        return [f"the RF's orbit is {scale:.3g} times the design's for its step: correct its unit "
                "(m) or the step's (Hz), or leave it out"]  # fmt: skip

    def misfit(self, names: Names = ()) -> Array:
        """See `Compared`: |measured - design|^2 over the mean of both squares, beyond the noise."""
        read, made, noise = (np.asarray(own) for own in self.pairs(self.assumed(names)))
        there, flat = np.isfinite(read) & ~_outliers(read), (len(read), -1)
        a, b = (np.where(there, own, 0.0).reshape(flat) for own in (read, made))
        square, own = ((values**2).sum(axis=1) for values in (a, b))
        left = ((a - b) ** 2).sum(axis=1) - np.where(there, noise, 0.0).reshape(flat).sum(1)
        size = (square + own) / 2
        whole = (made.reshape(flat) ** 2).sum(axis=1)
        seen = (size > 0) & (own > SEEN * whole)
        return np.where(seen, np.maximum(left, 0.0) / np.where(seen, size, 1.0), np.nan)


def _outliers(read: Array) -> Flags:
    """Which readings [column, monitor, 2] are far above those of their column in the plane that
    is moved."""
    size = np.abs(np.where(np.isfinite(read), read, 0.0))
    usual = np.quantile(size, MOVED, axis=(1, 2), keepdims=True)
    return np.asarray((size > GROSS * usual) & (usual > 0))


def names_of_others(
    what: str, names: Sequence[str], read: Array, made: Array
) -> tuple[str, NDArray[np.intp]]:
    """Return a sentence about names that stand in another order, in both planes or in one, and
    which these are: what was read [name, .., plane] is what the design makes of others. Empty if
    there are none.

    Args:
        what: a BPM, or a corrector.
        names: of them.
        read, made: as read and as the design makes it, NaN where missing.
    """
    from scipy.optimize import linear_sum_assignment  # takes a fifth of a second

    for planes, where in (([0, 1], ""), ([0], " in x"), ([1], " in y")):
        a, b = (np.nan_to_num(v[..., planes].reshape(len(v), -1)) for v in (read, made))
        there = np.isfinite(read[..., planes]).reshape(a.shape)
        square = (b**2).sum(axis=1)
        if np.median(square**2 / np.maximum((b**4).sum(axis=1), TINY)) < FEW:
            continue  # few numbers are alike by chance
        size = np.sqrt((a**2).sum(axis=1)[:, None] * (there @ (b**2).T))
        alike = a @ b.T / np.where(size > 0, size, 1.0)
        kept = np.flatnonzero(there.any(axis=1))
        alike = alike[np.ix_(kept, kept)]
        here, best = linear_sum_assignment(-alike)
        then, now = alike[here, best], np.diag(alike)
        moved = np.flatnonzero((then > ALIKE) & (now < then - APART))
        if len(moved) > LABELS and np.quantile(then, MOST) > ALIKE:
            pairs = [f"{names[kept[i]]} has what {names[kept[best[i]]]} should have" for i in moved]
            text = f"{len(moved)} {what}s have the names of others{where}: {first_of(pairs, 3)}"
            return f"{text}; give each {what} its own name", kept[moved]
    return "", np.array([], dtype=np.intp)


def ratio(read: Array, made: Array, similar: float = SIMILAR) -> float:
    """Ratio of the typical column [column, monitor, plane] to the design's; NaN if their
    correlation is smaller than that of similar ones."""
    there = np.isfinite(read)
    a, b = (np.where(there, own, 0.0) for own in (read, made))
    both, own, design = ((u * v).sum(axis=(1, 2)) for u, v in ((a, b), (a, a), (b, b)))
    seen = (own > 0) & (design > 0)
    if not seen.any():
        return float("nan")
    alike = float(np.median(both[seen] / np.sqrt(own[seen] * design[seen])))
    return float(np.median(both[seen] / design[seen])) if abs(alike) > similar else float("nan")


@dataclass(frozen=True)
class OfResponse(OfColumns):
    """Orbit changes by correctors, the RF's last; a single bad corrector is no global error."""

    what: ClassVar[str] = "column"
    least: ClassVar[int] = 2

    @property
    def stepped(self) -> bool:
        """Whether there is an orbit of the RF's step."""
        rf = self.data.rf
        return rf is not None and rf.orbit is not None

    @cached_property
    def design(self) -> tuple[Array, Array]:
        """Response to steps of one [corrector, monitor, 2], and to a relative RF step of one."""
        data, model = self.data, ResponseModel.of(self.ring, 6 if self.stepped else 4)
        columns = model.columns(data.correctors)
        for name, plane, own in zip(data.correctors, data.planes, columns.planes, strict=True):
            if plane != own:
                raise MeasurementError(
                    f"corrector '{name}' is stated to kick in {plane}; the ring's kicks in {own}"
                )
        order = {name: i for i, name in enumerate(model.monitors)}
        at = [order[self.ring[name].name] for name in data.monitors]
        of_rf = model.rf_change(NO_RF)[at] / NO_RF if self.stepped else np.zeros((len(at), 2))
        return np.asarray(model.response(data.correctors))[:, at], of_rf

    def pairs(self, data: OrbitResponse) -> tuple[Any, Any, Any]:
        """See `OfColumns`."""
        unit, of_rf = self.design
        read, made = [*data.response], [*(data.kicks[:, None, None] * unit)]
        if data.rf is not None and data.rf.orbit is not None:
            read.append(data.rf.orbit)
            made.append(of_rf * (data.rf.step / data.rf.frequency))
        return np.array(read), np.array(made), 0.0

    def scale(self) -> float:
        """See `OfColumns`."""
        read, made, _ = self.pairs(replace(self.data, rf=None))
        return ratio(read, made)

    def rf_scale(self) -> float:
        """See `OfColumns`."""
        if not self.stepped or not read_rf(self.data):
            return float("nan")
        read, made, _ = self.pairs(self.data)
        return ratio(read[-1:], made[-1:])

    def sizes(self) -> list[str]:
        """See `OfColumns`; of each plane of the correctors too."""
        read, made, _ = self.pairs(replace(self.data, rf=None))
        found = []
        for p, plane in enumerate("xy"):
            own = [own == plane for own in self.data.planes]
            scale = ratio(read[own][..., [p]], made[own][..., [p]], SAME)
            if scale < 1 / RESIZED or scale > RESIZED:
                found.append(f"{scale:.3g} times the design's in {plane}")
        if not found:
            return super().sizes()
        return [f"the orbit changes by the correctors are {' and '.join(found)}: correct their "
                "unit (m) or size, or the kicks' (rad)", *super().sizes()]  # fmt: skip

    def other_order(self) -> list[str]:
        """See `Compared`: names of BPMs, and of correctors."""
        read, made, _ = self.pairs(replace(self.data, rf=None))
        read = np.where(_outliers(read), np.nan, read)
        data = self.data
        found = [
            names_of_others(
                "BPM", data.monitors, *(np.moveaxis(own, 1, 0) for own in (read, made))
            ),
            names_of_others("corrector", data.correctors, read, made),
        ]
        text = "; or ".join(own for own, _ in found if own)
        return [text] if text else []

    def candidates(self) -> list[Names]:
        """Return the assumptions that these data allow."""
        left_out = "rf-" if not self.stepped else "rf-in" if not read_rf(self.data) else "-"
        return [own for own in super().candidates() if not own[0].startswith(left_out)]


@dataclass(frozen=True)
class OfOrbits(OfColumns):
    """Changes of closed orbits between settings, or with the RF frequency."""

    what: ClassVar[str] = "orbit change"
    data: ClosedOrbit | Dispersion

    @cached_property
    def _designs(self) -> dict[str, Array]:
        return {}

    def design(self, data: ClosedOrbit | Dispersion) -> Array:
        """Orbits [state, monitor, 2] of the design in the states of the data."""
        own: Any = self.data
        make: Any = closed_orbits
        if isinstance(data, Dispersion):
            make, pairs = dispersion, zip(own.steps, data.steps, strict=True)
            own = replace(own, steps=tuple(replace(a, step=b.step) for a, b in pairs))
        else:
            own = replace(own, settings=data.settings)
        key = repr([step.step for step in own.steps] if make is dispersion else own.settings)
        if key not in self._designs:
            problem = make(self.ring, own, dict.fromkeys(modelled(), 1.0))
            order = {name: i for i, name in enumerate(self.monitors)}
            at = [order[self.ring[name].name] for name in data.monitors]
            self._designs[key] = problem.read(problem.view(()), NOTHING)[:, at]
        return self._designs[key]

    def pairs(self, data: ClosedOrbit | Dispersion) -> tuple[Any, Any, Any]:
        """See `OfColumns`. One orbit is the sum of all errors, and has no change."""
        read, made = read_of(data), self.design(data)
        if isinstance(data, ClosedOrbit):
            if not any(data.settings):
                return np.full_like(read, np.nan), made, 0.0
            there = np.isfinite(read)
            read, made = (own - mean_pass(own, there) for own in (read, made))
        noise = np.zeros(2) if data.noise is None else np.nan_to_num(data.noise)
        return read, made, 2 * np.broadcast_to(noise, read.shape) ** 2

    def rf_scale(self) -> float:
        """See `OfColumns`."""
        read, made, _ = self.pairs(self.data)
        return ratio(read, made) if isinstance(self.data, Dispersion) else float("nan")

    def candidates(self) -> list[Names]:
        """Return the assumptions that these data allow."""
        kicked = any("kick" in own for shot in getattr(self.data, "settings", ())
                     for own in shot.values())  # fmt: skip
        return [own for own in super().candidates() if kicked or own[0][:8] != "settings"]


@dataclass(frozen=True)
class OfLines(Compared):
    """Betatron lines of turns; each is known up to one complex factor."""

    what: ClassVar[str] = "line"
    first: ManyTurns | None = None

    @cached_property
    def problem(self) -> ManyTurns:
        """The lines of the turns.

        Raises:
            MeasurementError: no line can be used.
        """
        return self.first or self._lines(self.data)

    def _lines(self, data: TurnByTurn, shifted: bool = True) -> ManyTurns:
        places = dict.fromkeys(modelled(turns=True), 1.0)
        return many_turns(self.ring, data, places, shifted=shifted)

    @property
    def warnings(self) -> Sequence[str]:
        """Data that could not be used; a sentence each."""
        return self.problem.warnings

    @property
    def tunes(self) -> Sequence[str]:
        """The measured tunes; a sentence."""
        values, used = self.problem.values[:, -2:], self.problem.used[:, -2:]
        measured = ", ".join(
            f"Q{'xy'[mode]} = {np.mean(values[used[:, mode], mode]) % 1:.4f}"
            for mode in (0, 1) if used[:, mode].any()
        )  # fmt: skip
        return [f"{measured}, near to those of '{self.ring.name}'"]

    def corrected(self, names: Names) -> Self:
        """Return the search with assumptions corrected in the data."""
        return replace(self, data=self.assumed(names), first=None)

    def misfit(self, names: Names = ()) -> Array:
        """See `Compared`; [shot * mode]. The lines are found once, but with planes exchanged, as
        each is sought in its own plane."""
        try:
            a, b = self._lines_of(names)
        except MeasurementError:
            return np.full(1, np.nan)
        inner, size = np.abs((b.conj() * a).sum(axis=(2, 3))) ** 2, self._size(a) * self._size(b)
        left = 1 - inner / np.where(size > 0, size, 1.0)
        return np.where(size > 0, 2 * left, np.nan).ravel()

    def _lines_of(self, names: Names) -> tuple[ComplexArray, ComplexArray]:
        """Lines with assumptions corrected, as read and as the design makes them, 0 where missing,
        [shot, mode, monitor, plane]."""
        problem, change = self.problem, self._changed(names)
        if "planes-swapped" in names:
            problem, change = self._lines(self.assumed(names), False), self._changed(())
        both = np.where(problem.used[:, :LINES], problem.values[:, :LINES], np.nan)
        own = both.reshape(len(both), -1, 2, 2, 2)  # [shot, monitor, plane, mode, re and im]
        read = np.moveaxis(own[..., 0] + 1j * own[..., 1], -1, 1)[:, :, change, [0, 1]]
        if "turns-backwards" in names:
            read = read.conj()
        made = np.stack([np.moveaxis(b.shown.modes, -1, 0) for b in problem.view(()).beams])
        there = np.isfinite(read)
        return np.where(there, read, 0.0), np.where(there, made, 0.0)

    def other_order(self) -> list[str]:
        """See `Compared`: BPMs that count turns otherwise; their lines are turned by the tunes."""
        read, made = (own[0] for own in self._lines_of(()))
        phase = np.angle((read * made.conj()).sum(axis=2))  # [mode, monitor]
        used = np.flatnonzero((read != 0).any(axis=2).all(axis=0))
        tunes = 2 * np.pi * self.problem.values[0, -2:, None, None]
        apart = phase[:, used, None] - phase[:, None, used]  # of each from each
        near = np.array([
            (np.abs((apart - late * tunes + np.pi) % (2 * np.pi) - np.pi) < TURNED).all(axis=0)
            for late in LATE
        ])  # fmt: skip
        if not len(used):
            return []
        first = int(near[0].sum(axis=0).argmax())
        alike, which = near[:, :, first].any(axis=0), near[:, :, first].argmax(axis=0)
        moved = np.flatnonzero(which)
        if len(moved) <= LABELS or alike.mean() < 1 - MOST:
            return []
        names = [f"{self.monitors[used[i]]} ({LATE[which[i]]:+d})" for i in moved]
        return [
            f"{len(moved)} BPMs count turns otherwise than {self.monitors[used[first]]}: "
            f"{first_of(names, 3)}; give what was read on one turn the same number"
        ]

    @staticmethod
    def _size(lines: ComplexArray) -> Array:
        return np.asarray((np.abs(lines) ** 2).sum(axis=(2, 3)))

    def _changed(self, names: Names) -> NDArray[np.intp]:
        """Which of the ring's monitors each of them reads with assumptions corrected, [monitor,
        plane]."""
        count = len(self.data.monitors)
        each = np.broadcast_to(np.arange(count)[:, None], (1, FEWEST, count, 2)).astype(float)
        places = replace(self.data, readings=each, noise=None, settings=(), shots=(0,))
        order = {name: i for i, name in enumerate(self.monitors)}
        at = np.array([order[self.ring[name].name] for name in self.data.monitors])
        found = np.tile(np.arange(len(self.monitors))[:, None], 2)
        found[at] = at[assume(places, names, self.monitors).readings[0, 0].astype(int)]
        return found


@dataclass(frozen=True)
class OfTunes(Compared):
    """Tunes of all shots, against the design's."""

    what: ClassVar[str] = "tune"
    usual: ClassVar[float] = 1 / 9

    @cached_property
    def design(self) -> Array:
        """Tunes of the ring.

        Raises:
            MeasurementError: it has none.
        """
        own = ring_tunes(self.ring)
        if own is None:
            raise MeasurementError(f"'{self.ring.name}' has no tune: its design is unstable")
        return np.array(own)

    def shown(self, misfit: float) -> str:
        """A misfit for a sentence."""
        return f"{USUAL * np.sqrt(misfit):.4f}"

    @property
    def tunes(self) -> Sequence[str]:
        """The measured tunes; a sentence."""
        (x, y), (qx, qy) = np.nanmedian(self.data.tune % 1, axis=0), self.design
        return [f"Qx = {x:.4f}, Qy = {y:.4f}; '{self.ring.name}' has {qx:.4f} and {qy:.4f}"]

    def misfit(self, names: Names = ()) -> Array:
        """Square of the larger distance from the design's, in units of `USUAL`, [1]."""
        read = np.nanmedian(self.assumed(names).tune % 1, axis=0)
        apart = np.abs(short_way(read - self.design))
        return np.array([np.nanmax(apart) ** 2 / USUAL**2])


def compared(ring: Ring, data: Any, lines: ManyTurns | None = None) -> Compared:
    """Return the search for global errors of a measurement.

    Args:
        ring: the design.
        data: any but first turns; its monitors those of the ring.
        lines: of turns, if they are known.
    """
    if isinstance(data, TurnByTurn):
        return OfLines(ring, data, lines)
    if isinstance(data, TuneReading):
        return OfTunes(ring, data)
    return OfResponse(ring, data) if isinstance(data, OrbitResponse) else OfOrbits(ring, data)
