"""Import of tables into a data set: the record that is read back, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from changed_folders import error_line, refusal
from matplotlib.figure import Figure

from wrf_mi import import_measurements
from wrf_mi.apps.checking import check_data
from wrf_mi.core import Record
from wrf_mi.datasets import read_ble_folder
from wrf_mi.datasets.ble_folder import TAG_HEIGHT_M

pandas = pytest.importorskip("pandas")
pyproj = pytest.importorskip("pyproj")

APS_M = {"kitchen": (1.0, 1.0), "hall": (11.0, 7.0), "7": (1.0, 7.0)}
ROUNDING = 1e-5
"""Of strengths near -60 dBm in single precision."""
rng = np.random.default_rng(0)
PLACES_M = np.round(rng.uniform(0, 12, (30, 2)), 3)
STRENGTHS = np.stack([-40 - 25 * np.log10(np.linalg.norm(PLACES_M - ap, axis=1) + 1) for ap in APS_M.values()], axis=1)
STRENGTHS = np.round(STRENGTHS, 2)


def wide(name: str = "rssi_{}") -> Any:
    frame = pandas.DataFrame(STRENGTHS, columns=[name.format(ap) for ap in APS_M])
    return frame.assign(x=PLACES_M[:, 0], y=PLACES_M[:, 1])


def long() -> Any:
    frame = wide("{}").assign(time=np.arange(30.0)).melt(["time", "x", "y"], var_name="bssid", value_name="level")
    return frame.sort_values(["time", "bssid"], ignore_index=True)


def imported(tmp_path: Path, frame: Any, **options: Any) -> Record:
    frame.to_csv(tmp_path / "table.csv", index=False)
    import_measurements(tmp_path / "table.csv", tmp_path / "data", replace=True, **options)
    assert check_data(tmp_path / "data").ok
    return read_ble_folder(tmp_path / "data")


def in_order(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Positions and strengths by receiver, in the order of `PLACES_M`."""
    ids = [receiver.name.removeprefix("anchor") for receiver in record.receivers]
    rows = [int(np.argmin(np.linalg.norm(record.tx_pos_m[:, :2] - place, axis=1))) for place in PLACES_M]
    return record.tx_pos_m[rows], record.observation[[ids.index(ap) for ap in APS_M]][:, rows].T


@pytest.mark.parametrize("form", ["wide", "long"])
def test_both_forms_give_the_same_rows(form: str, tmp_path: Path) -> None:
    record = imported(tmp_path, wide() if form == "wide" else long())
    positions_m, strengths = in_order(record)
    np.testing.assert_allclose(positions_m, np.column_stack([PLACES_M, np.full(30, TAG_HEIGHT_M)]))
    np.testing.assert_allclose(strengths, STRENGTHS, atol=ROUNDING)
    assert record.official is None
    assert np.isnan([receiver.position_m for receiver in record.receivers]).all()
    assert (record.n_readings, record.std, record.tx_heading_rad) == (None, None, None)


def test_receivers_and_rows_are_in_one_frame(tmp_path: Path) -> None:
    """Latitude and longitude, of rows and receivers: distances are those of the plan."""
    local = "+proj=aeqd +lon_0=-78.9385 +lat_0=36.001 +datum=WGS84"
    to_degrees = pyproj.Transformer.from_crs(local, "EPSG:4326", always_xy=True)
    plan_m = np.array(list(APS_M.values()))
    lon, lat = to_degrees.transform(*plan_m.T)
    anchors = pandas.DataFrame({"bssid": list(APS_M), "lat": lat, "lon": lon, "z": [2.0, 2.5, 3.0]})
    anchors.to_csv(tmp_path / "anchors.csv", index=False)
    lon, lat = to_degrees.transform(*PLACES_M.T)
    frame = wide().drop(columns=["x", "y"]).assign(latitude=lat, longitude=lon)
    record = imported(tmp_path, frame, anchors=tmp_path / "anchors.csv")
    positions_m = {receiver.name.removeprefix("anchor"): receiver.position_m for receiver in record.receivers}
    assert {ap: place[2] for ap, place in positions_m.items()} == {"kitchen": 2.0, "hall": 2.5, "7": 3.0}
    shift_m = positions_m["kitchen"][:2] - APS_M["kitchen"]
    for ap, place in APS_M.items():
        np.testing.assert_allclose(positions_m[ap][:2] - shift_m, place, atol=1e-3)
    shifted_m = record.tx_pos_m[:, :2] - shift_m
    assert max(np.linalg.norm(shifted_m - place, axis=1).min() for place in PLACES_M) < 1e-3
    facts = yaml.safe_load((tmp_path / "data" / "import.yml").read_text())
    assert facts["frame"]["crs"] == "EPSG:4326"
    assert len(facts["frame"]["origin"]) == 2


