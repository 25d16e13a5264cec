"""AT lattices that are MATLAB code: as AT writes them, and as people do."""

import at
import numpy as np
import pytest

from tmlattice import load_ring
from tmlattice.errors import LatticeError
from tmlattice.lattice.at_file import ring_from_at
from tmlattice.lattice.load import contents

M_FILE = """function ring = fodo()
%FODO  as atwritem writes it (2003)
ring = {...
atringparam('fodo', 3e9, 16);...
atmonitor('BPM');
atquadrupole('QF', 0.4, 1.1, 'StrMPoleSymplectic4Pass', ...
   'PolynomB', [0, 1.1, 0], 'MaxOrder', 2);... % strong (1.1)
atdrift('D1', 0.5);
atsbend('BB', 1.0, pi/8, 0.0, 'BndMPoleSymplectic4Pass');...
%atdrift('D1', 0.5);...
atdrift('D1', 0.5);...
atquadrupole('QD', 0.4, -1.15, 'StrMPoleSymplectic4Pass');...
atdrift('D1', 0.5);...
};
end
"""

AT_2 = """
QF = atquadrupole('QF', 0.4, 1.1, 'StrMPoleSymplectic4Pass');
QD = atquadrupole('QD', 0.4, -1.15, 'StrMPoleSymplectic4Pass');
D1 = atdrift('D1', 0.5);  M = atmonitor('BPM');
BB = atsbend('BB', 1.0, pi/8, 0, 'BndMPoleSymplectic4Pass');
R = atringparam('fodo', 3e9, 16);
"""
AT_1 = """
global FAMLIST THERING GLOBVAL
GLOBVAL.E0 = 3e9;  GLOBVAL.LatticeFile = mfilename;
FAMLIST = cell(0);
disp(['   Loading ' mfilename]);
QF = quadrupole('QF', 0.4, 1.1, 'StrMPoleSymplectic4Pass');
QD = quadrupole('QD', 0.4, -1.15, 'StrMPoleSymplectic4Pass');
D1 = drift('D1', 0.5, 'DriftPass');  M = marker('BPM', 'IdentityPass');
BB = sbend('BB', 1.0, 2*pi/16, 0, 0, 0, 'BndMPoleSymplectic4Pass');
"""
CELL = "[{R}; {M}; {QF}; {D1}; {BB}; {D1}; {QD}; {D1}]"
STRUCT = "struct('FamName', 'QF', 'Length', 0.4, 'PassMethod', 'StrMPoleSymplectic4Pass', ..."
STRUCT += "\n  'PolynomA', [0 0], 'PolynomB', [0 1.1], 'MaxOrder', 1, 'NumIntSteps', 10)"


def function(code, head="ring = fodo()", elements=AT_2, ring=f"ring = {CELL};"):
    return f"function {head}\n{elements}{code}\n{ring}\nend\n"


