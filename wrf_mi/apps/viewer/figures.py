"""Plotly figures of a view: the scene in 3D, and observed beside predicted values of the chosen transmitter.

Traces that depend on no choice are complete. Those that depend on the receiver, on the transmitter or on both get
attributes from a table for each, which ``page.js`` hands to ``Plotly.restyle``: Plotly's own frames and buttons know no
product of two choices.
"""

from __future__ import annotations

import base64
import html
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trimesh.creation import icosphere

from ...core.angles import FloatArray, rotation_matrix
from ...scene.drawing import COLOUR_MAP, ENDS
from ...scene.preview import SPAN_DB
from .content import GaussiansContent, MapContent, PathsContent, RowsContent, SceneContent, ViewContent

Changes = dict[int, dict[str, Any]]
"""Attributes by number of the trace that gets them."""

OPACITIES = (0.35, 0.05, 0.15, 0.7, 1.0)  # of the mesh, the first at first
SHOWN_GAUSSIANS = 200  # Gaussians that are visible at first, the strongest
ROWS_TAIL, MAP_TAIL = 2, 1  # percentages of scores and of a map's values beyond either end of their colours
BARS = {"rows": 0.0, "gain": 0.25, "signal": 0.5, "map": 0.75}  # left ends of colour bars, shares of the width
BAR_LETTERS, MENU_LETTERS = 16, 36  # letters in a line above a colour bar, and of a quantity in a menu
EYE = {"x": 1.05, "y": -1.55, "z": 1.35}  # place of the camera, in units of Plotly's
BOX = 1.6  # diagonal of the box of the axes in these units: the camera's 45 degrees see all of it, with its labels
THINNEST = 0.05  # least edge of the box, a share of the largest: Plotly's camera cannot see all of much thinner ones


def spec(values: NDArray[Any]) -> dict[str, str]:
    """An array as Plotly reads it from JSON: base64 of float32, or of unsigned integers of few bytes."""
    kind = "f4" if values.dtype.kind == "f" else f"u{np.min_scalar_type(int(values.max(initial=0))).itemsize}"
    text = base64.b64encode(np.ascontiguousarray(values, f"<{kind}").tobytes()).decode("ascii")
    return {"dtype": kind, "bdata": text, "shape": ", ".join(map(str, values.shape))}


def plain(text: str) -> str:
    """Text for Plotly, which reads some tags."""
    return html.escape(text, quote=False)


def _columns(names: str, rows: NDArray[Any]) -> dict[str, Any]:
    """Coordinates "xyz" of points, or corners "ijk" of faces, [n, 3]."""
    return {name: spec(column) for name, column in zip(names, rows.T, strict=True)}


def _lines(parts: Iterable[FloatArray]) -> FloatArray:
    """Polylines [n, 3] one after the other, each with a gap behind it."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([np.zeros((0, 3)), *(piece for part in parts for piece in (part, gap))])


def _coloured(bar: str, label: str, low: float, high: float, shown: bool = True) -> dict[str, Any]:
    """Colours of a quantity, perhaps with their bar above the scene."""
    title = {"text": "<br>".join(map(plain, textwrap.wrap(label, BAR_LETTERS))), "side": "top", "font": {"size": 11}}
    place = {"orientation": "h", "x": BARS[bar], "xanchor": "left", "y": 1, "yanchor": "bottom", "len": 0.24}
    place |= {"title": title, "thickness": 8, "nticks": 3, "tickfont": {"size": 10}, "xpad": 8, "ypad": 4}
    return {"colorscale": COLOUR_MAP.capitalize(), "cmin": low, "cmax": high, "showscale": shown, "colorbar": place}


def _ends(values: NDArray[Any], tail: float) -> tuple[float, float]:
    """Ends of a colour scale that leave a percentage of the known values beyond either of them."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [tail, 100 - tail]).tolist() if finite.size else (0.0, 1.0)
    return low, high