def test_readings_of_a_place_are_averaged_with_their_number_and_noise(tmp_path: Path) -> None:
    frame = pandas.concat([wide(), wide().assign(rssi_hall=wide().rssi_hall - 2)])
    frame.loc[frame.index == 3, "rssi_7"] = np.nan
    record = imported(tmp_path, frame)
    assert (len(record), record.n_readings is not None, record.std is not None) == (30, True, True)
    _, strengths = in_order(record)
    expected = STRENGTHS - [0, 1, 0]
    expected[3, 2] = np.nan
    np.testing.assert_allclose(strengths, expected, atol=ROUNDING)
    assert sorted(np.unique(record.n_readings)) == [0, 2]


@pytest.mark.parametrize("how", ["file", "column"])
def test_test_rows_are_the_stated_ones(how: str, tmp_path: Path) -> None:
    if how == "file":
        wide()[20:].to_csv(tmp_path / "test.csv", index=False)
        record = imported(tmp_path, wide()[:20], test=[tmp_path / "test.csv"])
    else:
        record = imported(tmp_path, wide().assign(split=["Train"] * 20 + ["test"] * 10))
    np.testing.assert_allclose(record.tx_pos_m[record.official[1], :2], PLACES_M[20:])


@pytest.mark.parametrize("match", ["rows", "point", "time"])
def test_positions_of_another_file(match: str, tmp_path: Path) -> None:
    values, positions = wide().drop(columns=["x", "y"]), pandas.DataFrame(PLACES_M, columns=["x", "y"])
    header = match != "rows"
    if match == "point":
        values, positions = values.assign(point=range(30)), positions.assign(point=range(30))[::-1]
    if match == "time":
        values = values.assign(time=np.arange(30) + 0.5)  # the last row is after all positions
        positions = positions.assign(time=np.arange(30))[::-1]
    positions.to_csv(tmp_path / "positions.csv", index=False, header=header)
    values.to_csv(tmp_path / "values.csv", index=False, header=header)
    import_measurements(tmp_path / "values.csv", tmp_path / "data", positions=[tmp_path / "positions.csv"])
    record = read_ble_folder(tmp_path / "data")
    expected = (PLACES_M[1:] + PLACES_M[:-1]) / 2 if match == "time" else PLACES_M
    assert len(record) == len(expected)
    assert max(np.linalg.norm(record.tx_pos_m[:, :2] - place, axis=1).min() for place in expected) < 1e-5


def test_times_of_another_unit_are_refused(tmp_path: Path) -> None:
    positions = tmp_path / "positions.csv"
    pandas.DataFrame(PLACES_M, columns=["x", "y"]).assign(time=np.arange(30)).to_csv(positions, index=False)
    frame = wide().drop(columns=["x", "y"]).assign(time=1000 * np.arange(30))
    message = r"row 2: its time is outside those of positions\.csv, as those of 29"
    refusal(imported, tmp_path, frame, message, positions=[positions])


def test_further_columns_are_kept(tmp_path: Path) -> None:
    frame = wide().assign(**{"hall RTT(mm)": np.arange(30.0), "operator": "a", "count_x": 3})
    imported(tmp_path, pandas.concat([frame, frame.assign(operator="b")]))
    tables = [pandas.read_csv(path) for path in (tmp_path / "data").glob("*.csv")]
    source_table = pandas.concat([table for table in tables if "rssi_hall" in table])
    order = [int(np.argmin(np.linalg.norm(source_table[["x", "y"]] - place, axis=1))) for place in PLACES_M]
    np.testing.assert_allclose(source_table["hall RTT(mm)"].iloc[order], np.arange(30.0))
    assert set(source_table.operator) == {"a|b"}
    assert set(source_table.source_count_x) == {3}


def of_two_devices(frame: Any) -> Any:
    """The second device's row 51 has no position, and another row no strength at one receiver."""
    both = pandas.concat([frame.assign(device=1.0), (frame - 20).assign(device=2.0)])
    both.iloc[40, 0] = both.iloc[50, both.columns.get_loc("x")] = np.nan
    return both


def test_rows_are_selected_by_a_column(tmp_path: Path) -> None:
    record = imported(tmp_path, of_two_devices(wide()), where={"device": "1"})
    np.testing.assert_allclose(in_order(record)[1], STRENGTHS, atol=ROUNDING)


@pytest.mark.parametrize("columns", [{"device": "a"}, {"walk": "a", "device": "c"}])
def test_rows_of_a_device_or_walk_are_a_run(tmp_path: Path, columns: dict[str, str]) -> None:
    first, other = columns, columns | {next(iter(columns)): "b"}
    record = imported(tmp_path, pandas.concat([wide().assign(**first), (wide() - 8).assign(**other)]))
    assert record.runs is not None
    assert sorted(record.runs) == ["a"] * 30 + ["b"] * 30


