"""Digests of the source that a result depends on, and keys of stored fits.

A result depends on the module of its benchmark, on what this module names for subprocesses, and on every module of this
project that these import. A digest is that of syntax trees without docstrings: comments and layout do not count.

A run folder whose name holds the key of a fit, a digest of everything that determines it, is used again. Other
settings, rows, seed, data or versions give another key, and so another folder.
"""

import ast
import hashlib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from wrf_mi.core.digest import content_digest, files_below
from wrf_mi.models import MODELS
from wrf_mi.runs.folder import versions

from .table_plan import CORRECTED, NAMED

PACKAGES = {"wrf_mi": "", "wrf_mi_bench": "benchmarks", "wrf_mi_plugins": "plugins", "wrf_mi_scenes": "scenes"}
"""Packages of this project, and their folders in a checkout."""
SOURCE = "source"  # key of the digests in a stored result
DIGITS = 12  # hexadecimal digits of a digest
KEY_DIGITS = 16  # hexadecimal digits of a key: two of a million fits share a key with a probability of 3e-8
COMMANDS = {
    "demo": ("wrf_mi.apps.commands.demo", MODELS.module("wrf-gs+")),
    "train": ("wrf_mi.apps.commands.train",),
    NAMED: ("wrf_mi_bench.scene",),
    CORRECTED: ("wrf_mi_bench.scene", "wrf_mi.apps.commands.scenes"),
}
"""Modules behind words of commands that benchmarks run in subprocesses."""
RUNNER = f"{__package__}.bench"  # lists, runs and stores benchmarks; makes no figure
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def source_digests(*modules: str) -> dict[str, str]:
    """Digest of modules and of what they import, by folder, e.g. ``wrf_mi/gaussians``."""
    return by_folder({name: file.read_text(encoding="utf-8") for name, file in needed_files(*modules).items()})


def by_folder(files: Mapping[str, str]) -> dict[str, str]:
    """Digest of each folder, by the names of its files with their text."""
    folders: dict[str, dict[str, str]] = {}
    for name, text in sorted(files.items()):
        folders.setdefault(name.rpartition("/")[0], {})[name] = code_digest(text)
    return {folder: _sha(repr(texts)) for folder, texts in folders.items()}


def modules_of_benchmark(module: str) -> tuple[str, ...]:
    """The module of a benchmark, and the modules, commands and models that its strings name, as for subprocesses."""
    file = _file(module)
    nodes = () if file is None else ast.walk(_tree(file))
    texts = sorted({node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)})
    named = [text for text in texts if text.partition(".")[0] in PACKAGES and _file(text) is not None]
    return (module, *named, *modules_of_command(texts))


def modules_of_command(words: Iterable[str]) -> tuple[str, ...]:
    """Modules of the command, models and scenes that words of ``wrf-mi`` name."""
    modules = {**COMMANDS, **{name: (MODELS.module(name),) for name in MODELS}}
    return tuple(module for word in words for module in modules.get(word, ()))


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


@cache
def code_digest(text: str) -> str:
    """Digest of the syntax tree of a module without docstrings, the same for every version of Python."""
    return _sha(repr(_plain(ast.parse(text))))


def _plain(node: Any) -> Any:
    # Not `ast.dump`: fields that are empty appear in some versions of Python only.
    if isinstance(node, list):
        return [_plain(item) for item in node]
    if not isinstance(node, ast.AST):
        return node
    fields = dict(ast.iter_fields(node))
    if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
        fields["body"] = fields["body"][1:]
    return type(node).__name__, [(name, _plain(value)) for name, value in fields.items() if value not in (None, [])]


def needed_files(*modules: str) -> dict[str, Path]:
    """Files of modules and of all that they import, by package and path."""
    files: dict[str, Path] = {}
    left, packages = list(modules), {*PACKAGES, *(module.partition(".")[0] for module in modules)}
    visited = {RUNNER}
    while left:
        module = left.pop()
        if module in visited or module.partition(".")[0] not in packages:
            continue
        visited.add(module)
        if (file := _file(module)) is None:
            continue
        name = module.replace(".", "/")
        files[f"{name}/__init__.py" if file.name == "__init__.py" else f"{name}.py"] = file
        left += [module.rpartition(".")[0], *_imports(file, module)]
    return files


@cache
def _file(module: str) -> Path | None:
    """File of a module; None: there is none, as for names that are imported from a module."""
    if not all(part.isidentifier() for part in module.split(".")):
        return None
    parent = module.rpartition(".")[0]
    if parent and ((above := _file(parent)) is None or above.name != "__init__.py"):
        return None
    spec = find_spec(module)
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


@cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


@cache
def _imports(file: Path, module: str) -> tuple[str, ...]:
    """Modules that a module imports, in its functions too except for packages, and names that may be modules."""
    # Functions of a package's first file call for users what modules below import where they need it.
    first = file.name == "__init__.py"
    package = module if first else module.rpartition(".")[0]
    modules: list[str] = []
    for node in _tree(file).body if first else ast.walk(_tree(file)):
        if isinstance(node, ast.Import):
            modules += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            modules += [base, *(f"{base}.{name.name}" for name in node.names)]
    return tuple(modules)


def fit_key(*determining: Any) -> str:
    """Key of a fit: a digest of `versions` and of values as for `wrf_mi.core.digest.content_digest`.

    `InputError` for a path that does not exist.
    """
    return content_digest(versions(), *determining)[:KEY_DIGITS]


def source_files() -> dict[str, Path]:
    """Files of `wrf_mi`, its plugins and its scenes by name, except compiled files."""
    by_name: dict[str, Path] = {}
    for name in PACKAGES.keys() - {__package__}:
        spec = find_spec(name)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            files = [path for path in files_below(Path(folder)) if "__pycache__" not in path.parts]
            by_name |= {f"{name}/{path.relative_to(folder).as_posix()}": path for path in files}
    return by_name
