"""`tmlattice diagnose`: where the gap lies, what causes it, how far it shrinks."""

import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tmlattice.cli.options import (
    FILE,
    NAMES,
    OfMachine,
    assume_option,
    background_option,
    console,
    is_in,
    json_option,
    lattice_argument,
    named_data,
    open_ring,
    outputs,
    path_option,
    print_report,
    radiation_option,
    read_data,
    seed_option,
)
from tmlattice.cli.progress import tell

if TYPE_CHECKING:
    from tmlattice.correction import Correction, Knob
    from tmlattice.diagnosis import Diagnosis
    from tmlattice.fitting.weights import WeightReading
    from tmlattice.inference.distributed import DistributedErrors
    from tmlattice.lattice import Ring
    from tmlattice.measurement import AnyMeasurement, Measurement

log = logging.getLogger(__name__)


@click.command("diagnose", cls=OfMachine)
@lattice_argument
@click.argument("measurements", metavar="MEASUREMENT...", type=FILE, nargs=-1)
@path_option(
    "--reference",
    "references",
    metavar="DIR",
    multiple=True,
    help="A measurement of the same machine and kind before the fault: static errors cancel, and "
    "the diagnosis reports what changed. Repeat it if several are diagnosed together.",
)
@path_option(
    "--settings",
    "settings_file",
    help="settings.csv of the last correction, applied before this measurement: the next "
    "correction starts from them. With the --reference before them the calibration of each "
    "device, measured over asked change, is printed instead.",
)
@background_option("Distributed errors (not given: estimated from the data)")
@assume_option
@click.option(
    "--max-effects",
    type=click.IntRange(1),
    default=None,
    help="Findings at most: 8 by default, 40 of a change between two responses. Of an "
    "orbit response, families of errors at most: all.",
)
@click.option(
    "--effects",
    type=NAMES,
    help="Look for these alone, or of an orbit response fit families of these alone; else for all "
    "usual ones (`tmlattice effects`).",
)
@path_option(
    "--network", help="network.pt of `tune-fit`: read what its weights changed as physics."
)
@click.option(
    "--missing",
    is_flag=True,
    help="Of an orbit response: test by log evidence which effect the result still lacks.",
)
@radiation_option
@seed_option("Of the split, the threshold's simulation and the bootstrap.")
@path_option(
    "--lattice-out",
    help="The estimated ring, with its errors: .json (the package's own), .at.json (AT), "
    ".xsuite.json (Xsuite), .madx or .seq (MAD-X), .py (OCELOT). FILE.calibration.json next to it "
    "holds the calibration of BPMs and correctors (`tmlattice predict`).",
)
@path_option(
    "--corrected-out",
    help="The corrected ring, in the same formats: the design with the settings that, loaded into "
    "the real machine, restore the design (a quadrupole that gives 20 % less is set 25 % higher). "
    "Errors that no setting corrects are printed.",
)
@json_option
@path_option(
    "--out",
    metavar="DIR",
    help="Folder for diagnosis.json, report.html, report.txt, the figures, and the estimated ring, "
    "for `tmlattice correct DIR`.",
)
def diagnose(
    lattice: str,
    measurements: tuple[Path, ...],
    references: tuple[Path, ...],
    settings_file: Path | None,
    background: tuple[tuple[str, float | None], ...],
    effects: tuple[str, ...] | None,
    network: Path | None,
    lattice_out: Path | None,
    corrected_out: Path | None,
    missing: bool,
    assumed: tuple[str, ...],
    json_file: Path | None,
    out: Path | None,
    **options: Any,
) -> None:
    """Find where the ring differs from LATTICE, by which effect, and how far the misfit shrinks.

    MEASUREMENT is a folder, as `tmlattice simulate` writes it: first turns, turns of a stored beam,
    a closed orbit, dispersion, tunes, an orbit response; or a control room's file of first turns
    (.csv, .txt, .h5, .sdds), whose columns are recognised; the assumptions are printed. Several
    measurements of one machine are diagnosed together. The verdict is one of identified, ambiguous
    (several explanations fit alike), localised (an error that the catalogue does not explain),
    distributed (no single place) and none; the exit code is 0 for each of them. The diagnosis of
    an orbit response alone fits all families of errors together; options about launches do not
    apply to it.
    """
    from tmlattice.correction.result import FILES
    from tmlattice.diagnosis.load import ESTIMATED_FILE
    from tmlattice.diagnosis.twin import knowledge_file, known_of
    from tmlattice.errors import LatticeError
    from tmlattice.files import write_json
    from tmlattice.report.text import wrapped

    kept = [Path(ESTIMATED_FILE)]
    if lattice_out and is_in(lattice_out, out):
        kept.append(Path(lattice_out.name))
    with_companions = [(own, calibration_beside(own), knowledge_file(own)) for own in kept]
    replaced = [*FILES, *(str(own) for files in with_companions for own in files)]
    with outputs(out, json_file, replaced) as (folder, place, write):
        from tmlattice.correction.applied import applied
        from tmlattice.correction.applied import sentence as of_device
        from tmlattice.correction.knobs import read_settings
        from tmlattice.effects import background_rms, names

        if effects is not None:
            names(effects)  # a wrong name is known before the work
        background_rms(dict(background))
        from tmlattice.diagnosis import diagnose as run
        from tmlattice.measurement import Measurement, OrbitResponse

        ring = open_ring(lattice)
        if both := {p.resolve() for p in measurements} & {p.resolve() for p in references}:
            raise click.UsageError(
                f"'{min(both)}' is the measurement and its --reference: between them nothing "
                "changed; give the one before"
            )
        asked = read_settings(settings_file, ring) if settings_file else []
        (data, said), (before, more_said) = (
            _read(p, ring, assumed) for p in (measurements, references)
        )
        files = [str(path) for path in (*measurements, *references) if path.is_file()]
        printed = [*said, *more_said, *2 * files]  # of a file also what it is, and a blank line
        (first, *more) = data.values()
        response = isinstance(first, OrbitResponse) and not more
        turns = isinstance(first, Measurement) and not more
        if not response and (known := _known(ring, lattice)) is not None:
            options["known"] = known
        if response:
            said += _not_used(lattice)
            _refuse("an orbit response", background=background)
        if not turns:
            what = "an orbit response" if response else "several measurements or a stored beam's"
            _refuse(what, network=network, radiation=options.pop("radiation"))
        if response:
            options["missing"] = missing
            if before:
                _refuse(
                    "a change since a reference", missing=missing, lattice_out=lattice_out,
                    corrected_out=corrected_out,
                )  # fmt: skip
        else:
            _refuse("anything but an orbit response alone", missing=missing)
            options["background"] = dict(background) or None
        if before:
            options["reference"] = before
        if options["max_effects"] is None:
            del options["max_effects"]
        if lattice_out and lattice_out == corrected_out:
            raise click.UsageError(f"--lattice-out and --corrected-out are both '{lattice_out}'")

        for option, path in (("lattice", lattice_out), ("corrected", corrected_out)):
            if path:
                _check_out(ring, f"--{option}-out", path, place)
        with named_data(" or ".join(str(path) for path in (*measurements, *references))):
            result = run(ring, data, effects=effects, assume=assumed, progress=tell, **options)
        reading = None
        if network:
            assert isinstance(first, Measurement)
            tell("network")
            reading = _weights(ring, network, first, assumed)
        source: dict[str, Any] = {"measurement": " ".join(map(str, measurements))}
        if said:
            source["assumed_of_files"] = said
        if lattice_out:
            here = is_in(lattice_out, out)  # the folder may be moved
            source["lattice_out"] = lattice_out.name if here else str(lattice_out.absolute())
        known = correction = None
        if lattice_out or ((asked or folder) and not before):
            tell("remaining uncertainties")  # minutes, of a large response
            known = known_of(result)
        if lattice_out or asked:
            # of what was changed on purpose it would be the way back
            correction = None if asked and before else _correction(result, known, asked)
        if folder and not lattice_out and not before:
            try:
                _save_rings(result, known, folder / ESTIMATED_FILE, None, place)
                source["lattice_out"] = ESTIMATED_FILE
            except LatticeError as error:  # an element that no file holds
                log.warning("no estimated ring for `tmlattice correct`: %s", error)
        calibrations = applied(result, asked) if asked and before else []
        if calibrations:
            source["applied"] = [vars(own) | {"ratio": own.ratio} for own in calibrations]
        document = result.as_json()
        document["provenance"] = {**document["provenance"], **source}
        if folder:
            from tmlattice.report.speaking import write_files

            tell("figures")
            write_files(result, folder, document, correction)
        write(document)
        written = _save_rings(result, known, lattice_out, corrected_out, place)
        if folder and reading:
            from tmlattice.plots import plot_weights, save_figure

            save_figure(plot_weights(reading), folder / "weights.png")
            write_json(folder / "weights.json", reading.as_json())
    screen, after = console(), []
    if correction is not None:
        after = ["", *wrapped(f"Correction: {correction.words}", "", screen.width)]
    after += ["", _extent(result), *_written_lines(out, json_file, written)]
    after += [of_device(own) for own in calibrations]
    if calibrations:
        after += ["", "To correct what is left, give the same command without --reference."]
    if reading:
        after += ["", _weights_text(ring, reading)]
    print_report(screen, result, after, printed)


