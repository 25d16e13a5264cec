"""Commands that are killed at any moment, and disks that fill up: nothing is half-written.

python tests/fuzz/kills.py [KILLS] [FILE.json]: each writing command in turn is killed after a
random part of the time that it takes. What is there then is nothing, the old output or the new
one, whole; the command done again makes the same bytes as if nobody had killed it, and removes what
the killed one left.
"""

import contextlib
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

COMMANDS = {
    "simulate": (["simulate", "ring.json", "--out", "out", "--truth", "truth.json", "--shots", "40",
                  "--engine", "ocelot", "--force", "-q"], ("out", "truth.json")),
    "simulate, response": (["simulate", "ring.json", "--kind", "orbit-response", "--engine",
                            "ocelot", "--out", "out", "--force", "-q"], ("out",)),
    "diagnose": (["diagnose", "ring.json", "turns", "--json", "found.json", "--lattice-out",
                  "found.at.json", "--corrected-out", "repaired.json", "-q"],
                 ("found.json", "found.at.json", "repaired.json")),
    "import": (["import", "turns/readings.csv", "--lattice", "ring.json", "--out", "out",
                "--force"], ("out",)),
    "check": (["check", "ring.json", "turns", "--json", "check.json", "-q"], ("check.json",)),
    "challenge make": (["dev", "challenge", "make", "A", "--cases", "3", "--seed", "1", "--lattice",
                        "ring.json", "--shots", "2", "--out", "new", "-q"], ("new",)),
    "challenge run": (["dev", "challenge", "run", "set", "--jobs", "1", "-q"], ("set/results",)),
    "challenge score": (["dev", "challenge", "score", "set", "--no-oracle", "--jobs", "1", "--json",
                         "score.json", "-q"], ("score.json",)),
    "tune-fit": (["tune-fit", "ring.json", "--method", "sparse", "--out", "fit", "--json",
                  "fit.json", "-q"], ("fit", "fit.json")),
}  # fmt: skip
TIMES = re.compile(rb'"(seconds|wall)": ([-0-9.e]+|{[^}]*})|"median": [-0-9.e]+')


def child(words, folder, limit=None):
    """A process that runs a command; of its own group, silent."""
    own = os.fork()
    if own:
        return own
    try:
        os.setsid()
        os.chdir(folder)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        code = 70
        from tmlattice.cli.command import main

        errors = io.StringIO()
        with (
            mock.patch.object(sys, "argv", ["tmlattice", *words]),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(errors),
        ):
            try:
                main()
            except SystemExit as end:
                code = end.code or 0
        if code == 2 and not errors.getvalue().splitlines()[-1].startswith("tmlattice: "):
            code = 71
    finally:
        os._exit(code)


def contents(folder, outputs):
    """Bytes of all outputs, times apart."""
    found = {}
    for output in outputs:
        path = folder / output
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and ".tmlattice-" not in str(file):
                found[str(file.relative_to(folder))] = TIMES.sub(b"", file.read_bytes())
    return found


def litter(folder):
    """What a killed command left."""
    return list(folder.rglob(".tmlattice-*"))


def halves(folder, outputs):
    """Outputs that are there and not whole."""
    from tmlattice import read_measurement
    from tmlattice.errors import TmlatticeError

    wrong = []
    for output in outputs:
        path = folder / output
        for file in sorted(path.rglob("*.json")) if path.is_dir() else [path]:
            if not file.exists() or ".tmlattice-" in str(file):
                continue
            try:
                json.loads(file.read_text())
                if file.name == "measurement.json":
                    read_measurement(file)
            except (ValueError, TmlatticeError) as error:
                wrong.append(f"{file.name}: {error}")
    return wrong


def prepared(folder, challenges=True):
    """Files that the commands read."""
    from inputs import write_all

    import tmlattice.cli.command  # noqa: F401  (children find it loaded, whoever edits it meanwhile)

    write_all(folder, challenges, more=False)
    for results in folder.glob("set/results/*"):
        results.unlink()


