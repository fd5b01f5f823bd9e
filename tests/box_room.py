"""A bare room of concrete walls, with or without a metal ceiling, for tests of traced paths."""

import numpy as np
from scipy.spatial.transform import Rotation
from traced_rooms import write_xml
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Receiver
from wrf_mi.tracing import open_scene

FREQUENCY_HZ = 920e6
LENGTH, WIDTH, HEIGHT = 6.0, 5.0, 3.0
THICKNESS_M = {"itu_concrete": 0.3, "itu_metal": 0.1, "itu_glass": 0.01, "itu_plasterboard": 0.02}

WALLS = {
    "west": ("itu_concrete", sheet(0, 0.0, (0.0, WIDTH), (0.0, HEIGHT))),
    "east": ("itu_concrete", sheet(0, LENGTH, (0.0, WIDTH), (0.0, HEIGHT))),
    "south": ("itu_concrete", sheet(1, 0.0, (0.0, LENGTH), (0.0, HEIGHT))),
    "north": ("itu_concrete", sheet(1, WIDTH, (0.0, LENGTH), (0.0, HEIGHT))),
}
CEILING = {"ceiling": ("itu_metal", sheet(2, HEIGHT, (0.0, LENGTH), (0.0, WIDTH)))}
PARTITION = {"partition": ("itu_plasterboard", sheet(0, 3.1, (0.0, 2.36), (0.0, 2.0)))}


def room(folder, parts):
    """A ``sionna.rt.Scene`` of named parts, each of a material and a mesh."""
    return open_scene(write_xml(folder, parts), FREQUENCY_HZ, THICKNESS_M)


def receiver(turn=(0.0, 2.0, 0.0), position=(4.2, 2.9, 0.4)):
    """An array that looks up, turned by Euler angles about z, y and x, in degrees; not quite upright."""
    return Receiver("array", np.array(position, float), Rotation.from_euler("zyx", turn, degrees=True).as_quat())


def transmitters(count, seed=0):
    """Positions [count, 3] within 0.3 x 0.3 x 0.15 m, about 2.7 m from the receiver."""
    spread = np.random.default_rng(seed).uniform(-0.15, 0.15, (count, 3))
    return np.array([1.9, 1.8, 1.3]) + spread * [1, 1, 0.5]
