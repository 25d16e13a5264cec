"""MAD-X's own figures of small decks, one statement or attribute each, for test_madx_decks.py.

    pip install cpymad
    python tests/lattices/referee_madx.py        # writes the figures into madx_decks.json

The file beside this one holds each deck's text, MAD-X's tunes, chromaticities, length, momentum
compaction, orbit at the start, and the beam, and the version of MAD-X. A new deck is a name with a
`text`, most often that of "plain" with one thing changed: the script adds the figures.
"""

import json
import tempfile
from pathlib import Path

FILE = Path(__file__).with_name("madx_decks.json")


def figures(text):
    from cpymad.madx import Madx

    with tempfile.TemporaryDirectory() as folder:
        mad = Madx(stdout=False, cwd=folder)
        mad.input(text)
        if "use," not in text:
            mad.input("use, sequence=ring;")
        mad.input("twiss;")
        summ, table = mad.table.summ, mad.table.twiss
        orbit = [float(table[k][0]) for k in ("x", "px", "y", "py")]
        beam = mad.sequence[str(table.summary.sequence).lower()].beam
        own = {k: float(summ[k][0]) for k in ("q1", "q2", "dq1", "dq2", "length", "alfa")}
        own |= {"orbit": orbit, "energy": float(beam.energy), "mass": float(beam.mass)}
        version = str(mad.version)
        mad.exit()
    return own, version


def main():
    content = json.loads(FILE.read_text())
    for name, deck in content["decks"].items():
        try:
            own, content["version"] = figures(deck["text"])
        except Exception as error:
            print(f"{name}: {type(error).__name__} {error}")
            continue
        content["decks"][name] = {"text": deck["text"], **own}
    FILE.write_text(json.dumps(content, indent=1) + "\n")
    print(f"{len(content['decks'])} decks, {content['version']}")


if __name__ == "__main__":
    main()