def fresh(name, master, folder, results):
    """A folder with what a command reads, and nothing else; the score reads results of a run."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(master, folder)
    if name == "challenge score":
        shutil.copytree(results, folder / "set" / "results", dirs_exist_ok=True)


def references(master, folder, names=tuple(COMMANDS)):
    """What each command writes, and the seconds that it takes."""
    whole = {}
    results = None
    for name in names:
        words, outputs = COMMANDS[name]
        fresh(name, master, folder, results)
        begun = time.perf_counter()
        _, status = os.waitpid(child(words, folder), 0)
        seconds = time.perf_counter() - begun
        assert os.waitstatus_to_exitcode(status) == 0, (name, status)
        whole[name] = contents(folder, outputs), seconds
        if name == "challenge run":
            results = Path(shutil.copytree(folder / "set/results", master.parent / "results"))
    return whole, results


def killed(name, whole, results, master, folder, rng):
    """One kill: what of the promise is broken, or None; and whether it hit the command alive."""
    words, outputs = COMMANDS[name]
    expected, seconds = whole[name]
    fresh(name, master, folder, results)
    if rng.integers(2):  # over an older output
        os.waitpid(child(words, folder), 0)
    process = child(words, folder)
    time.sleep(float(rng.uniform(0, 1.1 * seconds)))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    _, status = os.waitpid(process, 0)
    alive = os.waitstatus_to_exitcode(status) == -signal.SIGKILL
    if wrong := halves(folder, outputs):
        return f"half-written: {wrong}", alive
    for path in litter(folder):
        os.utime(path, (0, 0))
    _, status = os.waitpid(child(words, folder), 0)
    if os.waitstatus_to_exitcode(status) != 0:
        return f"done again it ends with {os.waitstatus_to_exitcode(status)}", alive
    if litter(folder):
        return f"left for ever: {litter(folder)}", alive
    if contents(folder, outputs) != expected:
        return "done again it writes something else", alive
    return None, alive


def filled(name, results, master, folder, limit):
    """A disk that is full after so many bytes of a file: what is broken, or None."""
    words, outputs = COMMANDS[name]
    fresh(name, master, folder, results)
    before = contents(folder, outputs)
    _, status = os.waitpid(child(words, folder, limit), 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 1, 2):
        return f"exit code {code}"
    if wrong := halves(folder, outputs):
        return f"half-written: {wrong}"
    if litter(folder):
        return f"left: {litter(folder)}"
    if (
        code == 2
        and name in ("simulate", "check", "import", "tune-fit")
        and contents(folder, outputs) != before
    ):
        return "a part is there"
    return None


def main(kills=200, file=None):
    """Exit code 1 where a promise was broken."""
    os.environ["TMLATTICE_CACHE"] = "off"
    os.environ["NUMBA_NUM_THREADS"] = "1"
    tally = {"kills": 0, "alive": 0, "full disks": 0, "broken": []}
    with tempfile.TemporaryDirectory() as place:
        master, folder = Path(place) / "master", Path(place) / "work"
        master.mkdir()
        prepared(master)
        import tmlattice.fitting  # noqa: F401  (torch, as above)

        whole, results = references(master, folder)
        names = list(COMMANDS)
        rng = np.random.default_rng(19)
        for number in range(kills):
            name = names[number % len(names)]
            said, alive = killed(name, whole, results, master, folder, rng)
            tally["kills"] += 1
            tally["alive"] += alive
            if said:
                tally["broken"].append(f"{name}, kill {number}: {said}")
                print(tally["broken"][-1], flush=True)
        for name in names:
            for limit in (0, 100, 3000):
                tally["full disks"] += 1
                if said := filled(name, results, master, folder, limit):
                    tally["broken"].append(f"{name}, {limit} bytes: {said}")
                    print(tally["broken"][-1], flush=True)
    print(json.dumps(tally, indent=1))
    if file:
        Path(file).write_text(json.dumps(tally, indent=1))
    return bool(tally["broken"])


if __name__ == "__main__":
    sys.exit(main(*(int(word) for word in sys.argv[1:2]), *sys.argv[2:3]))
