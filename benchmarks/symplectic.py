"""Symplectic layers against truncated ones: `python benchmarks/symplectic.py`.

The drift of the mean action of a particle of 3 mm from the first tenth of 5000 turns to the last,
and the time of a turn of one and of 64 particles, on the built-in ring.
"""

import numpy as np
from speed import median_time

import tmlattice

TURNS = 5000


def drift(network):
    """Relative change of the mean action of a particle in x, and of one in y."""
    states = network.track([[3e-3, 0, 0, 0], [0, 0, 3e-3, 0]], TURNS)
    optics = tmlattice.one_turn_optics(network)
    action = [np.abs(optics.normalised(states[plane])[:, plane]) ** 2 for plane in range(2)]
    tenth = TURNS // 10
    return [abs(own[-tenth:].mean() / own[1 : tenth + 1].mean() - 1) for own in action]


def main():
    truncated = tmlattice.TaylorNetwork.from_ring(tmlattice.load_ring("petra3"))
    layers = {"symplectic": truncated.symplectic(), "truncated": truncated}
    print("| layers | drift of the action, x / y | a turn of one particle | of 64 |")
    print("|---|---|---|---|")
    for name, network in layers.items():
        moved = " / ".join(f"{own:.1e}" for own in drift(network))
        times = []
        for particles, turns in ((1, 300), (64, 30)):
            states = np.outer(np.linspace(0.1, 1.0, particles), [3e-3, 0, 3e-3, 0])
            seconds = median_time(lambda n=network, s=states, t=turns: n.track(s, t), 5) / turns
            times.append(f"{1e3 * seconds:.3f} ms")
        print(f"| {name} | {moved} | {' | '.join(times)} |")


if __name__ == "__main__":
    main()
