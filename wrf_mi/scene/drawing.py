"""Elements of all pictures of plans, scenes and maps: outlines, faces, devices, layers, colour bars and axes.

Axes are Matplotlib's, flat or 3D. Figures are made without pyplot: no global state, no window system.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import ArrayLike

from ..core.angles import FloatArray

COLOUR_MAP = "viridis"  # of all quantities: equal steps of a value look equal, in grey and to the colour-blind, too
ENDS = {"transmitter": ("o", "#0353a4"), "receiver": ("^", "#c1121f")}
"""Marker and colour of each kind of device."""
ELEVATION_DEG, AZIMUTH_DEG = 48.0, -60.0  # direction of the viewer of oblique views
MOST_FACES = 20_000  # faces of a picture, the largest
LABEL_SIZE, TICK_SIZE = 8, 7  # sizes of letters in points
FLATTEST = 0.05  # least extent of an axis of a 3D view, a share of the largest
TICKS = 6  # largest number of intervals of the longest axis


def shades(low: float, high: float) -> ScalarMappable:
    """Colours of values between two ends."""
    return ScalarMappable(Normalize(low, high), COLOUR_MAP)


def colour_bar(figure: Figure, colours: ScalarMappable, axes: Any, label: str, **options: Any) -> Colorbar:
    """Add the bar of colours to axes, with the name of the quantity and its unit."""
    bar = figure.colorbar(colours, ax=axes, **options)
    bar.set_label(label, fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)
    return bar


def draw_layer(axes: Axes, x_m: FloatArray, y_m: FloatArray, values: FloatArray, colours: ScalarMappable) -> None:
    """Draw values [ny, nx] over a grid in plan; NaN is left out."""
    mesh = axes.pcolormesh(x_m, y_m, values, shading="nearest", rasterized=True, cmap=colours.cmap)
    mesh.set_norm(colours.norm)


def draw_values(axes: Any, positions_m: FloatArray, values: ArrayLike, colours: ScalarMappable, **marks: Any) -> None:
    """Draw values [n] at positions [n, 2] or [n, 3] in a plan or a 3D view."""
    axes.scatter(*positions_m.T[: _dimensions(axes)], c=values, cmap=colours.cmap, norm=colours.norm, **marks)


def draw_outlines(axes: Axes, outlines: Sequence[FloatArray], **options: Any) -> None:
    """Draw arrays of lines [n, 2, 2] in plan, such as the cuts of walls."""
    how: dict[str, Any] = {"colors": "black", "linewidths": 1.2, "capstyle": "round", **options}
    # One collection: each takes Matplotlib milliseconds, and buildings have a thousand walls.
    if len(outlines):
        axes.add_collection(LineCollection(list(np.concatenate(outlines)), **how))


def draw_faces(axes: Any, corners_m: FloatArray, colours: FloatArray, **options: Any) -> None:
    """Draw the largest triangles [f, 3, 3] with their colours [f, 4] in a 3D view."""
    # Matplotlib sorts faces at each drawing: a scan's million takes minutes.
    if len(largest := np.argsort(-trimesh.triangles.area(corners_m), kind="stable")[:MOST_FACES]):
        how = {"edgecolors": "none", "antialiaseds": False} | options
        axes.add_collection3d(Poly3DCollection(corners_m[largest], facecolors=colours[largest], **how))


def draw_devices(axes: Any, kind: str, positions_m: ArrayLike, **options: Any) -> Line2D:
    """Draw transmitters or receivers at positions [n, 2] or [n, 3] in a plan or a 3D view."""
    marker, colour = ENDS[kind]
    how = {"markersize": 7, "markeredgecolor": "white", "linestyle": "none", "zorder": 8, "label": kind} | options
    points = np.atleast_2d(np.asarray(positions_m, float))
    (line,) = axes.plot(*points.T[: _dimensions(axes)], marker=marker, color=colour, **how)
    return line


def add_legend(figure: Figure, loc: str = "outside lower center", columns: int = 4) -> None:
    """Add a legend of the labelled marks of all axes, each label once."""
    parts = (zip(*axes.get_legend_handles_labels(), strict=True) for axes in figure.axes)
    entries: dict[str, Any] = {label: handle for part in parts for handle, label in part}
    if entries:
        how: dict[str, Any] = {"fontsize": LABEL_SIZE, "loc": loc, "ncols": columns, "facecolor": "0.92"}
        figure.legend(list(entries.values()), list(entries), **how)


def _dimensions(axes: Any) -> int:
    return 3 if axes.name == "3d" else 2


def set_plan(axes: Axes, low_m: ArrayLike | None = None, high_m: ArrayLike | None = None) -> None:
    """Draw a plan to scale, its axes in metres, between two corners [2 or 3] or around all that is drawn."""
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)", fontsize=LABEL_SIZE)
    axes.set_ylabel("y (m)", fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
    if low_m is not None and high_m is not None:
        low, high = np.asarray(low_m), np.asarray(high_m)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def set_box(axes: Any, low_m: FloatArray, high_m: FloatArray) -> None:
    """View the box between two corners [3] obliquely from above, orthographic and to scale, its axes in metres."""
    axes.set_proj_type("ortho")
    axes.view_init(ELEVATION_DEG, AZIMUTH_DEG)
    size = np.maximum(high_m - low_m, max(FLATTEST * float((high_m - low_m).max()), 0.1))
    for axis, name, start, extent in zip((axes.xaxis, axes.yaxis, axes.zaxis), "xyz", low_m, size, strict=True):
        axes.set(**{f"{name}lim": (start, start + extent)})
        axis.set_label_text(f"{name} (m)", fontsize=LABEL_SIZE)
        axis.set_pane_color((1, 1, 1, 0))
        # Labels of a short axis would lie upon each other.
        axis.set_major_locator(MaxNLocator(max(1, round(TICKS * extent / size.max()))))
    axes.set_box_aspect(size, zoom=0.92)
    axes.tick_params(labelsize=TICK_SIZE, pad=0)
    axes.grid(False)


def without_formulas(figure: Figure) -> Figure:
    """Switch off formulas in all texts of a figure: names may contain dollar signs."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)
    return figure
