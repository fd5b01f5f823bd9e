"""How rows are divided into parts."""

from __future__ import annotations

PARTS_EACH = 8
"""Parts for each worker: a slow one, or one that came late, leaves the others at most an eighth of its share."""


def row_parts(count: int, workers: int, least: int = 1, most: int = 1024) -> list[slice]:
    """Consecutive rows in parts of nearly equal size.

    Args:
        count: rows, 1 or more.
        workers: that share them, 1 or more.
        least: rows of a part at least (but for the last), where a part costs something whatever its size.
        most: rows of a part at most: what is lost with a worker, and what a message holds.

    Returns:
        Slices that cover 0..count - 1 in order.
    """
    size = min(max(-(-count // (PARTS_EACH * workers)), least), most)
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]
