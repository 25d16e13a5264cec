"""Finds the strengths of petra3.py, or checks the ring.

    python lattices/match_petra3.py            match from rough values, print the two tables
    python lattices/match_petra3.py --write    the same, and put the strengths into petra3.py
    python lattices/match_petra3.py --check    measure every property the ring must have

The order of the matching: lengths that close the ring; the FODO cell; dispersion suppressors with
the north-west straight between; the achromats; every straight and junction between known Twiss
functions; the tunes, by the phases of six straights; the chromaticity.
"""

import re
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import petra3
from numba import njit
from ocelot import MagneticLattice, SecondTM
from scipy.optimize import least_squares

TUNES = np.array([37.1236, 30.2747])
CIRCUMFERENCE = 2303.952
CELL_TUNES = np.array([0.189, 0.206])
ENTRY = ("qd_b1", "qf_b1", "qd_b2", "qf_b2", "qd_b3", "qf_b3")
EXIT = ("qd_e3", "qf_e3", "qd_e2", "qf_e2", "qd_e1", "qf_e1")


# --- linear optics --------------------------------------------------------------------------------
@njit
def quad_block(matrix, plane, length, k):
    """One plane of a thick quadrupole."""
    w, i = np.sqrt(abs(k)), 2 * plane
    if k > 1e-12:
        c, s, d = np.cos(w * length), np.sin(w * length) / w, -w * np.sin(w * length)
    elif k < -1e-12:
        c, s, d = np.cosh(w * length), np.sinh(w * length) / w, w * np.sinh(w * length)
    else:
        c, s, d = 1.0, length, 0.0
    matrix[i, i], matrix[i, i + 1], matrix[i + 1, i], matrix[i + 1, i + 1] = c, s, d, c


@njit
def propagate(mats, where, lengths, ks, start):
    """beta_x alpha_x beta_y alpha_y D D' mu_x mu_y (mu in turns) after every element."""
    for i in range(where.size):
        quad_block(mats[where[i]], 0, lengths[i], ks[i])
        quad_block(mats[where[i]], 1, lengths[i], -ks[i])
    out = np.zeros((mats.shape[0] + 1, 8))
    out[0, :6] = start
    for i in range(mats.shape[0]):
        m = mats[i]
        for p in range(2):
            a, b = m[2 * p, 2 * p], m[2 * p, 2 * p + 1]
            c, d = m[2 * p + 1, 2 * p], m[2 * p + 1, 2 * p + 1]
            beta, alpha = out[i, 2 * p], out[i, 2 * p + 1]
            t = a * beta - b * alpha
            out[i + 1, 2 * p] = (t * t + b * b) / beta
            out[i + 1, 2 * p + 1] = -(c * beta - d * alpha) * t / beta - b * d / beta
            out[i + 1, 6 + p] = out[i, 6 + p] + np.arctan2(b, t) / (2 * np.pi)
        out[i + 1, 4] = m[0, 0] * out[i, 4] + m[0, 1] * out[i, 5] + m[0, 5]
        out[i + 1, 5] = m[1, 0] * out[i, 4] + m[1, 1] * out[i, 5] + m[1, 5]
    return out


def element_matrix(element):
    """The first-order map of an element, a bend's edges included."""
    total = np.eye(6)
    for r in element.R(petra3.energy):
        total = r @ total
    return total


