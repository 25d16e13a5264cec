"""Two days of a measured ring: `TMLATTICE_DATA=... python benchmarks/pairs.py [RING ...]`.

The response that was measured is the first day. The second is the same, with what changes of some
supplies and of some single magnets do to the readings of all that was fitted to the first (AT's
closed orbits, with less without; kicks that the dispersion has and no orbit shows, which AT lacks,
by the package's maps), drifts of monitors and correctors, magnets that come back to 1e-4 and
supplies to half of that, and noise of its own.
What the model of the ring lacks is in both days, as it is in two real ones; so is the first one's
noise, and the second's is drawn larger by that: two days differ by the noise of both.

Each case is drawn by its number: three supplies by 0.1 to 0.6 %, less where that moves a tune by
more than 0.03, and three single quadrupoles by 0.3 to 1 %, of either sign; or nothing (`--null`).
It prints what was found of what was changed, what else was named, and by how many of their stated
errors the amounts are off. `--cases N` that many of each ring, `--first N` from another number on.
"""

import argparse
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from real_rings import imported, sources

import tmlattice
from tmlattice import Cause, read_measurement
from tmlattice.diagnosis.families.dispersion import fitted_orbit_kicks
from tmlattice.diagnosis.response import procedure
from tmlattice.effects import apply
from tmlattice.errors import TmlatticeError
from tmlattice.lattice.supplies import magnets, supplied_alike
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.optics import ring_tunes

SUPPLIES, SINGLE = 3, 3
SHIFT = 0.03
"""Of a tune, at most: who changes a ring in use keeps its tunes."""
DRIFT = 2e-3
"""rms, relative, of gains and kicks from one day to the other."""
SCATTER = 1e-4
"""rms, relative: as well as every quadrupole comes back, and one that was changed is set; half of
it as well as all of a supply do together."""
STRANGE = 0.05
"""Share of the square of a column, or a monitor, that a multiple of its model leaves where it takes
no part: what is swapped, for example, would have the change of another one."""
KICK = 2e-5
"""rad; of AT's steps, small enough for orbits in proportion to them."""


class DistributedErrors(NamedTuple):
    """What was fitted to the first day: causes, and kicks that only the dispersion has."""

    causes: list[Cause]
    orbit_kicks: np.ndarray | None


def drawn(ring, rng, null):
    """Changes: (its name, amount, {magnet: relative change})."""
    own = magnets(ring, ("quadrupole",), powered=True)
    kinds, members = supplied_alike(ring)
    several = [i for i in range(len(kinds)) if members[:, i].sum() > 1]
    changes, taken = [], set()
    if null:
        return changes
    chosen = rng.permutation(several)[:SUPPLIES]
    amounts = rng.choice([-1, 1], SUPPLIES) * np.exp(rng.uniform(*np.log([1e-3, 6e-3]), SUPPLIES))
    pieces = [[e.name for m in np.flatnonzero(members[:, i]) for e in own[m]] for i in chosen]
    before = np.array(ring_tunes(ring))
    while True:
        causes = [
            Cause("quadrupole_gradient", name, amount)
            for names, amount in zip(pieces, amounts, strict=False)
            for name in names
        ]
        if np.abs(np.array(ring_tunes(apply(ring, causes))) - before).max() < SHIFT:
            break
        amounts = amounts / 2
    for i, amount in zip(chosen, amounts, strict=False):
        of = np.flatnonzero(members[:, i])
        taken.update(of)
        changes.append((kinds[i], amount, {own[m][0].name: amount for m in of}, own, of))
    for m in rng.permutation(len(own)):
        if len(changes) == SUPPLIES + SINGLE:
            break
        if m in taken:
            continue
        taken.update(np.flatnonzero(members[m] @ members.T))  # no other of its supply
        amount = rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(3e-3), np.log(1e-2)))
        changes.append((own[m][0].name, amount, {own[m][0].name: amount}, own, [m]))
    return changes


def causes_of(changes):
    """The changes of `drawn`, piece by piece."""
    return [
        Cause("quadrupole_gradient", piece.name, amount)
        for _, amount, _, own, of in changes
        for m in of
        for piece in own[m]
    ]


def with_dispersion(data, dispersion):
    """The design with a diagnosis's additional dispersion, for other correctors and BPMs."""
    none = Errors.none(data)
    if not dispersion:
        return none
    ring, nothing = data.ring, (0.0, 0.0)
    monitors, correctors = (
        np.array([dispersion.get(ring[name].name, nothing) for name in names])
        for names in (data.measured.monitors, data.measured.correctors)
    )
    own = correctors[np.arange(len(correctors)), data.plane[:-1]]
    return replace(none, dispersion=monitors * data.energy_of_rf, at_correctors=own)


