"""A storage ring in the style of PETRA III (DESY, Hamburg) as a plain OCELOT lattice.

    from petra3 import energy, ring

`ring` is a flat list of OCELOT elements in beam order: 1519 magnets, 246 monitors, drifts and a
few markers, 2303.952 m round, starting in the middle of the short south-west straight.  Nothing
but OCELOT is needed to read it.

The make-up (counts, lengths, order of the elements in a cell, tunes) follows the published figures
of PETRA III.  It is not the machine's own lattice: the lengths of the straights and all strengths
were found by match_petra3.py, which stands beside this file and rewrites the two tables below.

Conventions: metres and radians; k1 in 1/m^2, positive focuses horizontally; k2 in 1/m^3; a positive
angle bends towards the inside of the ring; energy in GeV.  Magnets of one family are one object and
bear one id; monitors and correctors bear the name of their place.

Beam order:  SW/2  A1  W  A2  NW  A3  N  A4  NE  A5  E  A6  SE  A7  S  A8  SW/2
  A1 A2 A3 A7 A8   14 FODO cells each
  A4 A6            two double-bend achromats, a junction, 11 FODO cells
  A5               nine double-bend achromats: the new octant
  W N              ten damping wigglers each;  S has the place of the cavities
"""

from math import acos, cos, cosh, pi, sin, sinh, sqrt

from ocelot import Drift, Hcor, Marker, Matrix, Monitor, Quadrupole, SBend, Sextupole, Vcor

energy = 6.0  # GeV

# --- tables written by match_petra3.py ------------------------------------------------------------
# Straights, from the end of one arc to the beginning of the next [m]: they close the ring.
LENGTHS = {
    "sw": 64.498323,
    "w": 108.809346,
    "nw": 59.530557,
    "n": 96.754209,
    "ne": 57.278174,
    "e": 83.967159,
    "se": 61.24594,
    "s": 110.022302,
}
# Quadrupoles: k1 [1/m^2]; sextupoles s1..s4: k2 [1/m^3].
STRENGTHS = {
    "q1_sw": -0.2437993432391493,
    "q2_sw": 0.18346933288690895,
    "q3_sw": -0.17986579949945863,
    "q4_sw": 0.13956853190641305,
    "q5_sw": -0.14158699759922586,
    "q6_sw": 0.1854945055053274,
    "q1_w": -0.20681731365290026,
    "q2_w": 0.19516310556800465,
    "q3_w": -0.1421786275839864,
    "q4_w": -0.0438154744890512,
    "q5_w": -0.206043210280359,
    "q6_w": 0.20487655923404352,
    "q7_w": 0.06692193657398657,
    "q1_nw": -0.25595448062482024,
    "q2_nw": 0.1944559852233122,
    "q3_nw": -0.19729143868112153,
    "q4_nw": 0.15119078843601091,
    "q5_nw": -0.14436754821321776,
    "q6_nw": 0.19591583267358625,
    "q1_n": -0.24103342802686564,
    "q2_n": 0.09832814671476106,
    "q3_n": -0.05231477940254715,
    "q4_n": -0.09073435990868431,
    "q5_n": 0.10608987066187923,
    "q6_n": -0.08512842730151166,
    "q1_ne": -0.20003987239775958,
    "q2_ne": 0.17481114732538292,
    "q3_ne": -0.1363039417797554,
    "q4_ne": 0.132817536290337,
    "q5_ne": -0.14448784090741185,
    "q6_ne": 0.15593644521986355,
    "q1_e": -0.019390890750289557,
    "q2_e": 0.13129439956453323,
    "q3_e": -0.13488101292911878,
    "q4_e": 0.11354849105950826,
    "q5_e": -0.11936658876923317,
    "q6_e": 0.10670020831432128,
    "q7_e": -0.11080425403195948,
    "q8_e": 0.1461994729226214,
    "q1_se": -0.25154584048161543,
    "q2_se": 0.19066749245436038,
    "q3_se": -0.1911913005883148,
    "q4_se": 0.14711912431352886,
    "q5_se": -0.14347227868485307,
    "q6_se": 0.19226796092599127,
    "q1_s": -0.2345245057527982,
    "q2_s": 0.18356331920619512,
    "q3_s": -0.1843628542174146,
    "q4_s": 0.14051159816435851,
    "q5_s": -0.13557836364390774,
    "q6_s": 0.14298116428443494,
    "q7_s": -0.1913958364436988,
    "q8_s": 0.16355966257078267,
    "q9_s": -0.20445800116679608,
    "q10_s": 0.20638404228207582,
    "q1_a4": -0.004211268492912101,
    "q2_a4": -0.1329409825647919,
    "q3_a4": 0.23275729188682928,
    "q4_a4": 0.00010380933110612949,
    "q1_a6": 0.004468761614433062,
    "q2_a6": -0.14504363098534848,
    "q3_a6": 0.23450992732212592,
    "q4_a6": 0.0044161639154665115,
    "qf_w": 0.17816432025577864,
    "qd_w": -0.18950956577024455,
    "qf_n": 0.16197377754574566,
    "qd_n": -0.17540543930336758,
    "qd": -0.2426314893914593,
    "qf": 0.23273138442828215,
    "qd_b1": -0.19469584679897353,
    "qf_b1": 0.3334188728174054,
    "qd_b2": -0.22647939109555904,
    "qf_b2": 0.2825269030705387,
    "qd_b3": -0.22237812083142328,
    "qf_b3": 0.2283006489886758,
    "qd_e3": -0.20170483012677903,
    "qf_e3": 0.2123619635000925,
    "qd_e2": -0.21633070603720214,
    "qf_e2": 0.28908050485529413,
    "qd_e1": -0.21251803101711061,
    "qf_e1": 0.3209302961473038,
    "qa1": -0.4107007271506541,
    "qa1_e": -0.7311654791002627,
    "qa1_ne": -0.6040026062704081,
    "qa2": 0.7577328917883637,
    "qa2_e": 0.793655559278185,
    "qa2_ne": 0.6953392125114422,
    "qa3": -0.9000000005371558,
    "qa3_e": -0.5360145815927867,
    "qa3_ne": -0.6793158550010794,
    "qa4": -0.48100072154226775,
    "qa5": 0.8944717678427108,
    "qe1": -0.4292982238387138,
    "qe1_e": -0.7006935539236692,
    "qe2": 0.7715522228710839,
    "qe2_e": 0.7413141697674107,
    "qe3": -0.9000000004119778,
    "qe3_e": -0.6774844571590483,
    "qe4": -0.24055684906167524,
    "qe5": 0.8099764476754941,
    "s1": -4.790727064963545,
    "s2": 3.1743001035292724,
    "s3": -4.790727064963545,
    "s4": 3.1743001035292724,
}
# --- end of the tables ----------------------------------------------------------------------------

