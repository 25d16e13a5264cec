"""Fine-tuning by the paper's recipe: every weight free, Adam, and a symplectic penalty."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from tqdm.auto import tqdm

from tmlattice.errors import BeamLostError, MeasurementError, choice
from tmlattice.fitting.launches import FreeLaunches
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork, symplectic_penalty
from tmlattice.network.symplectic import symplectic_coefficients
from tmlattice.observe.data import launch_errors
from tmlattice.speaks import Speaks

Network = TaylorNetwork | SymplecticNetwork


class Regularization(StrEnum):
    """Term that is added to the loss, times its rate."""

    SYMPLECTIC = "symplectic"
    NONE = "none"
    L1 = "l1"
    L2 = "l2"


@dataclass(frozen=True, repr=False)
class FitResult(Speaks):
    """A fine-tuned network and the history of its fit.

    Attributes:
        network: with the weights of the epoch of least loss, `best_epoch`.
        loss: of every epoch, m^2: squared residuals summed over monitors and planes, mean over
            shots; without the regularization.
        penalty: of every epoch, the regularization's value before its rate.
        stopped_early: whether the patience ran out before the epochs.
        seconds: of wall clock.
        tunes, tune_sigma: fractional tunes (x, y) by the method itself and their standard errors,
            [2] each; None if the method has none (Adam).
        changes: relative changes of strengths, by magnet, with their standard errors: the causes
            that `sparse` selected, or all that `map` changed.
        launches: as fitted, [shot, n]; None if they were taken as exact.
        chi2: mean square of the residual over the noise; None if no noise is stated.
    """

    network: Network
    loss: list[float]
    penalty: list[float]
    best_epoch: int
    stopped_early: bool
    seconds: float
    options: dict[str, Any] = field(default_factory=dict)
    tunes: NDArray[np.float64] | None = None
    tune_sigma: NDArray[np.float64] | None = None
    changes: dict[str, tuple[float, float]] = field(default_factory=dict)
    launches: NDArray[np.float64] | None = None
    chi2: float | None = None

    def _told(self) -> tuple[str, dict[str, str]]:
        largest = sorted(self.changes.items(), key=lambda own: -abs(own[1][0]))[:3]
        changed = (f"{name} {100 * amount:+.3g} %" for name, (amount, _) in largest)
        return str(self.options.get("method", "adam")), {
            "layers": str(len(self.network.layers)),
            "steps": str(len(self.loss)),
            "loss": f"{self.loss[0]:.3g} to {min(self.loss):.3g} m²",
            "chi-square": "" if self.chi2 is None else f"{self.chi2:.3g} a reading",
            "tunes": tunes_text(self.tunes),
            "changes": ", ".join(changed),
            "seconds": f"{self.seconds:.2f}",
        }


def tunes_text(tunes: NDArray[np.float64] | None) -> str:
    """Return tunes for a line; empty if there are none."""
    return "" if tunes is None else " ".join(f"{q:.6f}" for q in tunes)


def fit_adam(
    network: Network,
    measurement: Measurement,
    *,
    epochs: int = 1000,
    learning_rate: float = 1e-6,
    regularization: Regularization | str = "symplectic",
    regularization_rate: float = 1e-10,
    relative_to_design: bool = False,
    free: Sequence[str] | None = None,
    clip: float = 1.0,
    patience: int | None = 200,
    launch_sigma: ArrayLike | None = None,
    progress: bool = True,
) -> FitResult:
    """Fit all weights of a network to the first turn of a measurement, by Adam.

    The loss is sum over monitors and planes of (model - reading)^2, mean over shots, in m^2 (the
    norm is squared), plus rate times the regularization summed over layers:

    - "symplectic": the squares of the coefficients of J^T S J - S (`symplectic_penalty`);
    - "l1", "l2": sum of |w - w_design| or (w - w_design)^2 over all weights (of the departure from
      the design: pulled to zero, a layer would lose its magnet);
    - "none".

    W0 is fixed unless it is named in `free`: a magnet without field on the axis has none, and free
    constant kicks, the cheapest way to move an orbit, would absorb all of a gradient error and not
    change the tunes.

    The given network is not changed. The same input gives the same result: nothing is random.

    Args:
        measurement: at least one reading of the first turn; NaN are ignored.
        epochs: gradient steps at most.
        learning_rate: Adam's. A weight moves by at most about this per step, whatever its unit.
        regularization_rate: lambda. The paper's 1e-10 does nothing in metres.
        relative_to_design: the symplectic penalty counts departures from the design's own defect.
        free: names of the free weights: some of W0, W1, W2, or of W0, generator for a symplectic
            network, whose penalty is always zero. None: all but W0.
        clip: largest norm of the gradient, before Adam.
        patience: stop after this many epochs without a loss lower by 0.1 %; None: never.
        launch_sigma: standard error of the launch coordinates, one number, [n] or [shot, n]; 0:
            exact; inf: unknown; None: the measurement's own. Launches that are not exact follow
            the weights: after every epoch each moves half the way to its best value by the
            design's slopes.

    Raises:
        MeasurementError: no reading of the first turn, or a launch off the nominal energy for a
            network of four coordinates.
        UnknownNameError: a monitor that is not in the network.
        BeamLostError: the fit diverged (the learning rate is too high), or the launch is lost.
        ValueError: an unknown regularization or weight.

    Source: A. Ivanov, U. Iben, A. Golovkina, physics-based polynomial neural networks for one-shot
    learning of dynamical systems.
    """
    regularization = choice("regularization", regularization, Regularization)
    weight, target = _target(measurement, network.monitors)
    launches = _launches(network, measurement, launch_sigma)
    first = launches.fitted(network)
    gains = launches.gains(network, first) if launches.sigma.any() else None
    model, free = _freed(network, free)
    device = next(model.parameters()).device
    launch, weight, target = (t.to(device) for t in (torch.from_numpy(first), weight, target))
    start = [p.detach().clone() for p in model.parameters()]
    moving = [p for p in model.parameters() if p.requires_grad]
    design = None
    if relative_to_design and isinstance(network, TaylorNetwork):
        design = symplectic_coefficients(network.W1, network.W2)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the tensors are small: more threads only wait for each other
    step = _adam(moving, learning_rate)
    losses: list[float] = []
    penalties: list[float] = []
    best, best_epoch, best_weights, best_launch = np.inf, 0, start, launch
    milestone, milestone_epoch = np.inf, 0
    stopped = False
    begun = time.perf_counter()
    # disable=None: tqdm is silent without a terminal
    bar = tqdm(range(epochs), "fine-tuning", unit="epoch", disable=None if progress else True)
    try:
        for epoch in bar:
            for parameter in moving:
                parameter.grad = None
            readings = _readings(model, launch, epoch, learning_rate)
            loss = ((readings - target).square() * weight).sum()
            penalty = _penalty(model, start, regularization, design)
            total: Tensor = loss + regularization_rate * penalty
            total.backward()  # type: ignore[no-untyped-call]
            losses.append(loss.item())
            penalties.append(penalty.item())
            if losses[-1] < best:
                best, best_epoch = losses[-1], epoch
                best_weights, best_launch = [p.detach().clone() for p in model.parameters()], launch
            if losses[-1] < 0.999 * milestone:
                milestone, milestone_epoch = losses[-1], epoch
            elif patience is not None and epoch - milestone_epoch >= patience:
                stopped = True
                break
            torch.nn.utils.clip_grad_norm_(moving, clip)
            step()
            if gains is not None:
                now = launch.cpu().numpy()
                now = now + 0.5 * gains(readings.detach().cpu().numpy(), now)
                launch = torch.from_numpy(now).to(device)
    finally:
        bar.close()
        torch.set_num_threads(threads)
    with torch.no_grad():
        for parameter, kept in zip(model.parameters(), best_weights, strict=True):
            parameter.copy_(kept)
    model.requires_grad_(True)
    return FitResult(
        network=model,
        loss=losses,
        penalty=penalties,
        best_epoch=best_epoch,
        stopped_early=stopped,
        seconds=time.perf_counter() - begun,
        options={
            "epochs": epochs,
            "learning_rate": learning_rate,
            "regularization": regularization.value,
            "regularization_rate": regularization_rate,
            "relative_to_design": relative_to_design,
            "free": list(free),
            "clip": clip,
            "patience": patience,
        },
        launches=None if gains is None else launches.fitted(model, best_launch.cpu().numpy(), 2),
    )


def _launches(
    network: Network, measurement: Measurement, launch_sigma: ArrayLike | None
) -> FreeLaunches:
    sigma = launch_errors(measurement, network.dimension, launch_sigma)
    ordered = measurement.in_order_of(network.monitors)
    if ordered.noise is None and np.isfinite(sigma[sigma > 0]).any():
        raise MeasurementError(
            "the launches have an error but the readings have none; give the measurement's noise"
        )
    noise = np.full((len(network.monitors), 2), 1.0) if ordered.noise is None else ordered.noise
    launches = measurement.states(network.dimension)
    return FreeLaunches(launches, sigma, ordered.readings[:, 0], noise)


def _target(measurement: Measurement, monitors: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Weights (mean over shots; 0 where missing) and readings of the first turn, [shot, monitor,
    2]."""
    first_turn = measurement.in_order_of(monitors).readings[:, 0]
    present = np.isfinite(first_turn)
    if not present.any():
        raise MeasurementError("no reading of the first turn (turn 0); nothing can be fitted")
    return (
        torch.from_numpy(present / len(first_turn)),
        torch.from_numpy(np.where(present, first_turn, 0.0)),
    )


