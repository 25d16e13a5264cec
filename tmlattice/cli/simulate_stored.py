"""`tmlattice simulate --kind ...` of a stored beam: which options a kind has, and its run."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

SHOTS = frozenset({"shots", "settings_file"})
KINDS: Mapping[str, frozenset[str]] = {
    "trajectory": SHOTS | {"turns", "amplitude", "radiation", "engine", "jobs"},
    "orbit-response": frozenset({"correctors", "engine"}),
    "turn-by-turn": SHOTS | {"turns", "amplitude", "radiation", "particles"},
    "closed-orbit": SHOTS | {"radiation"},
    "dispersion": frozenset(),
    "tunes": SHOTS,
}
"""The options that a kind has in addition to those of all."""


def simulate_stored(
    kind: str,
    ring: Any,
    causes: list[Any],
    out: Path,
    truth: Path | None,
    force: bool,
    quiet: bool,
    chosen: Mapping[str, Any],
) -> tuple[str, str, Mapping[str, float]]:
    """Simulate a measurement of the stored beam, and write it with its truth, both or neither.

    Args:
        chosen: the command's options, those of other kinds too.

    Returns:
        Name of the table, what was measured in a line, and the background's rms.
    """
    from tmlattice.files import output_file
    from tmlattice.measurement import write_measurement, write_truth

    options = {name: chosen[name] for name in ("background", "seed", "machine_seed")}
    own = {"settings" if name == "settings_file" else name for name in KINDS[kind]}
    options |= {name: value for name, value in chosen.items() if name in own}
    if chosen["noise"] is not None:
        options["noise"] = chosen["noise"]
    with ExitStack() as both:
        file = None if truth is None else both.enter_context(output_file(truth))
        simulation, table, sentence = _run(kind, ring, causes, quiet, options)
        if file is not None:
            write_truth(file, **simulation.truth())
        write_measurement(out, simulation.measured, force)
    return table, f"{ring.name}: {sentence}, seed {options['seed']}", simulation.background


def _run(
    kind: str, ring: Any, causes: list[Any], quiet: bool, options: dict[str, Any]
) -> tuple[Any, str, str]:
    from tmlattice.machine import stored_beam
    from tmlattice.machine.response import simulate_response

    monitors = f"{len(ring.monitors)} monitors"
    made: Any
    if kind == "orbit-response":
        made = simulate_response(ring, causes, progress=not quiet, **options)
        rf = "" if made.measured.rf is None else f", RF step {made.measured.rf.step:g} Hz"
        return made, "response.csv", (
            f"{len(made.measured.correctors)} correctors, {monitors}, two-sided steps of "
            f"{1e6 * abs(made.measured.kicks[0]):g} µrad{rf}, engine {options['engine']}"
        )  # fmt: skip
    if kind == "turn-by-turn":
        made = stored_beam.simulate_turns(ring, causes, **options)
        shots, turns = made.measured.readings.shape[:2]
        return made, "readings.csv", (
            f"{shots} shots of {turns} turns of a stored beam, {monitors}, "
            f"{1e3 * options['amplitude']:g} mm rms, {options['particles']} particle(s), engine at"
        )  # fmt: skip
    if kind == "closed-orbit":
        made = stored_beam.simulate_orbits(ring, causes, **options)
        shots = len(made.measured.shots)
        return made, "readings.csv", f"{shots} closed orbit(s), {monitors}, engine at"
    if kind == "dispersion":
        made = stored_beam.simulate_dispersion(ring, causes, **options)
        (step,) = (one.step for one in made.measured.steps)
        return made, "readings.csv", f"{monitors}, a two-sided RF step of {step:g} Hz, engine at"
    if "noise" in options:
        options["noise"] = options["noise"], stored_beam.TUNE_NOISE[1]
    made = stored_beam.simulate_tunes(ring, causes, **options)
    return made, "tunes.csv", f"{len(made.measured.shots)} reading(s) of the tunes, engine at"