# Lengths of magnets [m]
QUAD = 0.7028  # quadrupoles of FODO arcs and straights
QUAD_SHORT = 0.4759  # quadrupoles of the achromats ...
QUAD_DBA_LONG = 0.7548  # ... but for qa2
SKEW = 0.3
SEXT = 0.286  # sd stands in two halves of it
CORR = 0.2
ARC_BEND = 5.378
DBA_BEND = 2 * 0.5263
WEAK_BEND = 0.4
WIGGLER = 4.0

# Drifts [m] that fix more than one place
CELL_SPACE = 0.8856  # from a dipole's end to the next quadrupole of a FODO cell
CELL_GAP = 0.2336  # from a quadrupole to the next dipole
UNDULATOR = 5.8  # the whole undulator straight of an achromat
TAIL = 6.0  # by this much the last gap before an achromat is shorter than the others
JUNCTION = 22.0  # from an achromat to a FODO arc
WIGGLER_GAP = 6.1 - QUAD  # between two quadrupoles of a wiggler channel

# Angles [rad].  The weak 20 mrad and 1 mrad bends cancel; five of 5 mrad are part of octant A5.
ARC_ANGLE = pi / 4 / 28
OCTANT_ANGLE = (pi / 4 - 5 * 5e-3) / 18  # a dipole of A5
EXTENSION_ANGLE = 6 * ARC_ANGLE / 4  # four of them stand for six arc dipoles


# --- building blocks ------------------------------------------------------------------------------
def drift(length):
    """A drift of `length` metres, rounded to a micrometre; none at all where there is no room."""
    micrometres = round(length * 1e6)
    if micrometres < 0:
        raise ValueError(f"no room: a drift of {length} m")
    return [Drift(l=micrometres * 1e-6, eid=f"drift_{micrometres}um")] if micrometres else []


def space(length, *placed):
    """A stretch of `length` metres with elements at offsets: `placed` holds (offset, element)."""
    line, end = [], 0.0
    for offset, element in placed:
        line += [*drift(offset - end), element]
        end = offset + element.l
    return [*line, *drift(length - end)]


