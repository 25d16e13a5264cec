"""xtrack's own figures of small rings, one class or field each, for test_xsuite_files.py.

    pip install xsuite
    python tests/lattices/referee_xsuite.py        # writes the figures into xsuite_classes.json

The file next to this one holds each deck's elements, where they differ from those that all share,
as xtrack writes them, with xtrack's length, tunes, largest orbit and momentum compaction, and its
version. A new deck is a name with `elements` (and a `cell`): the script adds the figures.
"""

import json
from pathlib import Path

import numpy as np
import xtrack as xt

FILE = Path(__file__).with_name("xsuite_classes.json")


def figures(line):
    twiss = line.twiss(method="4d")
    return {
        "length": line.get_length(),
        "tunes": [twiss.qx, twiss.qy],
        "orbit": [float(np.abs(twiss.x).max()), float(np.abs(twiss.y).max())],
        "momentum_compaction": twiss.momentum_compaction_factor,
    }


def main():
    content = json.loads(FILE.read_text())
    for deck in content["decks"].values():
        line = xt.Line.from_dict({
            "elements": {**content["elements"], **deck["elements"]},
            "element_names": deck.get("cell", content["cell"]) * content["cells"],
        })  # fmt: skip
        line.particle_ref = xt.Particles(**content["particle"])
        deck.update(figures(line))
    composed = content["composed"]
    line = xt.Environment.from_dict(composed["file"])["ring"]
    line.particle_ref = xt.Particles(**content["particle"])
    own = figures(line)
    composed |= {key: own[key] for key in ("length", "tunes")}
    content["versions"] = {"xtrack": xt.__version__}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    FILE.write_text(text.replace('},"', '},\n"') + "\n")


if __name__ == "__main__":
    main()
