"""Equal results of one and two threads, small, and children that fail."""

from dataclasses import replace

import numpy as np
import pytest
from wrf_mi_bench import elsewhere


@pytest.mark.slow
def test_two_threads_give_what_one_gives(monkeypatch):
    """Images, spectra and metrics have equal bits; a change of one of them is reported."""
    both = [variant for variant in elsewhere.variants((1, 2)) if variant.kind == "threads"]
    monkeypatch.setattr(elsewhere, "variants", lambda threads: iter(both))
    computed = elsewhere.computed
    results = [computed(variant, True) for variant in both]
    in_turn = iter(results)
    monkeypatch.setattr(elsewhere, "computed", lambda *_: next(in_turn))
    figures = elsewhere.main(small=True)
    assert "failed" not in figures
    exact = dict.fromkeys(elsewhere.EXACT, 0.0)
    bounds = {row["quantity"]: row["bound"] for row in figures["rows"]}
    assert bounds == {**exact, "gradient": elsewhere.BOUNDS["gradient"]}
    assert elsewhere.table(figures["rows"]).splitlines()[-1].startswith("| 2 threads | **0** (bit-identical) |")
    (first, _), (second, seconds) = results
    changed = {**second, "image": np.nextafter(second["image"], 2)}
    assert elsewhere.differences(first, changed)["image"] > 0
    in_turn = iter([results[0], (changed, seconds)])
    assert elsewhere.main(small=True)["failed"] == "beyond its bound: 2 threads: image of Gaussians"


def test_failed_child_is_reported():
    variant = replace(next(elsewhere.variants((1,))), backend="none")
    with pytest.raises(elsewhere.BenchFailed, match="is none of auto, llvm, cuda"):
        elsewhere.computed(variant, True)
