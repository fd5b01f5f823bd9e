"""Output of the command: figures on standard output, progress on standard error, and Ctrl-C."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

if TYPE_CHECKING:
    from ...training.loop import Progress as FitProgress
from ...core.files import MOST_LISTED, listed

QUANTITIES = ("median", "mean", "p10", "p90")


def show(as_json: bool, value: Any, text: str) -> int:
    """Print figures as JSON for programs, or as text; the exit status 0."""
    print(json.dumps(value, indent=1, default=str) if as_json else text)
    return 0


def exit_status(ok: bool, refused: object) -> int:
    """Exit status of a check: 2 for a fault, 1 for a lesser finding that the user refuses."""
    return 2 if not ok else 1 if refused else 0


def summary_table(title: str, blocks: Mapping[str, Mapping[str, float] | None], digits: int) -> str:
    """Table of the summaries of quantities by name; None leaves one out."""
    lines = [f"{title:<36}" + "".join(f"{key:>8}" for key in QUANTITIES)]
    for name, block in blocks.items():
        if block is not None:
            lines.append(f"{name:<36}" + "".join(f"{block[key]:8.{digits}f}" for key in QUANTITIES))
    return "\n".join(lines)


def show_metrics(metrics: dict[str, Any], folder: Path | None, as_json: bool, more: Sequence[str] = ()) -> int:
    """Print the content of ``metrics.json`` as a table, or as JSON, ``more`` lines and the run folder; exit status."""
    if as_json:
        return show(as_json, metrics, "")
    from ...runs.baselines import verdicts, warnings_of
    from ...runs.results import reference_words, rows_of_folds
    from ...tasks import TASKS

    task = TASKS[metrics["task"]]
    stored = metrics["reference"]
    in_order = [key for key in task.references if key in stored]
    references = {f"{reference_words(task, stored, key)} ({key})": stored[key] for key in in_order}
    blocks = {metrics["model"]: metrics[task.block], **references}
    print(summary_table(f"{task.label} on {metrics['n_test']} test rows", blocks, 3))
    if metrics.get("stages"):
        _show_stages(metrics["stages"], task.label, metrics.get("held_out", {}))
    if metrics.get("options"):
        _show_options(metrics["options"], task.label)
        if "hold_out" in metrics:
            print(f"held-out training rows are {metrics['hold_out']}")
    _show_receivers(metrics)
    if "inside_90" in metrics:
        share = f"{metrics['inside_90']:.0%} of the test values lie inside the predicted 90 % intervals"
        print(f"{share}, continuous ranked probability score (CRPS) {metrics['crps']:.3g}")
    if "reception" in metrics:
        _show_reception(metrics["reception"])
    costs = {"train_seconds": "trained {:.0f} s", "ms_per_sample": "{:.3g} ms per sample"}
    costs |= {"peak_memory_mb": "peak memory {:.0f} MB"}
    # Models of other programs need not state theirs.
    cost_texts = [form.format(metrics[key]) for key, form in costs.items() if math.isfinite(metrics[key])]
    of_folds, folds = rows_of_folds(metrics.get("n_train_of_folds", ())), metrics.get("cross_validated")
    # With the split "none" the model is fitted to all rows.
    rows = of_folds if of_folds and not folds else f"{metrics['n_train']} training rows"
    print(", ".join([f"split {metrics['split']}", rows, *cost_texts]))
    if folds:
        print(
            f"scores are cross-validated: each row is predicted by a fit to the other {folds['folds'] - 1} of "
            f"{of_folds or str(folds['folds']) + ' folds'}; the model is fitted to all rows"
        )
    if "evaluated" in metrics:
        parts = [(what, of["evaluated"], of["evaluated"] + of["skipped"]) for what, of in metrics["evaluated"].items()]
        print("evaluated: " + ", ".join(f"{done:,} of {every:,} {what}" for what, done, every in parts if every))
    for line in (*verdicts(metrics), *more, *warnings_of(metrics)):
        print(line)
    if folder is not None:
        print(f"results: {folder}")
    return 0


def _show_reception(block: dict[str, Any]) -> None:
    """Print the log loss of probabilities of reception beside those of both references."""
    reference = block["reference"]
    others = ", ".join(
        f"{words} {reference[key]['log_loss']:.3f}"
        for key, words in (("reception_rate", "the receivers' rates"), ("reception_neighbours", "nearest rows"))
    )
    share = f"{block['received']:.0%} of the test values were received"
    print(f"{share}; log loss of the predicted probabilities {block['log_loss']:.3f} ({others})")


def _show_receivers(metrics: dict[str, Any]) -> None:
    """Print what was not scored, the receivers with few rows, and the positions that were estimated."""
    if metrics.get("n_not_scored"):
        print(f"{metrics['n_not_scored']} observations of test rows are not finite and not scored")
    for key, what in (("receivers_with_few_rows", "few training rows"), ("receivers_left_out", "too few, left out")):
        if key in metrics:
            named = listed(f"{name} ({rows})" for name, rows in metrics[key].items())
            print(f"receivers with {what} (number): {named}")
    places = metrics.get("receiver_places", {})
    for name, place in list(places.items())[:MOST_LISTED]:
        axes = zip("xyz", place["position_m"], place["std_m"], strict=True)
        # A coordinate that the data state is not estimated.
        words = (f"{axis} {value:.1f} " + (f"± {std:.1f} m" if std else "m as stated") for axis, value, std in axes)
        print(f"receiver {name}: position estimated at {', '.join(words)} (± standard deviation)")
    if len(places) > MOST_LISTED:
        print(f"positions of {len(places) - MOST_LISTED} further receivers are estimated: metrics.json has them")


def _show_stages(reports: list[dict[str, Any]], label: str, weighed: dict[str, float]) -> None:
    """Print what each stage of a fit contributes on held-out training rows and on test rows, and what it costs.

    ``weighed`` are the scores by which the hybrid chose weights, after all stages of the scene were chosen.
    """
    usual_columns = ("held_out", "held-out rows", ".3f"), ("test", "test rows", ".3f"), ("seconds", "seconds", ".1f")
    columns = [
        each for each in (*usual_columns, ("ms", "ms", ".3g")) if any(row.get(each[0]) is not None for row in reports)
    ]
    print(f"{'stages up to, mean ' + label:<34}" + "".join(f"{title:>15}" for _, title, _ in columns))
    for report in reports:
        cells = [f"{report[key]:{form}}" if report.get(key) is not None else "" for key, _, form in columns]
        print(f"{report['stage']:<34}" + "".join(f"{cell:>15}" for cell in cells) + "  not kept" * (not report["kept"]))
    if reports[-1]["stage"] == "residual" and "paths" in weighed and "residual" in weighed:
        before, after = (f"{weighed[key]:.3f}" for key in ("paths", "residual"))
        print(f"residual: {before} without it, {after} with it, on held-out rows after the choice of the stages before")
    if not all(report["kept"] for report in reports):
        print("not kept: no clear gain on held-out rows, by itself or under the stages that follow")


def _show_options(reports: list[dict[str, Any]], label: str) -> None:
    """Print what held-out training rows chose from, stage by stage; stages without a choice are left out."""
    print(f"{'options, mean ' + label:<49}{'held-out rows':>15}{'seconds':>15}")
    stages = Counter((report.get("part"), report["stage"]) for report in reports)
    for report in reports:
        if stages[report.get("part"), report["stage"]] == 1 and report["held_out"] is None and report["taken"]:
            continue
        place = " ".join(filter(None, (report.get("part"), report["stage"])))
        cells = [f"{report[key]:{form}}" if report[key] is not None else "" for key, form in OPTION_COLUMNS]
        words = "taken" if report["taken"] else f"not taken: {report['why']}"
        print(f"{place + ': ' + report['option']:<49}" + "".join(f"{cell:>15}" for cell in cells) + f"  {words}")


OPTION_COLUMNS = ("held_out", ".3f"), ("seconds", ".1f")
ENDING = signal.SIGINT, signal.SIGTERM  # signals of Ctrl-C, and of batch systems and ``kill``
LOG_S = 5.0  # least time between lines of progress within a part of the work, where no bar is shown


class Watch:
    """Progress on standard error, a bar on a terminal, else plain lines, and a stop on Ctrl-C or SIGTERM.

    The first of these signals lets the current step of ``resumable`` work, which asks `stop` and can go on later,
    finish and write a checkpoint; a second one ends at once. ``run`` is the folder that the work can go on with.
    """

    def __init__(self, resumable: bool = False, run: str | None = None) -> None:
        self._resumable, self._run = resumable or run is not None, run
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"), console=self._console
        )
        self._task: Any = None
        self._stage: str | None = None
        self._score, self._stop, self._begun = "", False, 0.0
        self._part, self._told = "", 0.0

    def __enter__(self) -> Watch:
        """Handle the signals that end a process."""
        self._before = {number: signal.getsignal(number) for number in ENDING}
        if self._resumable:
            for number in ENDING:
                signal.signal(number, self._interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        """Restore the handlers and stop the bar."""
        if self._console.is_terminal:
            self._bar.stop()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True
        go_on = "" if self._run is None else f"; then go on with: wrf-mi train --resume {self._run}"
        print(f"stopping after this step; Ctrl-C again ends at once{go_on}", file=sys.stderr)

    def stop(self) -> bool:
        """Whether Ctrl-C was pressed, or the process was asked to end."""
        return self._stop

    def on_progress(self, stage: str, fraction: float, progress: FitProgress | None = None) -> None:
        """Show the fraction (0 to 1) of a stage that is done, and loss and score of a training."""
        new = stage != self._stage
        if new:
            self._stage, self._task, self._score = stage, None, ""
            self._begun = time.perf_counter()
        if progress is not None:
            text = self._text(progress)
        else:  # as if the stage went on as fast as so far
            begun = 0 < fraction < 1
            text = _minutes((time.perf_counter() - self._begun) * (1 - fraction) / fraction) if begun else ""
        if self._console.is_terminal:
            if self._task is None:
                self._bar.start()  # not before: the tracer has a bar of its own
                self._task = self._bar.add_task(stage, total=1.0, text=text)
            self._bar.update(self._task, completed=fraction, text=text)
        elif progress is not None and progress.validation_score is not None:
            steps = round(progress.step / fraction)
            print(f"{stage} {progress.step}/{steps}  {text}", file=sys.stderr, flush=True)
        elif progress is None and self._is_due(stage, new):
            print(stage if new else f"{stage}  {fraction:.0%}  {text}".rstrip(), file=sys.stderr, flush=True)

    def _is_due(self, stage: str, new: bool) -> bool:
        """Whether a stage has a line of a log: the first of a part, and then the first of each few seconds.

        Within a stage lines are as far apart as the stage was long at the line before: hours have a dozen lines.
        """
        part, now = stage.partition(":")[0], time.perf_counter()
        if (part == self._part or not new) and now - self._told < max(LOG_S, 0 if new else self._told - self._begun):
            return False
        self._part, self._told = part, now
        return True

    def _text(self, p: FitProgress) -> str:
        if p.validation_score is not None and not math.isnan(p.validation_score):  # NaN without validation rows
            score = p.far_score if p.held_out and p.far_score is not None else p.validation_score
            self._score = f"{p.label} {score:.3f} ({_validation_text(p)})"
        gaussians = f"{p.gaussians} Gaussians  " if p.gaussians else ""
        return f"loss {p.loss:.4f}  {self._score}  {gaussians}{_minutes(p.left_s)}"


def _validation_text(p: FitProgress) -> str:
    """The rows whose score is shown in training, and how far from training rows they and the test rows are."""
    text = f"{p.validation_rows or ''} validation rows".strip()
    if not p.held_out:
        return f"{text}, now trained on"
    if p.far_score is not None:  # only these are like test rows
        alike = f"{p.far_rows} validation rows as far from training rows as test rows, {p.test_m:.2g} m"
        return f"{alike}; {p.validation_score:.3f} of all {p.validation_rows}"
    if p.validation_m is not None:
        text += f", median {p.validation_m:.2g} m from training rows"
    return text if p.test_m is None else f"{text}, test rows {p.test_m:.2g} m"


def _minutes(left_s: float) -> str:
    minutes, seconds = divmod(int(left_s), 60)
    return f"{minutes}:{seconds:02d} left"
