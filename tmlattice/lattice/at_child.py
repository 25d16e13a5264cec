"""AT's tracking of an element out of a file, in a process of its own.

AT's compiled pass methods check little of what an element holds: a table of another size, or a
count that does not fit, ends the process that tracks it. That process is a child of ours, and its
death becomes a sentence. Which pass methods are loaded at all is a fixed list: `shipped_methods`.
"""

import atexit
import hashlib
import os
import pickle
import struct
import subprocess
import sys
import threading
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import LatticeError

SECONDS = 60
"""For one element; a long wiggler takes less than one."""


@cache
def shipped_methods() -> frozenset[str]:
    """The pass methods that AT comes with; AT loads any other by its path, whatever it is."""
    import at

    folder = Path(at.__file__).parent / "integrators"
    names = {path.name.split(".")[0] for path in folder.iterdir()}
    return frozenset(name for name in names if name.endswith("Pass"))


def check_methods(elements: Iterable[Any]) -> None:
    """Names from a file choose nothing that is loaded.

    Raises:
        LatticeError: a pass method that AT does not ship.
    """
    for element in elements:
        method = getattr(element, "PassMethod", None)
        if type(method) is not str or method not in shipped_methods():
            raise LatticeError(
                f"the element '{element.FamName!s:.40}' has the pass method {str(method)!r:.60}, "
                "which AT does not ship and which is not loaded; give it one of AT's"
            )


def map_of(element: Any, energy: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The matrix of an AT element, [6, 6], and what it adds to a particle on the axis, [6], in AT's
    coordinates, (.., delta, ct). The child is started by the first element, and ends with us.

    >>> matrix, kick = map_of(element, 3e9)

    Args:
        element: of AT.
        energy: eV, of a particle that is as fast as light.

    Raises:
        LatticeError: AT cannot track it, dies over it, or does not come back.
    """
    check_methods([element])
    own = {k: v for k, v in vars(element).items() if k == "PassMethod" or type(v) is not str}
    key = hashlib.sha256(pickle.dumps((type(element).__name__, own, energy))).digest()
    with _ONE_AT_A_TIME:
        reply = _replies.get(key) or _asked(pickle.dumps((element, energy)))
    if len(reply) == 42 * 8:
        _replies[key] = reply
        numbers = np.frombuffer(reply, "<f8").reshape(7, 6)
        return numbers[:6], numbers[6]
    why = reply.decode("utf-8", "replace") or "its tracking does not come back"
    raise LatticeError(
        f"AT cannot track the element '{element.FamName!s:.40}' ({why:.200}); correct it"
    )


_ONE_AT_A_TIME = threading.Lock()
_replies: dict[bytes, bytes] = {}
"""By the numbers of an element, whatever its name: a ring has most magnets many times."""
_children: dict[int, subprocess.Popen[bytes]] = {}
"""By the process that asks: a fork has one of its own."""


def _asked(message: bytes) -> bytes:
    """The child's answer; nothing where it is dead or silent."""
    if (child := _children.get(os.getpid())) is None:
        child = _children[os.getpid()] = subprocess.Popen(
            [sys.executable, "-P", "-c", _CHILD],  # nothing of the working directory
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        atexit.register(_end, child)
    assert child.stdin is not None
    assert child.stdout is not None
    late = threading.Timer(SECONDS, child.kill)
    late.start()
    try:
        child.stdin.write(struct.pack("<q", len(message)) + message)
        child.stdin.flush()
        head = child.stdout.read(8)
        reply = child.stdout.read(struct.unpack("<q", head)[0]) if len(head) == 8 else b""
    except BrokenPipeError:
        reply = b""
    finally:
        late.cancel()
    if not reply:
        del _children[os.getpid()]
        _end(child)
    return reply


def _end(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.communicate()


_CHILD = """
import os, pickle, struct, sys, warnings
sys.modules["matplotlib"] = None  # AT would load it
source, sink = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)  # what AT prints is no answer
warnings.simplefilter("ignore")
while len(head := source.read(8)) == 8:
    try:
        import at, numpy as np
        element, energy = pickle.loads(source.read(struct.unpack("<q", head)[0]))
        for name, value in vars(element).items():
            if isinstance(value, np.ndarray):  # compiled pass methods have columns first
                vars(element)[name] = np.asfortranarray(value)
        beam = {"energy": energy, "particle": at.Particle("relativistic")}
        kick = element.track(np.zeros(6), **beam).reshape(1, 6)
        matrix = at.find_elem_m66(element, XYStep=1e-6, **beam)
        reply = np.vstack([matrix, kick]).astype("<f8").tobytes()
    except Exception as error:
        reply = " ".join(f"{type(error).__name__}: {error}".split())[:200].encode()
    sink.write(struct.pack("<q", len(reply)) + reply)
    sink.flush()
"""