def _read(
    paths: tuple[Path, ...], ring: "Ring", assumed: tuple[str, ...]
) -> "tuple[dict[str, AnyMeasurement], list[str]]":
    """Measurements by the names of their folders, by the whole path where two have one name; and
    what was assumed of files that are none.

    Raises:
        click.UsageError: one is given twice: it would count as two.
    """
    for k, path in enumerate(paths):
        if path.resolve() in [other.resolve() for other in paths[:k]]:
            raise click.UsageError(f"'{path}' is given twice; give each measurement once")
    names = [path.resolve().name for path in paths]
    twice = len(set(names)) < len(names)
    found: dict[str, AnyMeasurement] = {}
    said: list[str] = []
    for name, path in zip(names, paths, strict=True):
        found[str(path) if twice else name], own = read_data(path, ring, assumed)
        said += own
    return found, said


def _not_used(lattice: str) -> list[str]:
    """The file next to a lattice that the diagnosis of an orbit response does not use."""
    from tmlattice.diagnosis.twin import knowledge_file

    beside = knowledge_file(Path(lattice))
    if not beside.is_file():
        return []
    return [
        f"'{beside}' is not used: an orbit response determines calibrations and distributed errors "
        "by itself; give --reference to find what changed since an earlier one"
    ]


def _known(ring: "Ring", lattice: str) -> "DistributedErrors | None":
    """The uncertainties that an earlier diagnosis wrote next to its estimated ring."""
    from tmlattice.diagnosis.twin import ESTIMATED, knowledge_file, read_known

    beside = knowledge_file(Path(lattice))
    if beside.is_file():
        return read_known(beside, ring)
    if ring.model == ESTIMATED:
        warnings.warn(
            f"'{lattice}' is an estimated ring, and '{beside}' is not there: what the diagnosis "
            "left uncertain is not used; copy that file too",
            stacklevel=2,
        )
    return None


