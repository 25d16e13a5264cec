"""The right answer to every scenario: always with few effects, and with all by `-m slow`."""

import pytest

from tests.scenarios import QUICK, SCENARIOS, run


def names(own):
    return own.name


def test_a_name_is_of_one_scenario():
    assert len({own.name for own in SCENARIOS}) == len(SCENARIOS) >= 100


@pytest.mark.parametrize("own", QUICK, ids=names)
def test_is_answered(own):
    assert run(own)["faults"] == []


@pytest.mark.slow
@pytest.mark.parametrize("own", [own for own in SCENARIOS if own.lasts], ids=names)
def test_that_takes_long_is_answered(own):
    assert run(own)["faults"] == []
