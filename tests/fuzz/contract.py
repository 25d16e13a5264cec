"""The contract of every reader, in one place.

A damaged file is accepted, with some meaning, or refused: one sentence that begins with
`tmlattice: `, exit code 2, within `SECONDS` of the processor, with less than `BYTES` of memory more
than the package itself,
nothing printed that steers a terminal or past the package, nothing left behind, and the process
alive. A verdict's exit code is 0 or 1.
"""

import contextlib
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from dataclasses import dataclass, field
from pathlib import Path

from command import tmlattice
from damage import (
    damaged_bytes,
    damaged_hdf5,
    damaged_json,
    damaged_mat,
    damaged_names,
    damaged_sizes,
    damaged_toml,
    damaged_yaml,
)

from tmlattice.temporaries import PREFIX

SECONDS = 5.0
HANG = 300
"""s, of a clock."""
BYTES = 1 << 30
VALUES = {
    ".json": damaged_json, ".mat": damaged_mat, ".h5": damaged_hdf5, ".yaml": damaged_yaml,
    ".toml": damaged_toml,
}  # fmt: skip
"""By what a file is: damage to its types and values, every second time."""
BINARY = (".mat", ".h5", ".sdds", ".npz", ".pt")
"""Files with sizes in them; the others have names in them."""
STEERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\x80-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


class Hang(BaseException):
    """No `except Exception` keeps it."""


@contextlib.contextmanager
def past_python():
    """A file of what a library or a child prints past Python's own streams."""
    with tempfile.TemporaryFile() as seen:
        kept = [(place, os.dup(place)) for place in (1, 2)]
        try:
            for place, _ in kept:
                os.dup2(seen.fileno(), place)
            yield seen
        finally:
            for place, own in kept:
                os.dup2(own, place)
                os.close(own)


@dataclass
class Tally:
    """What became of the inputs, by format."""

    accepted: int = 0
    refused: int = 0
    slow: int = 0
    undamaged: int = 0
    longest: float = 0.0
    broken: list[str] = field(default_factory=list)


def worked():
    """Processor seconds of this process and of its children: others may use the machine too."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def called(words, folder):
    """Exit code, output and processor seconds of a command, in this process; ended after `HANG`."""
    begun = worked()

    def late(*_):
        raise Hang

    old = signal.signal(signal.SIGALRM, late)
    signal.alarm(HANG)
    try:
        done = tmlattice(*words, cwd=folder)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
    return done.returncode, done.stdout, done.stderr, worked() - begun


def broken(words, folder, tally, whole=False):
    """What of the contract a command breaks, or None; of whole files it writes its outputs."""
    before = set(folder.rglob("*"))
    try:
        with past_python() as seen:
            code, out, errors, seconds = called(words, folder)
            seen.seek(0)
            if printed := seen.read():
                return f"printed past Python: {printed[:300]!r}"
    except Hang:
        return f"no end in {HANG} s"
    except BaseException:
        return traceback.format_exc(limit=-4)
    tally.longest = max(tally.longest, seconds)
    tally.slow += seconds > SECONDS
    left = {p.name for p in folder.rglob("*")} - {p.name for p in before}
    left = {name for name in left if name.startswith(PREFIX) or not whole}
    if left:
        return f"left behind: {left}"
    if code not in (0, 1, 2, None):
        return f"exit code {code}"
    if code == 2:
        told = ("tmlattice: warning", "tmlattice: machine file")
        sentences = [s for s in errors.splitlines() if not s.startswith(told)]
        if not sentences or not sentences[0].startswith("tmlattice: "):
            return f"no sentence: {errors[:300]!r}"
    if found := STEERS.search(out + errors):
        return f"{found.group()!r} reaches the terminal"
    tally.refused += code == 2
    tally.accepted += code != 2
    return None


def damages(path, whole):
    """Four kinds of damage to choose from."""
    other = damaged_sizes if path.suffix in BINARY else damaged_names
    values = VALUES.get(path.suffix, damaged_bytes)
    if path.suffix == ".mat" and whole.startswith(b"MATLAB 7.3"):
        values = damaged_hdf5
    return damaged_bytes, other, values, values


def tried(seed, inputs, rng):
    """One damaged input: (format, what of the contract it breaks or None)."""
    name = inputs.names[seed % len(inputs.names)]
    words, path = inputs.of(name)
    whole = path.read_bytes()
    tally = inputs.tallies.setdefault(name, Tally())
    damage = damages(path, whole)[int(rng.integers(4))]
    try:
        try:
            content = damage(rng, whole)
        except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError):
            tally.undamaged += 1  # twice damaged values that their own library does not write
            return name, None
        if content == whole:
            tally.undamaged += 1
            return name, None
        path.write_bytes(content)
        said = broken(words, inputs.folder, tally)
        if said is not None:
            tally.broken.append(f"seed {seed}: {said}")
        return name, said
    finally:
        path.write_bytes(whole)
        inputs.put_back()


def limit_memory():
    """A command that asks for more ends with a MemoryError, which it has to put into words."""
    with contextlib.suppress(ValueError, OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def forked(command, **options):
    """In place of `subprocess.run` for a process that reads a file: a fork of this one."""
    from tmlattice.lattice import binary_files

    if "input" not in options:  # another library's
        with subprocess.Popen(command, **options) as other:
            return subprocess.CompletedProcess(command, other.wait())
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as answer:
        given.write(options["input"])
        given.seek(0)
        child = os.fork()
        if not child:
            os.dup2(given.fileno(), 0)
            os.dup2(answer.fileno(), 1)
            sys.stdin = open(0, closefd=False)  # noqa: SIM115
            with contextlib.suppress(BaseException):
                signal.alarm(0)
                binary_files.main()
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        answer.seek(0)
        return subprocess.CompletedProcess(command, code, answer.read(), b"")


class Inputs:
    """Files of every format in a folder, on a ring of ten magnets, and the command of each."""

    def __init__(self, folder, challenges=True):
        from inputs import write_all

        self.folder = folder
        self.commands = write_all(folder, challenges)
        self.names = list(self.commands)
        self.tallies = {}
        self.results = {p: p.read_bytes() for p in folder.glob("set/results/*")}

    def check_accepted(self):
        """Each command accepts its files, which are not damaged, and writes its outputs."""
        for words in {str(words): words for words, _ in self.commands.values()}.values():
            tally = Tally()
            said = broken(words, self.folder, tally, whole=True)
            self.put_back()
            assert said is None, f"{words}: {said}"
            assert tally.accepted == 1, words

    def put_back(self):
        """Results that a damaged case has changed: as they were."""
        for path, content in self.results.items():
            path.write_bytes(content)

    def of(self, name):
        """The command that reads a format, and its file."""
        words, file = self.commands[name]
        return words, self.folder / file


def report(inputs):
    """A table of what became of the inputs."""
    rows = [
        f"{'format':24} {'inputs':>7} {'refused':>8} {'accepted':>9} {'> 5 s':>6} {'broken':>7}"
    ]
    for name, t in inputs.tallies.items():
        count = t.accepted + t.refused + len(t.broken)
        rows.append(
            f"{name:24} {count:7} {t.refused:8} {t.accepted:9} {t.slow:6} {len(t.broken):7}"
            f"   longest {t.longest:.1f} s"
        )
    return "\n".join(rows)
