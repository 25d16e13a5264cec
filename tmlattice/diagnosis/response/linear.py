"""The linearised readings of a hierarchical fit: derivatives, normal equations, priors.

>>> there = linear(state, 0)
>>> information, score = marginal(there, ["gradient"])
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.diagnosis.response.state import Kept, State
from tmlattice.diagnosis.response.weights import taken, weighed, weight
from tmlattice.inference.normal import Normal, Posterior, Slopes, normal_equations, solve
from tmlattice.inference.priors import Group

NEAR, STILL = 0.05, 0.3
"""Mean move of the ring, as a share of the step bounds, above which the derivatives of a block are
renewed: for evidence and errors, and for a step. Those at different rings would separate
near-degenerate families that the readings do not separate."""


def _ring(state: State) -> dict[str, Array]:
    """The ring's numbers, in units of their step bounds."""
    return {f.variable: state.values[f.variable] / f.trust
            for f in state.families if f.per == "ring"}  # fmt: skip


def _derivatives(state: State, block: int, within: float) -> Mapping[str, Kept]:
    """The derivatives by the ring's variables of a block, all at nearly one ring."""
    ring, gain = _ring(state), state.at.gain(block)
    scale = 1 + state.at.errors.calibration
    own = {f.variable: f for f in state.of_block(block) if f.per == "ring"}
    at, before = state.kept.pop(block, (ring, {}))
    kept = {
        name: before[name] for name, family in own.items()
        if name in before and before[name].causes == family.causes
        and len(before[name].rows) == len(ring[name])
        and not scale[before[name].scale == 0].any()
    }  # fmt: skip
    del before  # freed before others are computed
    if _distance(at, ring) >= (within if len(kept) == len(own) else NEAR):
        at, kept = ring, {}
    for name, family in own.items():
        if name not in kept:
            rows = np.asarray(family.rows(state.at, state.values[name]), dtype=np.float32)
            kept[name] = Kept(rows, family.causes, gain, scale)
    state.kept[block] = at, kept
    return kept


def _distance(before: Mapping[str, Array], now: Mapping[str, Array]) -> float:
    """The rms change of the ring's numbers; those that one of both lacks are zero there."""
    count, square = 0, 0.0
    for name in {**before, **now}:
        old, new = (one.get(name, np.zeros(0)) for one in (before, now))
        count += (size := max(len(old), len(new)))
        change = np.pad(new, (0, size - len(new))) - np.pad(old, (0, size - len(old)))
        square += float(change @ change)
    return float(np.sqrt(square / max(count, 1)))


def _now(kept: Kept, gain: Array, scale: Array) -> Array | None:
    """Factors on the present derivatives by changed gains and calibrations; None: unchanged."""
    if (gain == kept.gain).all() and (scale == kept.scale).all():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        share = gain / kept.gain * (scale / kept.scale)[:, None]
    return np.where(np.isfinite(share), share, 1.0)


class Linear(NamedTuple):
    """The linearised readings of one block.

    Parameters are those of the BPMs, x and y of each; of the columns; and of the ring. A parameter
    at its lower bound stays there if the readings would decrease it.
    """

    normal: Normal
    start: Array
    trust: Array
    by_monitor: Array
    by_column: Array
    ring: tuple[Slopes, ...]
    where: Mapping[str, slice]
    groups: tuple[Group, ...]
    lowest: Array

    @property
    def posterior(self) -> Posterior:
        """The solution, with the present priors."""
        return solve(self.normal, self.groups, self.start, rounds=0)

    def readings(self, plane: Indices, values: Array) -> Array:
        """Change of the readings, m, [column, monitor], by values of all parameters."""
        columns, monitors = self.by_monitor.shape
        m, end = 2 * monitors, 2 * monitors + columns
        out = values[:m].reshape(-1, 2)[:, plane].T * self.by_monitor
        out += values[m:end, None] * self.by_column
        for own in self.ring:
            out += own.readings(values[end : end + len(own.rows)])
            end += len(own.rows)
        return out

    def of_column(self, column: int, read: Indices, plane: int) -> Array:
        """Derivatives of some readings of a column in a plane, [reading, parameter]."""
        columns, monitors = self.by_monitor.shape
        out = np.zeros((len(read), len(self.start)))
        out[np.arange(len(read)), 2 * read + plane] = self.by_monitor[column, read]
        out[:, 2 * monitors + column] = self.by_column[column, read]
        out[:, 2 * monitors + columns :] = np.concatenate(
            [np.zeros((0, len(read))), *(own.of(column, read) for own in self.ring)]
        ).T
        return out


def linear(state: State, block: int, within: float = NEAR) -> Linear:
    """Normal equations of a state with its parameters, priors and step bounds.

    Args:
        state, block: where.
        within: mean move of the ring, as a share of the step bounds, up to which derivatives at
            another ring are used.
    """
    key = ("linear", block)
    latest = state.latest
    if key in latest and latest[key][0]() is state and latest[key][1][0] > within:
        del latest[key]  # freed before another is computed
    found: Linear = state.once(key, lambda: (within, _linear(state, block, within)))[1]
    return found