CODE = {
    "as atwritem writes it": M_FILE,
    "cells": function("", ring="ring = {R; M; QF; D1; BB; D1; QD; D1};"),
    "cells in a row, transposed": function("", ring="ring = {R, M QF D1 BB, D1 QD D1}.';"),
    "rows on lines": function("", ring="ring = [\n {R; M}\n\n {QF}\n {D1;BB; D1}; {QD}\n {D1}];"),
    "no end": function("").removesuffix("end\n"),
    "carriage returns": function("").replace("\n", "\r\n"),
    "double quotes": function("").replace("'", '"'),
    "a block comment": function("%{\n ring = { ' [\n%}"),
    "a script": AT_2 + f"ring = {CELL};\nclear M\n",
    "a script with other lists": AT_2 + f"half = {{M; QF}};\nRING = {CELL};\n",
    "periods written out": function(
        "c = {M; QF; D1; BB; D1; QD; D1}; R.Periodicity = 1;",
        ring="ring = [{R}; repmat(c, 16, 1)];",
    ),
    "periods in a loop": function(
        "c = {M; QF; D1; BB; D1; QD; D1}; R.Periodicity = 1; ring = {R};",
        ring="for k = 1:16\n ring = [ring; c];\nend",
    ),
    "elements in a loop": function(
        "c = {M QF D1 BB D1 QD D1}; ring = {R};",
        ring="for k=1:numel(c), ring{end+1} = c{k}; end",
    ),
    "a line from its mirror image": function(
        "c = {D1 QD D1 BB D1 QF M};", ring="ring = [{R} flip(c)];"
    ),
    "parts of lines": function(
        f"c = {CELL};", ring="c = {c{1:2} QD c{3:end}}; c(3) = []; ring = [c(1:4) c(5:end)];"
    ),
    "fields by name": function(
        "QF = atquadrupole('QF', 'K', 1.1, 'Length', 0.4);\n"
        "BB = atsbend('BB', 1, 'BendingAngle', pi/8, 'PassMethod', 'BndMPoleSymplectic4Pass');"
    ),
    "fields afterwards": function(
        "QF.PolynomB(2) = 0.7; QF.('K') = 1.1; QF.('PolynomB')(2) = QF.K;"
        " D1.Length = QF.Length + 0.1;"
    ),
    "fields of a list": function(
        f"c = {CELL}; c{{3}}.FamName = 'x'; c{{3}}.Length = .1;\n"
        "c = atsetfieldvalues(c, findcells(c, 'FamName', 'x'), 'Length', 0.4);\n"
        "c = setcellstruct(c, 'FamName', 3, 'QF'); c = setcellstruct(c, 'PolynomB', 3, 1.1, 1, 2);",
        ring="ring = c;",
    ),
    "structures": function(f"QF = {STRUCT};"),
    "elements of no class of AT's own": function(
        "QF = atbaselem('QF', 'StrMPoleSymplectic4Pass', 'Length', 0.4, 'PolynomB', [0 1.1], ...\n"
        "  'PolynomA', [0 0], 'MaxOrder', 1, 'NumIntSteps', 10);\n"
        "M = atbaselem('BPM', 'IdentityPass', 'Class', 'Monitor');"
    ),
    "structures by their fields": function(
        "D1 = []; D1.FamName = 'D1'; D1.PassMethod = 'DriftPass'; D1.Length = 0.5;"
    ),
    "a strength beside a sextupole field": function(
        "QF = atquadrupole('QF', 0.4, 1.1, 'PolynomB', [0 0 0]);"
    ),
    "arithmetic": function(
        "k = [1.1 -2.3/2]; l.q = .8/2; l.b = -(-1)^2 + 2;\n"
        "QF = atquadrupole('QF', l.q, k(1)); QD = atquadrupole('QD', l.q, k(end));\n"
        "BB = atsbend('BB', l.b, abs(-pi/4)/2, 0*k(2), 'BndMPoleSymplectic4Pass');"
    ),
    "conditions": function(
        "if nargin < 1, mode = 'M1'; else mode = 'M2'; end\n"
        "if (strcmp(mode, 'M2')) QF = D1; elseif ~isempty(mode) && 2 > 1\n QD.K = -1.15; end\n"
        "switch mode\n case {'M0', 'M2'}\n  QF = D1;\n case 'M1'\n  QF.PolynomB(2) = 1.1;\n end",
        head="ring = fodo(mode)",
    ),
    "a function of the file": function("QF = quad('QF', 1.1);")
    + "function q = quad(name, k)\n q = atquadrupole(name, 0.4, k);\nend\n",
    "statements of no effect": function(
        "figure; plot(1:3); hold on; t = tunechrom(D1); [a, ~] = other(t, @(x) x); s = 'a''b';"
    ),
    "names that are numbered": function("for k=1:1, QF.FamName = ['Q' 'F']; end"),
    "ring properties": function(
        f"c = {CELL};",
        ring="ring = atSetRingProperties(c(2:8), 'Energy', 3e9, 'Periodicity', 16);",
    ),
    "ring properties without periods": function(
        "R = atringparam('fodo', 3e9); R.Periodicity = 1;",
        ring=f"c = {CELL}; ring = [{{R}}; repmat(c(2:8), 16, 1)];",
    ),
    "energy of elements": function(
        "", ring=f"c = {CELL}; ring = atsetfieldvalues(c(2:8), 'Energy', 3e9);"
    ),
    "of AT 1": function("", "fodo", AT_1, "ELIST = [M QF D1 BB D1 QD D1];\nbuildlat(ELIST');"),
    "of AT 1, element by element": function(
        "ELIST = [D1 QD D1 BB D1 QF M];", "fodo", AT_1,
        "ELIST = reverse(ELIST);\nTHERING=cell(size(ELIST));\nfor i=1:size(ELIST, 2)\n"
        "  THERING{i} = FAMLIST{ELIST(i)}.ElemData;\n"
        "  FAMLIST{ELIST(i)}.NumKids=FAMLIST{ELIST(i)}.NumKids+1;\n"
        "  FAMLIST{ELIST(i)}.KidsList = [FAMLIST{ELIST(i)}.KidsList i];\nend\n"
        "THERING = setcellstruct(THERING,'Energy',1:length(THERING),GLOBVAL.E0);",
    ),
    "of AT 1, as a Middle Layer's": function(
        "HALF = [D1 QD D1 BB];", "varargout = fodo", AT_1,
        "ELIST = [M QF reverse(HALF(2:4)) QD D1];\nELIST(3:5) = [D1 BB D1];\nbuildlat(ELIST);\n"
        "THERING = setcellstruct(THERING, 'Energy', 1:length(THERING), GLOBVAL.E0);\n"
        "L0 = findspos(THERING, length(THERING)+1);\nfprintf('   L0 = %.6f m\\n', L0);\n"
        "evalin('caller', 'global THERING FAMLIST GLOBVAL');\natsummary;\n"
        "if nargout\n    varargout{1} = THERING;\nend",
    ),
}  # fmt: skip