def halves(name, length, angle):
    """A rectangular dipole in two halves, each with half the whole angle at its outer edge."""
    return (
        SBend(l=length / 2, angle=angle / 2, e1=angle / 2, e2=0.0, eid=f"{name}_in"),
        SBend(l=length / 2, angle=angle / 2, e1=0.0, e2=angle / 2, eid=f"{name}_out"),
    )


def rectangular(name, length, angle):
    """A rectangular dipole in one piece."""
    return SBend(l=length, angle=angle, e1=angle / 2, e2=angle / 2, eid=name)


def wiggler():
    """Four metres of damping wiggler: focusing in y, hardly any defocusing in x, symplectic."""
    ky, kx = acos(0.9787) / WIGGLER, sqrt(2.3e-4 / WIGGLER)  # R33 = cos(ky l), R21 = kx sinh(kx l)
    y, x = ky * WIGGLER, kx * WIGGLER
    return Matrix(
        l=WIGGLER,
        r11=cosh(x),
        r12=sinh(x) / kx,
        r21=kx * sinh(x),
        r22=cosh(x),
        r33=cos(y),
        r34=sin(y) / ky,
        r43=-ky * sin(y),
        r44=cos(y),
        r55=1.0,  # OCELOT leaves the longitudinal block at zero
        r66=1.0,
        eid="wiggler",
    )


class Families(dict):
    """The magnets that are shared: one object a family, made from the strengths by its name."""

    def __init__(self, strengths):
        for name, k in strengths.items():
            if name.startswith("s"):
                self[name] = Sextupole(l=SEXT if name in ("s2", "s4") else SEXT / 2, k2=k, eid=name)
            elif name.startswith(("qa", "qe")):
                length = QUAD_DBA_LONG if name[2] == "2" else QUAD_SHORT
                self[name] = Quadrupole(l=length, k1=k, eid=name)
            else:
                self[name] = Quadrupole(l=QUAD, k1=k, eid=name)
        self["sd0"] = Sextupole(l=SEXT / 2, k2=0.0, eid="sd0")
        self["wiggler"] = wiggler()
        self["b"] = rectangular("b", ARC_BEND, ARC_ANGLE)
        self["b_in"], self["b_out"] = halves("b", ARC_BEND, ARC_ANGLE)
        self["bo_in"], self["bo_out"] = halves("bo", DBA_BEND, OCTANT_ANGLE)
        self["be_in"], self["be_out"] = halves("be", DBA_BEND, EXTENSION_ANGLE)
        for name, angle in {"bu": 5e-3, "bc": 20e-3, "bs": 1e-3}.items():
            self[f"{name}_plus"] = rectangular(f"{name}_plus", WEAK_BEND, angle)
            self[f"{name}_minus"] = rectangular(f"{name}_minus", WEAK_BEND, -angle)


# --- FODO arcs ------------------------------------------------------------------------------------
def fodo_cell(magnets, place, qd, qf, sd=None, sf=None, split_second=False):
    """One cell of 14.4 m.  A sextupole pair has a vertical winding in its middle; a cell without
    one has a vertical corrector there.  The first dipole, in the arc's end cells the second one
    too, is split by a horizontal winding."""

    def split(name):
        return [magnets["b_in"], Hcor(l=0.0, eid=name), magnets["b_out"]]

    if sd is None:
        vertical = [(0.374, Vcor(l=CORR, eid=f"vcor_{place}"))]
    else:
        half = magnets[sd]
        winding = Vcor(l=0.0, eid=f"vcor_{place}")
        vertical = [(0.374, half), (0.374 + half.l, winding), (0.374 + half.l, half)]
    focusing = [(0.374, magnets[sf])] if sf else []
    return [
        *space(CELL_SPACE, *vertical, (0.8065, Monitor(eid=f"bpm_{place}"))),
        magnets[qd],
        *drift(CELL_GAP),
        *split(f"hcor_{place}"),
        *space(CELL_SPACE, *focusing),
        magnets[qf],
        *drift(CELL_GAP),
        *(split(f"hcor_{place}b") if split_second else [magnets["b"]]),
    ]


