"""The result of a diagnosis: findings with alternatives, amounts with errors, the gap, the file
format."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from tmlattice.arrays import Array, rms
from tmlattice.diagnosis.assessment import Assessment, Block
from tmlattice.diagnosis.consequences import Consequences
from tmlattice.diagnosis.recommended_actions import RecommendedAction, compensated
from tmlattice.diagnosis.records import HIDDEN, OPTIONAL, named, of, record_of
from tmlattice.diagnosis.support import FREE, Correlation, Support, share_of_fault
from tmlattice.diagnosis.tables import Tables
from tmlattice.diagnosis.views import PartView, ResponseView, TrajectoryView
from tmlattice.effects import Cause, Settings, apply, is_energy
from tmlattice.errors import MeasurementError
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.search import Explanation
from tmlattice.inference.validation import Gap, Misfit
from tmlattice.late import ClassMethod, Method
from tmlattice.lattice import Ring
from tmlattice.observe.calibration import CALIBRATES, Dispersion
from tmlattice.speaks import Speaks, last_part

if TYPE_CHECKING:
    from tmlattice.diagnosis.response.common_factors import CommonFactors
    from tmlattice.diagnosis.response.inconsistencies import Inconsistency
    from tmlattice.diagnosis.response.missing_effects import Weighed
    from tmlattice.diagnosis.response.validation import Step
    from tmlattice.diagnosis.suspects import Suspect

VERDICTS = ("identified", "ambiguous", "localised", "distributed", "none")
"""Verdicts from the most certain to the least."""


MOST = 4
"""Findings in the line of a diagnosis, and outliers in a warning."""


@dataclass(frozen=True)
class Member:
    """One explanation in a credible set.

    Attributes:
        effect, element, amount: see `Cause`.
        s: middle of the element, m.
        probability: of this explanation alone.
        recommended_action: the correction, in words.
        device: what the control system calls the element; None: unknown.
    """

    effect: str
    element: str | None
    s: float | None
    probability: float
    amount: float
    recommended_action: str
    device: str | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True, repr=False, kw_only=True)
class Finding(Speaks):
    """One error, or one localised but unexplained deviation.

    Attributes:
        effect, element: None where something is there and the catalogue does not explain it, and
            (the element) for the beam and for effects of all elements of a kind.
        s: middle of the element, m from the start of the sequence.
        amount, amount_sigma: in the effect's unit.
        unit: of the amount.
        probability: of its recommended action, given that one of the catalogue is there.
        detection: how clearly it was seen.
        where: from the last monitor before to the first one behind all members of the set, m.
        near: the names of those monitors.
        credible_set: explanations that the data do not exclude, the first is this finding.
        mass: the sum of their probabilities.
        recommended_actions: its correction, then the alternatives in the credible set; empty
            without an effect.
        consequences: its effect on the stored beam, before and after the correction.
        seen_by: share of each measurement in what is known of its amount, where there are several.
        words, to_check, elements: what it is, what to look at, and which elements it is of, where
            that is known and no effect of the catalogue is it; else empty.
        device: what the control system calls the element; None: unknown.
        devices: the same of `elements` and `near`, by name.
    """

    effect: str | None = None
    element: str | None = None
    s: float | None
    amount: float | None = None
    amount_sigma: float | None = None
    unit: str | None = None
    probability: float = 1.0
    detection: Detection
    where: tuple[float, float] | None = field(metadata=of("s_from", "s_to"))
    near: tuple[str, ...]
    credible_set: tuple[Member, ...] = ()
    mass: float = 0.0
    recommended_actions: tuple[RecommendedAction, ...] = ()
    consequences: Consequences | None = None
    seen_by: Mapping[str, float] | None = field(default=None, metadata=OPTIONAL)
    words: str = ""
    to_check: str = ""
    elements: tuple[str, ...] = ()
    device: str | None = field(default=None, metadata=OPTIONAL)
    devices: Mapping[str, str] = field(default_factory=dict, metadata=OPTIONAL)

    def _told(self) -> tuple[str, dict[str, str]]:
        place = "" if self.where is None else f"{self.where[0]:.1f} m to {self.where[1]:.1f} m"
        return self.in_short, {"place": place, "probability": f"{self.probability:.3g}"}

    @property
    def in_short(self) -> str:
        """Effect, element and amount, as the catalogue names them; else the finding's words."""
        if self.words:
            return self.words
        what = " ".join(word for word in (self.effect or "no known effect", self.element) if word)
        if self.amount is None:
            return what
        error = "" if self.amount_sigma is None else f" ± {self.amount_sigma:.2g}"
        return f"{what} {self.amount:.4g}{error} {self.unit or ''}".rstrip()

    @property
    def label(self) -> str:
        """The element, or the place, for short labels."""
        return self.element or ", ".join(self.elements) or "unnamed"

    @property
    def verdict(self) -> str:
        """Of this finding alone: `ambiguous` where recommended actions differ."""
        if self.effect is None:
            return "localised"
        return "identified" if len(self.recommended_actions) == 1 else "ambiguous"

    @property
    def recommended_action(self) -> RecommendedAction | None:
        """The most probable recommended action."""
        return self.recommended_actions[0] if self.recommended_actions else None

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        own = record_of(self)
        if not self.words:
            del own["words"], own["to_check"], own["elements"]
        first, *others = own.pop("recommended_actions") or [None]
        return own | {
            "share_from_data": share_of_fault(self.effect, self.amount_sigma),
            "recommended_action": first,
            "alternative_actions": others,
        }


