"""Page of a comparison, one HTML file that needs no network, for laptops and telephones; commands that repeat runs."""

from __future__ import annotations

import base64
import html
import json
import os
import platform
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

from PIL import Image

from ..core import AntennaOptions
from ..core.settings import flat
from ..core.yaml_files import read_yaml
from ..datasets.registry import KNOWN
from ..estimators.model import default_settings
from ..tasks import TASKS
from .baselines import warnings_of
from .compare_tables import (
    BETTER,
    COLUMNS,
    DIFFERENCES,
    METHODS,
    NO_GAIN,
    OTHER_ROWS,
    WORSE,
    Difference,
    best_run,
    common,
    difference_rows,
    first_differences,
)
from .folder import CONFIG, RunConfig, known_config, stored_versions
from .results import PREDICTED, Results

NUMERIC = frozenset(COLUMNS) - {"run", "model", "dataset", "split", "metric"}
CONSTANT = ("dataset", "metric")  # columns that are equal in a section, whose heading states them
MOST_RUNS = 8  # largest number of runs of which the page lists all pairs
FIRST = ("run", "median", "mean", "common_mean")  # columns that narrow screens show without scrolling


@dataclass(frozen=True)
class Section:
    """Runs of a data set with their tables and pictures."""

    slug: str  # name of the section in links, and beginning of its files' names
    runs: Sequence[Results]  # the runs
    scores: Sequence[Mapping[str, Any]]  # rows of the table of scores, by `COLUMNS`
    methods: list[dict[str, Any]]  # rows of the table of methods; none without several seeds
    differences: Sequence[Difference]  # paired differences
    pictures: Sequence[tuple[Path, str]]  # file and heading of each picture

    @property
    def title(self) -> str:
        """Data set and task."""
        name = Path(self.runs[0].dataset).name or "unknown data"
        return f"{name}: {TASKS[self.runs[0].task].heading}"


