"""Radio materials of ITU-R P.2040 that names of materials, shapes and layers of drawings mean."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping

from wrf_mi_scenes.mitsuba_xml import THICKNESS_M

WORDS: Mapping[str, str] = {
    **{name.removeprefix("itu_").replace("_", ""): name.removeprefix("itu_") for name in THICKNESS_M},
    **{"ceilingtile": "ceiling_board", "drywall": "plasterboard", "gypsum": "plasterboard", "window": "glass"},
    **{"steel": "metal", "alumin": "metal", "iron": "metal", "timber": "wood", "asphalt": "asphalt_concrete"},
    **{"gips": "plasterboard", "platre": "plasterboard", "beton": "concrete", "ziegel": "brick", "mauerwerk": "brick"},
    **{
        "brique": "brick",
        "masonry": "brick",
        "stahl": "metal",
        "stahlbeton": "concrete",
        "holz": "wood",
        "bois": "wood",
        "glas": "glass",
    },
    **dict.fromkeys(("metalstud", "steelstud", "woodstud"), "plasterboard"),  # what such walls are clad with
}
"""Words in names, without separators and accents, and the material of ITU-R P.2040 that they mean."""


def ascii_name(name: str) -> str:
    """A name with the letters of ASCII that its letters are written with."""
    return unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()


def meant(name: str) -> str | None:
    """Material of ITU-R P.2040 that a name of a material or shape means; the longest word counts."""
    plain = re.sub(r"[^a-z]", "", ascii_name(name).lower())
    words = sorted((word for word in WORDS if word in plain), key=len)
    return WORDS[words[-1]] if words else None
