"""How often the data checks are right: `python benchmarks/data_checks.py [RING ...]`.

Two tables for each ring, on first turns of the virtual machine. Data that are wrong everywhere: is
it named, and nothing else, in how many seconds? Healthy data of sick and of real machines: is
anything reported? Among them are machines with usual errors whose quadrupoles are so far off axis
that the orbit of the first turn is 1, 3 or 6 mm rms (`python benchmarks/data_checks.py --off-axis
RING ...`: these alone). RING is a lattice file, a built-in name, or a file of AT's `machine_data`.
"""

import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

import tmlattice
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.effects import Cause, background_rms, find, names
from tmlattice.machine import simulate
from tmlattice.machine.response import simulate_response
from tmlattice.machine.shots import draw_background
from tmlattice.measurement.assume import assume

RINGS = ("petra3", "tests/lattices/small_ring.py", "esrf.m", "thomx.m")
SHOTS = 6
SEEDS = range(300, 308)
"""Others than those that the thresholds were chosen with, 0 to 16, 100 to 116 and 200 to 212."""
LARGE = {"quadrupole_gradient": -0.2, "monitor_gain_x": -2.0, "monitor_gain_y": -2.0}
SMALL_OF_RESPONSES = {
    "quadrupole_gradient": 1e-3,
    "monitor_gain_x": 0.02,
    "monitor_gain_y": 0.02,
    "corrector_calibration": 0.03,
    "monitor_roll": 5e-3,
    "corrector_roll": 5e-3,
}


def load(name):
    if not Path(name).exists() and "." in name:
        import machine_data

        name = Path(machine_data.__file__).parent / name
    return tmlattice.load_ring(str(name))


# --- what is wrong everywhere ---------------------------------------------------------------------
def scaled(data, readings=1.0, launches=1.0, sigma=1.0, noise=1.0):
    return replace(
        data,
        readings=data.readings * readings,
        launches=data.launches * np.broadcast_to(launches, 5),
        launch_sigma=data.launch_sigma * np.broadcast_to(sigma, 5),
        noise=data.noise * noise,
    )


def reordered(data, order):
    return replace(data, readings=data.readings[:, :, order], noise=data.noise[order])


def wrong(data, ring):
    """Of each: name, the data, and the assumptions of which one has to be named (or the check)."""
    count = len(data.monitors)
    places = np.arange(count)
    yield "x of wrong sign", scaled(data, [-1, 1]), {"x-reversed"}
    yield "y of wrong sign", scaled(data, [1, -1]), {"y-reversed"}
    yield "x and y of wrong sign", scaled(data, -1), {"readings-reversed"}
    swapped = replace(data, readings=data.readings[..., ::-1], noise=data.noise[:, ::-1])
    yield "planes swapped", swapped, {"planes-swapped"}
    yield "readings in mm", scaled(data, 1e3), {"readings-in-mm"}
    yield "readings and noise in mm", scaled(data, 1e3, noise=1e3), {"readings-in-mm"}
    yield "readings in µm", scaled(data, 1e6), {"readings-in-um"}
    yield "readings in mm, noise unknown", scaled(replace(data), 1e3), {"readings-in-mm"}
    yield "readings in mm, x of wrong sign", scaled(data, [-1e3, 1e3]), {
        "readings-in-mm", "x-reversed"}  # fmt: skip
    yield "launches in mm and mrad", scaled(data, launches=1e3), {"launches-in-mm"}
    yield "with their sigma", scaled(data, launches=1e3, sigma=1e3), {"launches-in-mm"}
    yield "slopes in mrad", scaled(data, launches=[1, 1e3, 1, 1e3, 1]), {"slopes-in-mrad"}
    yield "launches of wrong sign", scaled(data, launches=[-1] * 4 + [1]), {"launches-reversed"}
    yield "slopes of wrong sign", scaled(data, launches=[1, -1, 1, -1, 1]), {"slopes-reversed"}
    other = replace(data, launches=data.launches[:, [2, 3, 0, 1, 4]])
    yield "planes of launches swapped", other, {"launches-swapped"}
    for by in (1, -2, 3):
        moved = reordered(data, np.roll(places, -by))
        yield f"monitors shifted by {by}", moved, {f"monitors-shifted={-by}"}
    yield "monitors in reverse order", reordered(data, places[::-1]), {"monitors-backwards"}
    by_name = np.argsort([name.casefold() for name in data.monitors], kind="stable")
    yield "monitors sorted by name", reordered(data, by_name), {"monitors-alphabetical"}
    late = np.concatenate([np.full_like(data.readings, np.nan), data.readings], axis=1)
    yield "turns counted from 1", replace(data, readings=late), {"turns-from-1"}
    back = replace(backwards(ring, data), noise=data.noise)
    yield "beam runs backwards", back, {"beam-backwards"}
    set_ = simulate(ring, shots=SHOTS, seed=2, kicks=1e-4).measurement()
    turned = tuple({k: {"kick": -v["kick"]} for k, v in shot.items()} for shot in set_.settings)
    if any(turned):
        yield "kicks of wrong sign", replace(set_, settings=turned), {"settings-reversed"}
    yield "noise a tenth", scaled(data, noise=0.1), {"noise-from-data"}
    yield "noise tenfold", scaled(data, noise=10), {"noise-from-data"}
    rng = np.random.default_rng(1)
    mixed = replace(data, readings=data.readings[:, :, rng.permutation(count)])
    yield "monitors in no order", mixed, "lattice"
    stray = np.full((len(data.launches), 41, count, 2), np.nan)
    stray[:, :1], stray[0, 40, 3] = data.readings, data.readings[0, 0, 3]
    yield "one row of turn 40", replace(data, readings=stray), "turns"