def _span(values_db: FloatArray) -> tuple[float, float]:
    """Ends of the colour scale of values in dB."""
    return max(float(values_db.min()), float(values_db.max()) - SPAN_DB), float(values_db.max())


class SceneFigure:
    """The scene: its traces, and the attributes that depend on receiver, transmitter or both."""

    def __init__(self, content: ViewContent) -> None:
        count = 0 if content.rows is None else len(content.rows.stored)
        self.traces: list[dict[str, Any]] = []
        self.receivers: list[Changes] = [{} for _ in content.receivers]
        self.transmitters: list[Changes] = [{} for _ in range(count)]
        self.pairs: list[list[Changes]] = [[{} for _ in content.receivers] for _ in range(count)]
        self.ellipsoids: dict[str, Any] | None = None
        self.choosable: int | None = None  # number of the trace of the transmitters that can be chosen
        self.menus: list[dict[str, Any]] = []
        self.shown_m: list[FloatArray] = []  # points that the axes include
        if content.rows is not None:
            self._add_rows(content.rows)
        if np.isfinite(content.receivers_m).any():
            self._add_receivers(content.receivers, content.receivers_m)
        if content.paths is not None and len(content.paths.tx):
            self._add_paths(content.paths)
        if content.gaussians is not None:
            self._add_gaussians(content.gaussians)
        self._add_maps(content.maps, content.receivers)
        if content.scene is not None:
            self._add_scene(content.scene)

    def _add(self, kind: str, name: str, points_m: FloatArray | None = None, **attributes: Any) -> int:
        """Number of a new trace, at points [n, 3] unless these depend on a choice."""
        placed = {} if points_m is None else _columns("xyz", points_m)
        self.shown_m += [] if points_m is None else [points_m]
        self.traces.append({"type": kind, "name": plain(name), "showlegend": True, **placed, **attributes})
        return len(self.traces) - 1

    def _add_rows(self, rows: RowsContent) -> None:
        """Held-out rows coloured by their score, those that can be chosen larger, and the chosen one."""
        hover = f"row %{{customdata}}, {plain(rows.label)} %{{marker.color:.{rows.digits}f}}<extra></extra>"
        every = np.arange(len(rows.row))
        for name, shown, size in (("held-out rows", every, 3), ("transmitters that can be chosen", rows.stored, 6)):
            # Plotly draws scores that are not finite, of rows that were not received, in grey.
            colours = _coloured("rows", rows.label, *_ends(rows.score, ROWS_TAIL), self.choosable is None)
            how = {"mode": "markers", "customdata": spec(rows.row[shown]), "hovertemplate": hover}
            how["marker"] = {"size": size, "symbol": "circle" if size == 3 else "diamond", **colours}
            self.choosable = self._add("scatter3d", f"{name} ({len(shown)})", rows.tx_pos_m[shown], **how)
            for changes, score in zip(self.receivers, rows.score, strict=True):
                changes[self.choosable] = {"marker.color": spec(score[shown])}
        marker = {"size": 6, "color": ENDS["transmitter"][1], "line": {"width": 1, "color": "#fff"}}
        chosen = self._add("scatter3d", "chosen transmitter", mode="markers", marker=marker, hovertemplate=name)
        for changes, position_m in zip(self.transmitters, rows.tx_pos_m[rows.stored], strict=True):
            changes[chosen] = _columns("xyz", position_m[None])

    def _add_receivers(self, names: Sequence[str], positions_m: FloatArray) -> None:
        """Receivers, the chosen one larger."""
        placed = np.flatnonzero(np.isfinite(positions_m).all(axis=1)).tolist()
        marker = {"color": ENDS["receiver"][1], "symbol": "diamond", "line": {"width": 1, "color": "#fff"}}
        how = {"mode": "markers", "text": [plain(names[k]) for k in placed], "hovertemplate": "%{text}<extra></extra>"}
        number = self._add("scatter3d", f"receivers ({len(placed)})", positions_m[placed], marker=marker, **how)
        for receiver, changes in enumerate(self.receivers):
            changes[number] = {"marker.size": [9 if k == receiver else 6 for k in placed]}

    def _add_paths(self, paths: PathsContent) -> None:
        """Paths of each pair of devices, coloured by their gain, a trace for each sequence of interactions."""
        self.shown_m.append(paths.corners_m)
        ends, groups = np.cumsum(paths.order + 2), defaultdict(list)
        for index, group in enumerate(zip(paths.tx.tolist(), paths.rx.tolist(), paths.kind.tolist(), strict=True)):
            groups[group].append(index)
        for kind, words in enumerate(paths.kinds):
            line = _coloured("gain", "gain of a path (dB)", *_span(paths.gain_db), kind == 0) | {"width": 3}
            how: dict[str, Any] = {"mode": "lines", "line": line}
            how["hovertemplate"] = "%{line.color:.1f} dB, %{customdata:.2f} m"
            number = self._add("scatter3d", f"paths: {words}", **how)
            for tx, rx in np.ndindex(len(self.transmitters), len(self.receivers)):
                chosen = groups[tx, rx, kind]
                corners = _lines(paths.corners_m[ends[k] - paths.order[k] - 2 : ends[k]] for k in chosen)
                repeats = paths.order[chosen] + 3  # corners and the gap behind them
                gain_db, length_m = (spec(np.repeat(v[chosen], repeats)) for v in (paths.gain_db, paths.length_m))
                self.pairs[tx][rx][number] = {**_columns("xyz", corners), "line.color": gain_db, "customdata": length_m}

    def _add_gaussians(self, gaussians: GaussiansContent) -> None:
        """Ellipsoids at one standard deviation; ``page.js`` makes their corners, for which a page has no room."""
        axes = rotation_matrix(gaussians.rotation_xyzw) * np.exp(gaussians.log_scale)[..., None, :]
        reach_m = np.linalg.norm(axes[0], axis=-1)
        self.shown_m += [gaussians.position_m - reach_m, gaussians.position_m + reach_m]
        sphere, numbers, count = icosphere(subdivisions=1), [], len(gaussians.position_m)
        for first, shown in ((0, min(count, SHOWN_GAUSSIANS)), (SHOWN_GAUSSIANS, count - SHOWN_GAUSSIANS)):
            if shown > 0:
                faces = sphere.faces + len(sphere.vertices) * np.arange(shown)[:, None, None]
                how = _coloured("signal", "signal of a Gaussian (dB)", *_span(gaussians.strength_db), not first)
                how |= {"visible": "legendonly" if first else True, "opacity": 0.4, "lighting": {"ambient": 0.85}}
                how |= {"hovertemplate": "%{intensity:.1f} dB<extra></extra>", **_columns("ijk", faces.reshape(-1, 3))}
                name = f"Gaussians ({'further' if first else 'strongest'} {shown} of {gaussians.total})"
                numbers.append(self._add("mesh3d", name, **how))
        arrays = {"axes": axes, "strengths": gaussians.strength_db}
        self.ellipsoids = {name: [spec(part.ravel()) for part in values] for name, values in arrays.items()}
        self.ellipsoids |= {"traces": numbers, "most": SHOWN_GAUSSIANS, "sphere": sphere.vertices.tolist()}
        self.ellipsoids["centres"] = gaussians.position_m.tolist()

    def _add_maps(self, maps: Sequence[MapContent], receivers: Sequence[str]) -> None:
        """Maps from below to above, a trace for each quantity of each; a menu chooses one of them."""
        numbers: list[int] = []
        labels = []
        for shown in sorted(maps, key=lambda content: np.inf if content.height_m is None else content.height_m):
            for name, values in shown.values.items():
                numbers.append(self._add_map(shown, shown.labels[name], values, receivers, not numbers))
                place = shown.name if shown.height_m is None else f"{shown.height_m:.2f} m"
                labels.append(f"{textwrap.shorten(shown.labels[name], MENU_LETTERS)}, {place}")
        self._add_menu(labels, [{"visible": [n == k for n in numbers]} for k in numbers], numbers)

    def _add_map(
        self, shown: MapContent, label: str, values: NDArray[Any], receivers: Sequence[str], visible: bool
    ) -> int:
        """A quantity as a surface over a grid, or as points; its values are those of the chosen receiver."""
        how: dict[str, Any] = {"opacity": 0.9, "visible": visible}
        colours = _coloured("map", label, *_ends(values, MAP_TAIL))
        if shown.z_m is not None:
            how |= {"mode": "markers", "marker": {"size": 4, **colours}}
            kind, attribute, points_m = "scatter3d", "marker.color", np.stack([shown.x_m, shown.y_m, shown.z_m], -1)
        else:
            height_m = np.where(np.isfinite(values).any(axis=0), float(shown.height_m or 0), np.nan)
            how |= {"lighting": {"ambient": 1, "diffuse": 0, "specular": 0}, **colours}
            kind, attribute = "surface", "surfacecolor"
            points_m = np.stack([*np.meshgrid(shown.x_m, shown.y_m), height_m], -1).reshape(-1, 3)
        number = self._add(kind, "map", points_m, hovertemplate=f"%{{{attribute}:.2f}}<extra></extra>", **how)
        if shown.z_m is None:
            self.traces[number] |= {"x": spec(shown.x_m), "y": spec(shown.y_m), "z": spec(height_m)}
        for receiver, changes in zip(receivers, self.receivers, strict=True):
            if len(values) == 1 or receiver in shown.receivers:
                of_receiver = values[0 if len(values) == 1 else shown.receivers.index(receiver)]
                changes[number] = {attribute: spec(of_receiver)}
        return number

    def _add_scene(self, scene: SceneContent) -> None:
        """Triangles by material, ceilings switched off, and edges; a menu chooses the opacity."""
        lighting = {"ambient": 0.75, "diffuse": 0.5, "specular": 0.05}
        lighting |= {"facenormalsepsilon": 0, "vertexnormalsepsilon": 0}
        numbers = []
        for mesh in scene.meshes:
            # Corners that triangles of a surface share are stored once.
            names, surface = np.unique(mesh.surface, return_inverse=True)
            corners = np.column_stack([mesh.corners_m.reshape(-1, 3), np.repeat(surface, 3)])
            vertices, faces = np.unique(corners, axis=0, return_inverse=True)
            how = _columns("ijk", faces.reshape(-1, 3)) | {"color": mesh.colour, "opacity": OPACITIES[0]}
            how |= {"flatshading": True, "lighting": lighting, "visible": "legendonly" if mesh.ceiling else True}
            how["text"] = [plain(names[k]) for k in vertices[:, 3].astype(int)]
            how["hovertemplate"] = f"%{{text}}<br>{plain(mesh.material)}<extra></extra>"
            name, vertices_m = mesh.material + ", ceiling" * mesh.ceiling, np.asarray(vertices[:, :3], float)
            numbers.append(self._add("mesh3d", name, vertices_m, **how))
        if len(scene.edges_m):
            line = {"color": "#2b2d42", "width": 1.5}
            self._add("scatter3d", "edges", _lines(scene.edges_m), mode="lines", line=line, hoverinfo="skip")
        opacities = [{"opacity": opacity} for opacity in OPACITIES]
        self._add_menu([f"mesh: {opacity:.0%} opaque" for opacity in OPACITIES], opacities, numbers)

    def _add_menu(self, labels: Sequence[str], attributes: Sequence[dict[str, Any]], traces: list[int]) -> None:
        """A menu that sets attributes of some traces; none for one choice."""
        if len(labels) > 1:
            choices = zip(labels, attributes, strict=True)
            buttons = [{"label": plain(text), "method": "restyle", "args": [what, traces]} for text, what in choices]
            place = {"x": 0, "xanchor": "left", "y": 1 - 0.1 * len(self.menus), "yanchor": "top"}
            self.menus.append({"buttons": buttons, "font": {"size": 11}, "pad": {"l": 6, "t": 6}, **place})

    def layout(self) -> dict[str, Any]:
        """Layout to scale, with the whole box of the axes in the picture, colour bars above it and a legend below."""
        shown = np.concatenate(self.shown_m)
        low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
        size = np.maximum(high - low, max(THINNEST * float((high - low).max()), 1e-3))
        ends = (low + high) / 2 + np.array([[-0.5], [0.5]]) * size
        ratio = dict(zip("xyz", (BOX * size / np.linalg.norm(size)).tolist(), strict=True))
        scene: dict[str, Any] = {"aspectmode": "manual", "aspectratio": ratio, "camera": {"eye": EYE}}
        for axis, extent in zip("xyz", ends.T.tolist(), strict=True):
            look = {"backgroundcolor": "#fff", "gridcolor": "#e5e7eb", "zeroline": False, "showspikes": False}
            scene[f"{axis}axis"] = {"title": {"text": f"{axis} (m)"}, "range": extent, **look}
        legend = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "font": {"size": 11}}
        margin = dict.fromkeys("lrtb", 0)
        return {"scene": scene, "legend": legend, "margin": margin, "updatemenus": self.menus}