class Section:
    """A piece of the ring; call it with strengths and the Twiss functions at its beginning."""

    def __init__(self, line):
        self.line = [e for e in line if e.l > 0]
        cache = {}
        self.mats = np.array([cache.setdefault(id(e), element_matrix(e)) for e in self.line])
        quads = [(i, e) for i, e in enumerate(self.line) if type(e).__name__ == "Quadrupole"]
        self.where = np.array([i for i, _ in quads])
        self.lengths = np.array([e.l for _, e in quads])
        self.names = [e.id for _, e in quads]

    def __call__(self, k, start):
        """Twiss functions and phases after every element."""
        ks = np.array([0.0 if n.startswith("qskew") else k[n] for n in self.names])
        return propagate(self.mats, self.where, self.lengths, ks, np.asarray(start, float))

    def matrix(self, k):
        """The matrix of the whole section."""
        self(k, [1, 0, 1, 0, 0, 0])  # sets the quadrupoles
        total = np.eye(6)
        for r in self.mats:
            total = r @ total
        return total

    def periodic(self, k):
        """Twiss functions and dispersion that repeat; None where there are none."""
        total, twiss = self.matrix(k), []
        for i in (0, 2):
            m = total[i : i + 2, i : i + 2]
            cosine = m.trace() / 2
            if abs(cosine) >= 1:
                return None
            sine = np.sqrt(1 - cosine**2) * np.sign(m[0, 1])
            twiss += [m[0, 1] / sine, (m[0, 0] - m[1, 1]) / 2 / sine]
        return np.array([*twiss, *np.linalg.solve(np.eye(2) - total[:2, :2], total[:2, 5])])


def soft(x, low, high, scale):
    """Residuals that are zero between two limits."""
    return np.concatenate([np.maximum(0, low - x), np.maximum(0, x - high)]) / scale


def survey(ring):
    """x, z and angle at the end of the ring, less those of its start."""
    x = z = angle = 0.0
    for e in ring:
        bend = e.angle if type(e).__name__ == "SBend" else 0.0
        chord = e.l * np.sinc(bend / 2 / np.pi)
        x += chord * np.sin(angle + bend / 2)
        z += chord * np.cos(angle + bend / 2)
        angle += bend
    return x, z, angle - 2 * np.pi


# --- second order: chromaticity and tracking ------------------------------------------------------
def second_order(ring):
    """The maps (R, T) of all elements in order, three for a bend.  Changes the ring's elements to
    OCELOT's second order: pass a ring built for the purpose."""
    cache, maps = {}, []
    for e in MagneticLattice(ring, method={"global": SecondTM}).sequence:
        if id(e) not in cache:
            cache[id(e)] = list(zip(e.R(petra3.energy), e.T(petra3.energy), strict=True))
        maps += cache[id(e)]
    return np.array([r for r, _ in maps]), np.array([t for _, t in maps])


@njit
def turn(r, t, start, delta):
    """One turn about a ray: the 4 x 4 Jacobian and the end."""
    z, jacobian = np.zeros(6), np.eye(4)
    z[:4], z[5] = start, delta
    for i in range(r.shape[0]):
        jac, y = np.zeros((4, 4)), np.zeros(6)
        for a in range(4):
            for b in range(6):
                y[a] += r[i, a, b] * z[b]
                if b < 4:
                    jac[a, b] += r[i, a, b]
                for c in range(6):
                    k = t[i, a, b, c]
                    if k != 0.0:
                        y[a] += k * z[b] * z[c]
                        if b < 4:
                            jac[a, b] += k * z[c]
                        if c < 4:
                            jac[a, c] += k * z[b]
        y[5] = delta
        z, jacobian = y, jac @ jacobian
    return jacobian, z[:4]


def chromaticity(ring, delta=1e-4):
    """From the tunes about the closed orbits at plus and minus delta."""
    r, t = second_order(ring)
    tunes = []
    for d in (-delta, delta):
        z = np.zeros(4)
        for _ in range(6):  # Newton's way to the off-momentum closed orbit
            m, end = turn(r, t, z, d)
            z = z + np.linalg.solve(np.eye(4) - m, end - z)
        m, _ = turn(r, t, z, d)
        q = [np.arccos(m[i : i + 2, i : i + 2].trace() / 2) / 2 / np.pi for i in (0, 2)]
        tunes.append(np.array(q) * np.sign([m[0, 1], m[2, 3]]))
    return (tunes[1] - tunes[0]) / (2 * delta)


@njit
def survived(r, t, z, turns):
    """The number of turns a particle stays within 0.2 m."""
    for n in range(turns):
        for i in range(t.shape[0]):
            y = r[i] @ z
            z = y.copy()
            for a in range(4):
                for b in range(4):
                    for c in range(4):
                        if t[i, a, b, c] != 0.0:
                            z[a] += t[i, a, b, c] * y[b] * y[c]
        z = r[-1] @ z
        if not (abs(z[0]) < 0.2 and abs(z[2]) < 0.2):
            return n
    return turns