def _correction(
    result: "Diagnosis", known: "DistributedErrors | None", asked: "Sequence[tuple[Knob, float]]"
) -> "Correction | None":
    """Settings of supplies that bring the estimated ring to the design, where the covariance of its
    errors is known and they have an expected gain; some supplies have applied settings."""
    from tmlattice.correction import correct
    from tmlattice.correction.estimate import estimate_of
    from tmlattice.errors import TmlatticeError

    if known is None:
        return None
    tell("correction")
    try:
        estimate = estimate_of(result, known)
        found = correct(estimate, knobs=_after(asked, estimate.settings) or None)
    except TmlatticeError:  # no supply acts, or the ring stores no beam
        log.info("no correction", exc_info=True)
        return None
    return None if found.refused else found


def _after(asked: "Sequence[tuple[Knob, float]]", ring: "Ring") -> "list[Knob]":
    """Devices with their applied settings, and all others of the lattice."""
    from tmlattice.correction.knobs import default_knobs

    devices = [replace(knob, present=new) for knob, new in asked]
    kinds = {"quadrupole", "skew_quadrupole"} | {knob.kind for knob in devices}
    taken = {(knob.kind, member) for knob in devices for member in knob.members}
    others = (
        knob for knob in default_knobs(ring)
        if knob.kind in kinds and not taken & {(knob.kind, member) for member in knob.members}
    )  # fmt: skip
    return [*devices, *others] if devices else []


def _save_rings(
    result: "Diagnosis",
    known: "DistributedErrors | None",
    lattice_out: Path | None,
    corrected_out: Path | None,
    place: Callable[[Path], Path],
) -> dict[str, tuple[str, ...]]:
    """The estimated ring and the corrected ring: the files, with what they do not hold (place:
    where a file is written)."""
    from tmlattice.diagnosis.twin import ESTIMATED, knowledge_file, known_document
    from tmlattice.files import output_file, write_json
    from tmlattice.lattice import save_ring
    from tmlattice.observe.calibration import Calibration, write_calibration
    from tmlattice.report.action_texts import by_hand_text

    written: dict[str, tuple[str, ...]] = {}
    if lattice_out:
        ring = result.as_found
        ring = ring if known is None else replace(ring, model=ESTIMATED)
        written[str(lattice_out)] = save_ring(ring, place(lattice_out))
        beside = calibration_beside(lattice_out)
        if result.calibration or result.by_families:
            amounts = zip(result.causes, result.errors, strict=True)
            errors = {(c.effect, c.element): e for c, e in amounts if isfinite(e)}
            own = (result.calibration, result.dispersion, result.rejected_channels, errors)
            write_calibration(place(beside), Calibration(*own))
            written[str(beside)] = ()
        else:  # that of the ring which stood there
            place(beside).unlink(missing_ok=True)
        beside = knowledge_file(lattice_out)
        place(beside).unlink(missing_ok=True)  # that of the ring which stood there
        if place(lattice_out).is_file() and known is not None:
            with output_file(place(beside)) as temporary:
                write_json(temporary, known_document(known, place(lattice_out)))
            written[str(beside)] = ()
    if corrected_out:
        ring, by_hand = result.repair()
        told = save_ring(ring, place(corrected_out))
        more = by_hand_text(result.ring, by_hand)
        written[str(corrected_out)] = (*told, more) if more else told
    return written


