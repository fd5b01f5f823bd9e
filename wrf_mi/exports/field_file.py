"""One file with all parameters of a trained field, and the run folder that it makes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import InputError
from ..core.array_files import stored_arrays, write_arrays
from ..core.files import atomic_folder, readable
from ..models.gaussian.model import PARAM
from ..models.model import keyed, under
from ..runs.folder import CONFIG, FITTED, METRICS, SPLIT, check_format, check_new
from ..runs.run import Run, open_run
from .format import ExportOptions
from .gaussians import field_of
from .source import Source

FORMAT = 1  # version of the file
VERSION, SPLIT_ARRAYS, FITTED_ARRAYS = "export/format", "split/", "run/"
TEXTS = {CONFIG: "export/config", METRICS: "export/metrics"}  # keys of the texts of a run folder's files


def write_field(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write a field of Gaussians (`wrf_mi.exports.source.Write`).

    Keys: ``param/<name>``, the parameters in single precision, [k, n] each; ``form/*``, the form of the observations;
    ``receiver_*`` and ``tx_antenna``; ``split/*`` and ``run/*`` of the run's ``split.npz`` and ``model.npz``; the texts
    ``export/config`` and ``export/metrics``. ``docs/export.md`` has the parameters' shapes. `InputError`: no Gaussians,
    or an unfinished run.
    """
    run = source.run
    field = field_of(run)
    form = {key: values for key, values in field.arrays().items() if not key.startswith(PARAM)}
    model = stored_arrays(run.folder / FITTED)
    arrays: dict[str, Any] = {
        VERSION: FORMAT,
        **keyed(PARAM, field.params),
        **form,
        **{key: values for key, values in model.items() if key.startswith(FITTED_ARRAYS)},
        **keyed(SPLIT_ARRAYS, stored_arrays(run.folder / SPLIT)),
    }
    for name, key in TEXTS.items():
        if (run.folder / name).exists():
            arrays[key] = (run.folder / name).read_text(encoding="utf-8")
    write_arrays(out, arrays, compressed=True)
    facts = {"parameters": len(field.params), "numbers": sum(values.size for values in field.params.values())}
    return facts | ({} if run.config.scene is None else {"scene (not included)": run.config.scene})


def import_field(file: str | Path, out: str | Path) -> Run:
    """Make a run folder of a file of `write_field`; its predictions are bit-identical to those of the exported run.

    Args:
        file: the file.
        out: run folder to make; must not exist or be empty.

    Raises:
        InputError: a file that is missing, damaged or of another kind, or a folder that is not empty.
    """
    path, folder = Path(file), Path(out)
    check_new(folder)
    with readable(path, f"{path}: missing; give a file of export --format field", "export it again"):
        arrays = stored_arrays(path)
        if VERSION not in arrays:
            raise InputError(f"{path}: not written by export --format field; give such a file")
        if (version := int(arrays.pop(VERSION))) != FORMAT:
            raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
        texts = {name: str(arrays.pop(key)) for name, key in TEXTS.items() if key in arrays}
        split = under(SPLIT_ARRAYS, arrays)
        model = {key: values for key, values in arrays.items() if not key.startswith(SPLIT_ARRAYS)}
        if CONFIG not in texts or not split:
            raise InputError(f"{path}: incomplete; export it again")
    with atomic_folder(folder, replace=True) as part:  # `check_new` leaves nothing that could be lost
        write_arrays(part / SPLIT, split)
        write_arrays(part / FITTED, model, compressed=True)
        for name, text in texts.items():
            (part / name).write_text(text, encoding="utf-8")
        check_format(part)
        open_run(part)
    return open_run(folder)