def _linear(state: State, block: int, within: float) -> Linear:
    data, at = state.data, state.at
    columns, monitors = data.shape
    families = state.of_block(block)
    kept = _derivatives(state, block, within)
    where: dict[str, slice] = {}
    rows = {"monitor": np.zeros(data.shape), "column": np.zeros(data.shape)}
    ring: list[Slopes] = []
    end = 2 * monitors + columns
    start, trust = [np.zeros(end)], [np.ones(end)]
    for family in {f.variable: f for f in families}.values():
        values = state.values[family.variable]
        if family.per == "ring":
            current = kept[family.variable]
            share = _now(current, at.gain(block), 1 + at.errors.calibration)
            where[family.variable] = slice(end, end + len(values))
            end += len(values)
            start.append(values)
            trust.append(np.full(len(values), family.trust))
            ring.append(Slopes(current.rows, share))
        else:
            slopes = np.asarray(family.rows(at, values), dtype=float)
            low = 0 if family.per == "monitor" else 2 * monitors
            mine = where[family.variable] = slice(low, low + len(values))
            start[0][mine], trust[0][mine] = values, family.trust
            rows[family.per] = slopes
    normal = normal_equations(
        data.pick(at.left, block), weight(state, block), data.plane_of(block), rows["monitor"],
        rows["column"], ring, taken(state, block),
    )  # fmt: skip
    groups = []
    lowest = np.full(end, -np.inf)
    for family in families:
        lowest[where[family.variable]] = family.lowest(data)
    begin = np.concatenate(start)
    free = (begin > lowest) | (normal.vector > 0)
    for family in families:
        for own in family.groups(data):
            basis = np.zeros((end, own.basis.shape[1]))
            basis[where[family.variable]] = own.basis
            basis[~free] = 0.0
            known = state.groups.get(own.name, own)
            groups.append(
                replace(own, basis=basis, rms=known.rms, each=known.each, first=own.rms,
                        guessed=state.guessed, largest=0.0 if own.fixed else family.largest)
            )  # fmt: skip
    for one in (one for one in state.apart if one.block == block and one.variable in where):
        basis = np.zeros((end, 1))
        basis[where[one.variable], 0] = one.members
        groups.append(Group(one.name, basis, one.wide, fixed=True, largest=one.wide))
    return Linear(
        normal, begin, np.concatenate(trust), rows["monitor"], rows["column"], tuple(ring),
        where, tuple(groups), lowest,
    )  # fmt: skip


def with_numbers(
    there: Linear, state: State, block: int, name: str, rows: Array, learnt: bool = False
) -> Linear:
    """Return the linearisation with more numbers of the ring, each of prior rms 1.

    Args:
        there: `linear` of a block of the state.
        state, block: as there.
        name: of their variable.
        rows: their derivatives, m, [number, column, monitor].
        learnt: whether the prior rms is learnt; 1 is the largest then.
    """
    if not len(rows):
        return there
    before, end = len(there.start), len(there.start) + len(rows)
    weighted = np.array([weighed(state, block, own) for own in rows]).reshape(rows.shape)
    plane, no_ring = state.data.plane_of(block), there._replace(ring=())
    linear_ones = [gathered(no_ring, plane, own) for own in weighted]
    across = np.concatenate([
        np.array(linear_ones).reshape(len(rows), -1), *(own.times(weighted).T for own in there.ring)
    ], axis=1)  # fmt: skip
    more, read = Slopes(rows), Slopes(weighted)
    own = read.times(rows)
    matrix = np.block([[there.normal.matrix, across.T], [across, own]])
    left = np.nan_to_num(state.data.pick(state.at.left, block))
    groups = [
        replace(group, basis=np.pad(group.basis, ((0, len(rows)), (0, 0))))
        for group in there.groups
    ]
    basis = np.eye(end)[:, before:]
    return there._replace(
        normal=Normal(matrix, np.append(there.normal.vector, read.times(left))),
        start=np.pad(there.start, (0, len(rows))),
        trust=np.pad(there.trust, (0, len(rows)), constant_values=1.0),
        ring=(*there.ring, more),
        where={**there.where, name: slice(before, end)},
        groups=(*groups, Group(name, basis, 1.0, fixed=not learnt, most=1.0)),
        lowest=np.pad(there.lowest, (0, len(rows)), constant_values=-np.inf),
    )


def with_undetermined(state: State, block: int) -> Linear:
    """Return the linearisation with the undetermined errors of the reference, if any."""
    there = linear(state, block)
    if state.undetermined is None:
        return there
    rows = [state.data.pick(own, block) for own in state.undetermined]
    return with_numbers(there, state, block, "undetermined", np.array(rows))


def marginal(there: Linear, names: Sequence[str]) -> tuple[Array, Array]:
    """Return information and score of some variables, with all others integrated out.

    Args:
        there: of the fit.
        names: of variables.

    Returns:
        Information, and score at zero: the log likelihood of the numbers x is score x - x
        information x / 2.
    """
    A = there.normal.matrix
    score = there.normal.vector + A @ there.start
    own = np.concatenate([np.arange(len(A))[there.where[name]] for name in names])
    spread = np.concatenate([group.basis * group.scale for group in there.groups], axis=1)
    spread = spread[:, ~spread[own].any(axis=0)]
    inside = spread.T @ A @ spread + np.eye(spread.shape[1])
    across = A[own] @ spread
    taken = np.linalg.solve(inside, np.column_stack([across.T, spread.T @ score]))
    information = A[np.ix_(own, own)] - across @ taken[:, :-1]
    return (information + information.T) / 2, score[own] - across @ taken[:, -1]


def gathered(there: Linear, plane: Indices, weighted: Array) -> Array:
    """Return J^T times weighted readings [column, monitor] in each column's plane, [parameter]."""
    by_monitor = there.by_monitor * weighted
    alone = np.stack([by_monitor[plane == p].sum(axis=0) for p in (0, 1)], axis=1)
    by_column = (there.by_column * weighted).sum(axis=1)
    return np.concatenate([alone.ravel(), by_column, *(r.times(weighted) for r in there.ring)])
