"""Meanings of columns, positions in metres of a local frame, headings, and means of readings."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from changed_folders import refusal

from wrf_mi.apps.importing.column_names import unit_of
from wrf_mi.apps.importing.files import read_table
from wrf_mi.apps.importing.forms import Columns, find_columns, parsed_columns
from wrf_mi.apps.importing.places import find_frame, headings_rad, place_numbers, unit_scale
from wrf_mi.apps.importing.readings import Readings, mean_strengths, normal_id, without_not_heard

pytest.importorskip("pandas")


def columns_of(tmp_path: Path, header: str, row: str, stated: str = "", receivers: tuple[str, ...] = ()) -> Columns:
    (tmp_path / "t.csv").write_text(f"{header}\n{row}\n")
    return find_columns(read_table(tmp_path / "t.csv"), parsed_columns(stated), receivers)


LONG = {
    "time,x,y,BSSID,RSSI": ("0,1,2,aa:bb:cc:00:00:01,-60", "BSSID", "RSSI"),
    "PCI,latitude,longitude,device,rsrp": ("C,36.004,-78.93,Samsung,-124", "PCI", "rsrp"),
    "timestamp,lat,lon,pci,rsrp,rsrq": ("0,51.1,4.4,17,-110,-12", "pci", "rsrp"),
    "bssid,ssid,level,frequency,x,y": ("aa:bb:cc:00:00:01,net,-60,2412,1,2", "bssid", "level"),
    "t,anchorId,RSSI_dBm,posX,posY": ("1,7,-70,1,2", "anchorId", "RSSI_dBm"),
    "time,mac,rssi,x,y": ("1,aa:bb:cc:00:00:01,-70,1,2", "mac", "rssi"),
}


@pytest.mark.parametrize("header", LONG)
def test_tables_with_a_row_per_reading(header: str, tmp_path: Path) -> None:
    row, receiver, strength = LONG[header]
    columns = columns_of(tmp_path, header, row)
    assert (columns.of["id"], columns.of["rssi"], columns.strengths) == (receiver, strength, {})


WIDE = {
    "X,Y,AP1 RTT(mm),AP2 RTT(mm),AP1 RSS(dBm),AP2 RSS(dBm),LOS APs": ("0,1,2204,6069,-51,-200,1 2", ["AP1", "AP2"]),
    "WAP001,WAP002,LONGITUDE,LATITUDE,FLOOR,BUILDINGID": ("100,-97,-7541.2,4864921,2,1", ["WAP001", "WAP002"]),
    "MAC1,MAC2,ECoord,NCoord,FloorID,SampleTimes": ("-60,100,1352.5,3664.5,1,20", ["MAC1", "MAC2"]),
    "'BS 1','BS 2',RX Time,SF,HDOP,Latitude,Longitude": ("-200,-110,2017-11-17,7,0.7,51.2,4.4", ["'BS 1'", "'BS 2'"]),
    "x,y,z,heading,rssi_1,rssi_kitchen,std_1": ("0,1,2,0.5,-60,-70,1.5", ["1", "kitchen"]),
    "x,y,aa:bb:cc:00:00:01,aa:bb:cc:00:00:02": ("0,1,-60,0", ["aa:bb:cc:00:00:01", "aa:bb:cc:00:00:02"]),
    "pos_x,pos_y,RSSI": ("0,1,-60", ["RSSI"]),
}


@pytest.mark.parametrize("header", WIDE)
def test_tables_with_a_column_per_receiver(header: str, tmp_path: Path) -> None:
    row, ids = WIDE[header]
    columns = columns_of(tmp_path, header, row)
    assert list(columns.strengths.values()) == ids
    assert {"x", "y"} <= set(columns.of) or {"lat", "lon"} <= set(columns.of)
    assert "id" not in columns.of


def test_further_quantities_of_receivers_are_kept(tmp_path: Path) -> None:
    header = next(iter(WIDE))
    columns = columns_of(tmp_path, header, WIDE[header][0])
    assert columns.kept == ["AP1 RTT(mm)", "AP2 RTT(mm)", "LOS APs"]


def test_stated_columns_and_patterns_replace_guesses(tmp_path: Path) -> None:
    header, row = "t,u,v,x,beacon,value", "0,1,2,3,b1,-60"
    columns = columns_of(tmp_path, header, row, "x=u,y=v,id=beacon,rssi=value,time=-")
    assert columns.of == {"x": "u", "y": "v", "id": "beacon", "rssi": "value"}
    assert columns.kept == ["t", "x"]
    columns = columns_of(tmp_path, "x,y,A [dBm],B [dBm],noise_dbm", "0,1,-60,-70,-95", receivers=("? [dBm]",))
    assert columns.strengths == {"A [dBm]": "A", "B [dBm]": "B"}


def test_units_stand_at_the_end_of_names() -> None:
    names = {"x_mm": "mm", "X (m)": "m", "AP1 RTT(mm)": "mm", "freq [MHz]": "mhz", "rssi": "", "room": "", "x_true": ""}
    assert {name: unit_of(name) for name in names} == names


@pytest.mark.parametrize(
    ("stated", "receivers", "message"),
    [
        ("x=east", (), r"line 1: no column east \(columns: x, y, p\); correct --columns"),
        ("", ("AP*",), r"no column of signal strengths among x, y, p; write a row for each reading.*, or --receivers"),
        ("", (), r"no column of signal strengths"),
        *((text, (), r"--columns: .* give MEANING=COLUMN") for text in ("place=x", "x", "x=")),
    ],
)
def test_other_columns_are_refused(stated: str, receivers: tuple[str, ...], message: str, tmp_path: Path) -> None:
    refusal(columns_of, tmp_path, "x,y,p", "0,1,55", stated, receivers, message)


pyproj = pytest.importorskip("pyproj")

PLACE = np.array([[-78.9385, 36.001], [-78.9394, 36.0041], [-78.9373, 36.0030], [-78.9415, 36.0005]])
"""Longitude and latitude of places on a campus."""
AGREEMENT = 1e-4
"""Relative difference of distances in the projection from those on the ellipsoid, over half a kilometre: the map is
azimuthal equidistant about its middle, where its scale is 1 to 1e-8."""


def geodesic_m(degrees: np.ndarray) -> np.ndarray:
    """Distances from the first place to the others on the ellipsoid, by Karney's method."""
    first = np.repeat(degrees[:1], len(degrees) - 1, axis=0)
    return np.array(pyproj.Geod(ellps="WGS84").inv(*first.T, *degrees[1:].T)[2])