def first_day(ring, measured):
    """What was measured by what resembles its model, what the model has, and the orbits of that."""
    found = tmlattice.diagnose(ring, measured)
    # a spread would take three times the orbits, and changes theirs by next to nothing
    causes = [own for own in found.causes if own.effect != "energy_spread" and own.amount]
    data = response_data(ring, measured)
    fitted = Predicted(data, with_dispersion(data, found.dispersion).with_causes(data, causes))
    known = DistributedErrors(causes, fitted_orbit_kicks(fitted))
    model = simulated(ring, known, measured)
    read, told, kicks = as_kicked(measured, model)
    good = stranger(read, told, 1) < STRANGE
    correctors = [name for name, own in zip(measured.correctors, good, strict=True) if own]
    of_plane = [good & (np.array(measured.planes) == plane) for plane in "xy"]
    left = np.max([stranger(read[own], kicks[own, None] * told[own], 0) for own in of_plane], 0)
    monitors = [name for name, own in zip(measured.monitors, left, strict=True) if own < STRANGE]
    measured, model = (own.select(correctors, monitors) for own in (measured, model))
    return known, measured, model


def as_kicked(measured, model):
    """Readings and model of each column in the plane that it kicks, [column, monitor], and what it
    has of the model's kick, [column]: held-out correctors have no calibration."""
    planes = [int(plane == "y") for plane in measured.planes]
    read, told = (own[np.arange(len(planes)), :, planes]
                  for own in (measured.response, model.response))  # fmt: skip
    told = np.where(np.isfinite(read), told, 0.0)
    read = np.where(np.isfinite(read), read, 0.0)
    return read, told, (read * told).sum(axis=1) / (told**2).sum(axis=1)


def stranger(read, told, axis):
    """Share of the square that a multiple of the model leaves, of each column or monitor."""
    both, size, whole = ((a * b).sum(axis=axis) for a, b in
                         ((read, told), (told, told), (read, read)))  # fmt: skip
    return 1 - both**2 / np.maximum(size * whole, 1e-300)


def simulated(ring, known, measured, changes=()):
    """AT's response with the monitors, the correctors and the RF step of a measurement, and what
    stray kicks add to it."""
    rf, causes = measured.rf, [*known.causes, *changes]
    made = simulate_response(
        ring, causes, correctors=list(measured.correctors), kick=KICK, noise=0.0, progress=False,
        rf_step=0.0 if rf is None or rf.orbit is None else rf.step,
    ).measured  # fmt: skip
    made = made.select(monitors=[m.name for m in ring.monitors if m.name in measured.monitors])
    if known.orbit_kicks is None:
        return made.select(monitors=measured.monitors)
    data = response_data(ring, made)
    errors = Errors.none(data).with_causes(data, causes)
    with_kicks, without = (
        Predicted(replace(data, orbit_kicks=orbit_kicks), errors).read
        for orbit_kicks in (known.orbit_kicks, None)
    )
    more = with_kicks - without
    rf = made.rf
    if rf is not None and rf.orbit is not None:
        rf = replace(rf, orbit=rf.orbit + more[-1])
    made = replace(made, response=made.response + more[:-1], rf=rf)
    return made.select(monitors=measured.monitors)


def second_day(measured, ring, known, before, changes, rng):
    """What would have been measured then, of a ring with some causes on the first day."""
    own = magnets(ring, ("quadrupole",), powered=True)
    members = supplied_alike(ring)[1]
    back = SCATTER * rng.standard_normal(len(own))
    back += SCATTER / 2 * members @ rng.standard_normal(members.shape[1])
    scatter = [
        Cause("quadrupole_gradient", piece.name, amount)
        for magnet, amount in zip(own, back, strict=True)
        for piece in magnet
    ]
    after = simulated(ring, known, measured, [*causes_of(changes), *scatter])
    kicks = as_kicked(measured, before)[2]
    noise = np.zeros(2) if measured.noise is None else np.sqrt(2) * np.nan_to_num(measured.noise)
    gain = 1 + DRIFT * rng.standard_normal((len(measured.monitors), 2))
    scale = 1 + DRIFT * rng.standard_normal((len(kicks), 1, 1))
    response = measured.response + (after.response - before.response) * kicks[:, None, None]
    response = gain * scale * response + noise * rng.standard_normal(response.shape)
    rf = measured.rf
    if rf is not None and rf.orbit is not None:
        orbit = rf.orbit + after.rf.orbit - before.rf.orbit
        rf = replace(rf, orbit=gain * orbit + noise * rng.standard_normal(orbit.shape))
    return replace(measured, response=response, rf=rf)


