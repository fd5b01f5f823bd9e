"""Measurements that a scene was corrected by, from its ``correction.json``.

A corrected scene knows these rows: models that trace it have smaller errors there than elsewhere, although they were
fitted without them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.files import readable
from ..core.types import IntArray

FILE, KEY = "correction.json", "data"  # file of a corrected scene, and the key there


@dataclass(frozen=True)
class CorrectionData:
    """Rows that a scene was corrected by.

    Attributes:
        name: name of the data set.
        rows: their numbers.
        error_ratio: error of rows that were held out of the correction, over the error of the same rows once they
            were used: 1 or more.
    """

    name: str
    rows: IntArray
    error_ratio: float

    def facts(self) -> dict[str, Any]:
        """The entry of ``correction.json``."""
        return {"name": self.name, "rows": self.rows.tolist(), "error_ratio": self.error_ratio}

    def knows(self, name: str, rows: IntArray) -> NDArray[np.bool_]:
        """Whether the scene was corrected by rows of a data set."""
        return np.isin(rows, self.rows) & (name == self.name)


def read_correction_data(scene: str | Path | None) -> CorrectionData | None:
    """The rows that a scene was corrected by; None for one that is not corrected.

    Raises:
        InputError: ``correction.json`` is not what a correction writes.
    """
    path = Path(scene or "") / FILE
    if scene is None or not path.is_file():
        return None
    with readable(path, f"{path}: missing", "correct the scene again"):
        facts = json.loads(path.read_text(encoding="utf-8")).get(KEY)
        if facts is None:  # nothing was changed, or the file is older than the entry
            return None
        rows = np.asarray(facts["rows"], np.int64).reshape(-1)
        return CorrectionData(str(facts["name"]), rows, max(float(facts["error_ratio"]), 1.0))
