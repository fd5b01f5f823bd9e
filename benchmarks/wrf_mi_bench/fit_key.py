"""Keys of stored fits: digests of everything that determines a fit.

A run folder whose name holds the key of a fit is used again. Other settings, rows, seed, data or versions give another
key, and so another folder.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from wrf_mi.core.digest import content_digest, files_below
from wrf_mi.runs.folder import versions

PACKAGES, COMPILED = ("wrf_mi", "wrf_mi_plugins", "wrf_mi_scenes"), "__pycache__"
DIGITS = 16  # hexadecimal digits of a key: two of a million fits share a key with a probability of 3e-8


def fit_key(*determining: Any) -> str:
    """Key of a fit: a digest of `versions` and of values as for `wrf_mi.core.digest.content_digest`.

    `InputError` for a path that does not exist.
    """
    return content_digest(versions(), *determining)[:DIGITS]


def source_files() -> dict[str, Path]:
    """Files of this package, its plugins and its scenes by name, except compiled files."""
    by_name: dict[str, Path] = {}
    for name in PACKAGES:
        spec = find_spec(name)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            files = [path for path in files_below(Path(folder)) if COMPILED not in path.parts]
            by_name |= {f"{name}/{path.relative_to(folder).as_posix()}": path for path in files}
    return by_name
