"""What a dense fit of an orbit response found, as causes with errors."""

import numpy as np

from tmlattice.diagnosis.families.family import Told
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.stated import stated
from tmlattice.errors import first_of
from tmlattice.inference.normal import Posterior, solve


def told(state: State) -> tuple[list[Told], tuple[str, ...]]:
    """What is wrong as causes, with errors; and what the data alone do not settle, in words."""
    found: list[Told] = []
    said: tuple[str, ...] = ()
    for block in (0, 1):
        families = {f.variable: f for f in state.of_block(block)}
        if not families:
            continue
        there = linear(state, block)
        posterior = solve(there.normal, there.groups, there.start, rounds=0)
        sigma = stated(state, block, there, posterior).sigma
        for name, family in families.items():
            own = sigma[there.where[name]]
            found += family.told(state.at.errors, state.values[name], own, state.data)
        if block == 0:
            said = _degenerate(state, there, posterior)
    return [row for row in found if row[0].amount != 0 or row[1] != 0], said


def _degenerate(state: State, there: Linear, posterior: Posterior) -> tuple[str, ...]:
    """Directions that the prior holds and not the data."""
    said = []
    columns, monitors = state.data.shape
    m = 2 * monitors
    spread = posterior.spread
    factor = np.linalg.cholesky(posterior.covariance + 1e-12 * np.eye(len(spread.T)))
    draws = spread @ factor
    scale = draws[:m].mean(axis=0)
    kick = draws[m : m + columns - 1].mean(axis=0)
    if scale.any() and kick.any():  # both are fitted
        both = float(scale @ kick / np.sqrt((scale @ scale) * (kick @ kick)))
        said.append(
            f"mean monitor gain against mean corrector scale: known to "
            f"{100 * np.sqrt(scale @ scale):.2f} % by the RF step and the priors, correlation "
            f"{both:+.2f}"
        )
    for family in state.families:
        own = [g for g in there.groups if g.name == family.name]
        if family.per != "ring" or family.block or not own or len(own[0].scale) < 2:
            continue
        loose = np.flatnonzero(posterior.sigma[there.where[family.variable]] > 0.5 * own[0].scale)
        moves = family.moves(state.data)  # of each number; a cause is one of its pieces
        names = [place for i in loose for _, place in list(moves[i])[:1] if place]
        if names:
            said.append(
                f"{len(names)} of {family.title} that the prior holds more than the data: "
                + first_of(names, 12)
            )
    return tuple(said)