def backwards(ring, data):
    """Launched at the ring's end, against the lattice: what a trajectory forward ends with."""
    from tmlattice.beam.model import Model

    exact = simulate(ring, shots=SHOTS, seed=1, launch_sigma=[0] * 5).measurement()
    paths = Model(ring, [{}] * SHOTS).paths(exact.launches)
    ends = paths.states[:, -1][:, [0, 1, 2, 3, 5]] * [1, -1, 1, -1, 1]
    error = np.random.default_rng(1).standard_normal(ends.shape) * data.launch_sigma
    return replace(exact, launches=ends + error, launch_sigma=data.launch_sigma)


def wrong_response(data, ring):
    """The same for an orbit response; the other explanation of some is named, too."""
    for name, made, asked in (
        ("x of wrong sign", "x-reversed", "x-reversed"),
        ("y of wrong sign", "y-reversed", "y-reversed"),
        ("planes swapped", "planes-swapped", "planes-swapped"),
        ("readings in mm", "readings-in-km", "readings-in-mm"),
        ("readings halved", "readings-doubled", "readings-halved"),
        ("kicks in mrad", "", "kicks-in-mrad"),
        ("kicks of wrong sign", "kicks-reversed", "kicks-reversed"),
        ("horizontal kicks of wrong sign", "kicks-x-reversed", "kicks-x-reversed"),
        ("half steps", "kicks-halved", "kicks-doubled"),
        ("monitors shifted by 1", "monitors-shifted=-1", "monitors-shifted=1"),
        ("correctors shifted by 1", "correctors-shifted=-1", "correctors-shifted=1"),
        ("RF step of wrong sign", "rf-reversed", "rf-reversed"),
    ):
        if name.startswith("horizontal") and data.planes.count("x") < 2:
            continue  # no one could tell it from a bad corrector
        if name == "kicks in mrad":
            yield name, replace(data, kicks=data.kicks * 1e3), {asked}
        else:
            monitors = [monitor.name for monitor in ring.monitors]
            yield name, assume(data, [made], monitors), {asked}


def named(checkup, expected):
    """Whether what was expected is reported, and nothing else is wrong."""
    bad = [check for check in checkup.checks if check.status == "wrong"]
    if isinstance(expected, str):
        return [check.name for check in bad] == [expected]
    offered = {name for check in bad for name in check.assume}
    said = " ".join(check.sentence for check in bad)
    return bool(bad) and all(name in offered or f"--assume {name}" in said for name in expected)


# --- healthy data ---------------------------------------------------------------------------------
def place(ring, effect, rng):
    places = find(effect).places(ring)
    return places[rng.integers(len(places))]


