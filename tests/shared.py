"""What tests of many subjects do alike: documents, measured data, pages, responses, errors."""

import functools
import json
import os
import re
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
SHORT = """from ocelot import *
energy = 1.0
q, s = Quadrupole(l=0.3, k1=1.2, eid="q"), Sextupole(l=0.1, k2=20.0, eid="s")
cell = [Monitor(eid="a"), q, Drift(l=0.5, eid="d"), s, Monitor(eid="b"), Monitor(eid="c")]
"""


@functools.cache
def _validator(name):
    schema = files("tmlattice") / "schemas" / f"{name}.schema.json"
    return jsonschema.Draft202012Validator(json.loads(schema.read_text(encoding="utf-8")))


def valid(document, name):
    """The document, or that of a path, as a file has it, which a schema allows."""
    text = document.read_text(encoding="utf-8") if isinstance(document, Path) else None
    document = json.loads(json.dumps(document) if text is None else text)
    _validator(name).validate(document)
    return document


def measured_data(*parts):
    """A file or folder of the measured data; without it the test is skipped."""
    path = Path(os.environ.get("TMLATTICE_DATA") or "nowhere").joinpath(*parts)
    if not path.exists():
        pytest.skip(f"TMLATTICE_DATA has no {'/'.join(parts)}")
    return path


def run_page(page, **names):
    """The names that the Python of a page of docs/, run as one, leaves."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), names)
    return names


def first_turns(ring, causes=(), **options):
    """Four first turns of little noise."""
    from tmlattice import simulate

    made = {"shots": 4, "seed": 1, "engine": "ocelot", "amplitude": 3e-4, "noise": 2e-6}
    return simulate(ring, list(causes), **made | options).measurement()


def gradients(ring, rms, rng):
    """Gradient errors of all quadrupoles."""
    from tmlattice import Cause

    quadrupoles = [e.name for e in ring.elements if e.kind == "quadrupole"]
    return [Cause("quadrupole_gradient", q, rms * rng.standard_normal()) for q in quadrupoles]


def small_steps(ring, causes=(), **options):
    """A response of little noise whose steps, of the RF too, are small for the small ring."""
    from tmlattice.machine.response import simulate_response

    made = {"kick": 1e-5, "noise": 2e-8, "rf_step": -3000.0, "engine": "ocelot"}
    return simulate_response(ring, causes, progress=False, **made | options).measured


def parted(ring, measured, seed=0):
    """Data of a response, and which of its columns are held out."""
    from tmlattice.observe.response_data import response_data, split_columns

    data = response_data(ring, measured)
    return data, split_columns(data, 0.2, np.random.default_rng(seed))
