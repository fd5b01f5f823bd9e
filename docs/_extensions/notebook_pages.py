"""Sphinx extension: pages of the executed notebooks, and a gallery of them with thumbnails.

Before the sources are read, each notebook of ``notebooks/`` is executed and written with its outputs to
``docs/notebooks/``, which git ignores. Executions are kept in ``docs/_build/executed`` by a digest of the notebook's
code, the package's code without docstrings, the versions and the data sets on this machine, so that only what has
changed is executed again. ``-D execute_notebooks=0`` shows stored executions and, where there is none, the notebook as
it is: the code, with the stored outputs of notebooks whose metadata name packages beside the dependencies
(``requires``). These are not executed where such a package is absent.
"""

from __future__ import annotations

import ast
import base64
import hashlib
import io
import json
import re
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import nbformat
from PIL import Image
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging
from wrf_mi_bench.sources import fit_key, source_files

from wrf_mi.core.files import write_atomically
from wrf_mi.datasets.registry import datasets

CELL_SECONDS = 900
"""Limit of one cell: the slowest takes a tenth of it on two cores."""
THUMBNAIL_PIXELS = (480, 270)
GALLERY_ORDER = (
    "first_field",
    "learned_against_traced",
    "scene_corrected_by_radio",
    "few_measurements",
    "without_measurements",
    "rssi_and_csi",
    "what_the_array_sees",
    "own_model_and_plugin",
    "pytorch_field",
    "run_as_mitsuba_scene",
    "run_time_against_error",
)
"""Names in the order of the gallery; others follow by name."""

