"""ThomX, a ring of strong sextupoles: chromaticities against AT's exact bends; healthy turns."""

from dataclasses import replace
from pathlib import Path

import machine_data
import pytest
from numpy.testing import assert_allclose

from tmlattice import Cause, diagnose, load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import MeasurementError
from tmlattice.machine.stored_beam import simulate_tunes, simulate_turns
from tmlattice.observe.tune_readings import chromaticity_uncertainty
from tmlattice.optics import off_momentum


@pytest.fixture(scope="module")
def thomx():
    return load_ring(Path(machine_data.__file__).parent / "thomx.m")


@pytest.mark.parametrize(("name", "least"), [("thomx", 0.5), ("australian_synchrotron", 0.3)])
def test_the_uncertainty_is_the_difference_to_ats_exact_bends(name, least):
    """Of gaps, and of gradients in bends."""
    ring = load_ring(Path(machine_data.__file__).parent / f"{name}.m")
    own = off_momentum(Chain.from_ring(ring, 6), ring.length).chromaticity
    read = simulate_tunes(ring, noise=(1e-5, 1e-3)).measured
    ats = read.chromaticity[0]
    assert_allclose(chromaticity_uncertainty(ring), abs(ats - own), atol=0.02)
    assert abs(ats - own)[1] > least
    assert diagnose(ring, read).verdict == "none"


def test_without_gaps_and_gradients_there_is_none(small_ring):
    assert_allclose(chromaticity_uncertainty(small_ring), 0.0, atol=1e-12)


def test_chromaticity_of_a_healthy_ring_is_no_fault(thomx):
    read = simulate_tunes(thomx, seed=1).measured
    assert diagnose(thomx, read).verdict == "none"


def test_a_gain_of_the_linear_model_alone_is_no_fault(thomx):
    """Orbits of millimetres in strong sextupoles: a displaced quadrupole was found, of ten usual
    errors, with which the full model's chi-square is ten times as large."""
    read = simulate_turns(thomx, background={"all": None}, amplitude=1e-3, seed=8).measured
    effects = ["quadrupole_gradient", "quadrupole_offset_x", "quadrupole_offset_y"]
    assert diagnose(thomx, read, effects=effects).verdict == "distributed"


def test_a_reversed_sextupole_is_still_seen(thomx):
    fault = Cause("sextupole_strength", "sx1::1", -2.0)
    found = diagnose(thomx, simulate_tunes(thomx, [fault], seed=1).measured)
    assert found.findings
    effects = [m.effect for m in found.findings[0].credible_set]
    assert "sextupole_strength" in effects


def test_a_chromaticity_that_no_error_explains_is_refused(thomx):
    read = simulate_tunes(thomx, shots=2, seed=1).measured
    values = read.chromaticity.copy()
    for value, words in ((-20.0, None), (-500.0, "a chromaticity of -500 in y")):
        values[1, 1] = value
        wrong = replace(read, chromaticity=values)
        if words is None:  # a ring without its sextupoles has as much
            assert diagnose(thomx, wrong).verdict != "none"
            continue
        with pytest.raises(MeasurementError, match=words):
            diagnose(thomx, wrong)


def test_chromaticity_of_slow_particles_is_per_momentum(tmp_path):
    """The maps have the energy dE / p0 c, which is beta times the momentum's deviation."""
    sequence = tmp_path / "slow.seq"
    sequence.write_text(
        "beam, particle=proton, energy=0.98;\n"
        "qf: quadrupole, l=0.5, k1=1.0; qd: quadrupole, l=0.5, k1=-1.0;\n"
        "b: sbend, l=1.0, angle=twopi/16; m: monitor; c: hkicker;\n"
        "cell: line=(m, qf, dr, b, dr, c, qd, dr, b, dr); dr: drift, l=0.5;\n"
        "ring: line=(8*cell);\nuse, sequence=ring;\n"
    )
    ring = load_ring(sequence)
    assert ring.beta < 0.4
    read = simulate_tunes(ring, noise=(2e-5, 0.01), seed=1).measured
    assert diagnose(ring, read).verdict == "none"
