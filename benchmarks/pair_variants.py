"""Pairs that come otherwise: `TMLATTICE_DATA=... python benchmarks/pair_variants.py [--both]`.

The second day of a measured pair is changed as in `variants.py` (a unit wrong, monitors dead, less
of everything), or with `--both` both days are. It prints what stopped the diagnosis, the
seconds, which of the pair's changes were found and lost and what else was named, and the largest
change of an amount in its stated errors. Where it names what to assume, it goes on with
that. `--variant NAME` (any number of them) takes some of them; `--null` the pair without a change.
"""

import argparse
import os
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
import variants

import tmlattice
from tmlattice.errors import TmlatticeError

CHANGED = ("lnls_2014-07-17_before", "lnls_2014-07-17_after")
NULL = ("lnls_2014-07-11_a", "lnls_2014-07-11_b")
OF_THE_LATTICE = ("started elsewhere", "names alike", "names by kind", "names unique", "in slices",
                  "gradients far", "no sextupoles")  # fmt: skip
"""The same in both days, or it is no pair."""


def tried(ring, before, after, assumed=()):
    """What comes of two days; a second time with what the first asks to assume."""
    begun = time.process_time()
    try:
        found = tmlattice.diagnose(ring, after, reference=before, assume=assumed)
    except TmlatticeError as error:
        said = str(error)
        names = variants.offered(said)
        if names and not assumed:
            return [f"stopped: {said}", *tried(ring, before, after, names)]
        return [f"refused: {said}"]
    except Exception:
        return ["TRACEBACK", traceback.format_exc()]
    return [f"{time.process_time() - begun:.0f} s", found]


def told(found, usual):
    """A line of findings, compared with those of the untouched pair."""
    own = {(f.effect, str(f.element)): (f.amount, f.amount_sigma) for f in found.findings}
    lost = [name for name in usual if name not in own]
    others = [f"{effect} {where} " + ("" if sigma is None else f"{amount:+.2g} ± {sigma:.1g}")
              for (effect, where), (amount, sigma) in own.items()
              if (effect, where) not in usual]  # fmt: skip
    moved = [abs(own[name][0] - usual[name][0]) / (own[name][1] or np.nan)
             for name in usual if name in own]  # fmt: skip
    least = [abs(amount / sigma) for amount, sigma in own.values() if sigma]
    return (
        f"{found.verdict}, {len(own) - len(others)} of {len(usual)}; lost: "
        f"{', '.join(name for _, name in lost) or 'none'}; others: "
        f"{'; '.join(others) or 'none'}; moved by "
        f"{max(moved, default=0):.1f} of their errors at most, all above "
        f"{min(least, default=np.inf):.1f}"
    )


def main():
    """Each variant in turn."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variant", action="append", choices=variants.VARIANTS)
    parser.add_argument("--both", action="store_true")
    parser.add_argument("--null", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    data = os.environ.get("TMLATTICE_DATA")
    if not data:
        sys.exit("set TMLATTICE_DATA to the folder that holds real_rings")
    with tempfile.TemporaryDirectory() as place:
        days = list(variants.cases(Path(data), NULL if options.null else CHANGED,
                                   Path(place)).values())  # fmt: skip
    usual, known = None, set()
    for name in ["untouched", *(options.variant or list(variants.VARIANTS)[1:])]:
        both = options.both or name in OF_THE_LATTICE
        try:
            first, second = (
                variants.VARIANTS[name](day, np.random.default_rng(options.seed)) if change else day
                for day, change in zip(days, (both, True), strict=True)
            )
        except TmlatticeError as error:
            print(name, f"refused: {error}", sep=" | ", flush=True)
            continue
        *said, found = tried(first.ring(), first.measured, second.measured)
        if isinstance(found, str):
            print(name, *said, found, sep=" | ", flush=True)
            continue
        if usual is None:
            usual = {(f.effect, str(f.element)): (f.amount, f.amount_sigma)
                     for f in found.findings}  # fmt: skip
            known = {one[:24] for one in found.warnings}
        print(name, *said, told(found, usual), sep=" | ", flush=True)
        for one in found.warnings:
            if one[:24] not in known:
                print(f"    {one}", flush=True)


if __name__ == "__main__":
    main()