logger = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.add_config_value("execute_notebooks", True, "env", types=(bool, str, int))
    app.connect("builder-inited", write_notebook_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_notebook_pages(app: Sphinx) -> None:
    """Write every notebook with its outputs, its thumbnail and the gallery into ``docs/notebooks``."""
    source, target = Path(app.srcdir).parent / "notebooks", Path(app.srcdir) / "notebooks"
    kept = Path(app.srcdir) / "_build" / "executed"
    execute = str(app.config.execute_notebooks) not in {"0", "False"}
    paths = sorted(source.glob("*.ipynb"), key=_place)
    # Without executions, neither stored nor asked for, no key is looked up.
    common = _common() if execute or any(kept.glob("*.ipynb")) else ""
    stored = {path: kept / f"{path.stem}-{_key(path, common)}.ipynb" for path in paths}
    if execute:
        _execute([(path, stored[path]) for path in paths if not stored[path].exists() and _executable(path)])
    target.mkdir(exist_ok=True)
    cards = []
    for path in paths:
        notebook = nbformat.read(stored[path] if stored[path].exists() else path, as_version=4)
        _link_documents(notebook)
        _write_changed(target / path.name, nbformat.writes(notebook).encode())
        picture = _last_picture(notebook)
        if picture is not None:
            _write_changed(target / "thumbnails" / f"{path.stem}.png", _thumbnail(picture))
        cards.append(_card(path.stem, notebook, picture is not None))
    _write_changed(target / "index.md", _gallery(cards, [path.stem for path in paths]).encode())
    for page in target.glob("*.ipynb"):
        if page.name not in {path.name for path in paths}:
            page.unlink()


def _place(path: Path) -> tuple[int, str]:
    known = path.stem in GALLERY_ORDER
    return (GALLERY_ORDER.index(path.stem) if known else len(GALLERY_ORDER), path.stem)


def _common() -> str:
    """Key of what all notebooks depend on: code, versions and fetched data sets."""
    fetched = [known.dataset.name for known in datasets() if known.dataset.base_url and known.location]
    return fit_key({name: _code(file) for name, file in source_files().items()}, fetched)


def _code(file: Path) -> str:
    """Digest of a file; of Python code without its docstrings and comments."""
    content = file.read_bytes()
    if file.suffix == ".py":
        tree = ast.parse(content)
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                node.body = [part for part in node.body if not _is_text(part)]
        content = ast.dump(tree).encode()
    return hashlib.sha256(content).hexdigest()


def _is_text(node: ast.stmt) -> bool:
    """Whether a statement is a string alone: a docstring of a module, class, function or constant."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _executable(path: Path) -> bool:
    """Whether the packages that a notebook requires beside the dependencies are installed."""
    required = json.loads(path.read_text(encoding="utf-8"))["metadata"].get("requires", ())
    return all(find_spec(name) is not None for name in required)


def _key(path: Path, common: str) -> str:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return fit_key(common, ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"])


def _execute(missing: list[tuple[Path, Path]]) -> None:
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    begin = time.monotonic()
    for number, (path, stored) in enumerate(missing):
        seconds = time.monotonic() - begin
        left = f", about {seconds / number * (len(missing) - number):.0f} s left" if number else ""
        logger.info(f"executing notebook {number + 1} of {len(missing)}: {path.stem} ({seconds:.0f} s so far{left})")
        notebook = nbformat.read(path, as_version=4)
        stored.parent.mkdir(parents=True, exist_ok=True)
        try:
            NotebookClient(notebook, timeout=CELL_SECONDS, resources={"metadata": {"path": str(path.parent)}}).execute()
        except CellExecutionError as error:
            raise ExtensionError(f"{path.name} failed: {error}") from error
        for old in stored.parent.glob(f"{path.stem}-*.ipynb"):
            old.unlink()
        write_atomically(stored, nbformat.writes(notebook))
    if missing:
        logger.info(f"executed {len(missing)} notebooks in {time.monotonic() - begin:.0f} s")


def _link_documents(notebook: nbformat.NotebookNode) -> None:
    """Turn names of documents and notebooks in the text into links of the site."""
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = re.sub(r"`docs/(\w+)\.md`", r"[\1](../\1.md)", cell.source)
            cell.source = re.sub(r"`notebooks/(\w+)\.ipynb`", r"[\1](\1.ipynb)", cell.source)


def _last_picture(notebook: nbformat.NotebookNode) -> str | None:
    """The last PNG among the outputs, of a cell with the tag ``thumbnail`` where there is one."""
    pictures = [
        (("thumbnail" in cell.metadata.get("tags", ())), output.data["image/png"])
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if "image/png" in output.get("data", {})
    ]
    tagged = [picture for is_thumbnail, picture in pictures if is_thumbnail]
    return (tagged or [picture for _, picture in pictures] or [None])[-1]


def _thumbnail(picture: str) -> bytes:
    with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
        small = image.convert("RGB")
        small.thumbnail(THUMBNAIL_PIXELS)
        canvas = Image.new("RGB", THUMBNAIL_PIXELS, "white")
        canvas.paste(small, ((canvas.width - small.width) // 2, (canvas.height - small.height) // 2))
    out = io.BytesIO()
    canvas.save(out, "PNG", optimize=True)
    return out.getvalue()


def _card(name: str, notebook: nbformat.NotebookNode, pictured: bool) -> str:
    title, _, text = notebook.cells[0].source.removeprefix("# ").partition("\n")
    first = re.split(r"(?<=[.:?])\s", text.strip().replace("\n", " "))[0].rstrip(":")
    picture = f":img-top: thumbnails/{name}.png\n:img-alt: last picture of the notebook\n" if pictured else ""
    return f":::{{grid-item-card}} {title}\n:link: {name}\n:link-type: doc\n{picture}\n{first}\n:::\n"


def _gallery(cards: list[str], names: list[str]) -> str:
    entries = "\n".join(names)
    return (
        "# Notebooks\n\nExecuted when this site was built. Data sets that were not on that machine are replaced by"
        " rooms that are traced by the notebook itself.\n\n::::{grid} 1 2 3 3\n:gutter: 3\n\n"
        + "\n".join(cards)
        + f"::::\n\n```{{toctree}}\n:hidden:\n\n{entries}\n```\n"
    )


def _write_changed(path: Path, content: bytes) -> None:
    """Write a file unless it has this content, so that Sphinx does not read its page again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_bytes() != content:
        path.write_bytes(content)
