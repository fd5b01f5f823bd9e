"""Differences between numbers of threads, small."""

from dataclasses import replace

import numpy as np
import pytest
from wrf_mi_bench import elsewhere


@pytest.mark.slow
def test_two_threads_give_what_one_gives(monkeypatch):
    """Images, spectra and metrics have equal bits; a change of one of them is reported."""
    both = [one for one in elsewhere.variants((1, 2)) if one.kind == "threads"]
    monkeypatch.setattr(elsewhere, "variants", lambda threads: iter(both))
    computed, found = elsewhere.computed, []
    monkeypatch.setattr(elsewhere, "computed", lambda *given: found.append(computed(*given)) or found[-1])
    figures = elsewhere.main(small=True)
    assert "failed" not in figures
    assert {row["quantity"]: row["bound"] for row in figures["rows"]} == {
        **dict.fromkeys(elsewhere.EXACT, 0.0),
        "gradient": elsewhere.BOUNDS["gradient"],
    }
    assert elsewhere.table(figures["rows"]).splitlines()[-1].startswith("| 2 threads | **0** (bit-identical) |")
    changed = {**found[1][0], "image": np.nextafter(found[1][0]["image"], 2)}
    assert elsewhere.differences(found[0][0], changed)["image"] > 0
    again = iter([found[0], (changed, found[1][1])])
    monkeypatch.setattr(elsewhere, "computed", lambda *given: next(again))
    assert elsewhere.main(small=True)["failed"] == "beyond its bound: 2 threads: image of Gaussians"


def test_failed_child_is_reported():
    one = next(elsewhere.variants((1,)))
    with pytest.raises(elsewhere.BenchFailed, match="is none of auto, llvm, cuda"):
        elsewhere.computed(replace(one, backend="none"), True)
