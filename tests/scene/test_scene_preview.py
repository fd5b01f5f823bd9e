"""Pictures of scenes: that they show what they are given, where it is."""

import numpy as np
import pytest
from made_plans import L_ROOM_M
from matplotlib.collections import LineCollection, PolyCollection
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image

from wrf_mi.core.files import write_figure
from wrf_mi.core.paths import Paths
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.plan.storey import plan_surfaces
from wrf_mi.scene.preview import GaussianCloud, draw_scene


def room():
    return plan_surfaces(L_ROOM_M, height_m=2.5)


def cloud(n=5):
    rng = np.random.default_rng(0)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    return GaussianCloud(rng.uniform(0, 4, (n, 3)), np.tile([0.3, 0.2, 0.1], (n, 1)), still, np.linspace(-60, -20, n))


def one_path():
    along = np.array([[1.0, 0, 0]])
    return Paths(
        tx=np.array([0]),
        rx=np.array([0]),
        gain=np.array([1e-3 + 0j]),
        length_m=np.array([5.0]),
        departure=along,
        arrival=along,
        interactions=np.array([[1, 0]], np.uint8),
        vertices_m=np.array([[[3.0, 0.0, 1.0], [np.nan] * 3]]),
        objects=np.array([[0, -1]], np.int32),
        object_names=("wall",),
        n_tx=1,
        n_rx=1,
    )


def test_preview_is_written_whole(tmp_path):
    figure = draw_scene(room(), points_m=np.random.default_rng(0).uniform(0, 4, (100, 3)))
    path = write_figure(tmp_path / "preview.png", figure)
    with Image.open(path) as picture:
        assert picture.size[0] > 1000
        grey = np.asarray(picture.convert("L"))
    assert grey.std() > 20
    assert [p.name for p in tmp_path.iterdir()] == ["preview.png"]


def test_plan_shows_the_walls_where_they_are():
    plan = draw_scene(room()).axes[1]
    cuts = [c for c in plan.collections if isinstance(c, LineCollection)]
    shown = np.concatenate([segment for c in cuts for segment in c.get_segments()])
    assert shown.min(axis=0) == pytest.approx([0, 0])
    assert shown.max(axis=0) == pytest.approx([5, 4.5])
    assert len(cuts) == len(L_ROOM_M) - 1


def faces_drawn(figure):
    """How many faces the slanted view shows: each has a colour of its own."""
    slant = figure.axes[0]
    return sum(len(c.get_facecolor()) for c in slant.collections if isinstance(c, Poly3DCollection))


def test_plan_states_the_height_of_its_cut_far_above_sea_level():
    high = [Surface(s.name, s.kind, s.vertices_m + np.array([0, 0, 412.0]), s.faces) for s in room()]
    title = draw_scene(high).axes[1].get_title()
    assert 412.0 < float(title.split()[-2]) < 414.5


def test_ceiling_is_taken_off_and_floor_stays():
    surfaces = room()
    walls = [s for s in surfaces if s.kind == "wall"]
    assert faces_drawn(draw_scene(surfaces[:1])) == len(surfaces[0].faces)
    assert faces_drawn(draw_scene(surfaces[1:2])) == 0
    assert faces_drawn(draw_scene(surfaces)) == len(surfaces[0].faces) + 2 * len(walls)


def test_paths_gaussians_and_devices_are_in_both_views():
    tx, rx = np.array([[1.0, 1, 1]]), np.array([[5.0, 1, 1]])
    figure = draw_scene(
        room(),
        points_m=np.zeros((3, 2)),
        paths=one_path(),
        transmitters_m=tx,
        receivers_m=rx,
        gaussians=cloud(),
        title="all",
    )
    slant, plan = figure.axes[:2]
    bounced = [c.get_segments()[0] for c in plan.collections if isinstance(c, LineCollection) and c.zorder == 6]
    assert np.allclose(bounced[0], [[1, 1], [3, 0], [5, 1]])
    ellipses = next(c for c in plan.collections if isinstance(c, PolyCollection) and c.zorder == 4).get_paths()
    # The strongest is drawn last; seen from above it spans its standard deviations.
    outline = ellipses[-1].vertices - cloud().position_m[-1, :2]
    assert np.abs(outline).max(axis=0) == pytest.approx([0.3, 0.2], rel=0.02)
    assert len(ellipses) == 5
    assert {c.zorder for c in slant.collections} >= {1, 2, 5, 6}
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["floor", "wall", "transmitter", "receiver"]
    assert {axes.get_ylabel() for axes in figure.axes[2:]} == {"gain of a path (dB)", "signal of a Gaussian (dB)"}


def test_level_faces_near_the_top_are_not_drawn():
    box = np.array([[x, y, z] for z in (0, 2) for y in (0, 3) for x in (0, 4)], float)
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]])
    assert faces_drawn(draw_scene([Surface("mesh", "other", box, faces)])) == 4


def test_scenes_without_surfaces_or_path_ends_are_refused():
    with pytest.raises(ValueError, match="no surface"):
        draw_scene([])
    with pytest.raises(ValueError, match="paths need"):
        draw_scene(plan_surfaces(L_ROOM_M, height_m=2), paths=one_path())
