"""Drawings of the documents: the graph of the stages with one stage marked, and the steps of that stage.

``python docs/_extensions/stage_drawings.py`` writes ``docs/images/stages/*.svg``; a test compares them with this file.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

TARGET = Path(__file__).resolve().parents[1] / "images" / "stages"
WIDTH, NODE, ROW = 760, (96, 30), 44
BLUE, GREY, LIGHT, INK = "#1f5fa8", "#8a94a0", "#eef3f9", "#1c2430"

PLACES = {
    "datasets": (14, 0),
    "scene": (14, 1),
    "gaussians": (140, 0),
    "tracing": (140, 1),
    "receivers": (270, 0.5),
    "training": (396, 0.5),
    "models": (522, 0.5),
    "runs": (648, 0.5),
}
"""Left edge in pixels and row of each stage."""
ARROWS = (
    ("datasets", "gaussians"),
    ("datasets", "tracing"),
    ("scene", "tracing"),
    ("gaussians", "receivers"),
    ("tracing", "receivers"),
    ("receivers", "training"),
    ("training", "models"),
    ("models", "runs"),
)
Box = tuple[str, tuple[str, ...]]
DETAILS: dict[str, tuple[tuple[Box, ...], ...]] = {
    "overview": (),
    "datasets": (
        (("files", ("spectra (PNG)", "signal strengths (CSV)", "channels (NPZ, HDF5)")),),
        (("reader", ("chosen by file names", "faults by file and row")),),
        (("Record", ("positions [n, 3] m", "receivers, carriers", "observation [n_rx, n, ...]")),),
        (("Split", ("train", "validation", "test rows")),),
    ),
    "scene": (
        (("source", ("LiDAR scan", "floor plan, robot's map", "CAD mesh")),),
        (("planes", ("found, merged, squared", "floor, ceiling, walls, other")),),
        (("materials", ("ITU-R P.2040, by kind", "exceptions by surface")),),
        (("scene folder", ("scene.xml, meshes/", "Mitsuba and Sionna RT", "open it as it is")),),
    ),
    "tracing": (
        (("scene", ("planes, materials",)), ("positions", ("tx [n, 3], receiver",))),
        (("search", ("rays find chains of planes,", "once; no derivative")),),
        (("evaluation", ("image method: length", "slabs, patterns: gain", "differentiable")),),
        (("paths", ("gain g (complex)", "length d, direction u")),),
    ),
    "gaussians": (
        (("Gaussians", ("centre, scale, rotation", "opacity or attenuation")), ("transmitter", ("position [3] m",))),
        (("network", ("complex signal of each", "Gaussian for this tx")),),
        (("projection", ("footprint on directions", "front to back by distance")),),
        (("L(direction)", ("complex sum per pixel", "splatted, traced or", "by operator")),),
    ),
    "receivers": (
        (("T: paths", ("g, d, u",)), ("L: Gaussians", ("complex per direction",))),
        (("combine", ("add complex numbers", "or powers")),),
        (("receiver model", ("pixel, array, power, CSI", "gain and phase")),),
        (("observation", ("spectrum, 0 to 1", "signal strength, dBm", "channel, complex")),),
    ),
    "training": (
        (("batch", ("rows of one receiver",)), ("parameters", ("Gaussians, network,", "materials, planes"))),
        (("forward", ("observation and loss", "of the task")),),
        (("backward", ("Dr.Jit's reverse mode,", "Adam; finite or stop")),),
        (("fit", ("running mean, best on", "held-out rows,", "checkpoint")),),
    ),
    "models": (
        (("registry", ("--model NAME", "entry points")),),
        (("fit(problem,", ("split, session)", "settings: a dataclass")),),
        (("Fitted", ("predict(inputs, receiver)", "arrays() to store")),),
        (("Prediction", ("mean", "std, where stated")),),
    ),
    "runs": (
        (("wrf-mi train", ("trace, sweep, --resume",)),),
        (("run folder", ("config.yaml, split.npz", "model.npz")),),
        (("scores", ("metrics.json", "predictions.npz")),),
        (("use", ("predict, evaluate", "compare: index.html")),),
    ),
}


def drawing(stage: str) -> str:
    """SVG of a stage."""
    columns = DETAILS[stage]
    top = 2 * ROW + 30
    lines = max((sum(len(body) + 2.2 for _, body in column) for column in columns), default=0)
    height = int(top + (lines * 15 + 20 if columns else -12))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" '
        'font-family="system-ui, sans-serif" font-size="12">',
        f"<title>{'Stages of the package' if stage == 'overview' else f'The stage {stage}'}</title>",
        '<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0L8 4L0 8z" fill="{GREY}"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height}" rx="8" fill="#ffffff"/>',
    ]
    for start, end in ARROWS:
        (x1, y1), (x2, y2) = (_corner(start), _corner(end))
        parts.append(_arrow(x1 + NODE[0], y1 + NODE[1] / 2, x2 - 2, y2 + NODE[1] / 2))
    for name in PLACES:
        x, y = _corner(name)
        marked = name == stage
        parts.append(_rect(x, y, *NODE, BLUE if marked else LIGHT, BLUE if marked else GREY))
        parts.append(_text(x + NODE[0] / 2, y + 19, name, "#ffffff" if marked else INK, "middle", bold=marked))
    if columns:
        parts.append(f'<path d="M14 {top - 8}H{WIDTH - 14}" stroke="{GREY}" stroke-dasharray="3 4"/>')
    step = (WIDTH - 28 + 26) / max(len(columns), 1)
    for number, column in enumerate(columns):
        x, y = 14 + number * step, top + 8.0
        centre = top + 8 + (height - top - 20) / 2
        y = centre - sum(len(body) * 15 + 30 for _, body in column) / 2
        for title, body in column:
            tall = len(body) * 15 + 24
            parts.append(_rect(x, y, step - 26, tall, "#ffffff", BLUE))
            parts.append(_text(x + 8, y + 17, title, BLUE, "start", bold=True))
            parts += [_text(x + 8, y + 33 + 15 * i, line, INK, "start") for i, line in enumerate(body)]
            if number + 1 < len(columns):
                parts.append(_arrow(x + step - 26, y + tall / 2, x + step - 2, centre - 3))
            y += tall + 6
    return "\n".join([*parts, "</svg>", ""])


def _corner(name: str) -> tuple[float, float]:
    x, row = PLACES[name]
    return x, 14 + row * ROW


def _rect(x: float, y: float, width: float, height: float, fill: str, stroke: str) -> str:
    size = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}"'
    return f'<rect {size} rx="5" fill="{fill}" stroke="{stroke}"/>'


def _arrow(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<path d="M{x1:g} {y1:g}L{x2:g} {y2:g}" stroke="{GREY}" fill="none" marker-end="url(#a)"/>'


def _text(x: float, y: float, text: str, colour: str, anchor: str, bold: bool = False) -> str:
    weight = ' font-weight="600"' if bold else ""
    return f'<text x="{x:g}" y="{y:g}" fill="{colour}" text-anchor="{anchor}"{weight}>{escape(text)}</text>'


if __name__ == "__main__":
    TARGET.mkdir(parents=True, exist_ok=True)
    for name in DETAILS:
        (TARGET / f"{name}.svg").write_text(drawing(name), encoding="utf-8")
