"""Sentences of SECURITY.md on other users, their files, the working directory and ports."""

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from command import printed, tmlattice
from conftest import SMALL

from tmlattice import cache, load_ring
from tmlattice.files import output_file, output_folder
from tmlattice.lattice import save_ring
from tmlattice.maps import ring_maps
from tmlattice.temporaries import PREFIX

OTHER = 54321
"""A user without a name or a home."""
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
_PACKAGE = Path(cache.__file__).parent
for_others = pytest.mark.skipif(
    any(not folder.stat().st_mode & 0o001 for folder in (_PACKAGE, *_PACKAGE.parents)),
    reason="another user cannot reach the package's files",
)


def as_other(work):
    """What `work` returns, a short text, as another user without a home."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.setgroups([])
            os.setresgid(OTHER, OTHER, OTHER)
            os.setresuid(OTHER, OTHER, OTHER)
            for name in ("HOME", "USER", "LOGNAME", "XDG_CACHE_HOME"):
                os.environ.pop(name, None)
            os.write(writer, str(work()).encode())
        except BaseException as error:
            os.write(writer, f"{type(error).__name__}: {error}".encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as said:
        text = said.read()
    os.waitpid(child, 0)
    return text


@pytest.fixture
def open_folder():
    """A folder that everybody may write to, and reach: pytest's own are this user's alone."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o1777)
        yield folder


@pytest.fixture
def kept(open_folder, monkeypatch):
    """A named cache folder with the entries of a ring, and their values."""
    monkeypatch.setenv("TMLATTICE_CACHE", str(open_folder))
    ring = load_ring(SMALL)
    return open_folder / "tmlattice", ring, ring_maps(ring).W1


def spoilt(folder):
    """Write another number into every entry, its checksum made to fit."""
    for path in folder.iterdir():
        content = bytearray(path.read_bytes()[32:])
        content[len(content) // 2] ^= 1
        path.write_bytes(cache.checksum(path.name, bytes(content)) + content)


def same(kept):
    _, ring, maps = kept
    again = load_ring(SMALL)
    return again == ring and np.array_equal(ring_maps(again).W1, maps)


def test_the_cache_is_this_user_s_alone(kept):
    folder, _, _ = kept
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}
    assert same(kept)


def test_a_lattice_is_kept_by_a_fresh_installation(open_folder):
    """Modules that are compiled while it is read may warn."""
    code = (  # not the libraries that warn of nothing, which takes longest
        "import sys, numpy, scipy.linalg, numba, click\n"
        f"sys.pycache_prefix = {str(open_folder / 'compiled')!r}\n"
        "from tmlattice.cli.command import main\n"
        "main()\n"
    )
    printed("-c", code, "info", SMALL, cwd=open_folder, TMLATTICE_CACHE=open_folder)
    assert list((open_folder / "tmlattice").iterdir())


@pytest.mark.parametrize("mode", [0o770, 0o702])
def test_a_cache_that_others_can_write_to_is_not_used(kept, mode):
    folder, _, _ = kept
    spoilt(folder)
    folder.chmod(mode)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.warns(UserWarning, match="others can write to it; remove it, or name") as told:
        assert same(kept)
    assert len(told) == 1
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@as_root
@pytest.mark.parametrize("what", ["folder", "entries"])
def test_another_user_s_cache_is_not_used(kept, what):
    folder, _, _ = kept
    spoilt(folder)
    if what == "folder":
        os.chown(folder, OTHER, OTHER)
        with pytest.warns(UserWarning, match="a link or another user's"):
            assert same(kept)
        return
    for path in folder.iterdir():
        os.chown(path, OTHER, OTHER)
    assert same(kept)


def test_a_cache_that_is_a_link_is_not_used(kept, tmp_path):
    folder, _, _ = kept
    spoilt(folder)
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.warns(UserWarning, match="is a link or"):
        assert same(kept)
    folder.unlink()
    folder.mkdir(0o700)
    for path in (tmp_path / "elsewhere").iterdir():
        (folder / path.name).symlink_to(path)
    assert same(kept)