def web_map(degrees: np.ndarray) -> np.ndarray:
    return np.column_stack(pyproj.Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(*degrees.T))


CASES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], bool, str]] = {
    "longitude, latitude": (lambda degrees: degrees, True, ""),
    "x, y in degrees": (lambda degrees: degrees, False, ""),
    "metres of web maps": (web_map, True, "EPSG:3857"),
}


@pytest.mark.parametrize("case", CASES)
def test_local_distances_are_those_on_the_ellipsoid(case: str) -> None:
    convert, geographic, crs = CASES[case]
    frame, notes = find_frame(convert(PLACE), geographic, "", 1.0, crs)
    local_m = frame.local_m(convert(PLACE))
    np.testing.assert_allclose(np.linalg.norm(local_m[1:] - local_m[0], axis=1), geodesic_m(PLACE), rtol=AGREEMENT)
    east_north = local_m[1] - local_m[0]
    assert east_north[0] < 0 < east_north[1]  # the second place is north-west of the first
    assert "azimuthal equidistant" in notes[-1]
    assert frame.facts()["local_crs"].startswith("+proj=aeqd +lon_0=-78.9")


def test_frames_are_told_from_the_numbers() -> None:
    swapped = np.array([[40.7, -111.84], [40.701, -111.841]])  # latitude before longitude
    frame, _ = find_frame(swapped, False, "", 1.0, "")
    plain, _ = find_frame(swapped[:, ::-1], True, "", 1.0, "")
    np.testing.assert_allclose(frame.local_m(swapped), plain.local_m(swapped[:, ::-1]))
    utm = np.array([[684_321.5, 3_985_678.25], [684_400.5, 3_985_700.25]])  # metres of a map projection
    frame, notes = find_frame(utm, False, "", 1.0, "")
    np.testing.assert_array_equal(frame.local_m(utm), [[1.5, 8.25], [80.5, 30.25]])
    assert "shifted by 684320, 3985670 m" in notes[0]
    assert "EPSG:3857" in find_frame(utm, True, "", 1.0, "")[1][0]
    rng = np.random.default_rng(0)
    for origin in ([0, 0], [5, 5], [15, 3], [-8, 2]):  # metres of a room
        frame, _ = find_frame(rng.uniform(0, 3, (50, 2)) + origin, False, "", 1.0, "")
        assert frame.crs == ""


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("ft", 0.3048), ("cm", 0.01), ("", 1.0)])
def test_units_and_plans_in_metres(unit: str, metres: float) -> None:
    plan = np.array([[0.25, 0.5], [11.0, 7.5]])
    frame, notes = find_frame(plan, False, unit, unit_scale(unit, "--units"), "")
    np.testing.assert_allclose(frame.local_m(plan), plan * metres)
    assert notes == []


