"""The quick benchmark's rule, on made-up timings, and its stored ratios."""

import json

import numpy as np
import pytest
from documents import CHECKOUT
from wrf_mi_bench import bench
from wrf_mi_bench import quick as bench_quick
from wrf_mi_bench.quick import FILE, PAIRS, Pair, measure_pairs, quick, ratio_table, read_stored, worse
from wrf_mi_bench.traced import StockRenderer, difference, random_field, splatted

from wrf_mi.apps.commands.main import main as cli
from wrf_mi.core import InputError

SAME_SSIM, SAME_L2 = 0.99, 0.06
"""Bounds for Gaussians of 2 degrees: projection differs from rays by 1.4 % (`wrf_mi_plugins.ray_response`), and
Mitsuba's integrator makes those of low opacity smaller and stops early."""
Ratios = dict[str, dict[str, float]]


def made_up(value: float, spread: float = 1.1, name: str = "splatting") -> Ratios:
    interval = {"value": value, "low": value / spread, "high": value * spread}
    return {name: interval | {"ours_ms": value, "theirs_ms": 1.0}}


@pytest.mark.parametrize(
    ("measured", "fails"),
    [
        (made_up(0.5), False),
        (made_up(0.9), False),
        (made_up(1.05), False),  # the value above twice the stored one, its interval not
        (made_up(1.5, spread=2.0), False),
        (made_up(1.2), True),
        (made_up(0.01), False),  # better is no failure
        (made_up(9.0, name="new"), False),  # not stored yet
    ],
)
def test_only_a_whole_interval_above_twice_the_stored_ratio_fails(measured, fails):
    lines = worse(measured, made_up(0.5))
    assert bool(lines) == fails
    assert all("splatting 1.2 (1.09 to 1.32) is above 2 times the stored 0.5" in line for line in lines)


def with_ratios(monkeypatch: pytest.MonkeyPatch, ratios: Ratios) -> None:
    monkeypatch.setattr(bench_quick, "measure_pairs", lambda pairs: ratios)
    monkeypatch.setattr(bench, "source_digests", lambda *modules: {})


def test_ratios_are_compared_with_stored_ones(tmp_path, monkeypatch, capsys):
    asked = ["bench", "--quick", "--out", str(tmp_path / "out")]
    with pytest.raises(InputError, match="no stored ratios; measure them with `wrf-mi bench --quick --store`"):
        quick(tmp_path / "out", store=False)
    with_ratios(monkeypatch, made_up(0.5))
    assert cli([*asked, "--store"]) == 0
    stored = json.loads((tmp_path / "out" / FILE).read_text())
    assert {"machine", "versions", "date", "command"} <= set(stored)
    with_ratios(monkeypatch, made_up(0.8))
    assert quick(tmp_path / "out", store=False)["figures"]["ratios"] == made_up(0.8)
    assert cli(asked) == 0
    assert read_stored(tmp_path / "out" / FILE) == made_up(0.5)  # only --store writes
    with_ratios(monkeypatch, made_up(2.0))
    capsys.readouterr()
    assert cli(asked) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "wrf-mi: bench --quick: splatting 2 (1.82 to 2.2) is above 2 times the stored 0.5"


@pytest.mark.parametrize("arguments", [["--store"], ["--quick", "wrf-gs+-paper"]])
def test_options_outside_quick_are_refused(arguments, capsys):
    assert cli(["bench", *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_ratios_of_another_backend_or_a_damaged_file_are_refused(tmp_path, monkeypatch):
    with_ratios(monkeypatch, made_up(0.5))
    stored = quick(tmp_path, store=True)
    stored["versions"]["backend"] = "abacus 1.0"
    (tmp_path / FILE).write_text(json.dumps(stored))
    with pytest.raises(InputError, match="ratios of the backend abacus"):
        read_stored(tmp_path / FILE)
    for damaged in ("{", "[]", '{"figures": {"ratios": {}}}'):
        (tmp_path / FILE).write_text(damaged)
        with pytest.raises(InputError, match="not readable"):
            read_stored(tmp_path / FILE)


def test_pair_measures_the_ratio_of_ours_to_theirs():
    calls: list[str] = []

    def busy(name: str, size: int) -> None:
        calls.append(name)
        np.sort(np.random.default_rng(0).random(size))

    pair = Pair("made-up", "little over much", lambda: (lambda: busy("a", 20_000), lambda: busy("b", 2_000_000)))
    assert measure_pairs([pair], repeats=5)["made-up"]["value"] < 0.5
    assert calls.count("a") == calls.count("b") >= 5


@pytest.mark.parametrize("seed", [0, 1])
def test_stock_integrator_renders_the_splatted_field(seed):
    """So that its time and ours are for the same job; complex and signed signals go through colours."""
    gaussians, receiver = random_field(seed, "alpha", 100, 2.0)
    stock = StockRenderer(receiver, 90, 360)
    same = difference(stock.field(gaussians).astype(complex), splatted(gaussians, receiver))
    assert same["ssim"] > SAME_SSIM
    assert same["complex_error"] < SAME_L2
    # Other Gaussians take the place of the first.
    other, _ = random_field(seed + 10, "alpha", 100, 2.0)
    assert difference(stock.field(other).astype(complex), splatted(other, receiver))["complex_error"] < SAME_L2


def test_stock_integrator_refuses_attenuation():
    gaussians, receiver = random_field(0, "product", 5)
    with pytest.raises(ValueError, match="opacity"):
        StockRenderer(receiver, 9, 36).field(gaussians)


def test_stored_ratios_are_those_of_the_benchmark():
    stored = json.loads((CHECKOUT / "benchmarks" / "results" / FILE).read_text())
    ratios = stored["figures"]["ratios"]
    assert set(ratios) == {pair.name for pair in PAIRS}
    assert stored["wall_seconds"] < 120
    assert len(ratio_table(ratios).splitlines()) == 2 + len(PAIRS)