def test_an_entry_under_another_s_name_is_made_anew(kept, tmp_path):
    """The checksum is of the name as well."""
    folder, _, _ = kept
    one, other = sorted(folder.iterdir())
    texts = one.read_bytes(), other.read_bytes()
    one.write_bytes(texts[1])
    other.write_bytes(texts[0])
    assert same(kept)


@as_root
def test_without_a_home_nothing_is_kept(open_folder, monkeypatch):
    monkeypatch.delenv("TMLATTICE_CACHE", raising=False)
    monkeypatch.chdir(open_folder)

    def work():
        cache.save(cache.key("x"), b"x")
        return cache.folder(), os.listdir()

    assert as_other(work) == "(None, [])"


TWICE = """
import contextlib, os, sys
from tmlattice.cli.command import main
sys.argv[:1] = ["tmlattice"]
with contextlib.suppress(SystemExit):
    main()  # what it imports is loaded now: the other user may not see Python's folder
os.chdir("his")
os.setgroups([])
os.setresgid(54321, 54321, 54321)
os.setresuid(54321, 54321, 54321)
for name in ("HOME", "USER", "LOGNAME", "XDG_CACHE_HOME", "TMLATTICE_CACHE"):
    os.environ.pop(name, None)
main()
"""


@as_root
@for_others
def test_a_user_without_a_name_or_a_home_can_work(open_folder, beside):
    (open_folder / "his").mkdir()
    os.chown(open_folder / "his", OTHER, OTHER)
    for name in ("ring.json", "M"):
        copy = shutil.copytree if (beside / name).is_dir() else shutil.copy
        copy(beside / name, open_folder / name)
    ring, data = open_folder / "ring.json", open_folder / "M"
    words = ("diagnose", ring, data, "--effects", "quadrupole_gradient", "--out", "R", "-q")
    printed("-P", "-c", TWICE, *words, cwd=open_folder)
    assert (open_folder / "his" / "R" / "report.html").stat().st_uid == OTHER
    assert os.listdir(open_folder / "his") == ["R"]


@as_root
def test_another_user_can_read_and_change_nothing_that_is_kept(kept):
    folder, _, _ = kept
    name = next(folder.iterdir()).name
    assert as_other(lambda: os.listdir(folder)).startswith("PermissionError")
    assert as_other((folder / name).read_bytes).startswith("PermissionError")
    assert as_other((folder / name).unlink).startswith("PermissionError")
    assert as_other(lambda: folder.rename(folder.with_name("x"))).startswith("PermissionError")
    assert same(kept)


@as_root
def test_another_user_s_temporary_files_are_left_alone(open_folder):
    """Also links that he has laid, under names of ours."""
    precious = open_folder / "precious"
    precious.write_text("mine")

    def lay():
        names = [open_folder / f"{PREFIX}{k:016x}" for k in range(3)]
        names[0].mkdir()
        names[1].symlink_to(precious)
        names[2].write_text("his")
        for name in names:
            os.utime(name, (0, 0), follow_symlinks=False)
        return "laid"

    assert as_other(lay) == "laid"
    before = sorted(os.listdir(open_folder))
    with output_folder(open_folder) as folder:
        (folder / "new").write_text("new")
    with output_file(open_folder / "file") as path:
        path.write_text("new")
    assert sorted(os.listdir(open_folder)) == sorted([*before, "new", "file"])
    assert precious.read_text() == "mine"


def test_names_of_temporary_files_cannot_be_known_before(tmp_path):
    seen = set()
    for _ in range(20):
        with output_folder(tmp_path / "out") as folder, output_file(tmp_path / "file") as file:
            seen |= {folder.name, file.name}
    assert len(seen) == 40
    assert {len(name.removeprefix(PREFIX)) for name in seen} == {16}


