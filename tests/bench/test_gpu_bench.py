"""Times on a GPU and on the CPU: the jobs of both, and the refusal without a GPU."""

import json
import os
import sys

from wrf_mi_bench import gpu, gpu_job
from wrf_mi_bench.bench import all_here
from wrf_mi_bench.check import main


def test_without_a_gpu_it_is_one_line(tmp_path, capsys):
    assert main("wrf_mi_bench.gpu:main", str(tmp_path / "out.json")) == 2
    assert capsys.readouterr().err.startswith("wrf-mi: bench gpu: CUDA cannot be used")
    assert "gpu" not in all_here()


def test_rows_have_the_times_of_both(monkeypatch, tmp_path):
    """Both jobs are measured on the CPU, each in its own process, as no test has a GPU."""
    small = tmp_path / "small_job.py"
    sizes = {"gaussians-splat": (20, 40)}
    small.write_text(
        "import sys\nfrom wrf_mi_bench import gpu_job\n"
        f"gpu_job.SIZES, gpu_job.STEP_SIZES = {sizes}, (8, 16)\ngpu_job.job(sys.argv[1], 'llvm')\n"
    )
    monkeypatch.setattr(gpu, "JOB", "small_job")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))
    monkeypatch.setattr(gpu, "choose", lambda backend: None)
    rows = gpu.main()["rows"]
    sizes |= {f"step-{model}": (8, 16) for model in gpu_job.STEPS_OF}
    titles = {"gaussians-splat": "splatting"}
    titles |= {f"step-{model}": f"training step of {title}" for model, title in gpu_job.STEPS_OF.items()}
    expected = [f"{titles[name]}, {size} Gaussians" for name, each in sizes.items() for size in each]
    assert [row["what"] for row in rows] == expected
    lines = gpu.table(json.loads(json.dumps(rows))).splitlines()
    assert lines[2].startswith("| splatting, 20 Gaussians | ")
    assert len(lines) == 2 + len(expected)