@dataclass(frozen=True)
class NextMeasurement:
    """A recommended measurement, and its separation.

    Attributes:
        launch: x, px, y, py, delta of one more shot; None of another kind of measurement.
        settings: of the shot.
        parts: the two hypotheses, as texts.
        separation: between them, in standard deviations.
        kind: of measurement.
        minutes: of machine time that it takes; None of a shot.
    """

    launch: dict[str, float] | None
    settings: Settings
    parts: tuple[str, str] = field(metadata=named("between"))
    separation: float = field(metadata=named("separation_sigma"))
    kind: str = "trajectory"
    minutes: float | None = field(default=None, metadata=OPTIONAL)

    def as_json(self) -> dict[str, object]:
        """The entry in the file of the diagnosis."""
        own = record_of(self)
        if self.minutes is None:
            del own["kind"]
        return own


def faults_of(findings: Sequence[Finding], causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """The causes, those of findings as their recommended actions name them."""
    named = {
        (f.effect, f.element): f.recommended_action.cause
        for f in findings
        if f.recommended_action is not None
    }
    return tuple(named.get((cause.effect, cause.element), cause) for cause in causes)


@dataclass(frozen=True, repr=False)
class Diagnosis(Speaks):
    """The result of a diagnosis. See `as_json` for the file format.

    Attributes:
        kind: of measurement, as its folder has it; "together" of several.
        verdict: the least certain of the findings', see `VERDICTS`.
        findings: by falling statistic.
        fit_before, fit_after: misfit of the readings of the fit.
        heldout: of held-out readings, before, each finding or step added, after; or None.
        heldout_shots: their ids, of trajectories.
        unexplained: p-value of the residual, its places and patterns (orbit response).
        tunes: fractions of Qx, Qy of the design and of the ring with the causes; None: unstable.
        next: the shot that separates the most probable alternatives, or None.
        sensitivity: by effect, the detection limit at half of its places.
        warnings: messages.
        outliers: single readings that the search rejected: shot, turn, monitor, plane.
        noise: rms of a reading, m, (x, y).
        noise_estimated: whether it comes from the data.
        provenance: package, lattice, options as used, seed, seconds.
        ring: the design.
        corrected: the estimated ring: the design with the identified causes
            in it; monitors and correctors are in `calibration`. See `as_found` and `repair`.
        causes: of ring, beam, correctors and monitors.
        errors: standard error of each one's amount, the same length.
        view: what figures need: of a stored beam's measurements, or of several together, the
            search; None after loading.
        measured: quantities of the stored beam that were measured.
        parts: the measurements, where there are several or a stored beam's.
        correctors_held_out: how many correctors of an orbit response are the validation set; None
            of another kind.
        steps: scores of the design, of the hierarchical fit, and of those given faults.
        families: of a hierarchical fit, the scores with the decision on each family reversed.
        bad_monitors: names of the rejected BPMs.
        priors: rms of distributed errors, learnt or stated, by family.
        prior_errors: relative error of those that were learnt; above one half the readings hardly
            see the family.
        degenerate: what the data alone do not determine, in words.
        common_factors: of the gradients of a hierarchical fit; None where none were fitted.
        inconsistencies: of the RF's orbit and the correctors' responses, or None.
        hypotheses: effects that may be missing, with scores; None: not tested.
        suspects: first places to inspect for an undetected fault.
        dispersion: additional to that of the estimated ring, for `write_calibration`.
        rejected_channels: those that the model cannot describe: (monitor, "x" or "y"), or
            (corrector, None).
        compared: blocks of readings with their prediction by the result.
        correlations: pairs of amounts that the data hardly separate.
        covariance: of the amounts of the causes, [cause, cause]; None where none is stated, as of
            many changes between two orbit responses, and after loading. See `tables`.
        devices: what the control system calls elements, by their names.
        supports: how much of each cause comes from the data, the same length; empty where all do,
            because their priors are log-uniform.
    """

    kind: str
    verdict: str
    findings: tuple[Finding, ...]
    fit_before: Misfit = field(metadata=HIDDEN)
    fit_after: Misfit = field(metadata=HIDDEN)
    heldout: Gap | None = field(metadata=HIDDEN)
    heldout_shots: tuple[int, ...] = field(metadata=HIDDEN)
    unexplained: dict[str, Any]
    tunes: dict[str, list[float] | None]
    next: NextMeasurement | None = field(metadata=named("next_measurement"))
    sensitivity: dict[str, float]
    warnings: tuple[str, ...]
    noise: tuple[float, float] = field(metadata=HIDDEN)
    noise_estimated: bool = field(metadata=HIDDEN)
    provenance: dict[str, Any]
    ring: Ring = field(repr=False, metadata=HIDDEN)
    corrected: Ring = field(repr=False, metadata=HIDDEN)
    causes: tuple[Cause, ...] = field(metadata=HIDDEN)
    errors: tuple[float, ...] = field(metadata=HIDDEN)
    view: TrajectoryView | ResponseView | Explanation | None = field(repr=False, metadata=HIDDEN)
    measured: tuple[str, ...] = field(metadata=HIDDEN)
    parts: tuple[PartView, ...] = field(default=(), metadata=OPTIONAL | named("measurements"))
    correctors_held_out: int | None = field(default=None, metadata=HIDDEN)
    outliers: tuple[dict[str, Any], ...] = ()
    steps: "tuple[Step, ...]" = ()
    families: "tuple[Step, ...]" = ()
    bad_monitors: tuple[str, ...] = ()
    priors: Mapping[str, float] = field(default_factory=dict)
    prior_errors: Mapping[str, float] = field(default_factory=dict)
    degenerate: tuple[str, ...] = ()
    common_factors: "CommonFactors | None" = None
    inconsistencies: "Inconsistency | None" = None
    hypotheses: "tuple[Weighed, ...] | None" = None
    suspects: "tuple[Suspect, ...]" = ()
    dispersion: Dispersion = field(default_factory=dict, repr=False, metadata=HIDDEN)
    rejected_channels: tuple[tuple[str, str | None], ...] = field(
        default=(), metadata=of("element", "plane")
    )
    compared: tuple[Block, ...] = field(default=(), metadata=HIDDEN)
    correlations: tuple[Correlation, ...] = ()
    devices: Mapping[str, str] = field(default_factory=dict, metadata=OPTIONAL)
    supports: tuple[Support, ...] = field(default=(), metadata=HIDDEN)
    covariance: Array | None = field(default=None, repr=False, metadata=HIDDEN)

    report = Method("tmlattice.report.plain", "report_text", "The report as plain text.")
    save = Method(
        "tmlattice.report.speaking",
        "save",
        "Write report.html, report.txt, diagnosis.json and the figures into a folder.",
    )
    load = ClassMethod(
        "tmlattice.diagnosis.load",
        "load",
        "Return the diagnosis of a folder of `save`, or of a diagnosis.json.",
    )
    plot = Method(
        "tmlattice.plots.speaking",
        "plot_diagnosis",
        "Draw the scan along the ring, or the figure of this name: a matplotlib Figure.",
    )

    def _told(self) -> tuple[str, dict[str, str]]:
        explained = None if self.heldout is None else self.heldout.explained
        rows = {"of": f"{self.kind} of {last_part(self.ring.name)}"}
        for number, finding in enumerate(self.findings[:MOST], 1):
            rows[f"finding {number}"] = finding.in_short
        if len(self.findings) > MOST:
            rows["and"] = f"{len(self.findings) - MOST} more"
        rows["gap explained"] = "" if explained is None else f"{100 * explained:.1f} %"
        return self.verdict, rows

    @property
    def tables(self) -> Tables:
        """The result as pandas DataFrames by name: `diagnosis.tables["errors"]`; see `Tables`."""
        return Tables(self)

    @cached_property
    def assessment(self) -> Assessment:
        """Whether the remainder is noise, a gap is explained, an effect is missing: each once."""
        return Assessment(
            self.verdict,
            self.compared,
            self.heldout,
            amounts=len(self.steps) > 1 if self.by_families else bool(self.causes or self.priors),
            findings=bool(self.findings),
            places=self.unexplained["places"],
            noise_estimated=self.noise_estimated,
            families=self.by_families,
            rejected=[own.effect for own in self.families if not own.kept],
            small_errors=bool(self.priors) and not self.by_families,
            reference=self.has_reference,
            change=self.since_reference,
            measured=self.measured,
            model=self.starting_model,
            false_alarm=self.provenance["options"].get("false_alarm", DEFAULT.false_alarm),
        )

    @property
    def supported(self) -> "tuple[tuple[Cause, float, Support], ...]":
        """The causes, with their errors and how much of each comes from the data."""
        supports = self.supports or (FREE,) * len(self.causes)
        return tuple(zip(self.causes, self.errors, supports, strict=True))

    @property
    def by_families(self) -> bool:
        """Whether families of errors were fitted together, as to an orbit response."""
        return self.kind == "orbit_response"

    @property
    def stored(self) -> bool:
        """Whether it is of `Diagnosis.load`, without readings, scan and covariance."""
        return self.view is None

    @property
    def since_reference(self) -> bool:
        """Whether the result is a change from an earlier measurement (except of trajectories)."""
        return self.kind != "trajectory" and self.has_reference

    @property
    def starting_model(self) -> str:
        """What the residuals before the findings are from: the reference, else the lattice."""
        return "reference" if self.since_reference else self.ring.model

    @property
    def has_reference(self) -> bool:
        """Whether a reference was given."""
        return bool(self.provenance["options"].get("reference"))

    @property
    def trajectories(self) -> TrajectoryView:
        """The view of trajectories; TypeError for another kind."""
        self._read()
        if not isinstance(self.view, TrajectoryView):
            raise TypeError(f"the diagnosis is of an {self.kind}, not of trajectories")
        return self.view

    @property
    def response(self) -> ResponseView:
        """The view of an orbit response; TypeError for another kind."""
        self._read()
        if not isinstance(self.view, ResponseView):
            raise TypeError(f"the diagnosis is of a {self.kind}, not of an orbit response")
        return self.view

    @property
    def explanation(self) -> Explanation:
        """The search, where there was one.

        Raises:
            TypeError: families of errors were fitted instead.
            MeasurementError: it was loaded from a file, which does not hold it.
        """
        self._read()
        if isinstance(self.view, TrajectoryView):
            return self.view.explanation
        if not isinstance(self.view, Explanation):
            raise TypeError("an orbit response has a hierarchical fit: there was no search")
        return self.view

    def _read(self) -> None:
        if self.stored:
            raise MeasurementError(
                "diagnosis.json does not hold the readings, the scan and the covariance: diagnose "
                "again, or keep a pickle of the diagnosis"
            )

    @property
    def calibration(self) -> tuple[Cause, ...]:
        """Gains and calibrations, for `write_calibration`."""
        bad = (Cause("monitor_dead", name, 1.0) for name in self.bad_monitors)
        own = [c for c in self.causes if c.effect in CALIBRATES]
        if (
            not self.by_families
        ):  # an energy that is a finding is matched by the RF, or the injector
            own = [c for c in own if not is_energy(c.effect)]
        # a hierarchical fit is of readings with swapped planes corrected
        swaps = (Cause(f.effect, f.element, 1.0) for f in self.findings
                 if f.effect == "monitor_swap" and self.by_families)  # fmt: skip
        return (*own, *swaps, *bad)

    def support(self, effect: str, element: str | None) -> Support:
        """How much of the amount of a cause comes from the data.

        Raises:
            KeyError: it is not among the causes.
        """
        return self._supported(effect, element)[2]

    def error(self, effect: str, element: str | None) -> tuple[float, float]:
        """Amount and standard error of a cause.

        Raises:
            KeyError: it is not among the causes.
        """
        cause, sigma, _ = self._supported(effect, element)
        return cause.amount, sigma

    def _supported(self, effect: str, element: str | None) -> tuple[Cause, float, Support]:
        for own in self.supported:
            if (own[0].effect, own[0].element) == (effect, element):
                return own
        raise KeyError((effect, element))

    @property
    def faults(self) -> tuple[Cause, ...]:
        """The causes, those of findings as their actions name them: a thin gradient that explains
        a quadrupole's is the quadrupole's own."""
        return faults_of(self.findings, self.causes)

    @property
    def as_found(self) -> Ring:
        """The estimated ring: the design with the faults in it."""
        faults = self.faults
        return self.corrected if faults == self.causes else apply(self.ring, faults)

    def repair(self) -> tuple[Ring, tuple[Cause, ...]]:
        """The design with the settings that correct the faults, and the causes that none corrects.

        In the present machine these settings restore the design: see
        `recommended_actions.compensated`.
        """
        return compensated(self.ring, self.faults)

    @property
    def gap(self) -> dict[str, Any]:
        """Residuals before and after, of fitted and of held-out readings.

        Where there are distributed errors and findings, before is with the distributed errors
        alone; the design's own is the first of the steps.
        """

        def both(before: Misfit, after: Misfit) -> dict[str, Any]:
            return {"before": dict(vars(before)), "after": dict(vars(after))}

        gap = self.heldout
        heldout = None
        if gap is not None:
            heldout = {
                **both(gap.misfits[gap.baseline], gap.misfits[-1]),
                "shots": list(self.heldout_shots),
                "monitors": "half" if self.by_families else "odd",
                "steps": [dict(vars(m)) for m in gap.misfits],
                "since": gap.baseline,
                "readings": gap.readings,
                "correctors": self.correctors_held_out,
                "lost": gap.lost,
            }
        return {
            "noise": rms(self.noise),
            "readings_noise": {
                "x": self.noise[0],
                "y": self.noise[1],
                "estimated": self.noise_estimated,
            },
            "fit": both(self.fit_before, self.fit_after),
            "heldout": heldout,
            # null without amounts in the model
            "explained": gap and gap.explained,
            "explained_interval": gap and gap.interval and list(gap.interval),
        }

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-diagnosis`, version 2 (see `schemas/`)."""
        from tmlattice import __version__

        return {
            "format": "tmlattice-diagnosis",
            "version": 2,
            "package": __version__,
            "model": self.ring.model,
            **record_of(self),
            "errors": [
                {
                    "effect": c.effect,
                    "element": c.element,
                    "amount": c.amount,
                    "amount_sigma": s,
                    **record_of(support),
                    **({"device": own} if (own := self.devices.get(c.element or "")) else {}),
                }
                for c, s, support in self.supported
            ],
            "assessment": self.assessment.as_json(),
            "gap": self.gap,
            "unexplained": {"patterns": None, **self.unexplained},
        }
