"""The tables of the results' pages, from stored JSON: `python benchmarks/tables.py`.

`docs/results/NAME.json` holds what one benchmark measured, with its command, seed, version and
machine; a page shows it between `<!-- table NAME -->` and `<!-- end -->`. With `--store NAME
COMMAND ...` a benchmark is run first and what it prints is stored, its last Markdown table as rows.
"""

import json
import os
import platform
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent.parent / "docs" / "results"
PLACE = re.compile(r"(<!-- table (\w+) -->\n).*?(\n<!-- end -->)", re.DOTALL)
GPU = (
    ("a turn of 100,000 particles (mean of ten)", "4-D: track 100000, a turn of ten",
     "4-D: torch loop 100000, one turn", None),
    ("a turn of 1,000,000 particles (mean of ten)", "4-D: track 1000000, a turn of ten",
     "4-D: torch loop 1000000, one turn", None),
    ("the same, design (65 % of its layers are linear)",
     "4-D: track 1000000, the design, a turn of ten", None,
     "4-D: Xsuite 1000000, the design, one turn"),
    ("training step, 100,000 launches, 246 BPMs, all gradients", "4-D: training step 100000",
     "4-D: torch loop, training step 100000", None),
    ("the same with the symplectic penalty", "4-D: training step 100000, with penalty", None, None),
    ("six dimensions: a turn of 1,000,000 particles", "6-D: track 1000000, a turn of ten",
     "6-D: torch loop 1000000, one turn", None),
    ("six dimensions: training step, 100,000 launches", "6-D: training step 100000", None, None),
)  # fmt: skip
OPTICS = ("beta_beating", "phase_advance", "dispersion", "tunes", "coupling")
BLIND = {"tool": "`diagnose`", "oracle": "oracle", "omp": "matching pursuit", "lasso": "LASSO",
         "svd_gradients": "SVD, gradients"}  # fmt: skip
BANDS = {"above 20": "20 and more", "10-20": "10 to 20", "5-10": "5 to 10"}


def commit():
    """The code's commit, as git describes it."""
    ran = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=FOLDER, text=True,
                         stdout=subprocess.PIPE, check=False)  # fmt: skip
    return ran.stdout.strip() or "unknown"


def of_gpu(stored):
    """Kernels, torch loop and Xsuite of `gpu.py`."""
    yield ["H100, times in ms", "kernels", "torch loop (ratio)", "Xsuite (ratio)"]
    for words, ours, *others in GPU:
        beside = [f"{stored[o]:.0f} ({stored[o] / stored[ours]:.0f})" if o else "" for o in others]
        yield [words, f"{stored[ours]:.3g}", *beside]


def code(machines):
    """The commits that they were measured with; of the first studies, which state none, 8c3c6fb."""
    count = Counter(one.get("commit", "8c3c6fb")[:8] for one in machines)
    if len(count) == 1:
        return next(iter(count))
    return ", ".join(f"{commit} ({n})" for commit, n in sorted(count.items()))


def against(machines, other):
    """How many corrections leave a smaller cost than another method's, an equal one and a larger
    one: equal within what 1 % errors of the changes add to the oracle's (0 where not measured)."""
    own, its, exact, made = (
        np.array([(one.get(m) or one["oracle"])["cost"] for one in machines])
        for m in ("tmlattice", other, "oracle", "oracle_made")
    )
    ties = np.abs(own - its) <= np.abs(made - exact)
    return [int(n.sum()) for n in ((own < its) & ~ties, ties, (own > its) & ~ties)]