def on_momentum(ring):
    """Linear stretches and second-order kicks between them, for `survived`.  A kick's T acts
    behind its own R, so it is turned to act on what comes out of R."""
    stretches, kicks, linear = [], [], np.eye(4)
    for r, t in zip(*second_order(ring), strict=True):
        linear = r[:4, :4] @ linear
        t4 = t[:4, :4, :4]
        if np.abs(t4).max() > 1e-14:
            back = np.linalg.inv(r[:4, :4])
            stretches.append(linear)
            kicks.append(np.einsum("abc,bi,cj->aij", t4, back, back))
            linear = np.eye(4)
    return np.array([*stretches, linear]), np.array(kicks)


# --- the matching ---------------------------------------------------------------------------------
def rough():
    """Starting values: alternating quadrupoles, published strengths in cells."""
    k = {}
    counts = {"sw": 6, "w": 7, "nw": 6, "n": 6, "ne": 6, "e": 8, "se": 6, "s": 10, "a4": 4, "a6": 4}
    for place, number in counts.items():
        signs = (1, -1, 1, -1, -1, 1, -1, 1) if place == "e" else (-1, 1) * (number // 2 + 1)
        k |= {f"q{i}_{place}": 0.17 * signs[i - 1] for i in range(1, number + 1)}
    k |= {"qf_w": 0.23, "qd_w": -0.23, "qf_n": 0.23, "qd_n": -0.23}
    k |= {n: -0.24 if n[1] == "d" else 0.24 for n in ("qd", "qf", *ENTRY, *EXIT)}
    for family in ("qa", "qe"):
        for i, value in enumerate((0.238, 0.268, -0.521, -0.565, 0.76), 1):
            k[f"{family}{i}"] = value
            if i < 4:
                k[f"{family}{i}_e"] = value
                if family == "qa":
                    k[f"{family}{i}_ne"] = value
    return k | {"s1": -5.22, "s2": 3.2, "s3": -5.22, "s4": 3.2}


def close_ring(k):
    """The lengths nearest to the wanted ones that close the ring at its circumference."""
    wanted = dict(zip(petra3.LENGTHS, (59, 106, 62, 104, 66, 90, 62, 106), strict=True))

    def miss(lengths):
        ring = petra3.build(k, lengths)
        return np.array([*survey(ring)[:2], sum(e.l for e in ring) - CIRCUMFERENCE])

    start = miss(wanted)
    moved = [miss(wanted | {p: wanted[p] + 1.0}) - start for p in wanted]
    change = -np.linalg.pinv(np.array(moved).T) @ start
    return {p: round(float(wanted[p] + c), 6) for p, c in zip(wanted, change, strict=True)}


def finite(parts):
    """One vector of residuals, without infinities."""
    return np.nan_to_num(np.concatenate(parts), nan=1e3).clip(-1e4, 1e4)


def best_of(residuals, starts, good=0.0, **options):
    """The best least-squares solution from several starts."""
    best = None
    for v0 in starts:
        found = least_squares(residuals, v0, **options)
        if best is None or found.cost < best.cost:
            best = found
        if best.cost < good:
            break
    return best


def match_cell(k, cell):
    """The periodic FODO cell; returns its Twiss functions."""

    def residuals(v):
        trial = {"qd": v[0], "qf": v[1]}
        twiss = cell.periodic(trial)
        return [1, 1] if twiss is None else cell(trial, twiss)[-1, 6:] - CELL_TUNES

    found = least_squares(residuals, [-0.24, 0.24], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    k["qd"], k["qf"] = found.x
    return cell.periodic(k)


def match_suppressors(k, leaving, line, entering, periodic, beta_max=36):
    """FODO cells to FODO cells through a straight, no dispersion in it; returns the Twiss functions
    at its two ends, which all FODO arcs then share."""
    middle = Section(line)
    names = [*EXIT, *ENTRY, *sorted({n for n in middle.names if n[1] != "s"})]
    base, rng = np.array([k[n] for n in names]), np.random.default_rng(5)

    def run(v):
        trial = dict(zip(names, v, strict=True))
        a = leaving(trial, periodic)
        b = middle(trial, a[-1, :6])
        return a, b, entering(trial, b[-1, :6])

    def residuals(v):
        a, b, c = run(v)
        o = np.vstack([a, b, c])
        miss = (c[-1, :6] - periodic) / [periodic[0], 1, periodic[2], 1, 0.1, 0.01]
        return finite(
            [
                10 * miss,
                a[-1, 4:6] * [100, 1000],
                0.5 * (b[-1, 6:] - [0.62, 0.6]),
                *(soft(o[:, i], 0, beta_max, 30) for i in (0, 2)),
                soft(o[:, 4], -1, 0.83, 0.03),
                soft(v, -0.345, 0.345, 0.02),
                0.001 * v,
            ]
        )

    starts = (base * (1 + rng.normal(size=base.size) * 0.15 * (t > 0)) for t in range(40))
    found = best_of(residuals, starts, good=0.03, max_nfev=100)
    found = least_squares(residuals, found.x, max_nfev=300)
    a, b, _ = run(found.x)
    k.update(zip(names, found.x, strict=True))
    no_dispersion = [1, 1, 1, 1, 0, 0]
    return a[-1, :6] * no_dispersion, b[-1, :6] * no_dispersion


def match_achromat(k, family, half, tunes, least_beta):
    """The periodic achromat; returns Twiss in mid-straight.  A tune of 4/5 makes the dispersion of
    the octant's five weak bends cancel."""
    names, rng = [f"{family}{i}" for i in range(1, 6)], np.random.default_rng(1)
    rough_start = np.array([-0.4, 0.7, -0.9, -0.498, 0.9, np.log(12), np.log(4)])
    spread = [0.15, 0.15, 0.15, 0.15, 0.1, 0.5, 0.5]

    def twiss(v):
        return np.array([np.exp(v[5]), 0, np.exp(v[6]), 0, 0, 0])

    def residuals(v):
        o = half(dict(zip(names, v[:5], strict=True)), twiss(v))
        aims = [o[-1, 1], o[-1, 3], o[-1, 5] * 100, *((o[-1, 6:] - np.array(tunes) / 2) * 20)]
        limits = [soft(o[:, i], 0, 26, 30) for i in (0, 2)]
        limits += [soft(v[6:], np.log(least_beta), 9, 0.3), soft(v[:5], -0.9, 0.9, 0.1)]
        return np.concatenate([np.array(aims) * 1000, *limits, 0.0002 * v[:5]])

    starts = (rough_start + rng.normal(size=7) * spread * (t > 0) for t in range(16))
    found = best_of(residuals, starts, max_nfev=200)
    k.update(zip(names, found.x[:5], strict=True))
    return twiss(found.x)


def match_line(k, place, job, tunes=None, weight=1.0, beta_max=44, seeds=50, resume=False):
    """A straight or junction between known Twiss functions; returns its phases."""
    line, first, last = job
    section = Section(line)
    fixed = re.compile(r"qs|q[ae]\d$")
    names = sorted({n for n in section.names if not fixed.match(n)})
    length = sum(e.l for e in line if e.id[:2] not in ("bo", "be"))
    aim = np.array([6.2, 6.3]) * length / 640 if tunes is None else tunes
    base, rng = np.array([k[n] for n in names]), np.random.default_rng(3)
    limit = np.array([0.88 if n[1] in "ae" else 0.34 for n in names])

    def residuals(v):
        o = section(k | dict(zip(names, v, strict=True)), first)
        miss = (o[-1, :4] - last[:4]) / [last[0], 1, last[2], 1] * 90
        limits = [soft(o[:, i], 0, beta_max, 30) for i in (0, 2)]
        phases = weight * (o[-1, 6:] - aim)
        return finite([miss, phases, *limits, soft(v / limit, -1, 1, 0.06), 0.001 * v])

    def starts():
        for t in range(1 if resume else seeds):
            v0 = base if resume else base * (1 + rng.normal(size=base.size) * 0.4 * (t > 0))
            if place in ("e", "ne") and t > 60:
                signs = rng.choice([-1, 1], base.size) * 0.18
                v0 = np.where(limit < 0.5, signs * (1 + rng.normal(size=base.size) * 0.3), base)
            yield v0

    found = best_of(residuals, starts(), max_nfev=80)
    k.update(zip(names, found.x, strict=True))
    o = section(k, first)
    print(f"  {place:3s} cost {found.cost:.1e} beta {o[:, [0, 2]].max(0)} phases {o[-1, 6:]}")
    return o[-1, 6:]


def index(line, name, last=False):
    """The place of the first or last element whose id begins so."""
    found = [i for i, e in enumerate(line) if e.id.startswith(name)]
    return found[-1 if last else 0]


def ring_tunes(k):
    """Both tunes, integers included, by phase count."""
    section = Section(petra3.build(k, petra3.LENGTHS))
    return section(k, section.periodic(k))[-1, 6:]


def newton(k, measure, aim, groups, step, tolerance):
    """Groups of strengths, each moved as one, until `measure` meets `aim`."""
    for _ in range(6):
        value = measure(k)
        if np.abs(aim - value).max() < tolerance:
            return
        moved = [measure(k | {n: k[n] + step for n in group}) for group in groups]
        change = np.linalg.solve(((np.array(moved) - value) / step).T, aim - value)
        for group, dk in zip(groups, change, strict=True):
            k.update({n: k[n] + dk for n in group})


def match():
    """All strengths, from rough values."""
    k = rough()
    magnets = petra3.Families(k)
    arc = petra3.fodo_arc(magnets, "a1", 14, range(3, 13))
    begins = [index(arc, f"vcor_a1_{c}") - 2 for c in range(1, 14)]  # drift, half sextupole before
    cells = [arc[a:b] for a, b in zip(begins, [*begins[1:], None], strict=True)]
    last_begin = begins[-1] + next(
        i for i, s in enumerate(np.cumsum([e.l for e in cells[-1]]), 1) if s > 14.4 - 1e-6
    )
    entering, leaving = Section(arc[: begins[3]]), Section(arc[begins[11] :])
    assert abs(sum(e.l for e in arc[last_begin:]) - 14.4) < 1e-5
    periodic = match_cell(k, Section(cells[5]))
    northwest = petra3.straights(magnets, petra3.LENGTHS)["nw"]
    leave, enter = match_suppressors(k, leaving, northwest, entering, periodic)

    middle, doublet, halves = {}, {}, {}
    drift = petra3.drift(petra3.UNDULATOR / 2)
    for family, bend, tunes, beta in (
        ("qa", "bo", (0.8, 0.52), 1e-4),
        ("qe", "be", (0.82, 0.45), 20),
    ):
        half = Section(drift + petra3.half_achromat(magnets, "x", family, bend, True))
        middle[family] = match_achromat(k, family, half, tunes, beta)
        doublet[family] = half(k, middle[family])[-1, :6]
        halves[family] = bend
        for name in (f"{family}{i}_{p}" for i in (1, 2, 3) for p in ("ne", "e")):
            if name in k:
                k[name] = k[name.split("_")[0]]

    magnets = petra3.Families(k)
    straights, arcs = petra3.straights(magnets, petra3.LENGTHS), petra3.arcs(magnets)

    def half_near(family, place):
        return drift + petra3.half_achromat(magnets, "x", family, halves[family], True, place)

    jobs = {p: (straights[p], leave, enter) for p in ("sw", "w", "nw", "se", "s")}
    jobs["n"] = straights["n"], leave, middle["qe"]
    jobs["ne"] = straights["ne"] + half_near("qa", "ne"), leave, doublet["qa"]
    octant = arcs["a5"]
    i = index(octant, "qa5", last=True)
    start = Section(octant[:i])(k, middle["qa"])[-1, :6]
    jobs["e"] = octant[i:] + straights["e"] + half_near("qe", "e"), start, doublet["qe"]
    for arc_name in ("a4", "a6"):
        line = arcs[arc_name]
        i = index(line, f"bpm_{arc_name}_u2", last=True) + 3  # its drift, half the straight
        i = i if abs(line[i - 1].l - petra3.UNDULATOR / 2) < 1e-9 else i - 1
        ends = i + np.searchsorted(np.cumsum([e.l for e in line[i:]]), petra3.JUNCTION - 1e-6) + 1
        jobs[arc_name] = line[i:ends], Section(line[:i])(k, middle["qe"])[-1, :6], enter
    print("straights and junctions")
    seeds = {"e": 150, "ne": 150}
    phase = {p: match_line(k, p, jobs[p], seeds=seeds.get(p, 50)) for p in jobs}

    free = ("sw", "nw", "se", "s", "w", "n")
    share = {p: petra3.LENGTHS[p] / sum(petra3.LENGTHS[q] for q in free) for p in free}
    for turn_number in range(4):
        off = TUNES - ring_tunes(k)
        print("tunes are off by", off)
        for p in free:
            phase[p] = phase[p] + off * share[p]
            first = turn_number == 0
            weight, beta = (10, 44) if first else (30, 46)
            match_line(k, p, jobs[p], phase[p], weight, beta, seeds=12, resume=not first)
    newton(k, ring_tunes, TUNES, (("qf",), ("qd",)), 1e-6, 1e-10)
    newton(
        k,
        lambda s: chromaticity(petra3.build(s, petra3.LENGTHS)),
        np.array([1.2, 1.2]),
        (("s1", "s3"), ("s2", "s4")),
        0.1,
        1e-6,
    )
    return {name: float(value) for name, value in k.items()}


# --- the check ------------------------------------------------------------------------------------
COUNTS = {"Quadrupole": 415, "SBend": 355, "Hcor": 262, "Vcor": 237, "Sextupole": 230}
COUNTS |= {"Matrix": 20, "Monitor": 246}


def in_straights(line):
    """For every element: does it stand in a straight (undulator straights with weak bends too)?"""
    inside, flags = True, []
    for e in line:
        name = e.id
        if re.match(r"(bo|be)_", name):
            flags.append(False)
            inside = None
            continue
        if re.match(r"q[1-9]|qa1|qe1|wiggler", name):
            inside = True
        elif re.match(r"b_|b$|qd$|qf$|q[df]_[be]\d|q[ae][345]", name):
            inside = False
        flags.append(bool(inside))
    return np.array(flags)


def check():
    """Print every requirement with its measured value; 1 if one fails."""
    ring, k, rows = petra3.ring, petra3.STRENGTHS, []

    def row(what, value, good):
        rows.append(bool(good))
        print(f"{what:44s} {value!s:40s} {'ok' if good else 'FAILED'}", flush=True)

    counts = Counter(type(e).__name__ for e in ring)
    for kind, number in COUNTS.items():
        row(kind, counts[kind], counts[kind] == number)
    others = set(counts) - set(COUNTS)
    row("other kinds", sorted(others), others == {"Drift", "Marker"})
    magnets = sum(counts[kind] for kind in COUNTS if kind != "Monitor")
    row("magnets", magnets, magnets == 1519)
    zero = sum(e.k2 == 0 for e in ring if type(e).__name__ == "Sextupole")
    row("sextupoles at zero", zero, zero == 50)
    for kind, number in (("Hcor", 132), ("Vcor", 85)):
        short = sum(e.l == 0 for e in ring if type(e).__name__ == kind)
        row(f"{kind} of zero length", short, short == number)
    unique = [e.id for e in ring if type(e).__name__ in ("Hcor", "Vcor", "Monitor")]
    row("monitor and corrector ids unique", len(set(unique)), len(set(unique)) == 745)
    row(
        "ids lower case, none generated",
        "",
        all(re.fullmatch(r"[a-z]\w*", e.id) and e.id.islower() for e in ring),
    )
    shortest = min(e.l for e in ring if type(e).__name__ == "Drift")
    row("shortest drift [m]", shortest, shortest > 0)
    length = sum(e.l for e in ring)
    row("circumference [m]", f"{length:.6f}", abs(length - CIRCUMFERENCE) < 1e-3)
    x, z, angle = survey(ring)
    row(
        "survey x, z [um], angle",
        f"{x * 1e6:.1f} {z * 1e6:.1f} {angle:.1e}",
        max(abs(x), abs(z)) < 1e-3 and abs(angle) < 1e-9,
    )
    w = next(element_matrix(e) for e in ring if e.id == "wiggler")
    row(
        "wiggler R33 R43 R21 R55 R66",
        f"{w[2, 2]:.4f} {w[3, 2]:.3e} {w[1, 0]:.2e} {w[4, 4]} {w[5, 5]}",
        abs(w[3, 2] + 1.06e-2) < 1e-4,
    )

    section = Section(ring)
    twiss = section.periodic(k)
    if twiss is None:
        row("stable", "no", False)
        return 1
    out = section(k, twiss)
    q = out[-1, 6:]
    row("tunes by phase count", f"{q[0]:.6f} {q[1]:.6f}", np.abs(q - TUNES).max() < 1e-4)
    beta = out[:, [0, 2]].max(0)
    row("largest beta [m]", f"{beta[0]:.2f} {beta[1]:.2f}", beta.max() < 60)
    row("largest dispersion [m]", f"{out[:, 4].max():.4f}", np.abs(out[:, 4]).max() < 0.9)
    flags = in_straights(section.line)
    leak = np.abs(out[1:, 4][flags]).max()
    row(f"largest |D| in straights [m] ({flags.sum()} places)", f"{leak:.4f}", leak < 0.1)
    m = section.matrix(k)
    eta = [*twiss[4:], 0, 0]
    alpha = -(m[4, :4] @ eta + m[4, 5]) / length
    row("momentum compaction", f"{abs(alpha):.4e}", 1.0e-3 <= abs(alpha) <= 1.25e-3)
    xi = chromaticity(petra3.build(k, petra3.LENGTHS))
    row("chromaticity", f"{xi[0]:.4f} {xi[1]:.4f}", (xi > 0.5).all() and (xi < 2).all())
    r, t = on_momentum(petra3.build(k, petra3.LENGTHS))
    for mm in (5, 6, 7):
        turns = [
            survived(r, t, np.array([x, 0, y, 0]) * mm * 1e-3, 5000)
            for x, y in ((1, 1), (1, 0), (0, 1))
        ]
        if mm == 5:
            row("turns survived at 5 mm (xy, x, y)", turns, min(turns) == 5000)
        else:
            print(f"  at {mm} mm: {turns}")
    places = np.linspace(0, 414, 40).astype(int)
    stable, at = 0, [i for i, e in enumerate(section.line) if type(e).__name__ == "Quadrupole"]
    for p in places:
        weak = Section.__new__(Section)
        weak.__dict__ = section.__dict__ | {
            "mats": section.mats.copy(),
            "names": list(section.names),
        }
        weak.names[p] = "weak"
        strength = 0.0 if section.names[p].startswith("qskew") else 0.8 * k[section.names[p]]
        stable += weak.periodic(k | {"weak": strength}) is not None
    row("stable with one quadrupole 20 % weak, of 40", stable, stable >= 25 and len(at) == 415)
    return 0 if all(rows) else 1


def write(strengths):
    """Put the strengths into petra3.py."""
    path = Path(petra3.__file__)
    old = path.read_text()
    head, rest = old.split("STRENGTHS = {", 1)
    table = "".join(f'    "{name}": {value!r},\n' for name, value in strengths.items())
    new = path.with_suffix(".new")
    new.write_text(head + "STRENGTHS = {\n" + table + rest[rest.index("}\n") :])
    new.replace(path)


def main():
    """Match or check."""
    if "--check" in sys.argv:
        return check()
    lengths = close_ring(petra3.STRENGTHS)
    print("LENGTHS =", lengths)
    away = max(abs(lengths[p] - petra3.LENGTHS[p]) for p in lengths)
    print("largest difference from petra3.py:", away, "m")
    found = match()
    print("STRENGTHS = {", *(f'    "{n}": {v!r},' for n, v in found.items()), "}", sep="\n")
    away = max(abs(v - petra3.STRENGTHS.get(n, np.inf)) for n, v in found.items())
    print("largest difference from petra3.py:", away)
    if "--write" in sys.argv:
        write(found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