def observed_figure(content: ViewContent) -> tuple[list[dict[str, Any]], dict[str, Any], list[list[Changes]]]:
    """Traces and layout of measured and predicted observations, and attributes by transmitter and receiver."""
    if content.rows is None:
        return [], {}, []
    kind, rows = content.rows.observed["kind"], content.rows
    values = {name: rows.observed[name] for name in ("measured", "predicted")}
    layout: dict[str, Any] = {"margin": {"l": 44, "r": 8, "t": 22, "b": 34}, "font": {"size": 11}}
    if kind == "image":
        height, width = values["measured"].shape[-2:]
        sky = {"type": "heatmap", "colorscale": COLOUR_MAP.capitalize(), "zmin": 0, "zmax": 255, "showscale": False}
        sky |= {"x0": 0, "dx": 360 / width, "y0": 45 / height, "dy": 90 / height, "hoverinfo": "x+y"}
        traces = [sky | {"xaxis": f"x{number}", "yaxis": f"y{number}"} for number in ("", 2)]
        layout["grid"] = {"rows": 2, "columns": 1, "pattern": "independent", "ygap": 0.5}
        for number, name in zip(("", 2), values, strict=True):
            layout[f"xaxis{number}"] = {"range": [0, 360], "dtick": 90, "title": {"text": f"{name}: azimuth (°)"}}
            layout[f"yaxis{number}"] = {"range": [0, 90], "dtick": 30, "title": {"text": "elevation (°)"}}
    else:
        how: dict[str, Any] = {"type": "scatter", "mode": "lines"}
        if kind == "level":
            how |= {"mode": "markers", "x": [plain(name) for name in content.receivers]}
        marks = zip(values, ("circle", "x"), ("solid", "dash"), strict=True)
        traces = [
            how | {"name": name, "marker": {"size": 10, "symbol": symbol}, "line": {"dash": dash}}
            for name, symbol, dash in marks
        ]
        titles = {"xaxis": "" if kind == "level" else "subcarrier", "yaxis": plain(rows.quantity)}
        layout |= {axis: {"title": {"text": text}} for axis, text in titles.items()}
        layout["legend"] = {"orientation": "h", "x": 0, "y": 1.15}
    changes: list[list[Changes]] = [[] for _ in rows.stored]
    for tx, rx in np.ndindex(len(rows.stored), len(content.receivers)):
        parts = (array[:, tx] if kind == "level" else array[rx, tx] for array in values.values())
        attribute = "z" if kind == "image" else "y"
        changes[tx].append({number: {attribute: spec(part)} for number, part in enumerate(parts)})
    return traces, layout, changes