def of_corrections(machines):
    """Each study of `correct.py`: errors in tolerances, medians over its machines."""
    yield ["study", "code", "machines", "nothing set", "before", "after", "oracle", "SVD", "LOCO",
           "beta beating over the oracle's, median (worst)", "not worse than before",
           "LOCO: better, equal, worse", "68 % intervals: now", "expected"]  # fmt: skip
    for study in sorted({tuple(one["study"]) for one in machines}):
        own = [one for one in machines if tuple(one["study"]) == study]
        cost = {m: np.array([one[m]["cost"] for one in own if m in one])
                for m in ("before", "tmlattice", "oracle", "svd", "loco")}  # fmt: skip
        own_beta, its = (np.array([np.linalg.norm(one[m]["beta_beating"]) for one in own])
                         for m in ("tmlattice", "oracle"))  # fmt: skip
        ratio = own_beta / its
        hold = [
            np.mean([
                low <= value <= high
                for one in own for name in OPTICS
                for (_, low, high), value in zip(one[when][name], one[true][name], strict=True)
            ])
            for when, true in (("now", "before"), ("expected", "tmlattice"))
        ]  # fmt: skip
        yield [
            ", ".join(study).replace("_", " "), code(own), str(len(own)),
            str(sum(bool(one["refused"]) for one in own)),
            *(f"{np.median(v):.3g}" if len(v) == len(own) else "" for v in cost.values()),
            f"{np.median(ratio):.3f} ({ratio.max():.3f})",
            str(np.sum(cost["tmlattice"] <= cost["before"])),
            ", ".join(map(str, against(own, "loco"))) if len(cost["loco"]) else "",
            *(f"{100 * share:.0f} %" for share in hold),
        ]  # fmt: skip


def of_threading(machines):
    """Beams that `threading_beam.py` brings round, by ring."""
    yield ["ring", "code", "quadrupoles displaced, rms", "machines", "first turn before, median",
           "oracle", "tmlattice", "rounds, median (most)"]  # fmt: skip
    for ring, offset in sorted({(one["ring"], one["offset"]) for one in machines}):
        own = [one for one in machines if (one["ring"], one["offset"]) == (ring, offset)]
        rounds = [len(one["rounds"]) + len(one.get("refused", ()))
                  for one in own if 20 in one["rounds"]]  # fmt: skip
        yield [
            ring, code(own), f"{1e3 * offset:g} mm", str(len(own)),
            f"{100 * np.median([one['before'] for one in own]):.0f} %",
            str(sum(one["oracle"] == 20 for one in own)), str(len(rounds)),
            f"{np.median(rounds):g} ({max(rounds)})" if rounds else "",
        ]  # fmt: skip


def of_score(scored):
    """Rates of `tmlattice dev challenge score --json`, by signal to noise and method."""
    yield ["single faults (tier A)", *BLIND.values()]
    for band, words in BANDS.items():
        found = scored["bands"][band]
        cases = found["tool"]["detected"]["cases"]
        yield [f"**signal to noise {words} ({cases} cases)**", *[""] * len(BLIND)]
        for rate in found["tool"]:
            text = rate.replace("_", " ")
            yield [text, *(f"{100 * found[name][rate]['share']:.1f} %" for name in BLIND)]


def false_alarm(row):
    """Whether something was found in a machine of `healthy.py`."""
    return bool(row.get("found")) or (row["verdict"], row["errors"]) == ("distributed", "none")


def of_healthy(rows):
    """False alarms of `healthy.py` by ring and kind of measurement, where there is a diagnosis."""
    kinds = list(dict.fromkeys((row["errors"], row["kind"]) for row in rows))
    yield ["ring", *(f"{kind.replace('_', ' ')}, {errors}" for errors, kind in kinds)]
    for name in [*dict.fromkeys(row["ring"] for row in rows), "all"]:
        line = [name]
        for errors, kind in kinds:
            own = [r for r in rows if name in (r["ring"], "all")
                   and (r["errors"], r["kind"]) == (errors, kind)]  # fmt: skip
            done = [r for r in own if r["verdict"] not in ("no beam", "refused", "traceback")]
            others = Counter(r["verdict"] for r in own if r not in done)
            cells = [f"{sum(map(false_alarm, done))} of {len(done)}"] if done else []
            words = {"refused": "not diagnosed"}
            cells += [f"{n} {words.get(verdict, verdict)}" for verdict, n in others.items()]
            line.append(", ".join(cells))
        yield line