def fault(ring, rng, effect=None):
    """A strong one."""
    if effect is None:
        possible = [n for n in names() if find(n).places(ring)]
        effect = str(rng.choice(possible))
    kind = find(effect)
    amount = 1.0 if kind.discrete else LARGE.get(effect, kind.largest * rng.choice([-1.0, 1.0]))
    if kind.one_sign:
        amount = abs(amount)
    return Cause(effect, place(ring, effect, rng), float(amount))


def healthy(ring, seed):
    """Kind, causes and options of the machine, and what is kept of the measurement."""
    rng = np.random.default_rng(seed)
    quad = place(ring, "quadrupole_gradient", rng)
    monitors = {place(ring, "monitor_swap", rng) for _ in range(3)}
    yield "no fault", [], {}
    yield "a quadrupole -30, -20 or +30 %", [
        Cause("quadrupole_gradient", quad, float(rng.choice([-0.3, -0.2, 0.3])))], {}  # fmt: skip
    yield "three monitors exchanged", [Cause("monitor_swap", m, 1.0) for m in monitors], {}
    yield "any strong fault", [fault(ring, rng)], {}
    yield "three strong faults", [fault(ring, rng) for _ in range(3)], {}
    yield "one shot, a fault", [fault(ring, rng)], {"shots": 1}
    yield "three turns, a fault", [fault(ring, rng)], {"turns": 3}
    yield "correctors set", [fault(ring, rng)], {"kicks": 2e-5}
    yield "energies of their own", [fault(ring, rng)], {"launch_sigma": (1e-4, 2e-5) * 2 + (1e-3,)}
    usual = {"background": {"all": None}}
    yield "distributed errors", [], usual
    yield "and a fault", [fault(ring, rng)], usual
    yield "and correctors set", [], {**usual, "kicks": 2e-5}
    yield "and one shot", [], {**usual, "shots": 1}
    yield "a third of the monitors", [fault(ring, rng)], {"keep": 0.3}
    yield "a third, small errors", [], {**usual, "keep": 0.3}
    yield "six monitors", [], {"keep": 6}
    yield "noise of 2 µm, errors", [], {**usual, "noise": 2e-6}
    yield "3 mm of orbit", [fault(ring, rng)], {"amplitude": 3e-3}


def healthy_response(ring, seed):
    """Kind, causes and small errors of the machine."""
    rng = np.random.default_rng(seed)
    small = SMALL_OF_RESPONSES
    yield "response: small errors", [], small
    yield (
        "response: a quadrupole 3 %",
        [Cause("quadrupole_gradient", place(ring, "quadrupole_gradient", rng), 0.03)],
        small,
    )
    yield (
        "response: a bad corrector",
        [Cause("corrector_calibration", place(ring, "corrector_calibration", rng), -2.0)],
        small,
    )
    yield (
        "response: a monitor reversed",
        [Cause("monitor_gain_x", place(ring, "monitor_gain_x", rng), -2.0)],
        small,
    )
    yield "response: three exchanged", [
        Cause("monitor_swap", m, 1.0)
        for m in {place(ring, "monitor_swap", rng) for _ in range(3)}], small  # fmt: skip
    yield "response: gradients 0.5 %", [], {**small, "quadrupole_gradient": 5e-3}


ORBITS = (1e-3, 3e-3, 6e-3)
"""m; rms of the first turn of a beam on the axis, by displaced quadrupoles."""
OFF_AXIS = range(17)
"""Seeds of these machines: 204 on four rings."""


def off_axis(ring, seed):
    """Machines with usual errors and with quadrupoles displaced until the orbit has its size."""
    for size in ORBITS:
        offset = 3e-4
        for _ in range(4):
            rms = background_rms({"all": None})
            rms |= {f"quadrupole_offset_{plane}": offset for plane in "xy"}
            causes = draw_background(ring, rms, seed)
            one = {"shots": 1, "amplitude": 1e-6, "launch_sigma": [0] * 5}
            read = simulate(ring, causes, seed=seed, **one).measurement().readings
            ratio = size / float(np.sqrt(np.nanmean(read**2)))
            if abs(np.log(ratio)) < 0.2:
                break
            offset = float(np.clip(offset * ratio, 1e-5, 3e-3))
        yield f"{1e3 * size:.0f} mm of orbit, quadrupoles off axis", causes, {"seed": 1000 * seed}


