"""Counts of what was evaluated and skipped."""

from wrf_mi.core.counts import added, count, counted, counting
from wrf_mi.parallel.threads import on_threads


def test_counts_of_threads_add_up_in_the_innermost_context():
    count("paths", 1, 1)  # nobody counts
    assert not counting()
    with counted() as outer:
        with counted():  # as empty as the outer one
            pass
        count("paths", 2, 3)
        with counted() as inner:
            on_threads(lambda k: count("paths", k, 1), range(20))
        count("tiles", 1, 0)
    assert outer == {"paths": {"evaluated": 2, "skipped": 3}, "tiles": {"evaluated": 1, "skipped": 0}}
    assert inner == {"paths": {"evaluated": 190, "skipped": 20}}
    assert added([outer, inner])["paths"] == {"evaluated": 192, "skipped": 23}
    assert not counting()
