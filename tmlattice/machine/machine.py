"""A virtual machine: a ring with causes, its monitors, and their noise."""

import logging
import pickle
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.by_name import by_name
from tmlattice.effects import Cause, Settings, background_rms, beams, check, monitors_with
from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.lattice.checks import need_monitors
from tmlattice.machine.shots import Shots, draw_background, stream
from tmlattice.workers import Caught, Processes, heard

log = logging.getLogger(__name__)

ENGINES = ("at", "ocelot")

CHUNK = 64
"""Shots tracked at once: memory does not grow with their number."""


@dataclass(frozen=True, kw_only=True)
class Errors:
    """The errors of a simulated machine, as a truth file states them.

    Attributes:
        causes, background: errors, and the rms of distributed ones by effect.
        seed, machine_seed: of the noise, of the background.
        more: further inputs: engine, particles, ...
    """

    ring: Ring
    causes: tuple[Cause, ...]
    background: Mapping[str, float]
    seed: int
    machine_seed: int
    more: Mapping[str, Any] = field(default_factory=dict)

    def every(self) -> list[Cause]:
        """Return all errors, those of the background first."""
        causes = [*draw_background(self.ring, self.background, self.machine_seed), *self.causes]
        need_monitors(self.ring)
        check(self.ring, causes)
        return causes

    def truth(self) -> dict[str, Any]:
        """Return the true state, for `write_truth`: effects, launches, background, seeds."""
        positions = {element.name: element.s for element in self.ring.elements}
        return {
            "effects": [
                {**vars(cause), "s": positions.get(cause.element or "")} for cause in self.causes
            ],
            "launches": np.zeros((0, 5)),
            "background": {**self.background, **self.more, "machine_seed": self.machine_seed},
            "seed": self.seed,
        }


@dataclass(frozen=True, kw_only=True)
class StoredSimulation(Errors):
    """A simulated measurement of a stored beam and its inputs.

    Attributes:
        measured: of the simulated kind.
    """

    measured: Any


def errors(
    ring: Ring,
    causes: Sequence[Cause],
    background: str | Mapping[str, float | None] | None,
    seed: int,
    machine_seed: int | None,
    **more: Any,
) -> Errors:
    """Return the errors of a machine, as the arguments of a simulation state them."""
    return Errors(
        ring=ring,
        causes=tuple(causes),
        background=background_rms(background or {}),
        seed=seed,
        machine_seed=seed if machine_seed is None else machine_seed,
        more=more,
    )


def rms_of(noise: float | Sequence[float]) -> Array:
    """Return the rms of a reading in x and y, m, [2]; TmlatticeError: neither one number nor two,
    or a negative one."""
    rms = np.asarray(noise, dtype=float)
    if rms.shape not in ((), (2,)) or not ((rms >= 0) & (rms < np.inf)).all():
        raise TmlatticeError(f"the noise is {noise} m; it is an rms, or two (x, y): zero or more")
    return np.broadcast_to(rms, (2,))


def add_noise(readings: Array, rms: ArrayLike, seed: int, purpose: str, first: int = 0) -> None:
    """Add noise to readings [shot, ...], whose first shot has the number `first`; each shot has its
    own random stream."""
    for shot, reading in enumerate(readings, first):
        reading += rms * stream(seed, purpose, shot).standard_normal(reading.shape)  # noqa: PLW2901


def stated_noise(rms: Array, monitors: int) -> Array | None:
    """Return the noise in the record, [monitor, 2]; None: without noise in a plane."""
    return np.tile(rms, (monitors, 1)) if (rms > 0).all() else None


def check_engine(name: str, known: Sequence[str] = ENGINES) -> None:
    """Check the name of an engine, of those that a kind of measurement has; TmlatticeError: it is
    unknown."""
    if name not in known:
        raise TmlatticeError(f"no engine '{name}'; there are {' and '.join(known)}")


