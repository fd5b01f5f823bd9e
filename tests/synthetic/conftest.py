"""Synthetic data of less work: where devices are free is judged by fewer points, and the scan has fewer rays."""

from collections.abc import Iterator
from typing import Any

import pytest
import trimesh

from wrf_mi.synthetic import stored


@pytest.fixture(scope="module", autouse=True)
def _coarse() -> Iterator[None]:
    sample = trimesh.sample.sample_surface

    def fewer(mesh: trimesh.Trimesh, count: int, **options: Any) -> Any:
        return sample(mesh, count // 16, **options)  # one in 8 cm, below the clearance of 10 cm

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trimesh.sample, "sample_surface", fewer)
        patch.setattr(stored, "SCANNED_RAYS", 1_000)
        yield
