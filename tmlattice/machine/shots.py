"""Launch and settings of every shot, drawn from a seed.

Launches, their jitter, settings, noise and background errors have one random stream each: the same
seed gives the same launches with either engine, with or without a fault, and the first shots of a
longer measurement.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.chain import Chain
from tmlattice.effects import Cause, Settings, find
from tmlattice.errors import BeamLostError, TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.lattice.checks import need_monitors
from tmlattice.optics import one_turn_optics

LAUNCH_SIGMA = (1e-4, 2e-5, 1e-4, 2e-5, 0.0)
"""rms of the launch's x, px, y, py, delta about the nominal one, m and rad."""


def stream(seed: int, *purpose: str | int) -> np.random.Generator:
    """Return the random numbers of one purpose, independent of those of any other."""
    words = [zlib.crc32(p.encode()) if isinstance(p, str) else p for p in purpose]
    return np.random.default_rng([seed, *words])


@dataclass(frozen=True)
class Shots:
    """Launches and settings.

    Attributes:
        nominal: (x, px, y, py, delta), [shot, 5]; `sigma` is the launches' rms about it, [5].
        launches: of the beam, OCELOT's six coordinates, [shot, 6].
    """

    nominal: Array
    launches: Array
    sigma: Array
    settings: tuple[Settings, ...]

    def __len__(self) -> int:
        return len(self.nominal)


def draw_shots(
    ring: Ring,
    shots: int,
    amplitude: float = 1e-3,
    *,
    sigma: Sequence[float] = LAUNCH_SIGMA,
    kicks: float = 0.0,
    settings: Sequence[Settings] = (),
    seed: int = 0,
) -> Shots:
    """Return shots with random betatron phases in both planes.

    Args:
        ring: the design; the amplitude is that of its own first turn.
        amplitude: rms orbit over monitors and planes, m; both planes have the same rms on average
            over phases.
        sigma: rms of x, px, y, py, delta about the nominal launch.
        kicks: rms of random settings of all correctors, rad, on top of `settings`' own.

    Raises:
        TmlatticeError: no shot, an amplitude that is not positive, or a sigma that is no rms.
        LatticeError: a ring without monitors.
        BeamLostError: an amplitude at which the design loses the beam.
        UnstableRingError: a design without betatron phases.
    """
    if shots < 1 or not 0 < amplitude < np.inf:
        raise TmlatticeError(
            f"{shots} shots of {amplitude:g} m cannot be made; give at least one, above 0 m"
        )
    spread = np.asarray(sigma, dtype=float)
    if spread.shape != (5,) or not ((spread >= 0) & (spread < np.inf)).all():
        raise TmlatticeError(
            f"the launches' rms {sigma} should be five numbers (x, px, y, py, delta), none negative"
        )
    need_monitors(ring)
    chain = Chain.from_ring(ring)
    modes = one_turn_optics(chain).modes
    phases = stream(seed, "launches").uniform(0, 2 * np.pi, (shots, 2))
    turned = np.exp(1j * phases)[:, :, None] * modes.T  # [shot, plane, 4]
    planes = 1e-6 * np.real(turned)
    for plane in (0, 1):  # each plane to the same rms, then both together
        planes[:, plane] /= _rms(chain, planes[:, plane])[:, None]
    launch = 1e-6 * planes.sum(axis=1)
    try:
        for _ in range(3):
            launch *= (amplitude / _rms(chain, launch))[:, None]
    except BeamLostError as error:
        raise BeamLostError(
            f"an orbit of {amplitude:g} m rms is lost in the design; give a smaller amplitude"
        ) from error
    nominal = np.concatenate([launch, np.zeros((shots, 1))], axis=1)
    jitter = stream(seed, "jitter").standard_normal(nominal.shape)
    actual = nominal + spread * jitter
    launches = np.zeros((shots, 6))
    launches[:, :4], launches[:, 5] = actual[:, :4], actual[:, 4]
    return Shots(nominal, launches, spread, _draw_settings(ring, shots, kicks, settings, seed))


def _rms(chain: Chain, launch: Array) -> Array:
    readings = chain.readings(launch)
    return np.asarray(np.sqrt((readings**2).mean(axis=(1, 2))))


def each_setting(given: Sequence[Settings], shots: int) -> tuple[Settings, ...]:
    """Return the settings of each shot; () are the design's in every one; TmlatticeError: their
    number differs from that of the shots."""
    if given and len(given) != shots:
        raise TmlatticeError(f"{len(given)} settings do not fit {shots} shots; give one for each")
    return tuple(given) or ({},) * shots


def _draw_settings(
    ring: Ring, shots: int, kicks: float, given: Sequence[Settings], seed: int
) -> tuple[Settings, ...]:
    own = [{k: dict(v) for k, v in one.items()} for one in each_setting(given, shots)]
    if kicks:
        correctors = [e.name for e in ring.elements if e.is_corrector]
        drawn = kicks * stream(seed, "kicks").standard_normal((shots, len(correctors)))
        for setting, row in zip(own, drawn.tolist(), strict=True):
            for name, kick in zip(correctors, row, strict=True):
                setting.setdefault(name, {"kick": kick})
    return tuple(own)


def draw_background(ring: Ring, rms: Mapping[str, float], seed: int = 0) -> list[Cause]:
    """Return random distributed errors: every effect at every possible place, Gaussian.

    Args:
        rms: by effect, see `background_rms`.
        seed: each effect has its own random stream.
    """
    causes = []
    for name, size in rms.items():
        places = find(name).places(ring)
        amounts = size * stream(seed, "background", name).standard_normal(len(places))
        causes += [Cause(name, p, float(a)) for p, a in zip(places, amounts, strict=True)]
    return causes