class Machine:
    """A ring with known causes.

    Args:
        engine: "at": thick symplectic tracking by accelerator-toolbox; "ocelot": second-order maps.
        radiation: bends and wigglers radiate as expected.
        noise: rms of one reading, m, one number or (x, y).

    Raises:
        EffectError, UnknownNameError: a cause that the ring cannot have.
        LatticeError: a ring without monitors.
        TmlatticeError: another engine, or negative noise.
    """

    @by_name
    def __init__(
        self,
        ring: Ring,
        causes: Sequence[Cause] = (),
        *,
        engine: str = "at",
        radiation: bool = False,
        noise: float | Sequence[float] = 2e-5,
    ) -> None:
        causes = list(causes)
        need_monitors(ring)
        check(ring, causes)
        self.ring = ring
        self.causes = tuple(causes)
        self.monitors = monitors_with(ring, causes)
        self.noise = rms_of(noise)
        self.engine = engine
        self._made_of: dict[str, Any] = {"engine": engine, "radiation": radiation, "noise": noise}
        check_engine(engine)
        Engine: Any  # imported where it is chosen: AT takes long
        if engine == "at":
            from tmlattice.machine.at_engine import AtEngine as Engine
        else:
            from tmlattice.machine.ocelot_engine import OcelotEngine as Engine
        scale = float(radiation)
        self._engine = Engine(ring, causes, radiation_bends=scale, radiation_wigglers=scale)

    def beam(
        self, launches: Array, turns: int = 1, settings: Sequence[Settings] | None = None
    ) -> Array:
        """Return the beam's centroid at every monitor, [shot, turn, monitor, 2], m.

        Args:
            launches: OCELOT's six coordinates, [shot, 6].
            turns: at least 1.
        """
        weights, nodes = beams(launches, self.causes)
        flat = nodes.reshape(-1, 6)
        repeated = list(settings) * len(weights) if settings else None
        positions = self._engine.track(flat, turns, repeated)
        positions = positions.reshape(len(weights), len(launches), *positions.shape[1:])
        return np.asarray(np.tensordot(weights, positions, 1))

    def _read(self, shots: Shots, chunk: range, turns: int, seed: int) -> Array:
        """Return readings of some shots, without frozen monitors."""
        part = slice(chunk.start, chunk.stop)
        further = turns + self.monitors.ahead
        beam = self.beam(shots.launches[part], further, shots.settings[part])
        readings = self.monitors.read(self.monitors.counted(beam, turns))
        add_noise(readings, self.noise, seed, "noise", chunk.start)
        return readings

    def measure(
        self, shots: Shots, turns: int = 1, seed: int = 0, jobs: int = 1
    ) -> Iterator[tuple[int, Array]]:
        """Yield the shots one after another: index and readings [turn, monitor, 2], m.

        A shot's noise depends neither on the number of shots nor on that of the processes.
        """
        frozen = self.monitors.frozen
        first: Array | None = None
        starts = range(0, len(shots), CHUNK)
        chunks = [range(start, min(start + CHUNK, len(shots))) for start in starts]
        dead = self.monitors.silent.sum() * turns * 2
        for chunk, readings in zip(chunks, self._parts(shots, chunks, turns, seed, jobs)):  # noqa: B905
            for shot, reading in zip(chunk, readings, strict=True):
                if first is None:
                    first = reading[0, frozen].copy()
                reading[:, frozen] = first
                if np.isnan(reading).sum() > dead:
                    log.warning("shot %d: the beam is lost; what follows is missing", shot)
                yield shot, reading

    def _parts(
        self, shots: Shots, chunks: Sequence[range], turns: int, seed: int, jobs: int
    ) -> Iterator[Array]:
        if jobs < 2 or len(chunks) < 2:
            for chunk in chunks:
                yield self._read(shots, chunk, turns, seed)
            return
        # as bytes: the process must silence OCELOT's greeting before it unpickles elements
        setup = pickle.dumps((self.ring, self.causes, self._made_of, shots, turns, seed))
        with Processes(_Reader(setup), min(jobs, len(chunks))) as processes:
            waiting: deque[Future[Caught]] = deque()
            for chunk in chunks:  # no more in flight than the processes need
                waiting.append(processes.submit(chunk))
                if len(waiting) > 2 * jobs:
                    yield heard(waiting.popleft().result())
            while waiting:
                yield heard(waiting.popleft().result())


class _Reader:
    """Readings of shots in another process, which makes the machine once."""

    def __init__(self, setup: bytes) -> None:
        self._setup = setup
        self._machine: tuple[Machine, Shots, int, int] | None = None

    def __call__(self, chunk: range) -> Array:
        if self._machine is None:
            import tmlattice.lattice.ocelot  # noqa: F401

            ring, causes, made_of, shots, turns, seed = pickle.loads(self._setup)
            self._machine = (Machine(ring, causes, **made_of), shots, turns, seed)
        machine, shots, turns, seed = self._machine
        return machine._read(shots, chunk, turns, seed)