def test_headings_that_are_incomplete_are_kept_and_not_used(tmp_path: Path) -> None:
    record = imported(tmp_path, wide().assign(heading=[np.nan] + [0.5] * 29, run=["a"] * 29 + [None]))
    assert (record.tx_heading_rad, record.runs) == (None, None)
    assert "heading is empty in 1 rows: kept" in (tmp_path / "data" / "import.yml").read_text()
    header = (tmp_path / "data" / "measurements.csv").read_text().splitlines()[0].split(",")
    assert {"source_heading", "source_run"} <= set(header)


def test_receivers_of_a_scan_have_their_carriers(tmp_path: Path) -> None:
    mhz = {"kitchen": 2412, "hall": 5180, "7": 2412}
    record = imported(tmp_path, long().assign(frequency=long().bssid.map(mhz)))
    carriers = zip(record.receivers, record.receiver_carriers_hz, strict=True)
    carrier_of_ap = {receiver.name.removeprefix("anchor"): hz for receiver, hz in carriers}
    assert carrier_of_ap == {ap: 1e6 * carrier for ap, carrier in mhz.items()}
    assert len(record) == len(PLACES_M)


def test_receivers_that_change_their_channel_keep_one_carrier(tmp_path: Path) -> None:
    mhz = long().bssid.map({"kitchen": 2412, "hall": 5180, "7": 2412}).to_numpy(float)
    hall = np.flatnonzero(long().bssid == "hall")
    mhz[hall[:5]] = 5260  # another channel of the band
    record = imported(tmp_path, long().assign(frequency=mhz))
    names = [receiver.name.removeprefix("anchor") for receiver in record.receivers]
    assert record.receiver_carriers_hz is not None
    assert record.receiver_carriers_hz[names.index("hall")] == 5180e6
    assert len(record) == len(PLACES_M)
    assert "1 of 3 receivers changed their channel" in (tmp_path / "data" / "import.yml").read_text()
    mhz[hall[:5]] = 2412  # another band: rows have carriers
    (tmp_path / "bands").mkdir()
    record = imported(tmp_path / "bands", long().assign(frequency=mhz))
    assert record.carriers_hz is not None


def test_hardware_addresses_match_in_any_case_and_notation(tmp_path: Path) -> None:
    first, second, other = "B4:FB:E4:71:0D:A8", "00:1a:1e:4f:9c:20", "hall"
    frame = pandas.DataFrame({"x": [0.0, 0, 1, 1, 1], "y": [0.0, 0, 0, 0, 0], "rssi": [-50, -60, -52, -61, -70]})
    frame["bssid"] = [first, second, first.lower().replace(":", "-"), second.replace(":", ""), other]
    anchors = pandas.DataFrame({"id": [first.lower(), second.upper(), "Hall"], "x": [1, 2, 3], "y": 0, "z": 2})
    anchors.to_csv(tmp_path / "anchors.csv", index=False)
    record = imported(tmp_path, frame, anchors=tmp_path / "anchors.csv")
    by_name = {receiver.name: receiver.position_m[0] for receiver in record.receivers}
    assert {name: by_name[name] for name in (first, second)} == {first: 1, second: 2}
    assert np.isnan(by_name[other]), "names are not addresses"
    anchors.assign(id=[first, first.replace(":", "_"), other]).to_csv(tmp_path / "anchors.csv", index=False)
    message = r"anchors\.csv: row 2: receiver B4:FB:E4:71:0D:A8 is in an earlier row, too"
    refusal(imported, tmp_path, frame, message, anchors=tmp_path / "anchors.csv")


def test_sectors_keep_orientation_antenna_and_carrier(tmp_path: Path) -> None:
    anchors = pandas.DataFrame({"id": ["hall", "kitchen", "7"], "x": [1, 2, 3], "y": 0, "z": 20, "mast": "a"})
    sectors = {"azimuth_deg": [90, 0, np.nan], "pattern": ["tr38901", "", ""], "frequency_hz": [3.56e9, 3.6e9, 3.69e9]}
    anchors.assign(**sectors).to_csv(tmp_path / "anchors.csv", index=False)
    record = imported(tmp_path, wide(), anchors=tmp_path / "anchors.csv")
    by_name = {receiver.name: receiver for receiver in record.receivers}
    np.testing.assert_allclose(by_name["hall"].to_world[:, 2], [0, 1, 0], atol=1e-9)
    np.testing.assert_array_equal(by_name["anchor7"].to_world, np.eye(3))
    assert (by_name["hall"].antenna.pattern, by_name["kitchen"].antenna.pattern) == ("tr38901", "iso")
    assert [by_name[name].frequency_hz for name in ("hall", "kitchen", "anchor7")] == [3.56e9, 3.6e9, 3.69e9]
    assert "columns that are not used (1): mast" in (tmp_path / "data" / "import.yml").read_text()
    anchors.assign(id="hall").to_csv(tmp_path / "anchors.csv", index=False)
    message = r"anchors\.csv: row 2: receiver hall is in an earlier row, too"
    refusal(imported, tmp_path, wide(), message, anchors=tmp_path / "anchors.csv")


