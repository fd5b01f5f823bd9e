"""Small scenes of sheets for the tests of the tracer."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.constants import speed_of_light
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Receiver
from wrf_mi.tracing import open_scene

FREQUENCY_HZ = 2.4e9
WAVELENGTH_M = speed_of_light / FREQUENCY_HZ
LENGTH, WIDTH, HEIGHT = 6.0, 5.0, 3.0
THICKNESS_M = {"itu_concrete": 0.2, "itu_brick": 0.1, "itu_plasterboard": 0.05}

Parts = dict[str, tuple[str, trimesh.Trimesh]]
SHOEBOX: Parts = {
    "floor": ("itu_concrete", sheet(2, 0.0, (0.0, LENGTH), (0.0, WIDTH))),
    "ceiling": ("itu_plasterboard", sheet(2, HEIGHT, (0.0, LENGTH), (0.0, WIDTH))),
    "west": ("itu_brick", sheet(0, 0.0, (0.0, WIDTH), (0.0, HEIGHT))),
    "east": ("itu_brick", sheet(0, LENGTH, (0.0, WIDTH), (0.0, HEIGHT))),
    "south": ("itu_concrete", sheet(1, 0.0, (0.0, LENGTH), (0.0, HEIGHT))),
    "north": ("itu_concrete", sheet(1, WIDTH, (0.0, LENGTH), (0.0, HEIGHT))),
}
PARTITION: Parts = {"partition": ("itu_plasterboard", sheet(0, 3.0, (0.0, 4.0), (0.0, 2.5)))}


def write_xml(folder: Path, parts: Parts) -> Path:
    """A Mitsuba scene file of named parts, each of a material and a mesh."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f'<bsdf type="diffuse" id="mat-{material}"/>' for material in sorted({m for m, _ in parts.values()})]
    for name, (_, mesh) in parts.items():
        mesh.export(folder / f"{name}.ply")
    for name, (material, _) in parts.items():
        lines.append(
            f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
            f'<boolean name="face_normals" value="true"/><ref id="mat-{material}" name="bsdf"/></shape>'
        )
    path = folder / "scene.xml"
    path.write_text("\n".join(['<scene version="3.0.0">', *lines, "</scene>"]))
    return path


def room(folder: Path, parts: Parts = SHOEBOX) -> Any:
    """The same opened at `FREQUENCY_HZ`."""
    return open_scene(write_xml(folder, parts), FREQUENCY_HZ, THICKNESS_M)


def receiver(position: Any, name: str = "rx") -> Receiver:
    """A receiver whose array looks up."""
    return Receiver(name, np.asarray(position, float), np.array([0.0, 0.0, 0.0, 1.0]))


def inside(count: int, seed: int = 0) -> np.ndarray:
    """Positions [count, 3] in the shoebox, away from its walls."""
    rng = np.random.default_rng(seed)
    return rng.uniform([0.3, 0.3, 0.3], [LENGTH - 0.3, WIDTH - 0.3, HEIGHT - 0.3], (count, 3))


def image_lengths(tx: np.ndarray, rx: np.ndarray, depth: int, size: Any = (LENGTH, WIDTH, HEIGHT)) -> np.ndarray:
    """Unfolded lengths of all paths of up to ``depth`` reflections in a box, sorted: the mirror images.

    Source: Allen and Berkley, "Image method for efficiently simulating small-room acoustics" (1979), JASA 65(4).
    """
    lengths = []
    span = range(-depth, depth + 1)
    for n in np.array(np.meshgrid(span, span, span)).reshape(3, -1).T:
        if np.abs(n).sum() > depth:
            continue
        # After |n| reflections along an axis the image is at n size + x or, for odd n, at (n + 1) size - x.
        image = np.where(n % 2 == 0, n * size + tx, (n + 1) * np.array(size) - tx)
        lengths.append(np.linalg.norm(image - rx))
    return np.sort(lengths)
