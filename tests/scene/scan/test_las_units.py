"""Units in the headers of LAS files, by keys of GeoTIFF and well-known text."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr
from made_rooms import closed_box, sampled

from wrf_mi.checking import check_scene
from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.scan.las_units import stated_units

FOOT_M = 0.3048
GEOGRAPHIC = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.25]],UNIT["degree",0.0174532925]]'
METRES = f'PROJCS["UTM",{GEOGRAPHIC},PROJECTION["Transverse_Mercator"],UNIT["metre",1]]'
FEET = METRES.replace('UNIT["metre",1]', 'UNIT["US survey foot",0.3048006096]')
HEIGHTS = 'VERT_CS["NAVD88",VERT_DATUM["NAVD88",2005],UNIT["US survey foot",0.3048006096]]'
METRES_2 = (
    'PROJCRS["UTM",BASEGEOGCRS["WGS 84",DATUM["WGS 84",ELLIPSOID["WGS 84",6378137,298.25,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["UTM",METHOD["Transverse Mercator"],PARAMETER["False easting",0,LENGTHUNIT["metre",1]]],'
    'CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
)


def write_las(file: Path, points: np.ndarray, system: str | dict[int, int] | None) -> Path:
    """Points with a coordinate system in well-known text, or in codes by number of the key."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(points.min(axis=0))
    if isinstance(system, str):
        header.vlrs.append(WktCoordinateSystemVlr(system))
    elif system is not None:
        record = GeoKeyDirectoryVlr()
        record.geo_keys = [GeoKeyEntryStruct(key, 0, 1, code) for key, code in system.items()]
        record.geo_keys_header.number_of_keys = len(system)
        header.vlrs.append(record)
    cloud = laspy.LasData(header)
    cloud.xyz = points
    cloud.write(file)
    return file


@pytest.mark.parametrize(
    ("system", "units"),
    [
        (None, []),
        (METRES, ["m"]),
        (METRES_2, ["m"]),
        (METRES_2.replace("metre", "US survey foot"), ["ft"]),
        (FEET, ["ft"]),
        (f'COMPD_CS["both",{FEET},{HEIGHTS}]', ["ft"]),
        (f'COMPD_CS["both",{METRES},{HEIGHTS}]', ["m", "ft"]),
        (GEOGRAPHIC, ["degrees"]),
        (f'COMPD_CS["both",{GEOGRAPHIC},{HEIGHTS}]', ["degrees", "ft"]),
        ({1024: 1, 3076: 9001}, ["m"]),
        ({1024: 1, 3076: 9002, 4099: 9003}, ["ft"]),
        ({1024: 2, 4099: 9001}, ["degrees", "m"]),
        ({1024: 1, 3072: 25832}, []),
    ],
)
def test_units_are_those_of_easting_and_of_height(
    system: str | dict[int, int] | None, units: list[str], tmp_path: Path
) -> None:
    assert stated_units(write_las(tmp_path / "scan.las", np.eye(3), system)) == units


def test_scan_in_feet_is_refused_until_its_unit_is_given(tmp_path: Path) -> None:
    points = sampled(closed_box(), 12_000)
    file = write_las(tmp_path / "feet.laz", points / FOOT_M, FEET)
    with pytest.raises(InputError, match=r"feet\.laz: its coordinate system is in ft; state --units ft"):
        make_scene(file, tmp_path / "scene")
    assert "stated-units" in {finding.kind for finding in check_scene(file).of_level("warning")}
    assert "stated-units" not in {finding.kind for finding in check_scene(file, units="ft").findings}
    made = make_scene(file, tmp_path / "scene", units="ft")
    vertices_m = [trimesh.load(mesh).vertices for mesh in sorted((made.folder / "meshes").iterdir())]
    size = np.ptp(np.concatenate(vertices_m), axis=0)
    np.testing.assert_allclose(size, trimesh.util.concatenate(closed_box()).extents, atol=0.02)


def test_scan_of_two_units_is_to_be_exported_anew(tmp_path: Path) -> None:
    file = write_las(tmp_path / "both.las", sampled(closed_box(), 2000), f'COMPD_CS["both",{METRES},{HEIGHTS}]')
    with pytest.raises(InputError, match="is in m and heights in ft; export it in a projected"):
        make_scene(file, tmp_path / "scene")
    text = [finding.text for finding in check_scene(file).findings if finding.kind == "stated-units"]
    assert text == ["its coordinate system is in m and heights in ft, and is read in m"]
