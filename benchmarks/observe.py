"""What measurements of a stored beam cost, and how it grows: `python benchmarks/observe.py`.

Turns of two modes with coupling and noise at all monitors, as many as asked for; for each size the
processor seconds that the spectra take (`observe.spectra.lines`), that the folder takes to be
written and read, and the rms of the amplitudes' deviations over their errors. Least of three runs.

22 November 2026, `python benchmarks/observe.py --files`, one thread of a busy machine:

    turns monitors shots   spectra   write    read    rms of deviations over errors
     1000      246     4      0.44     2.1     3.9    0.99
     1000      246     1      0.11     0.6     0.9    0.99
     1000       60     4      0.12     0.5     0.9    1.04
      250      246     4      0.11     0.5     0.9    1.00
     4000      246     4      2.09     8.8    16.2    1.00
    10000      246     1      1.43     5.5     9.5    0.99

All grow as turns x monitors x shots. On the same machine idle, 1000 turns, 246 monitors and 4 shots
took 0.3 s, and their folder 1.4 s to be written and 2.2 s to be read.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from tmlattice.measurement import TurnByTurn, read_measurement, write_measurement
from tmlattice.observe.spectra import lines

SIZES = (
    # turns, monitors, shots
    (1000, 246, 4),
    (1000, 246, 1),
    (1000, 60, 4),
    (250, 246, 4),
    (4000, 246, 4),
    (10_000, 246, 1),
)
TUNES, NOISE = (0.1237, 0.2746), 2e-5


def turns_of(turns, monitors, shots, rng):
    """Readings and true amplitudes [shot, monitor, plane, mode]."""
    size = np.array([[1e-3, 5e-5], [1e-4, 5e-4]])
    modulus = size * rng.uniform(0.5, 1.5, (shots, monitors, 2, 2))
    amplitude = modulus * np.exp(2j * np.pi * rng.uniform(size=modulus.shape))
    moving = np.exp(2j * np.pi * np.outer(np.arange(turns), TUNES))
    readings = np.einsum("sbpm,tm->stbp", amplitude, moving).real
    readings += NOISE * rng.standard_normal(readings.shape)
    return TurnByTurn(readings, tuple(f"b{i}" for i in range(monitors)), (NOISE, NOISE)), amplitude


def least(function, number=3):
    """Seconds, and what it gives."""
    best = np.inf
    for _ in range(number):
        start = time.process_time()
        made = function()
        best = min(best, time.process_time() - start)
    return best, made


def pulls(found, amplitude):
    """rms over shots, monitors and planes, one complex scale a mode and shot taken out."""
    off = []
    for true, read, error in zip(amplitude, found.amplitude, found.error, strict=True):
        for mode in (0, 1):
            a, b, e = (v[..., mode].ravel() for v in (true, read, error))
            off.append((b - np.vdot(a / e, b / e) / np.vdot(a / e, a / e) * a) / e)
    return float(np.sqrt(np.mean(np.abs(off) ** 2) / 2))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", action="store_true", help="Write and read folders too.")
    chosen = parser.parse_args()
    print("turns monitors shots   spectra   write    read    rms of deviations over errors")
    for turns, monitors, shots in SIZES:
        measured, amplitude = turns_of(turns, monitors, shots, np.random.default_rng(1))
        at = np.zeros(monitors)
        seconds, found = least(lambda m=measured, at=at: lines(m, at=at))
        write = read = np.nan
        if chosen.files:
            with tempfile.TemporaryDirectory() as folder:
                place = Path(folder) / "m"
                write, _ = least(lambda m=measured, p=place: write_measurement(p, m), 1)
                read, _ = least(lambda p=place: read_measurement(p), 1)
        print(
            f"{turns:5d} {monitors:8d} {shots:5d} {seconds:9.2f} {write:7.1f} {read:7.1f} "
            f"{pulls(found, amplitude):7.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
