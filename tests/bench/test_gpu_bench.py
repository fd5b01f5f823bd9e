"""Times on a GPU and on the CPU: the jobs of both, and the refusal without a GPU."""

import json
import os
import sys
from pathlib import Path

import pytest
from wrf_mi_bench import gpu, gpu_job
from wrf_mi_bench.bench import all_here
from wrf_mi_bench.check import main

TRACED = ("train", "laboratory", "--model", "ray-tracing", "--scene", "SCENE", "--set", "depth=1", "--set", "rays=1024")


def test_without_a_gpu_it_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main("wrf_mi_bench.gpu:main", str(tmp_path / "out.json")) == 2
    assert capsys.readouterr().err.startswith("wrf-mi: bench gpu: CUDA cannot be used")
    assert "gpu" not in all_here()


@pytest.mark.slow
def test_rows_have_the_figures_of_all_backends(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """All jobs are measured on the CPU, each in its own process, as no test has a GPU."""
    small = tmp_path / "small_job.py"
    sizes, predicted = {"gaussians-splat": (20, 40)}, {"factorised": (1, 4)}
    small.write_text(
        "import sys\nfrom wrf_mi_bench import gpu_job\n"
        f"gpu_job.SIZES, gpu_job.STEP_SIZES, gpu_job.PREDICTED = {sizes}, (8, 16), {predicted}\n"
        "gpu_job.MOST_S, gpu_job.FEW_STEPS = 0.05, 'steps=2'\ngpu_job.job(*sys.argv[1:])\n"
    )
    monkeypatch.setattr(gpu, "JOB", "small_job")
    monkeypatch.setattr(gpu, "DEVICE", "llvm")
    monkeypatch.setattr(gpu, "BACKENDS", {gpu.GPU: ("llvm", 0), gpu.TWO: ("llvm", 2), gpu.ALL: ("llvm", 0)})
    monkeypatch.setattr(gpu, "FITS", {"ray tracing, laboratory": TRACED})
    monkeypatch.setattr(gpu, "FEW", {"train": ()})
    monkeypatch.setattr(gpu, "RUNS", tmp_path / "runs")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))
    rows = gpu.main()["rows"]
    titles = {"gaussians-splat": "splatting"}
    titles |= {f"step-{model}": f"training step of {title}" for model, title in gpu_job.STEPS_OF.items()}
    sizes |= {f"step-{model}": (8, 16) for model in gpu_job.STEPS_OF}
    expected = list(gpu.FITS)
    expected += [f"{titles[name]}, {size} Gaussians" for name, each in sizes.items() for size in each]
    expected += [f"predictions of factorised, {size} at once" for size in (1, 4)]
    expected += [f"a step of {title}" for title in gpu_job.STEPS_OF.values()]
    assert [row["what"] for row in rows] == expected
    assert "s to median SSIM" in rows[0]["value"]
    assert all(row[name] for row in rows[1:] for name in gpu.BACKENDS)
    lines = gpu.table(json.loads(json.dumps(rows))).splitlines()
    assert lines[3].startswith("| splatting, 20 Gaussians | ")
    assert len(lines) == 2 + len(expected)