def _refuse(kind: str, **given: Any) -> None:
    """An option that has no meaning for this kind of measurement."""
    for name, value in given.items():
        if value:
            raise click.UsageError(f"--{name.replace('_', '-')} has no meaning for {kind}")


def _check_out(ring: "Ring", option: str, path: Path, place: Callable[[Path], Path]) -> None:
    """Whether the ring can be written there, before minutes of work."""
    from tempfile import TemporaryDirectory

    from tmlattice.correction.result import FILES
    from tmlattice.diagnosis.load import DOCUMENT, LATTICE
    from tmlattice.files import OutputError, check_writable
    from tmlattice.lattice import save_ring
    from tmlattice.lattice.write import SUFFIXES, knows

    if not knows(path):
        raise click.UsageError(f"{option} '{path}' names no format; end it in {SUFFIXES}")
    if place(path) != path and path.name in (DOCUMENT, LATTICE, *FILES):
        raise OutputError(f"{option} '{path}' is a file of --out; give it another name")
    for file in (path, calibration_beside(path)):
        check_writable(place(file))
    with TemporaryDirectory() as folder:
        save_ring(ring, Path(folder) / path.name)


def calibration_beside(lattice: Path) -> Path:
    """Where the calibration of a lattice file stands."""
    return lattice.with_name(f"{lattice.name}.calibration.json")


def _weights(
    ring: "Ring", path: Path, data: "Measurement", assumed: tuple[str, ...]
) -> "WeightReading":
    from tmlattice.fitting.weights import read_network
    from tmlattice.measurement.assume import assume
    from tmlattice.network import load_network

    names = [monitor.name for monitor in ring.monitors]
    return read_network(ring, load_network(ring, path), assume(data, assumed, names))


def _weights_text(ring: "Ring", reading: "WeightReading") -> str:
    magnets = ring.magnets
    raw, score = (magnets[int(reading.places(by)[0])] for by in ("raw", "score"))
    return (
        f"the network's weights changed most at {raw.name} (s = {raw.s:.2f} m); in units of "
        f"their error, at {score.name} (s = {score.s:.2f} m)"
    )


def _extent(result: "Diagnosis") -> str:
    """The ring, the readings that were used, and the time."""
    if result.parts:
        parts = result.parts
        names = (p.label.replace("_", " ") if len(parts) == 1 else p.label for p in parts)
        what = ", ".join(
            f"{name} ({part.readings} readings)" for name, part in zip(names, parts, strict=True)
        )
    elif result.kind == "trajectory":
        view = result.trajectories
        what = (
            f"{view.data.shots} shots in the fit, {len(result.heldout_shots)} held "
            f"out, {len(view.explanation.first.hypotheses)} hypotheses"
        )
    else:
        held, good = result.response.held, result.response.good
        what = (
            f"{len(held) - 1} correctors, {int(held.sum())} of them held out, {int(good.sum())} "
            "BPMs"
        )
    made = result.provenance
    return f"{result.ring.name}: {what}, seed {made['seed']}, {made['seconds']:.1f} s"


def _written_lines(
    out: Path | None, json_file: Path | None, rings: dict[str, tuple[str, ...]]
) -> list[str]:
    """The files that were written, and what those of rings do not hold."""
    from tmlattice.diagnosis.load import ESTIMATED_FILE

    written = []
    if out:
        also = ", estimated ring" if (out / ESTIMATED_FILE).exists() else ""
        written = [f"{out}/: report.html, report.txt, diagnosis.json, figures{also}"]
    written += [str(json_file)] if json_file else []
    written += rings
    lines = [f"written: {'; '.join(written)}"] if written else []
    return lines + [f"{file}: {sentence}" for file, told in rings.items() for sentence in told]
