"""Independent parts of a NumPy computation on threads."""

from __future__ import annotations

import threading

from wrf_mi.parallel.threads import on_threads


def test_parts_of_a_part_are_computed_in_its_thread() -> None:
    """Else each of them would have as many threads as there are processors."""

    def work(number: int) -> tuple[int, set[int]]:
        return 10 * number, set(on_threads(lambda _: threading.get_ident(), range(4))) ^ {threading.get_ident()}

    assert on_threads(work, range(5)) == [(10 * number, set()) for number in range(5)]
    assert on_threads(lambda _: threading.get_ident(), [0]) == [threading.get_ident()]
