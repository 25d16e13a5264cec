"""What a command loads, and what is kept between two calls."""

import io
import json
import os
import shutil
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files

import numpy as np
import pytest
from command import printed
from conftest import SMALL
from scipy import stats

from tmlattice import cache, load_ring
from tmlattice.inference import chi2
from tmlattice.lattice import save_ring, stored
from tmlattice.lattice.ring import KEPT
from tmlattice.maps import element_map, ring_maps


def python(code, folder, *arguments, **environment):
    """What a fresh interpreter prints, with a cache of its own."""
    own = {"TMLATTICE_CACHE": folder / "cache", **environment}
    return printed("-c", code, *arguments, cwd=folder, **own)


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """An empty cache folder, and a lattice file of one's own."""
    monkeypatch.setenv("TMLATTICE_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "small.py"
    shutil.copy(SMALL, path)
    return path


HEAVY = (
    "heavy = {'ocelot', 'torch', 'scipy.stats', 'scipy.optimize', 'pandas', 'matplotlib', 'at'}\n"
    "print('loaded:', *sorted(heavy & set(sys.modules)))\n"
)
LOADED = (
    "import sys\n"
    "from tmlattice.cli.command import tmlattice\n"
    f"tmlattice(sys.argv[1:], standalone_mode=False)\n{HEAVY}"
)


def test_a_second_info_loads_neither_ocelot_nor_torch_and_says_the_same(tmp_path):
    def info(name):
        out = python(LOADED, tmp_path, "info", SMALL, "--json", name)
        return json.loads((tmp_path / name).read_text()), out.partition("loaded:")

    cold, (said_cold, _, _) = info("cold.json")
    warm, (said_warm, _, loaded) = info("warm.json")
    assert cold == warm
    assert said_cold == said_warm
    assert loaded.split() == []


def test_the_diagnosis_of_a_response_is_loaded_without_what_it_does_not_need(tmp_path):
    code = f"import sys, tmlattice.diagnosis.response.procedure\n{HEAVY}"
    assert python(code, tmp_path).split() == ["loaded:"]


def test_ocelot_is_whole_for_a_user_who_imports_it_after_the_package(tmp_path):
    python(
        "import sys, numba\n"
        "jit = numba.jit\n"
        "from tmlattice.lattice.ocelot import elements\n"
        "assert numba.jit is jit\n"
        "left = [n for n in ('pandas', 'scipy.signal', 'scipy.optimize') if n in sys.modules]\n"
        "assert not left, left\n"
        "import ocelot, ocelot.cpbd.match\n"
        "missing = [n for n in ocelot.__all__ if not hasattr(ocelot, n)]\n"
        "assert not missing, missing\n"
        "assert all(getattr(ocelot, n) is getattr(elements, n) for n in elements.__all__\n"
        "           if n in ocelot.__all__)\n"
        "import numpy as np\n"
        "from ocelot.common import math_op\n"
        "assert hasattr(math_op.corr_f_nb, 'py_func')  # compiled, not plain Python\n"
        "a, b = (np.random.default_rng(1).normal(size=(4, 4)) for _ in range(2))\n"
        "c = a.copy()\n"
        "math_op.corr_f_nb(a, b, 1, 2); math_op.corr_f_py(c, b, 1, 2)\n"
        "assert np.allclose(a, c, equal_nan=True)\n"
        "from ocelot.cpbd.beam import core\n"
        "assert abs(core.savgol_filter(np.arange(9.0), 5, 2) - np.arange(9.0)).max() < 1e-12\n"
        "assert len(ocelot.Twiss().to_series()) > 10  # pandas\n"
        "cell = ocelot.MagneticLattice([ocelot.Drift(l=1.0), ocelot.Quadrupole(l=0.2, k1=1.0)])\n"
        "assert cell.totalLen == 1.2\n",
        tmp_path,
    )


def test_ocelot_stays_as_it_is_for_a_user_who_imported_it_before(tmp_path):
    """And the built-in lattice is plain OCELOT: it runs without the package, from anywhere."""
    shutil.copy(str(files("tmlattice") / "lattices" / "petra3.py"), tmp_path)
    python(
        "import ocelot, sys\n"
        "before = dict(vars(ocelot))\n"
        "sys.modules['tmlattice'] = None\n"
        "import petra3\n"
        "length = ocelot.MagneticLattice(petra3.ring).totalLen\n"
        "assert (round(length, 2), petra3.energy) == (2303.95, 6.0)\n"
        "del sys.modules['tmlattice']\n"
        "import tmlattice\n"
        "ring = tmlattice.load_ring('petra3.py')\n"
        "assert len(ring.elements) > 3000\n"
        "tmlattice.element_map(ring.magnets[0], ring.energy)\n"
        "assert sys.modules['ocelot'] is ocelot and type(ocelot) is type(sys)\n"
        "assert all(vars(ocelot)[name] is value for name, value in before.items())\n"
        "source = ring.magnets[0].source\n"
        "assert type(source) is getattr(ocelot, type(source).__name__)\n",
        tmp_path,
    )


def test_a_version_of_ocelot_that_cannot_be_parted_is_imported_whole(tmp_path):
    python(
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        light = type(sys.modules.get('ocelot')) is not type(sys)\n"
        "        if name == 'ocelot.cpbd.elements' and light:\n"
        "            raise RuntimeError('parted')\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from tmlattice.lattice.ocelot import elements\n"
        "import ocelot\n"
        "assert type(ocelot) is type(sys) and ocelot.Drift is elements.Drift\n",
        tmp_path,
    )


def test_a_kept_ring_is_the_ring_that_was_read(kept):
    read = load_ring(kept)
    again = load_ring(kept)
    assert all(e.data is not None for e in again.elements)
    assert again == read
    for ours, theirs in zip(again.elements, read.elements, strict=True):
        assert type(ours.source) is type(theirs.source)
        a, b = vars(ours.source.element), vars(theirs.source.element)
        for name in a.keys() - {"id"}:
            assert np.array_equal(a[name], b[name]), (ours.name, name)
    for dimension in (4, 6):
        made, found = (ring_maps(ring, dimension) for ring in (read, again))
        again.memory.clear()
        anew = ring_maps(again, dimension)  # without the key: made from the kept elements
        again = load_ring(kept)
        for name in ("s", "W0", "W1", "W2", "s_monitors", "at", "R0", "R1", "R2"):
            assert np.array_equal(getattr(made, name), getattr(found, name)), name
            assert np.array_equal(getattr(made, name), getattr(anew, name)), name
        assert made.layers == found.layers
        assert made.monitors == found.monitors
        for a, b in zip(made.closing.coefficients, found.closing.coefficients, strict=True):
            assert np.array_equal(a, b)


def test_a_kept_ring_is_written_as_the_ring_that_was_read(kept, tmp_path):
    texts = []
    for name in ("read.py", "kept.py"):
        assert save_ring(load_ring(kept), tmp_path / name) == ()
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1]