def of_turns(rows):
    """Counts of `turns_amplitude.py` by ring, beam, fault and amplitude, of amplitudes
    that the maps describe."""
    rows = [{"particles": 1} | row for row in rows]
    amplitudes = sorted({row["amplitude"] for row in rows})
    yield ["ring", "particles", "quadrupole error", *(f"{1e3 * own:g} mm" for own in amplitudes)]
    kinds = ("ring", "particles", "fault")
    for case in dict.fromkeys(tuple(row[key] for key in kinds) for row in rows):
        name, particles, fault = case
        named = f"{100 * fault:g} %: named" if fault else "none: false alarms"
        line = [name, f"{particles:,}", named]
        for amplitude in amplitudes:
            own = [r for r in rows if tuple(r[key] for key in kinds) == case]
            own = [r for r in own if r["amplitude"] == amplitude]
            done = [r for r in own if r["verdict"] not in ("refused", "error")]
            count = sum(r["right"] if fault else r["verdict"] != "none" for r in done)
            cells = [f"{count} of {len(done)}"] if done else []
            cells += [f"{len(own) - len(done)} above the limit"] if len(done) < len(own) else []
            line.append(", ".join(cells))
        yield line


def of_stated_errors(rows):
    """The rms pulls of `stated_errors.py`, by ring."""

    def rms(values):
        return f"{np.sqrt(np.mean(np.square(values))):.2f}" if values else ""

    yield ["ring", "machines", "numbers", "all", "determined by the data", "not determined",
           "gradients", "faulty quadrupole", "its largest pull"]  # fmt: skip
    for name in [*dict.fromkeys(row["ring"] for row in rows), "all"]:
        some = [row for row in rows if name in (row["ring"], "all")]
        pairs = [pair for row in some for own in row["pulls"].values() for pair in own]
        faulty = [own["pull"] for row in some for own in row["faulty"]]
        yield [
            name, str(len(some)), f"{len(pairs):,}", rms([pull for pull, _ in pairs]),
            rms([pull for pull, share in pairs if share >= 0.5]),
            rms([pull for pull, share in pairs if share < 0.5]),
            rms([pull for row in some for pull, _ in row["pulls"]["quadrupole_gradient"]]),
            rms(faulty), f"{max(map(abs, faulty), default=0):.1f}",
        ]  # fmt: skip


SOURCES = {
    "healthy.jsonl": of_healthy,
    "turns_amplitude.jsonl": of_turns,
    "stated_errors.jsonl": of_stated_errors,
    "gpu_raw.json": of_gpu,
    "correct_studies.jsonl": of_corrections,
    "threading.jsonl": of_threading,
    "blind_score.json": of_score,
}


def markdown(rows):
    """Rows of cells as a table."""
    head, *others = ["| " + " | ".join(row) + " |" for row in rows]
    line = "|---" * (head.count(" | ") + 1) + "|"
    return "\n".join([head, line, *others])


def filled(text):
    """A page's text with its tables as they are stored."""

    def made(place):
        stored = json.loads((FOLDER / f"{place[2]}.json").read_text(encoding="utf-8"))
        rows = stored.get("rows")
        if rows is None:
            source = (FOLDER / stored["source"]).read_text(encoding="utf-8")
            if stored["source"].endswith(".jsonl"):
                source = f"[{','.join(source.splitlines())}]"
            rows = SOURCES[stored["source"]](json.loads(source))
        return f"{place[1]}\n{markdown(rows)}\n{place[3]}"

    return PLACE.sub(made, text)


def store(name, command, folder=FOLDER):
    """Run a benchmark and store its lines and its table, with what it was made with."""
    from tmlattice.files import write_json
    from tmlattice.version import __version__

    lines = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        for line in running.stdout or ():
            print(line, end="", flush=True)
            lines.append(line.rstrip())
    if running.returncode:
        sys.exit(f"it ended with {running.returncode}: nothing is stored")
    tables = re.findall(r"(?:^\|.*\n)+", "\n".join([*lines, ""]), re.MULTILINE)
    rows = [[cell.strip() for cell in line.strip("|").split("|")]
            for line in (tables[-1].splitlines() if tables else ())]  # fmt: skip
    seed = re.search(r"--(?:seeds?|first) ([\d ]*\d)", " ".join(command))
    stored = {
        "command": " ".join(command),
        "seed": seed[1] if seed else "the command's default",
        "version": f"{__version__}, commit {commit()}",
        "machine": f"{platform.platform()}, {os.cpu_count()} cores, {platform.python_version()}",
        "lines": lines,
        "rows": rows[:1] + rows[2:],
    }
    write_json(folder / f"{name}.json", stored)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--store"]:
        store(sys.argv[2], sys.argv[3:])
    for page in FOLDER.glob("*.md"):
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
