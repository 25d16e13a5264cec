"""Lotka-Volterra about its equilibrium: a map learned from one solution, against other networks.

x' = y + x y, y' = -2 x - x y, in the units of the equilibrium; a solution from (0.5, 0.5) closes
after 4.53 s.

>>> learned = learn()                         # third order, from the one solution
>>> race(epochs=(300, 3000)).cells            # multilayer perceptron and LSTM on the same data
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from tqdm.auto import tqdm

from tmlattice.arrays import Array
from tmlattice.errors import missing_package
from tmlattice.maps import TaylorMap, right_hand_side, taylor_map_of_ode
from tmlattice.systems import Comparison
from tmlattice.systems.learning import fit_step_by_step, follow, weights_of

if TYPE_CHECKING:
    import torch


EQUATION: dict[tuple[int, ...], list[float]] = {
    (0, 1): [1.0, 0.0],
    (1, 0): [0.0, -2.0],
    (1, 1): [1.0, -1.0],
}
STEP = 0.01  # s
STEPS = 465
LEARNED_FROM = (0.5, 0.5)
UNSEEN = ((0.8, 0.8), (0.1, 0.1), (0.0, 0.0))
GOOD = 0.05  # rms of a solution's error: a tenth of the amplitude that was learned from
SEEN = 5  # states that every network is given before it runs alone


def solutions(starts: ArrayLike) -> Array:
    """True states every 0.01 s, [start, step + 1, 2], by a tight numerical solver."""
    slope = right_hand_side(EQUATION)
    times = STEP * np.arange(STEPS + 1)
    return np.array([
        solve_ivp(
            slope, (0, times[-1]), x, method="DOP853", t_eval=times, rtol=1e-12, atol=1e-14
        ).y.T
        for x in np.asarray(starts, dtype=float)
    ])  # fmt: skip


def learn(order: int = 3) -> TaylorMap:
    """Return the map fitted to the one solution from (0.5, 0.5), without the equation."""
    return fit_step_by_step(solutions([LEARNED_FROM])[0], order)


@dataclass(frozen=True)
class Cell:
    """One network of the table.

    Attributes:
        name, regularization, epochs: its kind and training.
        learned: rms error of its free run on the solution that it learned from.
        unseen: the same for the other starts, in the order of `UNSEEN`.
        parameters: number of learned parameters.
    """

    name: str
    regularization: str
    epochs: int
    learned: float
    unseen: tuple[float, ...]
    parameters: int

    @property
    def verdict(self) -> str:
        """Underfitted: not even the learned solution; memorised: that alone; else generalised."""
        if not self.learned < GOOD:
            return "underfitted"
        return "generalised" if max(self.unseen) < GOOD else "memorised"


@dataclass(frozen=True)
class Race:
    """All networks, and the mean squared error of each at its checkpoints.

    Attributes:
        cells: the table; the map comes first.
        epochs: checkpoints of the curves.
        curves: (name, regularization) -> mean squared error over the unseen starts [epoch].
        runs: name -> states of the free runs of the last checkpoint without regularization,
            [start, step, 2]; the first start is the learned one.
        truth: [start, step, 2].
    """

    cells: list[Cell]
    epochs: Array
    curves: dict[tuple[str, str], Array]
    runs: dict[str, Array]
    truth: Array


def race(
    epochs: Sequence[int] = (300, 3000),
    cells: Sequence[int] = (1, 5, 10, 100),
    regularizations: Sequence[str] = ("none", "L2", "dropout"),
    seed: int = 0,
    progress: bool = False,
) -> Race:
    """Train a multilayer perceptron and LSTMs on the one solution, then run all alone.

    Every network sees windows of five states and gives the next; afterwards it gets five true
    states and runs on its own output for the rest of 4.65 s. Adam, rate 3e-3, the whole solution a
    step; L2 is a weight decay of 1e-4, dropout leaves out a tenth of the hidden values.

    Args:
        epochs: rows of the table; the last is how long all train.
        cells: of the LSTMs; the perceptron has 64 hidden values.
        regularizations: of "none", "L2", "dropout".
        progress: whether to show a bar.
    """
    try:
        import torch
    except ModuleNotFoundError as error:
        raise missing_package(error, "the networks of the race need", "reproduce") from error

    truth = solutions([LEARNED_FROM, *UNSEEN])
    learned = learn()
    run = follow(learned, truth[:, 0], STEPS).swapaxes(0, 1)
    made = [_cell("third-order map", "none", 1, run, truth, int(weights_of(learned).size))]
    checkpoints = np.unique(np.concatenate([
        np.geomspace(10, epochs[-1], 9).astype(int), list(epochs)
    ]))  # fmt: skip
    curves: dict[tuple[str, str], Array] = {}
    runs = {"third-order map": run}
    kinds = [("MLP, 5 states", 0), *((f"LSTM, {k} cell" + "s" * (k > 1), k) for k in cells)]
    work = [(*kind, how) for kind in kinds for how in regularizations]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the networks are too small to share
    try:
        for name, width, how in tqdm(work, disable=None if progress else True, leave=False):
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed)
                network = _network(width, how)
                count = sum(p.numel() for p in network.parameters())
                errors = []
                for epoch in _train(network, truth[0], how, checkpoints):
                    run = _free_run(network, truth)
                    errors.append(float(np.mean((run[1:] - truth[1:]) ** 2)))
                    if epoch in epochs:
                        made.append(_cell(name, how, int(epoch), run, truth, count))
            curves[name, how] = np.array(errors)
            if how == "none":
                runs[name] = run
    finally:
        torch.set_num_threads(threads)
    return Race(made, checkpoints, curves, runs, truth)


def _cell(name: str, how: str, epochs: int, run: Array, truth: Array, count: int) -> Cell:
    rms = np.sqrt(np.mean((run - truth) ** 2, axis=(1, 2)))
    rms = np.where(np.isfinite(rms), rms, np.inf)
    return Cell(name, how, epochs, float(rms[0]), tuple(map(float, rms[1:])), count)


def _network(width: int, how: str) -> "torch.nn.Module":
    """A window [batch, 5, 2] to the next state [batch, 2]: a perceptron, or an LSTM of a width."""
    import torch

    drop = 0.1 if how == "dropout" else 0.0

    class Lstm(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.lstm = torch.nn.LSTM(2, width, batch_first=True)
            self.drop = torch.nn.Dropout(drop)
            self.out = torch.nn.Linear(width, 2)

        def forward(self, window: torch.Tensor) -> torch.Tensor:
            result: torch.Tensor = self.out(self.drop(self.lstm(window)[0][:, -1]))
            return result

    if width:
        return Lstm()
    return torch.nn.Sequential(
        torch.nn.Flatten(),
        torch.nn.Linear(2 * SEEN, 64),
        torch.nn.Tanh(),
        torch.nn.Dropout(drop),
        torch.nn.Linear(64, 2),
    )


def _train(network: "torch.nn.Module", solution: Array, how: str, checkpoints: Array):  # type: ignore[no-untyped-def]
    """Yields the epoch at every checkpoint, with the network ready to run."""
    import torch

    data = torch.tensor(solution, dtype=torch.float32)
    windows = data.unfold(0, SEEN + 1, 1).transpose(1, 2)  # [window, 6, 2]
    given, wanted = windows[:, :SEEN].contiguous(), windows[:, SEEN].contiguous()
    decay = 1e-4 if how == "L2" else 0.0
    adam = torch.optim.Adam(network.parameters(), lr=3e-3, weight_decay=decay)
    for epoch in range(1, int(checkpoints[-1]) + 1):
        network.train()
        adam.zero_grad()
        loss = torch.nn.functional.mse_loss(network(given), wanted)
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        if epoch in checkpoints:
            network.eval()
            yield epoch


def _free_run(network: "torch.nn.Module", truth: Array) -> Array:
    import torch

    states = torch.tensor(truth[:, :SEEN], dtype=torch.float32)
    with torch.no_grad():
        window, out = states, [states]
        for _ in range(truth.shape[1] - SEEN):
            window = torch.cat([window[:, 1:], network(window)[:, None]], dim=1)
            out.append(window[:, -1:])
    return np.asarray(torch.cat(out, dim=1).double().numpy())


def comparisons(done: Race) -> list[Comparison]:
    """Return one row for each network: our verdict with its rms errors."""
    model, learned = taylor_map_of_ode(EQUATION, 3, STEP), learn()
    difference = np.abs(weights_of(model) - weights_of(learned))
    closed = _period()
    rows = [
        Comparison("learned solution lasts [s]", 4.65, STEP * STEPS,
                   f"one round takes {closed:.4f} s by a numerical solver"),
        Comparison("third-order map: largest linear, quadratic weight error", None,
                   f"{difference[:, 1:3].max():.1e}, {difference[:, 3:6].max():.1e}",
                   "learned weights less the equation's map"),
    ]  # fmt: skip
    why = (
        f"rms over 4.65 s, free run: learned start; {UNSEEN}. Generalised: all below {GOOD}; "
        "memorised: only the learned one. Paper: only the map generalises; its regularizations "
        "and epochs are not at hand, these are ours"
    )
    for i, cell in enumerate(done.cells):
        errors = ", ".join(f"{e:.2g}" for e in cell.unseen)
        fits = "fit by least squares" if i == 0 else f"{cell.epochs} epochs, {cell.regularization}"
        rows.append(
            Comparison(f"{cell.name} ({cell.parameters} weights), {fits}",
                       "generalised" if i == 0 else None,
                       f"{cell.verdict}: {cell.learned:.2g}; {errors}", why if i == 0 else "")
        )  # fmt: skip
    return rows


def _period() -> float:
    """Period of the learned solution, s."""
    times = np.linspace(3.0, 6.0, 30_001)
    done = solve_ivp(
        right_hand_side(EQUATION), (0.0, 6.0), np.array(LEARNED_FROM), method="DOP853",
        t_eval=times, rtol=1e-12, atol=1e-14,
    )  # fmt: skip
    return float(times[np.argmin(np.linalg.norm(done.y.T - np.array(LEARNED_FROM), axis=1))])
