"""Page of a comparison, one HTML file that needs no network, for laptops and telephones; commands that repeat runs."""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from ..core import AntennaOptions
from ..core.settings import flat
from ..core.yaml_files import read_yaml
from ..datasets.registry import KNOWN
from ..estimators.model import default_settings
from ..tasks import TASKS
from .baselines import CONSTANT, verdicts, warnings_of
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
from .page import definitions, document, escaped, picture, sorted_table
from .results import PREDICTED, Results

NUMERIC = frozenset(COLUMNS) - {"run", "model", "dataset", "split", "metric"}
GAINS = frozenset(("rows", "blocks", "difference", "low", "high"))
"""Columns of numbers in the tables of scores and of differences."""
SAME = ("dataset", "metric")  # columns that are equal in a section, whose heading states them
MOST_RUNS = 8  # largest number of runs of which the page lists all pairs
FIRST = ("run", "rank", "median", "mean", "common_mean")  # columns that narrow screens show without scrolling


@dataclass(frozen=True)
class Section:
    """Runs of a data set with their tables and pictures."""

    slug: str  # name of the section in links, and beginning of its files' names
    runs: Sequence[Results]  # the runs
    scores: Sequence[Mapping[str, Any]]  # rows of the table of scores, by `COLUMNS`
    methods: list[dict[str, Any]]  # rows of the table of methods; none without several seeds
    differences: Sequence[Difference]  # paired differences
    pictures: Sequence[tuple[Path, str, str]]  # file and heading of each picture, and what is seen in words

    @property
    def title(self) -> str:
        """Data set and task."""
        name = Path(self.runs[0].dataset).name or "unknown data"
        return f"{name}: {TASKS[self.runs[0].task].heading}"


def page(sections: Sequence[Section], folder: Path) -> str:
    """HTML of a comparison in a folder; the pictures must have been written."""
    runs = [run for section in sections for run in section.runs]
    count = f"{len(runs)} run{'s' if len(runs) > 1 else ''}"
    links = " · ".join(f'<a href="#{escaped(part.slug)}">{escaped(part.title)}</a>' for part in sections)
    contents = f"<nav>{links}</nav>" if len(sections) > 1 else ""
    today = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    again = shlex.join(["wrf-mi", "compare", *(str(run.path) for run in runs), "--out", str(folder)])
    body = f"""<h1>Comparison of {count}</h1>
{contents}
{"".join(map(_section, sections))}
<h2>Versions and machines</h2>
{_versions(runs)}
<p class="note">Made {today} by <code>{escaped(again)}</code></p>"""
    return document("Comparison of runs", body)


def _section(section: Section) -> str:
    shown = {key: COLUMNS[key] for key in dict.fromkeys((*FIRST, *COLUMNS)) if key not in SAME}
    listed, words = section.differences, ""
    if len(section.runs) > MOST_RUNS:
        listed, words = first_differences(section.runs, listed), " Further pairs are in differences.csv."
    gains = sorted_table(
        DIFFERENCES, difference_rows(listed), frozenset(("rows", "blocks", "difference", "low", "high"))
    )
    images = "\n".join(picture(path.read_bytes(), title, description) for path, title, description in section.pictures)
    best = best_run(section.runs).name
    lines = [_command(run) for run in section.runs]
    others = f" and the best run by mean score on common rows, {best}; then all other pairs"
    others = others if len(section.runs) > 1 else ""
    return f"""
<h2 id="{escaped(section.slug)}">{escaped(section.title)}</h2>
{_result(section.runs)}
<h3>Scores</h3>
<p class="note">{escaped(TASKS[section.runs[0].task].label)}, {_better(section.runs[0])}. Ranked by the median; click a
heading to sort. Paired differences are of means: they may rank runs differently.</p>
{sorted_table(shown, sorted(section.scores, key=lambda row: int(row["rank"])), NUMERIC)}
{_unbeaten(section.runs)}{_methods(section.methods)}<h3>Paired differences</h3>
<p class="note">Each run against its best reference{escaped(others)}, on the test rows that both have: mean difference
per row, positive in favour of the run, with the 95 % interval of 2,000 bootstrap resamples of blocks of rows: clusters
of their positions, since near rows resemble each other, or else stretches of consecutive rows. {BETTER} and {WORSE}:
the interval excludes zero, in all seeds; else a tie. {NO_GAIN}: the run would be {BETTER}, but is not better than the
constant prediction. {OTHER_ROWS}: differences would be those of the training
rows.{words}</p>
{gains}
{images}
<h3>Data and models</h3>
{_facts(section.runs)}
{_models(section.runs)}
<h3>Commands</h3>
<pre>{escaped(chr(10).join(lines))}</pre>
"""


