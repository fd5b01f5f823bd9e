"""Fields of point clouds that are not coordinates: other types, labels, noise and withheld points."""

import logging

import lzf
import numpy as np
import pytest
from made_rooms import closed_box, sampled, write_las

from wrf_mi.core import InputError
from wrf_mi.scene.scan.points import read_scan

STEP_M = 1e-3
"""Step of coordinates in LAS."""


@pytest.mark.parametrize("text", ["11 1.5 2.5 3.5\n13 0.5 2 3\n", "255,0,0,1.5,2.5,3.5\n0,0,9,1.5,2.5,3.5\n"])
def test_columns_that_may_be_labels_are_refused(text, tmp_path):
    (tmp_path / "scan.txt").write_text(text)
    with pytest.raises(InputError, match=r"scan\.txt: .*column 1 has whole numbers alone.*as in: label x y z"):
        read_scan([tmp_path / "scan.txt"])


def test_whole_millimetres_are_no_labels(tmp_path):
    (tmp_path / "scan.txt").write_text("1200 350 900 17\n1201 351 905 12\n")
    read = read_scan([tmp_path / "scan.txt"], "mm").points_m
    np.testing.assert_allclose(read, [[1.2, 0.35, 0.9], [1.201, 0.351, 0.905]], rtol=1e-12)


PCD_RECORD = np.dtype([("_", "<u1", (3,)), ("y", "<f8"), ("x", "<f4"), ("label", "<u2"), ("z", "<i4"), ("_2", "<u1")])
"""Fields of other types and widths than three floats, padding among them."""


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_fields_of_a_pcd_have_their_own_types(kind, tmp_path):
    rows = np.zeros(50, PCD_RECORD)
    rng = np.random.default_rng(3)
    rows["x"], rows["y"], rows["z"] = rng.uniform(0, 9, 50), 5e5 + rng.uniform(0, 9, 50), np.arange(50) - 20
    rows["label"], rows["_"] = 7, 255
    header = (
        "VERSION 0.7\nFIELDS _ y x label z _\nSIZE 1 8 4 2 4 1\nTYPE U F F U I U\nCOUNT 3 1 1 1 1 1\n"
        f"WIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA {kind}\n"
    )
    if kind == "ascii":
        lines = [" ".join(str(value) for field in row for value in np.atleast_1d(field)) for row in rows.tolist()]
        body = "\n".join(lines).encode()
    elif kind == "binary":
        body = rows.tobytes()
    else:
        plain = b"".join(rows[name].tobytes() for name in PCD_RECORD.names)
        packed = lzf.compress(plain)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    (tmp_path / "scan.pcd").write_bytes(header.encode() + body)
    read = read_scan([tmp_path / "scan.pcd"]).points_m
    np.testing.assert_allclose(read, np.stack([rows["x"], rows["y"], rows["z"]], axis=1), rtol=1e-7)


@pytest.mark.parametrize("name", ["scan.las", "scan.laz"])
@pytest.mark.parametrize("point_format", [3, 6])
def test_noise_and_withheld_points_of_las_are_left_out(name, point_format, tmp_path, caplog):
    rows = np.round(sampled(closed_box(), 400) / STEP_M)[:400] * STEP_M

    def marked(las):
        las.classification[:10] = 7
        las.classification[10:30] = 18 if point_format >= 6 else 7
        las.withheld[30:60] = 1
        las.classification[60:] = 6  # building

    write_las(tmp_path / name, rows, STEP_M, point_format=point_format, version="1.4", mark=marked)
    with caplog.at_level(logging.INFO):
        read = read_scan([tmp_path / name]).points_m
    np.testing.assert_allclose(read, rows[60:], atol=STEP_M / 2)
    assert "60 of 400 are points of classes noise or withheld: left out" in caplog.text
