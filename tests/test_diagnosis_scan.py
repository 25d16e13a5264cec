"""The scan and its ingredients against explicit algebra, simulation and finite changes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from tmlattice.beam.model import Model
from tmlattice.diagnosis.findings import sensitivity
from tmlattice.effects import CATALOGUE, Cause
from tmlattice.inference import scan as scanning
from tmlattice.inference.alternatives import linear_evidence
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import fit
from tmlattice.inference.whitening import Projection
from tmlattice.machine import simulate
from tmlattice.observe.data import Whitening, of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.noise import estimate

SETTINGS = [
    {"hcor_sw_4": {"kick": 1e-4}},
    {},
    {"hcor_sw_4": {"kick": 1e-4}, "qd::4": {"k1_relative": 0.02}},
]


class Base:
    """A measurement of petra3 with its launches fitted."""

    def __init__(self, ring, causes, settings=SETTINGS, seed=2, **options):
        simulation = simulate(
            ring,
            causes,
            shots=len(settings),
            settings=settings,
            engine="ocelot",
            seed=seed,
            **options,
        )
        self.data = of_measurement(ring, simulation.measurement())
        self.model = Model(ring, self.data.settings)
        self.hypotheses = [h for h in self.model.hypotheses() if h[0] != "monitor_dead"]
        self.problem = FirstTurns(model=self.model, data=self.data, places={})
        self.whitening = self.problem.whitening
        self.fit = fit(self.problem, (), self.data.launches)
        self.metric = self.problem.metric(self.fit.point)

    def scan(self, hypotheses=None, **options):
        return scanning.scan(
            self.metric, hypotheses or self.hypotheses, self.fit.residual, **options
        )

    def rows(self, hypotheses):
        signatures = self.model.signatures(self.fit.point.view, hypotheses, self.fit.nuisances)
        return self.fit.projection.out(self.whitening.signature(np.nan_to_num(signatures)))


@pytest.fixture(scope="module")
def base(petra3):
    return Base(petra3, [Cause("quadrupole_gradient", "qd::12", -0.05)])


def test_sums_behind_each_place_equal_explicit_signatures(base):
    """The fast scan of every effect against its signatures written out, settings included."""
    found = base.scan(effective=1000.0)
    random = np.random.default_rng(3)
    chosen = [
        index
        for name in CATALOGUE
        for members in [[i for i, h in enumerate(base.hypotheses) if h[0] == name]]
        if members
        for index in random.choice(members, min(3, len(members)), replace=False)
    ]
    chosen += [base.hypotheses.index(("corrector_calibration", "hcor_sw_4"))]
    rows = base.rows([base.hypotheses[i] for i in chosen])
    clean = base.fit.projection.out(base.fit.residual)
    for index, row in zip(chosen, rows, strict=True):
        if found.information[index] == 0:
            continue
        assert found.information[index] == pytest.approx(row @ row, rel=1e-6)
        assert found.statistic[index] == pytest.approx(
            (row @ clean) ** 2 / (row @ row), abs=1e-6, rel=1e-6
        )
    assert np.count_nonzero(found.information[chosen]) > 50


def test_free_kicks_and_free_monitors_equal_explicit_least_squares(base):
    kicks = scanning.scan_kicks(base.metric, [5, 700, 1400], base.fit.residual)
    clean = base.fit.projection.out(base.fit.residual)
    for i, layer in enumerate([5, 700, 1400]):
        kicked = base.model.kick_signatures(base.fit.point.view, np.array([layer]))[0]
        alone = np.zeros((3, *kicked.shape))
        for shot in range(3):
            alone[shot, :, shot] = kicked[:, shot]
        rows = base.fit.projection.out(base.whitening.signature(alone)).reshape(6, -1)
        best, *_ = np.linalg.lstsq(rows.T, clean, rcond=1e-6)
        assert kicks.statistic[i] == pytest.approx(best @ rows @ clean, rel=1e-5)
    shape = base.fit.point.view.readings.shape
    monitors = scanning.scan_monitors(base.metric, base.fit.residual)
    m = 100
    alone = np.zeros((6, *shape))
    for i, (shot, plane) in enumerate(np.ndindex(3, 2)):
        alone[i, shot, m, plane] = 1.0
    rows = base.fit.projection.out(base.whitening.signature(alone))
    best, *_ = np.linalg.lstsq(rows.T, clean, rcond=None)
    assert monitors.statistic[m] == pytest.approx(best @ rows @ clean, rel=1e-6)


def test_threshold_vs_simulated_noise(base):
    """The largest statistic of 400 draws of pure noise passes the 5 % threshold in 5 % of them."""
    some = base.hypotheses[::12]
    found = base.scan(some, seed=1)
    rows = base.rows(some)
    norm = np.einsum("hr,hr->h", rows, rows)
    seen = found.information > 0
    draws = np.random.default_rng(9).standard_normal((400, rows.shape[1]))
    largest = ((rows[seen] @ base.fit.projection.out(draws).T) ** 2 / norm[seen, None]).max(axis=0)
    share = np.mean(largest > found.threshold(0.05))
    assert 0.02 < share < 0.09  # three standard errors of 400 draws, and of N
    assert np.mean([found.p_value(t) < 0.5 for t in largest]) == pytest.approx(0.5, abs=0.12)


def test_every_statistic_of_noise_is_a_chi_square(petra3):
    """Without a fault each single statistic has one degree of freedom."""
    quiet = Base(petra3, [], seed=11)
    found = quiet.scan(effective=1.0)
    seen = found.statistic[found.information > 0]
    assert np.mean(seen) == pytest.approx(1.0, abs=0.35)  # thousands, but strongly correlated
    assert seen.max() < stats.chi2.isf(1e-7, 1)


def test_evidence_by_the_scan_differs_between_places_as_that_of_the_refits(small_ring):
    """A weak fault, so that the model is linear: the scan picks those that are refitted."""
    fault = Cause("quadrupole_gradient", "QD::5", 0.01)
    base = Base(small_ring, [fault], settings=[{}] * 3, amplitude=1e-4, noise=2e-6)
    problem = replace(base.problem, places={"quadrupole_gradient": 16})
    found = base.scan([("quadrupole_gradient", f"QD::{k}") for k in range(16)], effective=16.0)
    linear = linear_evidence(problem, found)
    seen = np.flatnonzero(found.statistic > 1.5)  # of what is not seen the scan knows no amount
    assert found.statistic[seen].max() > 10 * found.statistic[seen].min()
    refitted = [
        fit(problem, [Cause(*found.hypotheses[i], found.amount[i])], base.fit.nuisances)
        for i in seen
    ]
    away = np.array([one.log_evidence for one in refitted]) - linear[seen]
    assert np.ptp(away) < 0.05  # 0.002 was seen; half the logarithm of ten is 1.2


@pytest.mark.parametrize("name", ["energy_spread", "energy_offset", "radiation_loss_bends"])
def test_the_least_amount_that_is_seen_reaches_the_threshold(base, name):
    """Put into the model: of a spread the readings know the square."""
    found = base.scan(effective=100.0)
    judgement = Judgement()
    least = Cause(name, None, sensitivity(found, judgement)[name])
    launches = base.fit.nuisances
    change = base.model.readings(launches, [least]) - base.model.readings(launches)
    seen = base.fit.projection.out(base.whitening.signature(np.nan_to_num(change)))
    assert seen @ seen == pytest.approx(found.threshold(judgement.false_alarm), rel=0.01)


def test_noise_is_estimated_within_five_percent_despite_a_strong_fault(petra3):
    causes = [Cause("quadrupole_gradient", "qd::12", -0.2), Cause("monitor_swap", "bpm_a4_3", 1.0)]
    base = Base(petra3, causes, noise=(3e-5, 1.5e-5))
    blind = base.data
    start = fit(base.problem, (), blind.launches)
    assert estimate([(blind, start.point.view)]) == pytest.approx([3e-5, 1.5e-5], rel=0.05)


def test_projection_takes_out_what_a_launch_can_do(base):
    """A change of one shot's launch leaves nothing; the coordinates come back."""
    data, paths = base.data, base.fit.point.view
    free = Whitening(data.__class__(**{**vars(data), "launch_sigma": np.full((3, 5), np.inf)}))
    projection = Projection(free.launch(paths.launch))
    step = np.array([1e-5, 2e-6, -3e-5, 1e-6, 1e-5])
    rows = free.signature(np.einsum("srpc,c->srp", paths.launch, step))
    assert np.abs(projection.out(rows)).max() < 1e-9 * np.abs(rows).max()
    assert projection.coordinates(rows).reshape(3, 5) == pytest.approx(
        np.tile(step, (3, 1)), rel=1e-6
    )


def test_exactly_known_launches_have_no_directions(petra3):
    base = Base(petra3, [], launch_sigma=(0, 0, 0, 0, 0))
    assert base.whitening.launch(base.fit.point.view.launch).shape[2] == 0
    assert base.scan(base.hypotheses[:50], effective=1.0).statistic.max() < 40