def page(sections: Sequence[Section], folder: Path) -> str:
    """HTML of a comparison in a folder; the pictures must have been written."""
    runs = [run for section in sections for run in section.runs]
    count = f"{len(runs)} run{'s' if len(runs) > 1 else ''}"
    links = " · ".join(f'<a href="#{_text(part.slug)}">{_text(part.title)}</a>' for part in sections)
    contents = f"<nav>{links}</nav>" if len(sections) > 1 else ""
    today = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    again = shlex.join(["wrf-mi", "compare", *(str(run.path) for run in runs), "--out", str(folder)])
    style, script = (files(__package__).joinpath(f"compare_page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    return f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Comparison of runs</title>
<style>
{style}</style>
<h1>Comparison of {count}</h1>
<p class="note">Made {today} by <code>{_text(again)}</code></p>
{contents}
{"".join(map(_section, sections))}
<h2>Versions and machines</h2>
{_versions(runs)}
<script>
{script}</script>
</html>
"""


def _section(section: Section) -> str:
    shown = {key: COLUMNS[key] for key in dict.fromkeys((*FIRST, *COLUMNS)) if key not in CONSTANT}
    listed, words = section.differences, ""
    if len(section.runs) > MOST_RUNS:
        listed, words = first_differences(section.runs, listed), " Further pairs are in differences.csv."
    gains = _table(DIFFERENCES, difference_rows(listed), frozenset(("rows", "blocks", "difference", "low", "high")))
    images = "\n".join(_image(path, title) for path, title in section.pictures)
    best = best_run(section.runs).name
    lines = [_command(run) for run in section.runs]
    others = f" and the best run by mean score on common rows, {best}; then all other pairs"
    others = others if len(section.runs) > 1 else ""
    return f"""
<h2 id="{_text(section.slug)}">{_text(section.title)}</h2>
{_facts(section.runs)}
<h3>Models</h3>
{_models(section.runs)}
<h3>Scores</h3>
<p class="note">{_text(TASKS[section.runs[0].task].label)}, {_better(section.runs[0])}. Click a heading to sort.
The median comes first here, the verdicts below are of differences of means: they may rank runs differently.</p>
{_table(shown, section.scores, NUMERIC)}
{_unbeaten(section.runs)}{_methods(section.methods)}<h3>Paired differences</h3>
<p class="note">Each run against its best reference{_text(others)}, on the test rows that both have: mean difference
per row, positive in favour of the run, with the 95 % interval of 2,000 bootstrap resamples of blocks of rows: clusters
of their positions, since near rows resemble each other, or else stretches of consecutive rows. {BETTER} and {WORSE}:
the interval excludes zero, in all seeds; else a tie. {NO_GAIN}: the run would be {BETTER}, but is not better than the
constant prediction. {OTHER_ROWS}: differences would be those of the training
rows.{words}</p>
{gains}
{images}
<h3>Commands</h3>
<pre>{_text(chr(10).join(lines))}</pre>
"""


def _unbeaten(runs: Sequence[Results]) -> str:
    """What the command says of runs that are no better than the constant prediction."""
    lines = [f"{run.name}: {line}" for run in runs for line in warnings_of(run.metrics)]
    return "".join(f'<p class="note">{_text(line)}</p>\n' for line in lines)


def _methods(rows: Sequence[Mapping[str, Any]]) -> str:
    """Table of methods of several seeds."""
    if not rows:
        return ""
    return f"""<h3>Methods over seeds</h3>
<p class="note">Runs that differ in their seed alone are one method. The difference from the best method is that of
scores that are means over seeds, on the rows that all runs score, positive in favour of the method, with the interval
over blocks of rows; the standard deviations are those over seeds.</p>
{_table(METHODS, rows, frozenset(METHODS) - {"method"})}
"""


def _better(run: Results) -> str:
    return "higher is better" if TASKS[run.task].higher_is_better else "lower is better"


def _facts(runs: Sequence[Results]) -> str:
    first, task = runs[0], TASKS[runs[0].task]
    origins = {known.name: f" ({known.licence}; {known.origin})" for known in KNOWN}
    origin = (first.dataset or "unknown") + origins.get(first.dataset, "")
    receivers = f"{len(first.receivers)} receiver{'s' if len(first.receivers) > 1 else ''}"
    facts = {"data": origin, "task": f"{task.heading}, {receivers}"}
    facts["score"] = f"{task.label}, {_better(first)}. {task.note}"
    facts["rows"] = _distinct(
        f"{run.metrics['split']}: {run.training_rows}, {run.metrics['n_test']} test rows" for run in runs
    )
    if len(runs) > 1:
        count = len({row for _, row in common(runs)})
        text = "; pairs are compared on the rows that both have" if count else ", so means differ in rows"
        facts["common"] = f"{count} test rows are common to all runs{text}"
    facts["reference"] = _distinct(run.reference_name for run in runs) + " (of the same training rows)"
    facts["scene"] = _distinct(str(run.metrics.get("scene") or "") for run in runs)
    return _definitions(facts)


def _distinct(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(filter(None, texts)))


def _definitions(facts: Mapping[str, str]) -> str:
    """Facts as a list of definitions; empty ones are left out."""
    terms = (f"<dt>{_text(key)}</dt><dd>{_text(words)}</dd>" for key, words in facts.items() if words)
    return f"<dl>{''.join(terms)}</dl>"


def _models(runs: Sequence[Results]) -> str:
    """Models in words, and what differs from their defaults."""
    columns = {"run": "run", "model": "model", "settings": "settings that differ from the defaults", "scene": "scene"}
    rows = []
    for run in runs:
        config = known_config(run.path)
        if config is None:
            outside = PREDICTED in run.metrics
            settings = "predictions of another program; training rows as stated by their author" if outside else None
            row = {"run": run.name, "model": run.metrics["model"], "settings": settings or "not stored"}
            rows.append(row)
            continue
        changed = ", ".join(f"{name}={value}" for name, value in changed_settings(config).items())
        described = config.entry.described(config.scene is not None)
        words = f"{config.model}: {described}" + (", calibrated intervals" if config.intervals else "")
        rows.append({"run": run.name, "model": words, "settings": changed or "none", "scene": config.scene})
    return _table(columns, rows, frozenset())


def _versions(runs: Sequence[Results]) -> str:
    """Versions with which the runs were made, grouped, and the machine of this page."""
    groups: dict[str, list[str]] = {}
    for run in runs:
        versions = ", ".join(f"{name} {value}" for name, value in stored_versions(run.path).items())
        groups.setdefault(versions or "not stored", []).append(run.name)
    machine = f"{platform.platform()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    facts = {", ".join(names): words for words, names in groups.items()} | {"this page": machine}
    return _definitions(facts)


def _table(columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]], numeric: frozenset[str]) -> str:
    """Table that sorts by a click on a heading; columns without a value are left out."""
    filled = {key: title for key, title in columns.items() if any(row.get(key) is not None for row in rows)}
    buttons = {key: f'<button type="button">{_text(title)}</button>' for key, title in filled.items()}
    head = "".join(f'<th scope="col"{_class(key, numeric)}>{button}</th>' for key, button in buttons.items())
    body = "\n".join("<tr>" + "".join(_cell(key, row.get(key), numeric) for key in filled) + "</tr>" for row in rows)
    table = f'<table class="sorts"><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table>'
    return f'<div class="scroll">{table}</div>'


def _class(key: str, numeric: frozenset[str]) -> str:
    return ' class="n"' if key in numeric else ""


def _cell(key: str, value: Any, numeric: frozenset[str]) -> str:
    """A value with four significant digits, empty where unknown; verdicts are coloured."""
    if value is None or value != value:  # NaN: not stated by another program
        return f"<td{_class(key, numeric)}></td>"
    if key == "verdict":
        return f'<td class="{_text(str(value).partition(" ")[0])}">{_text(value)}</td>'
    exact = f' data-value="{_text(value)}"' if key in numeric else ""
    shown = f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"<td{_class(key, numeric)}{exact}>{_text(shown)}</td>"


def _image(path: Path, title: str) -> str:
    with Image.open(path) as picture:
        width, height = picture.size
    data = base64.b64encode(path.read_bytes()).decode()
    # On a telephone a wide picture keeps half its size, at which its texts are legible, and scrolls.
    size = f'width="{width}" height="{height}" style="--least: {width // 2}px"'
    image = f'<img src="data:image/png;base64,{data}" {size} alt="{_text(title)}">'
    return f'<h3>{_text(title)}</h3>\n<div class="scroll">{image}</div>'


def _text(value: Any) -> str:
    return html.escape(str(value))


def changed_settings(config: RunConfig) -> dict[str, Any]:
    """Settings, by dotted name, that differ from the model's defaults for these data; not arguments of `train`."""
    entry = config.entry
    stated = {"model": config.model, "seed": config.seed, "deterministic": config.deterministic}
    standard = dict(flat(asdict(default_settings(entry, (), stated))))
    settings = {name: value for name, value in flat(asdict(config.settings)) if name not in entry.train_arguments}
    return {name: value for name, value in settings.items() if value != standard[name]}


def _preset(config: RunConfig) -> str | None:
    """The preset that gave values to settings that are not stated, the one with most of them; None: no preset did."""
    entry, values, found = config.entry, dict(flat(asdict(config.settings))), dict[str, int]()
    standard = dict(flat(asdict(default_settings(entry, (), {"model": config.model}))))
    for name, texts in entry.presets.items() if config.stated is not None else ():
        preset = dict(flat(asdict(default_settings(entry, texts, {"model": config.model}))))
        given = [key for key in preset.keys() - {*(config.stated or ())} if preset[key] != standard[key]]
        if given and all(values[key] == preset[key] for key in given):
            found[name] = len(given)
    return max(found, key=lambda name: found[name], default=None)


def _options(config: RunConfig) -> dict[str, Any]:
    """Options of `train` that a run was made with; None for those that were not stated."""
    options = {"n_train": config.n_train, "scene": config.scene, "material": config.material}
    options |= {field.name: getattr(config.antennas, field.name) for field in fields(AntennaOptions)}
    standard = default_settings(config.entry, (), {})
    for option, name in {"receiver_model": "receiver", "evaluation": "evaluation"}.items():
        if name in config.entry.train_arguments and getattr(config.settings, name) != getattr(standard, name):
            options[option] = getattr(config.settings, name)
    return options | {"seed": config.seed or None}


def _command(run: Results) -> str:
    """The line that repeats a run, or a comment on what is missing for it."""
    config, metrics = known_config(run.path), run.metrics
    if config is not None:
        return command(config, run.path)
    if PREDICTED not in metrics:
        return f"# {run.name}: {CONFIG} is missing, or of a model that this version lacks"
    stated = read_yaml(run.path / CONFIG) if (run.path / CONFIG).exists() else {}
    options = {"predictions": metrics[PREDICTED], "dataset": metrics["dataset"], "name": metrics["model"]}
    options |= {"split": metrics["split"], "n-train": stated.get("n_train"), "seed": run.seed or None}
    words = [word for key, value in options.items() if value is not None for word in (f"--{key}", str(value))]
    return shlex.join(["wrf-mi", "evaluate", *words, "--out", str(run.path)])


def command(config: RunConfig, folder: Path) -> str:
    """The line that repeats a run; data sets passed as objects are named by their folder, rows by their split."""
    entry, settings = config.entry, config.settings
    preset = _preset(config)
    if config.stated is None:
        changed = changed_settings(config)
        if config.seed and "seed" not in entry.train_arguments and hasattr(settings, "seed"):
            changed["seed"] = settings.seed  # --seed alone would set that of the rays, too
    else:  # not those that the fit found from its data, which might be refused as without effect
        values = dict(flat(asdict(settings)))
        changed = {name: values[name] for name in config.stated if name not in entry.train_arguments}
    words = ["wrf-mi", "train", config.dataset, "--model", config.model, "--split", config.split]
    words += [] if preset is None else ["--preset", preset]
    for name, value in _options(config).items():
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    words += [f"--{name}" for name in ("deterministic", "intervals") if getattr(config, name)]
    for name, value in changed.items():
        words += ["--set", f"{name}={json.dumps(value)}"]
    return shlex.join([*words, "--out", str(folder)])