COMPILED = (
    "import os, sys, tmlattice.beam.sweeps as sweeps\n"
    "from tmlattice.compiled import numba\n"
    "kernel = next(k for k in vars(sweeps).values() if hasattr(k, 'stats'))\n"
    "print(numba.config.CACHE_DIR or '-', kernel.stats.cache_path)\n"
)


def test_compiled_kernels_are_read_from_no_folder_that_data_name(tmp_path):
    """They are code: numba would take the folder from a file in the working directory."""
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: beside\n")

    def compiled(folder):
        kept = {"TMLATTICE_CACHE": tmp_path / "kept", "NUMBA_CACHE_DIR": folder}
        return printed("-P", "-c", COMPILED, cwd=tmp_path, **kept).split()

    told, where = compiled(None)
    assert told == "-"
    assert "beside" not in where
    assert not (tmp_path / "beside").exists()
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    assert compiled("open")[0] == "-"
    (tmp_path / "own").mkdir(0o700)
    told, where = compiled("own")
    assert told == "own"
    assert Path(where).parts[0] == "own"


MODULES = (
    "multiprocessing", "socket", "numpy", "scipy", "typing", "json", "click", "logging", "pickle",
    "queue", "random", "struct", "tqdm", "inspect", "threading", "subprocess", "signal", "at",
    "numba", "yaml", "h5py", "concurrent", "distributed", "dask", "torch", "matplotlib",
)  # fmt: skip
SIMULATE = ("simulate", "ring.json", "--shots", "66", "--engine", "ocelot", "--jobs", "2", "-q")
STUDY = ("dev", "study", "tune-fit", "ring.json", "--magnets", "2", "--methods", "sparse", "-q")
COMMANDS = {
    "diagnose": ("diagnose", "ring.py", "M", "--effects", "quadrupole_gradient", "--out", "R"),
    "simulate": (*SIMULATE, "--out", "N", "--force"),
    "challenge run": ("dev", "challenge", "run", "set", "--jobs", "2", "-q"),
    "study": (*STUDY, "--jobs", "2", "--out", "study"),
    "challenge score": ("dev", "challenge", "score", "set", "--jobs", "2", "-q"),
}


@pytest.fixture(scope="module")
def beside(tmp_path_factory):
    """A folder of data with a module beside them for every package that is imported."""
    folder = tmp_path_factory.mktemp("beside")
    (folder / "ring.py").write_bytes(SMALL.read_bytes())
    save_ring(load_ring(SMALL), folder / "ring.json")
    tmlattice("simulate", "ring.json", "--shots", 3, "--out", "M", "-q", cwd=folder, check=0)
    tmlattice("dev", "challenge", "make", "A", "--cases", 2, "--lattice", "ring.json", "--shots", 2,
              "--out", "set", "-q", cwd=folder, check=0)  # fmt: skip
    for module in MODULES:
        (folder / f"{module}.py").write_text(f"open({str(folder / 'MARK')!r}, 'a').write(__file__)")
    return folder


def slow(*names):
    return [pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize(
    "name", ["diagnose", "simulate", "study", *slow("challenge run", "challenge score")]
)
def test_no_module_of_the_working_directory_is_loaded_and_no_port_is_open(beside, name):
    """By no process of a command; nothing listens, on no address and no Unix socket."""
    (beside / "MARK").unlink(missing_ok=True)
    words = [sys.executable, "-m", "tmlattice", *COMMANDS[name]]
    process = psutil.Popen(words, cwd=beside, stdout=subprocess.DEVNULL)
    workers = set()
    while process.poll() is None:
        for one in [process, *process.children(recursive=True)]:
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                workers.add(one.pid)
                sockets = one.net_connections("all")
                assert not [s for s in sockets if s.status == psutil.CONN_LISTEN]
                assert not [s for s in sockets if s.type == socket.SOCK_DGRAM]
                assert not [s for s in sockets if s.family == socket.AF_UNIX and one != process]
        time.sleep(0.05)
    assert not (beside / "MARK").exists(), (beside / "MARK").read_text()
    assert process.returncode == 0
    assert len(workers) >= 3 or "--jobs" not in words