def test_a_change_of_a_kept_ring_gets_its_own_maps(kept):
    load_ring(kept)
    ring = load_ring(kept)
    ring_maps(ring)
    weak = ring.with_changed("qf::3", k1=0.7)
    assert ring["qf::3"].source.k1 == 0.9
    assert ring["qf::4"].source.k1 == 0.9
    moved = np.flatnonzero((ring_maps(weak).W1 != ring_maps(ring).W1).any(axis=(1, 2)))
    assert [ring.magnets[k].name for k in moved] == ["QF::3"]
    pushed = ring["qf::3"].with_errors(dx=1e-3)
    assert element_map(pushed, ring.energy)([0.0] * 4)[1] != 0.0


def test_a_changed_file_is_read_again(kept):
    load_ring(kept)
    kept.write_text(kept.read_text().replace("k = 0.9", "k = 0.8"))
    assert load_ring(kept)["qf::0"].k1 == 0.8
    assert load_ring(kept, energy=2.0).energy == 2.0


def test_a_damaged_entry_is_made_anew(kept):
    ring = load_ring(kept)
    expected = ring_maps(ring).W1
    entries = sorted((kept.parent / "cache" / "tmlattice").iterdir())
    assert len(entries) == 2  # elements, maps
    whole = [entry.read_bytes() for entry in entries]
    for spoil in (lambda b: b[:-1], lambda b: b"", lambda b: b[:90] + b"?" + b[91:]):
        for entry, content in zip(entries, whole, strict=True):
            entry.write_bytes(spoil(content))
        again = load_ring(kept)
        assert again == ring
        assert np.array_equal(ring_maps(again).W1, expected)
        assert [entry.read_bytes()[:32] for entry in entries] == [w[:32] for w in whole]


