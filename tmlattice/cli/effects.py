"""`tmlattice effects`: the catalogue."""

from pathlib import Path

import click

from tmlattice.cli.options import console, json_option, table


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
