"""MAD-X's own figures and tables of small decks, one statement or attribute each.

    pip install cpymad
    python tests/lattices/referee_madx.py        # writes the figures into madx_decks.json

The file beside this one holds each deck's text, MAD-X's tunes, chromaticities, length, momentum
compaction, orbit at the start, and the beam, and the version of MAD-X. A new deck is a name with a
`text`, most often that of "plain" with one thing changed: the script adds the figures. Under
`tables` stand decks of which the script adds a TWISS table, without blanks and columns of zeros.
test_madx_decks.py reads both.
"""

import contextlib
import json
import tempfile
from pathlib import Path

FILE = Path(__file__).with_name("madx_decks.json")


@contextlib.contextmanager
def started(text):
    """MAD-X with the ring of a deck in use, and the folder in which it works."""
    from cpymad.madx import Madx

    with tempfile.TemporaryDirectory() as folder:
        mad = Madx(stdout=False, cwd=folder)
        Path(folder, "ring.madx").write_text(f"{text};\n")
        mad.call("ring.madx")
        if "use," not in text:
            mad.input("use, sequence=ring;")
        yield mad, Path(folder)
        mad.exit()


def figures(text):
    with started(text) as (mad, _):
        mad.input("twiss;")
        summ, table = mad.table.summ, mad.table.twiss
        orbit = [float(table[k][0]) for k in ("x", "px", "y", "py")]
        beam = mad.sequence[str(table.summary.sequence).lower()].beam
        own = {k: float(summ[k][0]) for k in ("q1", "q2", "dq1", "dq2", "length", "alfa")}
        own |= {"orbit": orbit, "energy": float(beam.energy), "mass": float(beam.mass)}
        return own, str(mad.version)


COLUMNS = ("name,keyword,s,l,angle,k0l,k0sl,k1l,k1sl,k2l,k2sl,e1,e2,h1,h2,hgap,fint,fintx,tilt,"
           "hkick,vkick,lrad,ks,ksi,x,y,dx,dy,wx")  # fmt: skip
HEADER = ("MASS", "CHARGE", "ENERGY", "BV_FLAG", "LENGTH", "ALFA", "XCOMAX", "YCOMAX", "Q1", "Q2",
          "DQ1", "DQ2")  # fmt: skip


def table(text, options=""):
    with started(text) as (mad, folder):
        mad.input(f"select, flag=twiss, column={COLUMNS}; twiss, {options} file=twiss.tfs;")
        lines = [line.split() for line in (folder / "twiss.tfs").read_text().splitlines()]
    header = [line for line in lines if line[0] == "@" and line[1] in HEADER]
    names, types, *rows = [line for line in lines if line[0] != "@"]
    needed = ("NAME", "KEYWORD", "S", "L", "ANGLE", "K1L", "K2L")
    rows = [["", *row] for row in rows]
    kept = [0] + [k for k, name in enumerate(names)
                  if name in needed or (k and any(float(row[k]) for row in rows))]  # fmt: skip
    lines = [*header, *([line[k] for k in kept] for line in (names, types, *rows))]
    return "\n".join(" ".join(line) for line in lines) + "\n"


def main():
    content = json.loads(FILE.read_text())
    for name, deck in content["decks"].items():
        try:
            own, content["version"] = figures(deck["text"])
        except Exception as error:
            print(f"{name}: {type(error).__name__} {error}")
            continue
        content["decks"][name] = {"text": deck["text"], **own}
    for deck in content["tables"].values():
        deck["table"] = table(deck["text"], deck.get("options", ""))
    FILE.write_text(json.dumps(content, indent=1) + "\n")
    print(f"{len(content['decks'])} decks, {content['version']}")


if __name__ == "__main__":
    main()