@pytest.mark.parametrize("place", ["off", "a file/in the way"])
def test_without_a_place_to_keep_it_a_ring_is_read_every_time(kept, monkeypatch, place):
    (kept.parent / "a file").write_text("")
    monkeypatch.chdir(kept.parent)
    monkeypatch.setenv("TMLATTICE_CACHE", place)
    first, second = load_ring(kept), load_ring(kept)
    assert first == second
    assert second["qf::0"].data is None
    assert np.array_equal(ring_maps(first).W1, ring_maps(second).W1)


@pytest.mark.parametrize(
    "line",
    [
        "from parts import q",
        "import os",
        "k = float(open('k.txt').read())",
        "k = np.loadtxt('k.txt')",
        "k = np.random.rand()",
        "k = __import__('parts').k",
        "from .parts import q",
        "this is no Python",
    ],
)
def test_code_that_may_depend_on_more_than_itself_is_run_every_time(tmp_path, line):
    path = tmp_path / "ring.py"
    path.write_text(f"from ocelot import *\nimport numpy as np\n{line}\n")
    assert stored.key_of(path, None, None) is None
    path.write_text("from ocelot import *\nimport numpy as np\nk = np.sqrt(2.0)\n")
    assert stored.key_of(path, None, None) is not None
    (tmp_path / "numpy.py").write_text("sqrt = max")
    assert stored.key_of(path, None, None) is None


def test_a_neighbour_that_changes_is_seen(kept):
    (kept.parent / "parts_of_it.py").write_text("k1 = 1.0\n")
    kept.write_text(
        "from ocelot import *\nfrom parts_of_it import k1\nenergy = 1.0\n"
        "ring = [Quadrupole(l=0.1, k1=k1, eid='q'), Drift(l=1.0)]\n"
    )
    assert load_ring(kept)["q"].k1 == 1.0
    (kept.parent / "parts_of_it.py").write_text("k1 = 2.0  # another size\n")
    sys.modules.pop("parts_of_it")
    assert load_ring(kept)["q"].k1 == 2.0


def test_a_warning_is_told_every_time(kept):
    kept.write_text("from ocelot import *\nring = [Quadrupole(l=0.1, k1=1.0, eid='q')]\n")
    for _ in range(2):
        with pytest.warns(UserWarning, match="states no beam energy"):
            load_ring(kept)


def test_what_data_cannot_say_is_not_kept(kept):
    kept.write_text(
        "from ocelot import *\nenergy = 1.0\nq = Quadrupole(l=0.1, k1=1.0, eid='q')\n"
        "q.element.mag_field = max\nring = [q]\n"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert KEPT not in load_ring(kept).memory
    assert load_ring(kept)["q"].data is None


def test_many_writers_never_leave_a_torn_entry(tmp_path, monkeypatch):
    monkeypatch.setenv("TMLATTICE_CACHE", str(tmp_path))
    contents = [bytes([k]) * (40_000 + 977 * k) for k in range(4)]
    name = cache.key("entry")
    cache.save(name, contents[0])
    wrong = []

    def work(k):
        for _ in range(40):
            cache.save(name, contents[k])
            if cache.load(name, bytes) not in contents:
                wrong.append(k)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(work, range(4)))
    assert not wrong
    assert [path.name for path in (tmp_path / "tmlattice").iterdir()] == [name]


