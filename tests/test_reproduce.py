"""`tmlattice dev reproduce` as a user runs it."""

import json
from importlib.resources import files

import jsonschema
import pytest
from click.testing import CliRunner

from tmlattice.cli.command import tmlattice


@pytest.mark.parametrize(
    "system",
    [
        "free-fall",
        "pendulum",
        "magnets",
        "lotka-volterra",
        pytest.param("cavitation", marks=pytest.mark.slow),
    ],
)
def test_table_json_and_figure(system, tmp_path):
    out = tmp_path / "out"
    done = CliRunner().invoke(
        tmlattice,
        ["dev", "reproduce", system, "--small", "--out", str(out)],
        catch_exceptions=False,
    )
    assert done.exit_code == 0
    assert "why they differ" in done.output
    assert sorted(p.name for p in out.iterdir()) == sorted([f"{system}.png", "reproduction.json"])
    assert (out / f"{system}.png").read_bytes().startswith(b"\x89PNG")
    result = json.loads((out / "reproduction.json").read_text())
    schema = files("tmlattice") / "schemas" / "reproduction.schema.json"
    jsonschema.validate(result, json.loads(schema.read_text()))
    assert [entry["system"] for entry in result["systems"]] == [system]


def test_an_unknown_system_is_refused():
    done = CliRunner().invoke(tmlattice, ["dev", "reproduce", "pendulums"])
    assert done.exit_code == 2
    assert "pendulum" in done.output
