"""Records as data with named dimensions, and back."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from spectrum_records import assert_same, full_record, make_record

import wrf_mi
from wrf_mi.datasets.labelled import ordered

CHANNELS = full_record()
STRENGTHS = replace(
    CHANNELS,
    task="rssi",
    observation=CHANNELS.observation[..., 0].real,
    **dict.fromkeys(("truth", "uplink", "uplink_hz", "frequencies_hz")),
)
RECORDS = {
    "rssi": (STRENGTHS, ()),
    "spectrum": (
        replace(make_record(6, 2, 9, 36), n_readings=CHANNELS.n_readings).at_carriers(np.arange(1.0, 7) * 1e9),
        ("elevation", "azimuth"),
    ),
    "csi": (CHANNELS, ("subcarrier",)),
    "csi of antennas": (
        replace(CHANNELS, **{name: getattr(CHANNELS, name)[:, :, None] for name in ("observation", "truth")}),
        ("antenna", "subcarrier"),
    ),
}


@pytest.mark.parametrize("name", RECORDS)
def test_records_are_read_back_without_loss_in_any_order_of_dimensions(name: str) -> None:
    record, dims = RECORDS[name]
    dataset = record.to_xarray()
    assert dataset["observation"].dims == ("row", "receiver", *dims)
    assert (dataset["observation"].isel(row=5, receiver=1).values == record.observation[1, 5]).all()
    assert_same(wrf_mi.load(dataset.transpose(*reversed(list(dataset.dims)))), record)
    if name == "spectrum":
        assert dataset["azimuth"].values[-1] == 350.0


def test_an_array_with_coordinates_of_its_rows_is_a_record() -> None:
    places = {axis: ("row", column) for axis, column in zip("xyz", STRENGTHS.tx_pos_m.T, strict=True)}
    labels = {"receiver": ["hall", "attic"], **places}
    array = xr.DataArray(STRENGTHS.observation.T, dims=("row", "receiver"), coords=labels)
    again = wrf_mi.load(array)
    np.testing.assert_array_equal(again.observation, STRENGTHS.observation)
    np.testing.assert_array_equal(again.tx_pos_m, STRENGTHS.tx_pos_m)
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