def test_unknown_units_and_systems_are_refused() -> None:
    refusal(unit_scale, "yard", "--units", "--units 'yard' is unknown; give one of m, mm")
    refusal(find_frame, PLACE, False, "", 1.0, "EPSG:0", "--crs: 'EPSG:0' is no coordinate reference system")


@pytest.mark.parametrize(
    ("name", "stated", "values", "expected"),
    [
        ("heading", "", [0, 90, 359], [0, np.pi / 2, np.radians(359)]),
        ("yaw", "", [0, -3.1, 6.2], [0, -3.1, 6.2]),
        ("heading_deg", "", [1, 2, 3], np.radians([1, 2, 3])),
        ("bearing", "", [0, 90, 270], [np.pi / 2, 0, -np.pi]),
        ("heading", "compass", [0, 4, 8], np.radians([90, 86, 82])),
    ],
)
def test_headings_run_from_x_towards_y(name: str, stated: str, values: list[float], expected: list[float]) -> None:
    np.testing.assert_allclose(headings_rad(np.array(values, float), name, stated)[0], expected)


def test_places_are_told_apart_by_position_and_conditions() -> None:
    xy_m = np.array([[0, 0], [1, 0], [-0.0, 0], [0, 0], [0.2, 0.1]])
    run = np.array(["a", "a", "a", "b", "a"])
    np.testing.assert_array_equal(place_numbers({"run": run}, xy_m, 0.0), [0, 1, 0, 2, 3])
    np.testing.assert_array_equal(place_numbers({"run": run}, xy_m, 0.5), [0, 1, 0, 2, 0])


NOISE_DB = 4.0
RATIO = 0.03
"""Relative error of a root mean square of 8000 errors: 1 / sqrt(16000), four times."""


def readings(dbm: np.ndarray, receivers: int = 1) -> Readings:
    """Readings [rows, receivers] in the order of the rows."""
    row, receiver = np.divmod(np.arange(dbm.size), receivers)
    ids = tuple(f"ap{number}" for number in range(receivers))
    return Readings(ids, row, receiver, np.asarray(dbm, float).ravel())


@pytest.mark.parametrize(("average", "expected"), [("db", -55.0), ("mw", 10 * np.log10((1e-5 + 1e-6) / 2))])
def test_means_in_db_and_in_mw(average: str, expected: float) -> None:
    means = mean_strengths(readings(np.array([-50.0, -60.0, -70.0])), np.array([0, 0, 2]), 3, average)
    np.testing.assert_allclose(means.dbm, [[expected, np.nan, -70.0]])
    np.testing.assert_array_equal(means.count, [[2, 0, 1]])
    np.testing.assert_array_equal(np.isnan(means.std), [[False, True, False]])