def fodo_arc(magnets, arc, cells, powered):
    """An arc of FODO cells.  Three at either end suppress the dispersion.  Sextupoles stand in
    five or ten cells in a row: near 72 degrees a cell their kicks cancel."""
    ends = {1: "b1", 2: "b2", 3: "b3", cells - 2: "e3", cells - 1: "e2", cells: "e1"}
    line = []
    for c in range(1, cells + 1):
        end = f"_{ends[c]}" if c in ends else ""
        if c in powered:
            sd, sf = ("s1", "s2") if c % 2 else ("s3", "s4")
        else:
            sd, sf = ("sd0", None) if c < cells else (None, None)
        split_second = c in (1, cells)
        line += fodo_cell(magnets, f"{arc}_{c}", f"qd{end}", f"qf{end}", sd, sf, split_second)
    return line


# --- double-bend achromats ------------------------------------------------------------------------
def half_achromat(magnets, place, family, bend, first, near=""):
    """From the monitor at an undulator straight to the middle of the doublet, or mirrored.  Next to
    the straight `near` its three outer quadrupoles have strengths of their own."""
    n = (1, 2, 3, 4) if first else (8, 7, 6, 5)
    q1, q2, q3, q4, q5 = (
        magnets[f"{family}{i}_{near}" if near and i < 4 else f"{family}{i}"] for i in range(1, 6)
    )
    into, out = magnets[f"{bend}_in"], magnets[f"{bend}_out"]

    def bpm(i):
        return Monitor(eid=f"bpm_{place}_{n[i]}")

    def hcor(i, length=CORR):
        return Hcor(l=length, eid=f"hcor_{place}_{n[i]}")

    def vcor(i):
        return Vcor(l=CORR, eid=f"vcor_{place}_{n[i]}")

    line = [
        *space(0.25, (0.0, bpm(0))),
        q1,
        *drift(0.80),
        q2,
        *space(0.84, (0.1, bpm(1)), (0.2, hcor(0)), (0.5, vcor(0))),
        q3,
        *space(0.79, (0.1, hcor(1)), (0.4, vcor(1)), (0.7, bpm(2))),
        *([into, hcor(2, 0.0), out] if first else [out, hcor(2, 0.0), into]),
        *space(1.15, (0.3, vcor(2)), (0.75, bpm(3))),
        q4,
        *drift(0.63),
        q5,
        *drift(0.20),
    ]
    return line if first else line[::-1]


def achromats(magnets, arc, count, family, bend, near, weak):
    """Achromats with undulator straights between them and half a straight at either end; `weak`
    maps the number of a cell to the weak bends in the middle of the straight behind it."""
    line = drift(UNDULATOR / 2)
    for c in range(1, count + 1):
        place = f"{arc}_u{c}"
        before, after = near[0] if c == 1 else "", near[1] if c == count else ""
        line += half_achromat(magnets, place, family, bend, True, before)
        line += half_achromat(magnets, place, family, bend, False, after)
        if c == count:
            return line + drift(UNDULATOR / 2)
        bends = [magnets[name] for name in weak.get(c, ())]
        pitch = WEAK_BEND + 0.3
        start = UNDULATOR / 2 - (pitch * len(bends) - 0.3) / 2
        line += space(UNDULATOR, *((start + pitch * i, b) for i, b in enumerate(bends)))


# --- straights ------------------------------------------------------------------------------------
def straight(magnets, place, length, quads, bpms, lead, tail, wigglers=(), skews=(), middle=None):
    """Quadrupoles evenly spaced, each with correctors (and a monitor) behind it.

    `lead` is the drift before the first of them and `tail` the length at the far end that already
    belongs to the arc.  Behind the quadrupoles in `wigglers` stands a wiggler.  No vertical
    corrector stands between two wigglers, and no horizontal one before a FODO arc, which begins
    with a winding of its own.
    """
    gaps = len(quads) - len(wigglers)
    gap = length - lead + tail - QUAD * len(quads) - WIGGLER_GAP * len(wigglers)
    line = drift(lead)
    for i, name in enumerate(quads):
        last = i == len(quads) - 1
        placed = []
        if not (last and tail == CELL_SPACE):
            placed.append((0.25, Hcor(l=CORR, eid=f"hcor_{place}_{i + 1}")))
        if not (i in wigglers and i - 1 in wigglers):
            placed.append((0.55, Vcor(l=CORR, eid=f"vcor_{place}_{i + 1}")))
        if i in bpms:
            placed.append((0.85, Monitor(eid=f"bpm_{place}_{i + 1}")))
        if i in wigglers:
            placed.append((1.2, magnets["wiggler"]))
        if i in skews:
            number = skews.index(i) + 1
            skew = Quadrupole(l=SKEW, k1=0.0, tilt=pi / 4, eid=f"qskew_{place}_{number}")
            placed.append((1.2, skew))
        if i == middle:
            placed.append((gap / gaps / 2, Marker(eid="rf")))
        room = WIGGLER_GAP if i in wigglers else gap / gaps - (tail if last else 0.0)
        line += [magnets[name], *space(room, *placed)]
    return line


