"""Progress of a run in stages: a line each, or bars on a terminal."""

from __future__ import annotations

import pytest

from wrf_mi.cli.output import Watch


def test_stages_are_named_once(capsys: pytest.CaptureFixture[str]) -> None:
    with Watch() as stages:
        for what, share in (("a", 0.0), ("a", 0.5), ("b", 0.1), ("b", 1.0)):
            stages.on_progress(what, share)
    assert capsys.readouterr().err.splitlines() == ["a", "b"]


def test_stages_show_bars_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("FORCE_COLOR", "1")
    with Watch() as stages:
        stages.on_progress("first", 0.5)
        stages.on_progress("second", 1.0)
    shown = capsys.readouterr().err
    assert "first" in shown
    assert "second" in shown
