"""What is stated of a material's diffuse scattering, in ``materials.yml`` and in scene files."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from wrf_mi_scenes.mitsuba_xml import SCATTERING as SHARES

from ..core import InputError
from ..datasets.folder_files import shown

PATTERN = "scattering_pattern"
PATTERNS = {"lambertian": (), "directive": ("alpha_r",), "backscattering": ("alpha_r", "alpha_i", "lambda_")}
"""Parameters of each pattern: exponents of the lobes about reflection and incidence, share of power in the first."""
EXPONENTS = ("alpha_r", "alpha_i")
SCATTERING = (*SHARES, PATTERN, *PATTERNS["backscattering"])  # all that may be stated of it


def check_scattering(where: str, facts: Any) -> dict[str, Any]:
    """What is stated of a material's scattering; `InputError` for anything else than `SHARES` and one of `PATTERNS`.

    The shares, ``lambda_`` among them, are numbers in 0..1, exponents whole numbers from 1.
    """
    if not isinstance(facts, dict):
        raise InputError(f"{where} is {shown(facts)}; give a mapping, such as {{{SHARES[0]}: 0.3}}")
    pattern = facts.get(PATTERN, "lambertian")
    if not isinstance(pattern, str) or pattern not in PATTERNS:
        raise InputError(f"{where}: unknown {PATTERN} {shown(pattern)}; known are {', '.join(PATTERNS)}")
    allowed = (*SHARES, PATTERN, *PATTERNS[pattern])
    for key, value in facts.items():
        if key not in allowed:
            raise InputError(f"{where}: no {shown(key)} with a {pattern} pattern; give {', '.join(allowed)}")
        is_integer = key in EXPONENTS
        is_number = isinstance(value, int if is_integer else int | float) and not isinstance(value, bool)
        valid = is_number and (value >= 1 if is_integer else 0 <= value <= 1)
        if key != PATTERN and not valid:
            wanted = "a whole number from 1 upwards" if is_integer else "a number in 0..1"
            raise InputError(f"{where}: {key} is {shown(value)}; give {wanted}")
    return dict(facts)


def stated_scattering(bsdf: Element, root: Element) -> dict[str, Any]:
    """What a BSDF of a scene states about scattering, as `check_scattering` takes it."""
    defaults = {f"${default.get('name')}": default.get("value", "") for default in root.findall("default")}
    texts = {child.get("name", ""): child.get("value", "") for child in bsdf if child.get("name") in SCATTERING}
    return {name: _value(defaults.get(text, text)) for name, text in texts.items()}


def _value(text: str) -> int | float | str:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def take_scattering(root: Element, path: Path) -> dict[str, dict[str, Any]]:
    """Take what BSDFs state about scattering out of the root of a scene file; facts by the name of the material.

    Sionna RT 2.2 drops it where a BSDF is named like a material of ITU-R P.2040, and has no pattern in scene files.
    `InputError` of another value than those of `check_scattering`.
    """
    result = dict[str, dict[str, Any]]()
    for bsdf in [bsdf for element in [root, *root.findall("shape")] for bsdf in element.findall("bsdf")]:
        if facts := stated_scattering(bsdf, root):
            identifier = bsdf.get("id", "")
            result[identifier.removeprefix("mat-")] = check_scattering(f"{path}: <bsdf> {identifier}", facts)
            for child in [child for child in bsdf if child.get("name") in facts]:
                bsdf.remove(child)
    return result