def numbered(place, count):
    """The names of the quadrupoles of a straight."""
    return [f"q{i}_{place}" for i in range(1, count + 1)]


def wiggler_quads(place, after):
    """Three matching quadrupoles, a channel of eleven (ten wigglers between), `after` more."""
    channel = [f"qf_{place}", f"qd_{place}"] * 5 + [f"qf_{place}"]
    names = numbered(place, 3 + after)
    return names[:3] + channel + names[3:]


def straights(magnets, lengths):
    """The eight straights by name."""
    short = {"bpms": range(6), "skews": (1, 3)}
    wiggle = {"bpms": (0, 2, 5, 9, 13, 15), "skews": (0, 1), "wigglers": range(3, 13)}
    long = {"bpms": (0, 2, 4, 5, 7, 9), "skews": (1, 7), "middle": 4}
    east = {"bpms": (0, 1, 3, 4, 6, 7), "skews": (1, 6)}
    quads = {
        "w": wiggler_quads("w", 4),
        "n": wiggler_quads("n", 3),
        "e": numbered("e", 8),
        "s": numbered("s", 10),
    }
    line = {}
    for place, length in lengths.items():
        layout = {"w": wiggle, "n": wiggle, "s": long, "e": east}.get(place, short)
        names = quads.get(place) or numbered(place, 6)
        lead = 0.3 if place == "e" else CELL_SPACE  # behind an achromat or behind a FODO arc
        tail = {"n": UNDULATOR / 2, "ne": TAIL, "e": TAIL}.get(place, CELL_SPACE)
        line[place] = [
            Marker(eid=place),
            *straight(magnets, place, length, names, lead=lead, tail=tail, **layout),
        ]
    return line


# --- the ring -------------------------------------------------------------------------------------
def arcs(magnets):
    """The eight arcs by name; A4 and A6 begin with two achromats and a junction."""
    ten, five = range(3, 13), range(4, 9)
    line = {arc: fodo_arc(magnets, arc, 14, ten) for arc in ("a1", "a2", "a3", "a7", "a8")}
    octant = {c: ["bu_plus"] for c in (2, 4, 5, 6, 8)}
    line["a5"] = achromats(magnets, "a5", 9, "qa", "bo", ("ne", "e"), octant)
    for arc, near, weak in (("a4", "", "bc"), ("a6", "e", "bs")):
        # a closed bump: neither the orbit nor the dispersion leaves it
        bump = [f"{weak}_plus", f"{weak}_minus", f"{weak}_minus", f"{weak}_plus"]
        place = f"{arc}_j"
        names = numbered(arc, 4)
        line[arc] = [
            *achromats(magnets, arc, 2, "qe", "be", (near, ""), {1: bump}),
            *straight(magnets, place, JUNCTION, names, bpms=(1,), lead=0.3, tail=CELL_SPACE),
            *fodo_arc(magnets, arc, 11, five),
        ]
    return {arc: [Marker(eid=arc), *elements] for arc, elements in line.items()}


def cut(line, position):
    """Cut a line in two at `position` metres, which must lie in a drift."""
    end = 0.0
    for i, element in enumerate(line):
        start, end = end, end + element.l
        if end > position:
            head, rest = drift(position - start), drift(end - position)
            return [*line[:i], *head], [*rest, *line[i + 1 :]]
    raise ValueError(f"the line ends before {position} m")


def build(strengths, lengths):
    """The ring as a list of elements in beam order."""
    magnets = Families(strengths)
    arc, between = arcs(magnets), straights(magnets, lengths)
    first, second = cut(between["sw"], lengths["sw"] / 2)
    line = list(second)
    for place, number in zip(("w", "nw", "n", "ne", "e", "se", "s"), range(1, 8), strict=True):
        line += [*arc[f"a{number}"], *between[place]]
    return [*line, *arc["a8"], *first]


ring = build(STRENGTHS, LENGTHS)