def test_picture_names_receivers_at_known_and_at_unknown_places(tmp_path, monkeypatch):
    figures = list[Figure]()
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    (tmp_path / "aps.csv").write_text("id,x,y,z\nkitchen,1,1,2.5\n7,1,7,2.5\n")
    imported(tmp_path, wide(), anchors=tmp_path / "aps.csv")
    (axes,) = figures[0].axes
    assert sorted(text.get_text() for text in axes.texts) == ["anchor7", "kitchen"]
    assert axes.get_title().splitlines()[1] == "receivers at unknown places: hall"


def test_receivers_heard_too_rarely_are_left_out_by_name(tmp_path: Path) -> None:
    frame = wide().assign(rssi_far=[-95.0, -96] + [np.nan] * 28, split=["train"] * 20 + ["test"] * 10)
    assert len(imported(tmp_path, frame).receivers) == 4
    assert len(imported(tmp_path, frame, min_heard=3).receivers) == 3
    assert "left out (--min-rows): far" in (tmp_path / "data" / "import.yml").read_text().replace("\n", " ")


def test_pitch_heading_carrier_run_and_storeys(tmp_path: Path) -> None:
    frame = wide().assign(x=range(30), y=0, floor=["L0", "L2"] * 15, heading=90, frequency_mhz=920, run="monday")
    record = imported(tmp_path, frame, pitch_m=0.6)
    np.testing.assert_allclose(np.sort(record.tx_pos_m[:, 0]), 0.6 * np.arange(30))
    assert set(record.tx_pos_m[:, 2].tolist()) == {TAG_HEIGHT_M, TAG_HEIGHT_M + 6.0}
    np.testing.assert_allclose(record.tx_heading_rad, np.pi / 2)
    np.testing.assert_array_equal(record.frequencies_hz, [920e6])
    assert set(record.runs) == {"monday"}


REFUSED: dict[str, tuple[Any, dict[str, Any], str]] = {
    "no x": (lambda f: f.assign(x=[np.nan, *f.x[1:]]), {}, r"table\.csv: row 1: x is empty or infinite; give a number"),
    "no position": (lambda f: f.drop(columns="x"), {}, "no columns of positions among .*--positions FILE"),
    "cell": (
        lambda f: f.drop(columns=["x", "y"]).assign(Cid="L4"),
        {"columns": "cell=Cid"},
        "row 1: Cid is 'L4'; give a text such as",
    ),
    "position of a device": (of_two_devices, {"where": {"device": "2"}}, "row 51: x is empty or infinite"),
    "unknown device": (of_two_devices, {"where": {"device": "3"}}, "no row has device 3; correct --where"),
    "carrier": (lambda f: f.assign(frequency=0), {}, "row 1: frequency is 0; give the carrier, or --columns"),
    "floor": (lambda f: f.assign(floor="attic"), {}, "row 1: floor is 'attic'; give its number, or leave"),
    "split": (lambda f: f.assign(split="maybe"), {}, "row 1: split is 'maybe'; give train or test"),
    "nothing heard": (None, {"not_heard": STRENGTHS.ravel().tolist()}, "no reading was heard"),
    "rarely heard": (None, {"min_heard": 99}, "no receiver was heard in 99 training rows"),
    "average": (None, {"average": "median"}, "--average 'median' is unknown; give one of db, mw"),
    "pitch": (None, {"pitch_m": -1}, "--pitch -1: give a number above 0"),
    "storey": (None, {"storey_m": 4.0}, "--storey: it belongs to a column floor without z; omit it"),
    "heading unit": (None, {"heading": "deg"}, "--heading-unit: the table has no column of headings; omit it"),
    "option": (None, {"sentinel": 1}, "no option sentinel; see ImportOptions"),
    "positions": (None, {"positions": ["a.csv", "b.csv"]}, r"a\.csv: missing"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_refused_and_nothing_written(case: str, tmp_path: Path) -> None:
    change, options, message = REFUSED[case]
    frame = change(wide()) if change else wide()
    frame.to_csv(tmp_path / "table.csv", index=False)
    error_line(import_measurements, tmp_path / "table.csv", tmp_path / "data", message, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]


def test_existing_folder_is_refused(tmp_path: Path) -> None:
    wide().to_csv(tmp_path / "table.csv", index=False)
    (tmp_path / "data").mkdir()
    refusal(import_measurements, tmp_path / "table.csv", tmp_path / "data", "data: exists; remove it")
    assert not list((tmp_path / "data").iterdir())
