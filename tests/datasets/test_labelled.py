"""Records as data with named dimensions, and back."""

from __future__ import annotations

from dataclasses import astuple, fields, replace

import numpy as np
import pytest
import xarray as xr

import wrf_mi
from wrf_mi.core import Antenna
from wrf_mi.datasets.labelled import ordered

RNG = np.random.default_rng(0)
POSITIONS_M = RNG.uniform(0, 5, (6, 3))
ARRAYS_M = (None, RNG.normal(size=(4, 3)))
RECEIVERS = tuple(
    wrf_mi.Receiver(name, np.full(3, k), np.array([0, 0, 0, 1.0]), Antenna("dipole"), ARRAYS_M[k])
    for k, name in enumerate(("hall", "attic"))
)
ROWS = {"tx_heading_rad": RNG.uniform(0, 6, 6), "folds": np.arange(6) % 2, "runs": np.array(list("aabbcc"))}
RECORDS = {
    "rssi": wrf_mi.Record(
        "flat", "rssi", POSITIONS_M, RECEIVERS, RNG.normal(-60, 5, (2, 6)), (np.arange(4), np.arange(4, 6)), **ROWS
    ),
    "spectrum": wrf_mi.Record(
        "room", "spectrum", POSITIONS_M, RECEIVERS, RNG.random((2, 6, 9, 36)), carriers_hz=np.arange(1.0, 7) * 1e9
    ),
    "csi": wrf_mi.Record(
        "cell",
        "csi",
        POSITIONS_M,
        RECEIVERS,
        RNG.random((2, 6, 4, 3)) + 1j,
        frequencies_hz=np.array([1e9, 2e9, 3e9]),
        uplink=RNG.random((6, 4, 2)) + 1j,
        uplink_hz=np.array([4e9, 5e9]),
    ),
}
DIMS = {"rssi": (), "spectrum": ("elevation", "azimuth"), "csi": ("antenna", "subcarrier")}


def equal(a: object, b: object) -> bool:
    return (a is b is None) or np.array_equal(np.asarray(a), np.asarray(b))


@pytest.mark.parametrize("task", RECORDS)
def test_records_are_read_back_without_loss_in_any_order_of_dimensions(task: str) -> None:
    record = RECORDS[task]
    dataset = record.to_xarray()
    assert dataset["observation"].dims == ("row", "receiver", *DIMS[task])
    assert float(dataset["observation"].isel(row=5, receiver=1).sum().real) == record.observation[1, 5].sum().real
    again = wrf_mi.load(dataset.transpose(*reversed(list(dataset.dims))))
    for name in (field.name for field in fields(record)):
        one, other = getattr(record, name), getattr(again, name)
        if name == "receivers":
            pairs = [pair for both in zip(one, other, strict=True) for pair in zip(*map(astuple, both), strict=True)]
            assert all(equal(a, b) for a, b in pairs)
        elif name == "official" and one is not None:
            assert all(map(equal, one, other))
        else:
            assert equal(one, other), name
    if task == "spectrum":
        assert dataset["azimuth"].values[-1] == 350.0


def test_an_array_with_coordinates_of_its_rows_is_a_record() -> None:
    record = replace(RECORDS["rssi"], official=None)
    places = {axis: ("row", column) for axis, column in zip("xyz", POSITIONS_M.T, strict=True)}
    labels = {"receiver": ["hall", "attic"], **places}
    array = xr.DataArray(record.observation.T, dims=("row", "receiver"), coords=labels)
    again = wrf_mi.load(array)
    np.testing.assert_array_equal(again.observation, record.observation)
    np.testing.assert_array_equal(again.tx_pos_m, POSITIONS_M)
    assert not again.receivers[0].is_surveyed
    for wrong, message in (
        (array.drop_vars("z"), "no variable tx_pos_m"),
        (array.rename(receiver="anchor"), "dimensions"),
        (array.to_dataset(name="rssi"), "no variable observation"),
    ):
        with pytest.raises(wrf_mi.InputError, match=message):
            wrf_mi.load(wrong)
    with pytest.raises(wrf_mi.InputError, match="name them row, axis"):
        ordered(array, "row", "axis")
