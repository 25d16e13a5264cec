"""Speed of the diagnosis: `python benchmarks/diagnosis.py`.

- the scan of all magnets, monitors and effects, by number of shots and by size of the ring;
- the whole diagnosis of one fault;
- the alternative: every hypothesis refitted by OCELOT's own tracking of the ring, one bunch of
  as many particles as there are shots, four turns a hypothesis (extrapolated from one turn).
"""

import time

import numpy as np

import tmlattice
from tmlattice.beam.model import Model
from tmlattice.inference.newton import fit
from tmlattice.inference.scan import scan
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns


def median_time(call, repeats=5):
    call()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def scanner(ring, measurement):
    """A call that scans every hypothesis anew, the directions of the ring at hand."""
    data = of_measurement(ring, measurement)
    model = Model(ring, data.settings, data.turns)
    problem = FirstTurns(model=model, data=data, places={})
    base = fit(problem, (), data.launches)
    hypotheses = [h for h in model.hypotheses() if h[0] != "monitor_dead"]

    def call():
        return scan(problem.metric(base.point), hypotheses, base.residual)

    return call, len(hypotheses)


def ocelot_turn(ring, launches):
    """Seconds of one turn of a few particles by OCELOT's own `track`."""
    from ocelot.cpbd.beam import ParticleArray
    from ocelot.cpbd.magnetic_lattice import MagneticLattice
    from ocelot.cpbd.navi import Navigator
    from ocelot.cpbd.track import track
    from ocelot.cpbd.transformations.second_order import SecondTM

    lattice = MagneticLattice([e.source for e in ring.elements], method={"global": SecondTM})
    beam = ParticleArray(len(launches))
    beam.E = ring.energy
    beam.rparticles[:] = np.asarray(launches).T
    begun = time.perf_counter()
    track(lattice, beam, Navigator(lattice), print_progress=False)
    return time.perf_counter() - begun


def main():
    ring = tmlattice.load_ring("petra3")
    small = tmlattice.load_ring("tests/lattices/small_ring.py")
    cause = tmlattice.Cause("quadrupole_gradient", "qd::12", -0.05)
    print("scan of every hypothesis, threshold's simulation included")
    six = None
    for shots in (1, 3, 6, 12, 24):
        measurement = tmlattice.simulate(ring, [cause], shots=shots, seed=1).measurement()
        call, count = scanner(ring, measurement)
        seconds = median_time(call)
        six = seconds if shots == 6 else six
        print(f"  petra3, {shots:2d} shots: {seconds:.3f} s for {count} hypotheses")
    measurement = tmlattice.simulate(small, [], shots=6, seed=1, amplitude=1e-4).measurement()
    call, count = scanner(small, measurement)
    print(f"  small ring, 6 shots: {median_time(call):.3f} s for {count} hypotheses")
    begun = time.perf_counter()
    Model(tmlattice.load_ring("petra3"), [{}]).hypotheses()
    print(f"maps of the ring: {time.perf_counter() - begun:.2f} s, once")
    measurement = tmlattice.simulate(ring, [cause], shots=6, seed=1).measurement()
    seconds = median_time(lambda: tmlattice.diagnose(ring, measurement), 3)
    print(f"whole diagnosis of one fault, 4 shots in the fit and 2 held out: {seconds:.2f} s")
    launches = tmlattice.simulate(ring, [cause], shots=6, seed=1).shots.launches
    turn = ocelot_turn(ring, launches)
    call, count = scanner(ring, measurement)
    refits = 4 * turn * count
    print(f"one turn of six particles by OCELOT's own track: {turn:.2f} s")
    print(
        f"refitting {count} hypotheses by it, 4 turns each: {refits:.0f} s (extrapolated), "
        f"{refits / six:.0f} times the scan, {refits / seconds:.0f} times the whole diagnosis"
    )


if __name__ == "__main__":
    main()
