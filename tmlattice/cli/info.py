"""`tmlattice info`: what a lattice holds and how it focuses. `tmlattice effects`: the catalogue."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import (
    WithDefault,
    console,
    json_option,
    lattice_argument,
    open_ring,
    outputs,
    table,
)

if TYPE_CHECKING:
    from tmlattice.lattice import Ring


@click.command("info", cls=WithDefault)
@lattice_argument
@json_option
def info(lattice: str, json_file: Path | None) -> None:
    """Print counts, length, tunes, chromaticity and betas of LATTICE."""
    with outputs(None, json_file) as (*_, write):
        facts = _facts(open_ring(lattice, read=False))
        write(facts)
    _print(facts)


def _facts(ring: "Ring") -> dict[str, Any]:
    from tmlattice import __version__
    from tmlattice.beam.chain import Chain
    from tmlattice.errors import UnstableRingError
    from tmlattice.optics import off_momentum, twiss

    facts: dict[str, Any] = {
        "format": "tmlattice-info",
        "version": 1,
        "package": __version__,
        "lattice": ring.name,
        "energy_gev": ring.energy,
        "mass_gev": ring.mass,
        "length": ring.length,
        "counts": dict(sorted(ring.counts().items())),
        "layers": len(ring.magnets),
        "magnets_in_pieces": len(ring.slices),
        "bend_angle": sum(e.bending for e in ring.elements),
        "tunes": None,
        "chromaticity": None,
        "beta_max": None,
        "closed_orbit_max": None,
        "dispersion_max": None,
        "momentum_compaction": None,
        "problem": None,
    }
    try:
        chain = Chain.from_ring(ring, 6)  # its maps are in the cache
        functions = twiss(chain)
        facts["tunes"] = functions.total_tunes.tolist()
        facts["beta_max"] = functions.beta.max(axis=0).tolist()
        facts["closed_orbit_max"] = [float(abs(own).max()) for own in (functions.x, functions.y)]
        energy_effects = off_momentum(chain, ring.length)
        # per momentum, not per energy dE / (p0 c) = beta delta; and of the path, not of its time
        beta, lag = (1.0, 0.0) if ring.gamma > 1e3 else (ring.beta, ring.gamma**-2)
        facts["chromaticity"] = (beta * energy_effects.chromaticity).tolist()
        facts["dispersion_max"] = (beta * abs(energy_effects.dispersion)).max(axis=0).tolist()
        facts["momentum_compaction"] = beta**2 * energy_effects.momentum_compaction + lag
    except UnstableRingError as error:
        facts["problem"] = str(error)
    return facts


def _print(facts: dict[str, Any]) -> None:
    heavy = facts["mass_gev"] > 1e-3
    particle = f" (particles of {facts['mass_gev']:.6g} GeV)" if heavy else ""
    screen = console()
    screen.print(
        f"{facts['lattice']}: {facts['length']:.4f} m, {facts['energy_gev']:g} GeV{particle}, "
        f"{facts['layers']} magnets, bends sum to {facts['bend_angle']:.9f} rad"
    )
    counts = ((kind, str(count)) for kind, count in facts["counts"].items())
    screen.print(table("elements", "count", rows=counts))
    if facts["magnets_in_pieces"]:
        screen.print(f"{facts['magnets_in_pieces']} magnets stand in two pieces or more")
    if facts["tunes"] is not None:
        optics = table("optics", "x", "y")
        rows = [
            ("tune", "tunes", "{:.6f}"),
            ("chromaticity dQ / d delta", "chromaticity", "{:+.3f}"),
            ("largest beta at a magnet's exit [m]", "beta_max", "{:.2f}"),
            ("largest dispersion there [m]", "dispersion_max", "{:.4f}"),
        ]
        if max(facts["closed_orbit_max"]) > 1e-7:  # the lattice has kicks of its own
            rows.append(("largest closed orbit there [m]", "closed_orbit_max", "{:.3e}"))
        for name, key, form in rows:
            value = facts[key]
            optics.add_row(name, *(("-", "-") if value is None else map(form.format, value)))
        screen.print(optics)
        if facts["momentum_compaction"] is not None:
            screen.print(f"momentum compaction {facts['momentum_compaction']:.4e}")
    if facts["problem"]:
        screen.print(f"{facts['problem']}")


@click.command("effects")
@json_option
def effects(json_file: Path | None) -> None:
    """List the effects that the project knows, with units, signs and sizes."""
    from tmlattice import __version__
    from tmlattice.effects import CATALOGUE
    from tmlattice.files import output_file, write_json

    if json_file:
        rows = [
            {
                "effect": effect.name,
                "words": effect.words,
                "group": effect.group,
                "sits_on": effect.sits_on_text,
                "unit": effect.unit,
                "sign": effect.sign,
                "background_rms": effect.background,
                "largest_fault": effect.largest,
                "modelled": effect.modelled,
                "energy": effect.energy,
                "acts_on_settings": effect.acts_on_settings,
                "usual": effect.usual,
            }
            for effect in CATALOGUE.values()
        ]
        document = {"format": "tmlattice-effects", "version": 1, "package": __version__}
        with output_file(json_file) as path:
            write_json(path, {**document, "effects": rows})
        return
    shown = table("effect", "unit", "rms / largest", "sits on; what a positive amount does")
    for column in shown.columns:
        column.justify = "left"
        column.no_wrap = column is not shown.columns[-1]
    for effect in CATALOGUE.values():
        usual = "-" if effect.background is None else f"{effect.background:g}"
        where = "in turns of a stored beam" if effect.of_turns else "where it is named (--effects)"
        asked = "" if effect.usual else f"; looked for {where}"
        text = f"{effect.sits_on_text}; {effect.sign}{asked}"
        shown.add_row(effect.name, effect.unit, f"{usual} / {effect.largest:g}", text)
    console().print(shown)