def read(folder, text, **options):
    path = folder / "fodo.m"
    path.write_bytes(text.encode())
    return load_ring(path, **options)


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return read(tmp_path_factory.mktemp("known"), M_FILE)


def test_list_of_elements(known):
    assert known.length == pytest.approx(16 * 3.3)
    assert known.counts()["quadrupole"] == 32
    assert (known["qf::0"].k1, known["bb::0"].angle, known.energy) == (1.1, np.pi / 8, 3.0)


@pytest.mark.parametrize("what", CODE)
def test_code_gives_the_ring_that_it_means(tmp_path, known, what):
    assert contents(read(tmp_path, CODE[what])) == contents(known)


STR, BND = "'StrMPoleSymplectic4Pass'", "'BndMPoleSymplectic4Pass'"
EDGES = {"EntranceAngle": 0.05, "ExitAngle": 0.05}
SKEW, MULTIPOLE = at.Multipole("e", 0.2, [0, 0.3], [0, 0]), at.Multipole("e", 0.2, [0, 3], [0, 2])
MADE = {
    "atskewquad('E', 0.2, 0.3)": SKEW,
    f"skewquad('E', 0.2, 0.3, {STR})": SKEW,
    "atrbend('E', 1, 0.1, -0.4)": at.Dipole("e", 1.0, 0.1, -0.4, **EDGES),
    f"sbend('E', 1, 0.1, 0.05, 0.05, -0.4, {BND})": at.Dipole("e", 1.0, 0.1, -0.4, **EDGES),
    f"sextupole('E', 0.2, 12, {STR})": at.Sextupole("e", 0.2, 12.0),
    f"multipole('E', 0.2, [0 3], [0 2], {STR})": MULTIPOLE,
    f"atmultipole('E', 0.2, [0 3], [0 2], {STR})": MULTIPOLE,
    "atthinmultipole('E', [0 0.1], [0; 0.2])": at.ThinMultipole("e", [0, 0.1], [0, 0.2]),
    "atcorrector('HCM', 0.1, [1e-4 0])": at.Corrector("hcm", 0.1, [1e-4, 0.0]),
    "corrector('HCM', 0.1, [0 0], 'CorrectorPass')": at.Corrector("hcm", 0.1, [0.0, 0.0]),
    "solenoid('E', 0.3, 0.2, 'SolenoidLinearPass')": at.Element(
        "e", Length=0.3, K=0.2, PassMethod="SolenoidLinearPass"
    ),
    "atsolenoid('E', 0.3, 0.2)": at.Element(
        "e", Length=0.3, K=0.2, PassMethod="SolenoidLinearPass"
    ),
    "aperture('E', [-1 1 -1 1], 'AperturePass')": at.Aperture("e", [-1, 1, -1, 1]),
    "rfcavity('E', 0.2, 1e6, 5e8, 100, 'CavityPass')": at.RFCavity("e", 0.2, 1e6, 5e8, 100, 3e9),
    "atM66('E', diag([2 1/2 2 0.5 1 1]))": at.M66("e", np.diag([2, 0.5, 2, 0.5, 1, 1])),
    "atwiggler('E', 0.6, 0.1, 1, 3e9)": at.Wiggler("e", 0.6, 0.1, 1.0),
    f"atbaselem('E', {STR}, 'Length', 0.2, 'PolynomA', [0 3], 'PolynomB', [0 2])": MULTIPOLE,
}