def _result(runs: Sequence[Results]) -> str:
    """The runs, best median first, each with its verdicts against the best constant and the best simple model."""
    task = TASKS[runs[0].task]

    def score(run: Results) -> float:
        return float(run.metrics[task.block]["median"])

    ranked = sorted(runs, key=score, reverse=task.higher_is_better)
    lines = []
    for run in ranked[:MOST_RUNS]:
        # Earlier versions store no constant, or no gains.
        has_gains = CONSTANT in run.metrics and all("gain" in block for block in run.metrics["reference"].values())
        words = verdicts(run.metrics) if has_gains else [f"median {score(run):.4g}"]
        lines.append(f"<li><b>{escaped(run.name)}</b>: {escaped('. '.join(words))}</li>")
    more = f"<p>{len(runs) - MOST_RUNS} more below.</p>" if len(runs) > MOST_RUNS else ""
    return f"<ol>{''.join(lines)}</ol>{more}"


def _unbeaten(runs: Sequence[Results]) -> str:
    """What the command says of runs that are no better than the constant prediction."""
    lines = [f"{run.name}: {line}" for run in runs for line in warnings_of(run.metrics)]
    return "".join(f'<p class="note">{escaped(line)}</p>\n' for line in lines)


def _methods(rows: Sequence[Mapping[str, Any]]) -> str:
    """Table of methods of several seeds."""
    if not rows:
        return ""
    return f"""<h3>Methods over seeds</h3>
<p class="note">Runs that differ in their seed alone are one method. The difference from the best method is that of
scores that are means over seeds, on the rows that all runs score, positive in favour of the method, with the interval
over blocks of rows; the standard deviations are those over seeds.</p>
{sorted_table(METHODS, rows, frozenset(METHODS) - {"method"})}
"""


def _better(run: Results) -> str:
    return "higher is better" if TASKS[run.task].higher_is_better else "lower is better"


def _facts(runs: Sequence[Results]) -> str:
    first, task = runs[0], TASKS[runs[0].task]
    origins = {data_set.name: f" ({data_set.licence}; {data_set.origin})" for data_set in KNOWN}
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
    return definitions(facts)


def _distinct(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(filter(None, texts)))


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
    return sorted_table(columns, rows, frozenset())


def _versions(runs: Sequence[Results]) -> str:
    """Versions with which the runs were made, grouped, and the machine of this page."""
    groups: dict[str, list[str]] = {}
    for run in runs:
        versions = ", ".join(f"{name} {value}" for name, value in stored_versions(run.path).items())
        groups.setdefault(versions or "not stored", []).append(run.name)
    machine = f"{platform.platform()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    facts = {", ".join(names): words for words, names in groups.items()} | {"this page": machine}
    return definitions(facts)


def changed_settings(config: RunConfig) -> dict[str, Any]:
    """Settings, by dotted name, that differ from the model's defaults for these data; not arguments of `train`."""
    entry = config.entry
    arguments = {"model": config.model, "seed": config.seed, "deterministic": config.deterministic}
    standard = dict(flat(asdict(default_settings(entry, (), arguments))))
    settings = {name: value for name, value in flat(asdict(config.settings)) if name not in entry.train_arguments}
    return {name: value for name, value in settings.items() if value != standard[name]}


def _preset(config: RunConfig) -> str | None:
    """The preset that gave values to settings that are not stated, the one with most of them; None: no preset did."""
    entry, values, counts = config.entry, dict(flat(asdict(config.settings))), dict[str, int]()
    standard = dict(flat(asdict(default_settings(entry, (), {"model": config.model}))))
    for name, texts in entry.presets.items() if config.stated is not None else ():
        preset = dict(flat(asdict(default_settings(entry, texts, {"model": config.model}))))
        changed = [key for key in preset.keys() - {*(config.stated or ())} if preset[key] != standard[key]]
        if changed and all(values[key] == preset[key] for key in changed):
            counts[name] = len(changed)
    return max(counts, key=lambda name: counts[name], default=None)


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
    content = read_yaml(run.path / CONFIG) if (run.path / CONFIG).exists() else {}
    options = {"predictions": metrics[PREDICTED], "dataset": metrics["dataset"], "name": metrics["model"]}
    options |= {"split": metrics["split"], "n-train": content.get("n_train"), "seed": run.seed or None}
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
