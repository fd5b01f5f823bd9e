"""Keys of stored fits: digests of everything that determines a fit.

A run folder whose name holds the key of a fit is used again. Other settings, rows, seed, data or versions give another
key, and so another folder.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import parse

from ..core import InputError
from ..core.digest import content_digest, files_below
from ..core.files import one_line
from ..datasets.registry import locate
from .folder import versions

PACKAGES, COMPILED = ("wrf_mi", "wrf_mi_plugins", "wrf_mi_scenes"), "__pycache__"
DIGITS = 16
"""Hexadecimal digits of a key: two of a million fits share a key with a probability of 3e-8."""


def fit_key(*determining: Any) -> str:
    """Key of a fit: a digest of `versions` and of the given values.

    Args:
        determining: values as for `wrf_mi.core.digest.content_digest`.

    Raises:
        InputError: a path that does not exist.
    """
    return content_digest(versions(), *determining)[:DIGITS]


def source_files() -> dict[str, Path]:
    """Files of this package, its plugins and its scenes by name, except compiled files."""
    found: dict[str, Path] = {}
    for name in PACKAGES:
        spec = find_spec(name)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            files = [path for path in files_below(Path(folder)) if COMPILED not in path.parts]
            found |= {f"{name}/{path.relative_to(folder).as_posix()}": path for path in files}
    return found


def dataset_files(name_or_folder: str) -> list[Path]:
    """Folder or file of a data set; empty where it is not on this machine.

    Raises:
        InputError: no such data set.
    """
    path = Path(name_or_folder)
    found = path if path.exists() else locate(name_or_folder)
    return [] if found is None else [found]


def scene_files(scene: str | Path) -> list[Path]:
    """Folder or file of a scene, with the files that a Mitsuba XML names; empty for the name of an embedded scene.

    Raises:
        InputError: an XML that cannot be read.
    """
    path = Path(scene)
    if not path.exists():
        return []
    if path.suffix.lower() != ".xml":
        return [path]
    try:
        stated = [node.get("value", "") for node in parse(path, forbid_dtd=True).iter("string")]
    except (ElementTree.ParseError, DefusedXmlException, OSError) as error:
        raise InputError(f"{path}: not readable as XML ({one_line(error)}); correct the scene") from None
    return [path, *(file for value in stated if value and (file := path.parent / value).is_file())]
