"""Pairs of outputs into one folder, and another program that writes there meanwhile.

python tests/fuzz/pairs.py [PAIRS]: says what was lost, and how many files were written.
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PAIR = """
import os, sys
from pathlib import Path
from tmlattice.files import output_folder
print("ready", flush=True)
os.read(0, 1)  # both begin at once
with output_folder(Path(sys.argv[1])) as temporary:
    for name in ("both", "shared", sys.argv[2]):
        (temporary / name).write_text(sys.argv[2])
print("written")
"""
COUNTED = {"pairs": 0, "other files": 0}


def pairs(place, count, there=True):
    """What was lost of so many pairs of outputs, each into a folder that is there or not."""
    return [wrong for number in range(count) for wrong in pair(place / f"out{number}", there)]


def pair(folder, there):
    if there:
        folder.mkdir()
    children = [
        subprocess.Popen([sys.executable, "-c", PAIR, folder, name], stdin=subprocess.PIPE,
                         stdout=subprocess.PIPE, text=True)
        for name in ("one", "other")
    ]  # fmt: skip
    for child in children:
        child.stdout.readline()
    for child in children:
        child.stdin.write("x")
        child.stdin.flush()
    others = 0
    while any(child.poll() is None for child in children):
        with contextlib.suppress(FileNotFoundError):  # the folder is not there yet
            (folder / f"other program {others}").write_text("x")
            others += 1
        time.sleep(0.0005)
    said = [child.communicate()[0] for child in children]
    names = {path.name for path in folder.iterdir()}
    wanted = {f"other program {k}" for k in range(others)} | {"both", "shared", "one", "other"}
    wrong = [f"lost: {name}" for name in sorted(wanted - names)]
    wrong += [f"left: {name}" for name in sorted(names - wanted)]
    if (folder / "both").read_text() != (folder / "shared").read_text():
        wrong.append("files of two outputs")
    if said != ["written\n"] * 2 or (there and not others):
        wrong.append(f"the outputs said {said}, the other program wrote {others} files")
    COUNTED["pairs"] += 1
    COUNTED["other files"] += others
    return [f"{folder.name}: {one}" for one in wrong]


def main(count=500):
    """Exit code 1 where something was lost."""
    with tempfile.TemporaryDirectory() as place:
        lost = []
        for there in (True, False):
            (Path(place) / str(there)).mkdir()
            lost += pairs(Path(place) / str(there), count // 2, there)
    print("\n".join(lost))
    print(COUNTED, f"{len(lost)} lost")
    return bool(lost)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:2])))
