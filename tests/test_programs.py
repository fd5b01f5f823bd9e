"""Tests whose program is missing."""

import pytest
from programs import installed


@pytest.mark.parametrize(("ci", "outcome"), [("true", pytest.fail.Exception), ("", pytest.skip.Exception)])
def test_missing_program_fails_in_continuous_integration_alone(monkeypatch, ci, outcome):
    monkeypatch.setenv("CI", ci)
    with pytest.raises(outcome, match=r"none of no-such-program is installed; install it: \.ci/test_programs\.sh"):
        installed("no-such-program")


def test_programs_beside_python_are_found() -> None:
    assert installed("no-such-program", "pytest").endswith("pytest")