def test_only_what_the_cache_has_written_is_counted_and_removed(tmp_path, monkeypatch):
    """The oldest entries go, until the cache is within its bound."""
    monkeypatch.setenv("TMLATTICE_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "LIMIT", 5000)
    own = tmp_path / "tmlattice"
    own.mkdir(0o700)
    others = [tmp_path / "measured.h5", tmp_path / ("0" * 64), own / "notes", own / "0a.json"]
    for path in others:
        path.write_bytes(b"y" * 9000)
        os.utime(path, (0, 0))
    names = [cache.key(k) for k in range(6)]
    for k, name in enumerate(names):
        cache.save(name, b"x" * 1500)
        os.utime(own / name, (k, k))
    left = {path.name for path in own.iterdir()} & set(names)
    assert left == set(names[-3:])  # 1532 bytes each
    assert cache.load(names[5], bytes) == b"x" * 1500
    assert cache.load(names[0], bytes) is None
    assert all(path.stat().st_size == 9000 for path in others)


def test_an_entry_of_another_content_is_made_anew(kept):
    """Its checksum is right: what a reader makes of it decides."""
    ring = load_ring(kept)
    expected = ring_maps(ring).W1
    folder = kept.parent / "cache" / "tmlattice"
    names = [path.name for path in folder.iterdir()]
    archive = io.BytesIO()
    np.savez(archive, W0=np.zeros(3), at=np.full(35, 10**9))
    for content in (b"[]", b'{"definitions": [[1]]}', b"PK", archive.getvalue(), b"null"):
        for name in names:
            cache.save(name, content)
        again = load_ring(kept)
        assert again == ring
        assert np.array_equal(ring_maps(again).W1, expected)
    maps, elements = sorted(names, key=lambda name: (folder / name).read_bytes()[32:34] != b"PK")
    with np.load(io.BytesIO((folder / maps).read_bytes()[32:])) as arrays:
        whole = dict(arrays)
    for name, wrong in (
        ("at", whole["at"] + 10**9), ("W2", whole["W2"][:, :2]), ("s", whole["s"].astype("U9")),
    ):  # fmt: skip
        archive = io.BytesIO()
        np.savez(archive, **{**whole, name: wrong})
        cache.save(maps, archive.getvalue())
        assert np.array_equal(ring_maps(load_ring(kept)).W1, expected)
    document = json.loads((folder / elements).read_bytes()[32:])
    for key, wrong in (("energy", "3"), ("families", [1] * len(document["families"])),
                       ("sequence", [10**6]), ("changes", {"qf::0": 1})):  # fmt: skip
        cache.save(elements, json.dumps({**document, key: wrong}).encode())
        assert load_ring(kept) == ring


@pytest.mark.parametrize("tilt", [0.3, np.pi / 2])
@pytest.mark.parametrize(
    "make",
    [
        lambda e, t: e.Quadrupole(l=0.4, k1=0.9, tilt=t),
        lambda e, t: e.Sextupole(l=0.2, k2=12.0, tilt=t),
        lambda e, t: e.SBend(l=1.2, angle=0.2, e1=0.1, e2=0.1, tilt=t),
    ],
)
def test_tilted_maps_vs_ocelots_own_rotation(make, tilt):
    from tmlattice.lattice.ocelot import SecondTM, TMTypes, elements, parts_of_ocelot

    source = make(elements, tilt)
    ours = parts_of_ocelot(source, 3.0, split=False)
    edges = source.element.has_edge
    types = [TMTypes.ENTRANCE, TMTypes.MAIN, TMTypes.EXIT] if edges else [TMTypes.MAIN]
    for (_, R, T), which in zip(ours, types, strict=True):
        theirs = SecondTM.from_element(source.element, which).get_params(3.0)
        assert np.allclose(R, theirs.get_rotated_R(), rtol=1e-14, atol=1e-15)
        # three products of sums of six terms: a few roundings of the largest term
        largest = abs(T).max()
        symmetric = 0.5 * (T + T.swapaxes(1, 2))
        assert abs(symmetric - theirs.get_rotated_T()).max() < 1e-14 * largest
        assert largest > 0.1


def test_tails_of_chi_square_vs_scipy_stats():
    statistic = np.array([-1.0, 0.0, 1e-3, 5.0, 4000.0, 1e5, np.inf, np.nan])
    for freedom in (0, 1, 6, 4000):
        assert np.array_equal(
            chi2.sf(statistic, freedom), stats.chi2.sf(statistic, freedom), equal_nan=True
        )
        rate = np.array([1e-300, 1e-12, 0.01, 0.5, 1.0])
        assert np.array_equal(
            chi2.isf(rate, freedom), stats.chi2.isf(rate, freedom), equal_nan=True
        )


def test_kept_directions_are_those_worked_out(small_ring, tmp_path, monkeypatch):
    from tmlattice.beam.assembly import assembly
    from tmlattice.beam.model import Model
    from tmlattice.effects import RingEffect, directions, find
    from tmlattice.effects.directions import ARRAYS, kept_directions

    monkeypatch.setenv("TMLATTICE_CACHE", str(tmp_path))
    ring = load_ring(SMALL)
    layers = assembly(ring).layers
    hypotheses = Model(ring, [{}]).hypotheses()
    hypotheses = [h for h in hypotheses if isinstance(find(h[0]), RingEffect)]
    worked_out = directions(layers, hypotheses)
    first = kept_directions(layers, hypotheses)
    entries = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = kept_directions(layers, hypotheses)
    assert entries == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    for name in ARRAYS:
        for found in (first, again):
            np.testing.assert_array_equal(getattr(found, name), getattr(worked_out, name))
