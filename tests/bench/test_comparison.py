"""Parts of long benchmarks."""

from wrf_mi_bench.comparison import MEASURED, STORED, measured_on, stored_part


def test_part_is_measured_once_and_stored_with_machine_and_date(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    calls: list[int] = []

    def measure() -> dict[str, object]:
        calls.append(1)
        return {"score": 0.5}

    first, second = stored_part("rooms", "part", measure), stored_part("rooms", "part", measure)
    assert (len(calls), first) == (1, second)
    assert first["score"] == 0.5
    assert {"date", "machine", "versions", "source"} <= set(first[MEASURED])
    (STORED / "rooms" / "part.json").unlink()
    stored_part("rooms", "part", measure)
    assert len(calls) == 2


def test_dates_of_parts():
    assert measured_on([{MEASURED: {"date": "2026-01-02"}}]) == "2026-01-02"
    assert (
        measured_on([{MEASURED: {"date": day}} for day in ("2026-01-02", "2025-12-31")]) == "2025-12-31 to 2026-01-02"
    )