def _freed(network: Network, free: Sequence[str] | None) -> tuple[Network, Sequence[str]]:
    """A copy in which these weights are free, and their names."""
    model = network.copy()
    if free is None:
        free = ("generator",) if isinstance(network, SymplecticNetwork) else ("W1", "W2")
    unknown = set(free) - {name for name, _ in model.named_parameters()}
    if unknown or not free:
        known = ", ".join(name for name, _ in model.named_parameters())
        raise ValueError(f"no weights {sorted(unknown)}; free are some of {known}")
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name in free)
    return model, free


def _readings(model: Network, launch: Tensor, epoch: int, rate: float) -> Tensor:
    """Readings in an epoch; a beam that is lost after the first epoch was lost by the fit."""
    try:
        readings: Tensor = model(launch)
        return readings
    except BeamLostError as error:
        if not epoch:
            raise
        raise BeamLostError(
            f"the fit diverged in epoch {epoch}: lower the learning rate ({rate:g}); {error}"
        ) from error


def _adam(moving: Sequence[Tensor], rate: float) -> Callable[[], None]:
    """One step of Adam with torch's defaults: its class imports torch's compiler, seconds."""
    from torch.optim.adam import adam

    mean, square = ([torch.zeros_like(p) for p in moving] for _ in range(2))
    counts = [torch.zeros((), dtype=torch.float32, device=p.device) for p in moving]

    @torch.no_grad()
    def step() -> None:
        gradients = [p.grad for p in moving if p.grad is not None]
        adam(
            list(moving),
            gradients,
            mean,
            square,
            [],
            counts,
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )

    return step


def _penalty(model: Network, start: list[Tensor], kind: Regularization, design: Any) -> Tensor:
    if kind is Regularization.SYMPLECTIC and isinstance(model, TaylorNetwork):
        return symplectic_penalty(model.W1, model.W2, design).sum()
    if kind in (Regularization.NONE, Regularization.SYMPLECTIC):
        return torch.zeros((), dtype=torch.float64, device=start[0].device)
    moved = [p - s for p, s in zip(model.parameters(), start, strict=True)]
    if kind is Regularization.L1:
        return torch.stack([m.abs().sum() for m in moved]).sum()
    return torch.stack([m.square().sum() for m in moved]).sum()