def test_mean_in_db_does_not_depend_on_the_number_of_readings() -> None:
    """The mean in mW does: it is above the typical strength, the more so the more readings there are."""
    rng = np.random.default_rng(0)
    count = np.repeat([2, 50], 4000)
    place = np.repeat(np.arange(len(count)), count)
    strengths = readings(-70 + NOISE_DB * rng.standard_normal(len(place)))
    few, many = (slice(0, 4000), slice(4000, None))
    in_db, in_mw = (mean_strengths(strengths, place, len(count), average).dbm[0] for average in ("db", "mw"))
    assert abs(in_db[few].mean() - in_db[many].mean()) < 0.2
    assert in_mw[many].mean() - in_mw[few].mean() > 0.5


def test_stated_noise_is_that_of_the_means() -> None:
    """Errors over the stated standard deviation are standard, at places with few readings and with many."""
    rng = np.random.default_rng(1)
    for count in (1, 2, 20):
        place = np.repeat(np.arange(8000), count)
        others = np.repeat(np.arange(8000, 8200), 30)  # places that tell the noise of a reading
        place = np.concatenate([place, others])
        means = mean_strengths(readings(NOISE_DB * rng.standard_normal(len(place))), place, 8200, "db")
        error = means.dbm[0, :8000] / np.sqrt(np.mean(means.std[0, :8000] ** 2))
        assert np.sqrt(np.mean(error**2)) == pytest.approx(1, abs=RATIO)


@pytest.mark.parametrize("mark", [-200.0, -101.0, -100.0, 0.0, 1.0, 100.0])
def test_numbers_for_not_heard_are_found(mark: float) -> None:
    rng = np.random.default_rng(2)
    dbm = np.round(rng.normal(-65, 8, (300, 3)))
    silent = rng.random(dbm.shape) < 0.3
    dbm[silent] = mark
    part, notes, numbers = without_not_heard(readings(dbm, 3), None)
    assert numbers == [mark]
    assert len(part.dbm) == np.count_nonzero(~silent)
    assert notes == [f"{mark:g} is not heard: {np.count_nonzero(silent)} readings are empty fields"]


def test_other_numbers_that_pile_up_are_kept() -> None:
    rng = np.random.default_rng(3)
    clipped = np.maximum(np.round(rng.normal(-80, 8, (1000, 1))), -87)
    part, notes, numbers = without_not_heard(readings(clipped), None)
    assert (len(part.dbm), numbers) == (1000, [])
    assert "--not-heard -87 leaves it out" in notes[0]
    assert len(without_not_heard(readings(clipped), [-87.0])[0].dbm) == np.count_nonzero(clipped > -87)
    # A customary number that one receiver of several has often, and measured strengths.
    weak = np.concatenate([np.full(50, -100.0), np.repeat(np.arange(-99.0, -89), 9)])
    dbm = np.concatenate([weak, np.round(rng.normal(-70, 5, 3000))])
    both = Readings(("weak", "strong"), np.arange(len(dbm)), np.repeat([0, 1], [len(weak), 3000]), dbm)
    alone = Readings(("weak",), np.arange(len(weak)), np.zeros(len(weak), int), weak)
    assert without_not_heard(alone, None)[2] == [-100]
    assert without_not_heard(both, None)[2] == []
    for _ in range(20):
        assert without_not_heard(readings(np.round(rng.normal(-70, 9, (200, 4))), 4), None)[2] == []


def test_ids_are_those_that_the_layout_reads() -> None:
    ids = {"007": "7", "7.0": "7", " 12 ": "12", "AP 1": "AP 1", "a/b": "a-b", "00:11:22:33:44:55": "00:11:22:33:44:55"}
    assert {text: normal_id(text) for text in ids} == ids