@pytest.mark.filterwarnings("ignore:.*left out of the model")
@pytest.mark.parametrize("call", MADE)
def test_an_element_is_made_as_by_at(tmp_path, call):
    ring = read(tmp_path, function(f"ring = {{R; {call}}};", ring=""))
    known = ring_from_at(at.Lattice([MADE[call].deepcopy()], energy=3e9, periodicity=16), "x")
    assert contents(ring) == contents(known)
    for one, other in zip(ring.elements, known.elements, strict=True):
        for r, other_r in zip(one.source.R(3.0), other.source.R(3.0), strict=True):
            np.testing.assert_allclose(r, other_r, rtol=0, atol=1e-12)


def test_a_ring_without_an_energy_takes_the_given_one(tmp_path):
    code = f"c = {CELL}; ring = [c(2:8); {{atrfcavity('RF')}}];"
    with pytest.raises(LatticeError, match="states no beam energy; give energy="):
        read(tmp_path, function("", ring=code))
    assert read(tmp_path, function("", ring=code), energy=2.0).energy == 2.0


def test_cavities_are_set_to_a_voltage_and_a_harmonic(tmp_path):
    code = f"c = {CELL}; RF = atrfcavity('RF'); ring = atsetcavity([c(1:2); {{RF; RF}}; c(3:8)],"
    ring = read(tmp_path, function("", ring=f"{code} 5e5, 0, 11);"))
    cavities = [e.source for e in ring.elements if e.kind == "cavity"]
    assert len(cavities) == 32
    assert cavities[0].v == pytest.approx(2.5e-4)  # GV
    assert cavities[0].freq == pytest.approx(11 * 299792458 / 3.3)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("QD = atway('D');", r"line 8, 'QD = atway\('D'\);': 'atway' is no variable, and no func"),
        ("while k < 3, QD = D1; end", "line 8, .*'while' is not read; write the ring with AT's"),
        ("QD = atsbend('B2', 1, pi/8, 'BndMPoleSymplectic4Pass');", "the K of 'B2' is a text"),
        ("QD = atquadrupole('Q2', 0.4, [0 1.1]*2);", "line 8, .*the K of 'Q2' is no number"),
        ("QD = atquadrupole('Q2', 0.4, 1, 'PolynomB', [0 2]);", "K 1 and in PolynomB 2; MATLAB's"),
        ("QD = atdrift('D', 0.4, 3, 'K');", "'atdrift' has the arguments Length, PassMethod, then"),
        ("k = 2^3^2; QD.Length = k;", "line 8, .*a power of a power needs brackets"),
        ("QD = rbend3('B', 1, 0.1, 0, 0, 0, 0.1, 1, 1, 'BendLinearPass');", "'rbend3' is no var"),
        ("QD.Length = missing(3); D1 = D1;", "line 8, 'QD.Length = missing.*: 'missing' is no var"),
        ("QD = D1(;", "line 8, 'QD = D1.;': a bracket is left open"),
        ("QD = 'D1;", "line 8, .*: a text does not end"),
        ("QD = cellfun(@(x) x, D1);", r"line 8, 'QD = cellfun\(@\(x\) x, D1\);': it is not read"),
        ("if any(tunes(QD) > 1), QD = D1; end", "line 8, .*is no variable, and no function that"),
        ("for k = 1:1e9, QD = D1; end", "a variable has 1e.09 items; no ring has as many"),
        ("QD = {D1 D1}; R = 3;", "'ring' is no list of AT's elements; lists are"),
    ],
)
def test_a_statement_that_is_not_read_is_named(tmp_path, code, message):
    with pytest.raises(LatticeError, match=message):
        read(tmp_path, function(code))


def test_an_element_of_a_long_list_is_named_by_its_line(tmp_path):
    text = M_FILE.replace("atdrift('D1', 0.5);\na", "atway('D');\na", 1)
    with pytest.raises(LatticeError, match=r"line 8, 'atway\('D'\);': 'atway' is no variable"):
        read(tmp_path, text)


def test_the_ring_of_several_lists_is_chosen_by_its_name(tmp_path, known):
    text = AT_2 + f"one = {CELL};\nother = {{M; QF; D1}};\n"
    with pytest.raises(LatticeError, match=r"no variable is the list of .*; lists are one, other"):
        read(tmp_path, text)
    assert contents(read(tmp_path, text, sequence="one")) == contents(known)