def measured(ring, causes, options, seed):
    options = {"shots": SHOTS, "seed": seed, **options}
    keep = options.pop("keep", None)
    data = simulate(ring, causes, **options).measurement()
    if keep is not None:
        rng = np.random.default_rng(seed)
        count = round(keep * len(data.monitors)) if keep < 1 else keep
        places = np.sort(rng.choice(len(data.monitors), count, replace=False))
        data = data.select(monitors=[data.monitors[i] for i in places])
    return data


def stepped(ring, causes, background, seed):
    names_ = [e.name for e in ring.elements if e.kind in ("hcorrector", "vcorrector")]
    some = [names_[i] for i in np.unique(np.linspace(0, len(names_) - 1, 60).round().astype(int))]
    return simulate_response(
        ring, causes, background=background, correctors=some, engine="ocelot", seed=seed
    ).measured


def checked(ring, data):
    begun = time.process_time()
    return check_data(ring, data), time.process_time() - begun


def expected_notes(causes):
    """What a dead monitor's fault makes a true note."""
    return {"silent BPMs", "frozen BPMs"} if any(
        cause.effect == "monitor_dead" for cause in causes
    ) else set()  # fmt: skip


def main(rings):
    warnings.simplefilter("ignore")
    alone = rings[:1] == ["--off-axis"]
    for name in rings[alone:] or RINGS:
        ring = load(name)
        print(f"\n## {ring.name}: {len(ring.monitors)} monitors\n")
        data = simulate(ring, shots=SHOTS, seed=1).measurement()
        checked(ring, data)  # compiled before anything is timed
        cases = [] if alone else [("first turns", own) for own in wrong(data, ring)]
        if any(e.kind == "hcorrector" for e in ring.elements) and not alone:
            steps = simulate_response(
                ring, background=SMALL_OF_RESPONSES, engine="ocelot", seed=1
            ).measured
            cases += [("response", own) for own in wrong_response(steps, ring)]
        right, seconds = 0, []
        print("| wrong everywhere | named | s |\n|---|---|---|")
        for kind, (what, own, expected) in cases:
            found, took = checked(ring, own)
            good = named(found, expected)
            right += good
            seconds.append(took)
            print(f"| {kind}: {what} | {'yes' if good else 'NO'} | {took:.2f} |", flush=True)
            if not good:
                for check in found.reported:
                    print(f"    {check.status}: {check.sentence}")
        if seconds:
            print(
                f"\nnamed {right} of {len(cases)}; {np.median(seconds):.2f} s, {max(seconds):.2f}"
            )
        print("\n| healthy | cases | reported |\n|---|---|---|")
        told, count = {}, {}
        steers = any(e.kind == "hcorrector" for e in ring.elements)
        for seed in (*OFF_AXIS, *([] if alone else SEEDS)):
            kind = off_axis if seed in OFF_AXIS else healthy
            cases = [(measured, case) for case in kind(ring, seed)]
            if steers and seed in SEEDS:
                cases += [(stepped, case) for case in healthy_response(ring, seed)]
            for make, (what, causes, options) in cases:
                try:
                    own = make(ring, causes, options, seed)
                except tmlattice.errors.TmlatticeError as error:
                    print(f"    not made: {what}: {error}"[:150])
                    continue
                found, took = checked(ring, own)
                bad = [c for c in found.reported if c.name not in expected_notes(causes)]
                if seed in OFF_AXIS:  # notes that the beam was lost or the noise is large are true
                    true = ("lost beam", "noise", "launches", "outliers")
                    bad = [c for c in bad if c.status == "wrong" or c.name not in true]
                count[what] = count.get(what, 0) + 1
                told[what] = told.get(what, 0) + bool(bad)
                for check in bad:
                    print(f"    {what}, seed {seed}, {causes}: {check.status}: {check.sentence}")
        for what, number in count.items():
            print(f"| {what} | {number} | {told[what]} |")
        print(f"| all | {sum(count.values())} | {sum(told.values())} |")


if __name__ == "__main__":
    main(sys.argv[1:])