def judged(ring, result, changes):
    """Names of what was found and missed, findings that are none, and pulls."""
    own = magnets(ring, ("quadrupole",), powered=True)
    kinds, members = supplied_alike(ring)
    true = {magnet[0].name: 0.0 for magnet in own}
    for _, _, of, _, _ in changes:
        true.update(of)
    found, wrong, pulls = set(), [], []
    for one in result.findings:
        if one.effect == "quadrupole_gradient":
            about = [next(m[0].name for m in own if one.element in [piece.name for piece in m])]
        elif one.effect == "family_gradient":
            names = [kind.casefold() for kind in kinds]
            column = (
                names.index(one.element.casefold()) if one.element.casefold() in names else None
            )
            about = [m[0].name for i, m in enumerate(own)
                     if (members[i, column] if column is not None
                         else m[0].family.casefold() == one.element.casefold())]  # fmt: skip
        else:
            about = []
        amounts = [true[name] for name in about]
        if not about or not any(amounts):
            wrong.append((one.effect, one.element, one.amount, one.amount_sigma))
            continue
        pulls.append((one.amount - np.mean(amounts)) / one.amount_sigma)
        found |= {what for what, _, of, _, _ in changes if set(of) & set(about)}
    missed = [(what, amount) for what, amount, _, _, _ in changes if what not in found]
    return found, missed, wrong, pulls


def weighed(name, case, ring, result, changes, seconds):
    """How many were found, were there, and are none; and pulls. It prints them, too."""
    found, missed, wrong, pulls = judged(ring, result, changes)
    told = ", ".join(f"{what} {100 * amount:+.2f} %" for what, amount in missed)
    others = ", ".join(f"{effect} {where} {amount:+.2g} ± {error:.1g}"
                       for effect, where, amount, error in wrong)  # fmt: skip
    print(f"{name}, case {case}: {result.verdict}, {len(found)} of {len(changes)}; missed: "
          f"{told or 'none'}; others: {others or 'none'}; pulls "
          f"{' '.join(f'{pull:+.1f}' for pull in pulls)}; {seconds:.0f} s", flush=True)  # fmt: skip
    return [len(found), len(changes), len(wrong)], pulls


def rms(pulls):
    """NaN of none."""
    return np.sqrt(np.mean(np.square(pulls))) if pulls else np.nan


def cases(name, files, data, place, options):
    """Each in turn; and the counts."""
    lattice, folder, _ = imported(name, files, data, place, "last")
    ring, measured = tmlattice.load_ring(lattice), read_measurement(folder)
    known, measured, before = first_day(ring, measured)
    total = np.zeros(4, dtype=int)
    every = []
    for case in range(options.first, options.first + options.cases):
        rng = np.random.default_rng(case)
        changes = drawn(ring, rng, options.null)
        begun = time.process_time()
        try:
            after = second_day(measured, ring, known, before, changes, rng)
            begun = time.process_time()
            result = tmlattice.diagnose(ring, after, reference=measured)
        except TmlatticeError as error:
            print(f"{name}, case {case}: {error}", flush=True)
            total += [0, len(changes), 0, 1]
            continue
        spent = time.process_time() - begun
        counts, pulls = weighed(name, case, ring, result, changes, spent)
        every += pulls
        total += [*counts, 0]
    return f"| {name} | {total[0]} of {total[1]} | {total[2]} | {rms(every):.2f} | {total[3]} |"


def main():
    """Of all rings, or of those that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rings", nargs="*")
    parser.add_argument("--cases", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--null", action="store_true")
    options = parser.parse_args()
    data = os.environ.get("TMLATTICE_DATA")
    if not data:
        sys.exit("set TMLATTICE_DATA to the folder that holds real_rings")
    # the ring alone is wanted of the first day
    procedure.detected_faults = lambda *args: ((), [], [])
    known = sources(Path(data))
    with tempfile.TemporaryDirectory() as place:
        rows = [
            cases(name, known[name], Path(data), Path(place), options)
            for name in options.rings or known
        ]
    print("\n| ring | found | others | pulls, rms | no result |\n|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
