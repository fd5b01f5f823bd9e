"""``wrf-mi evaluate``, ``predict`` and ``compare``: what is done with finished runs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...core import InputError
from .options import (
    Arguments,
    add_command,
    add_n_train,
    add_operator,
    add_own,
    add_replace,
    add_scheduler,
    check_operator,
    refuse,
    stated,
)
from .output import Watch, show, show_metrics


def add_parser(commands: Any) -> None:
    """Add ``evaluate``, ``predict`` and ``compare`` to the commands."""
    for add in (_add_evaluate, _add_predict, _add_compare):
        add(commands)


def _add_evaluate(commands: Any) -> None:
    text = "score a run on its held-out rows, or predictions that another program made"
    parser = add_command(commands, "evaluate", evaluate_command, text)
    parser.add_argument("run", nargs="?", metavar="RUN", help="run folder; omit it with --predictions")
    text = "score on the test rows of another split that the run was not trained on; nothing is written"
    parser.add_argument("--split", help=f"{text}. With --predictions: the split (default: official)")
    other = parser.add_argument_group("predictions of another model")
    text = "row or tx_pos, prediction and optionally std, as predictions.npz; signal strengths also as .csv; or what "
    text += "the test scripts of NeRF2 and WRF-GS+ write: folder pred_spectrum, result.txt, result.mat"
    other.add_argument("--predictions", metavar="FILE", help=text)
    other.add_argument("--dataset", metavar="DATASET", help="data set that they are of: a name or a folder")
    other.add_argument("--name", metavar="NAME", help="name of the model, for tables")
    other.add_argument("--out", metavar="DIR", help="run folder to make, for compare")
    add_replace(other)
    add_n_train(other)
    other.add_argument("--seed", type=int, metavar="N", help="seed of the split, and of the other fit (default: 0)")
    text = "draw how reliable probabilities of coverage are on test rows, P(level > threshold) against observed share"
    parser.add_argument("--reliability", metavar="FILE.png", help=text)
    text = "also score local mean powers: signal strengths of test rows, measured and predicted, averaged in mW over "
    text += "windows of so many wavelengths, such as 10 or 5,10,20 (docs/data.md, Scores)"
    parser.add_argument("--local-mean", metavar="WAVELENGTHS", help=text)
    add_operator(parser)


def evaluate_command(a: Arguments) -> int:
    """Score a run again."""
    if a.predictions is not None:
        return _score_predictions(a)
    refuse(a, ("dataset", "name", "out", "replace", "n_train", "seed"), "belongs to --predictions")
    if a.run is None:
        raise InputError("evaluate: nothing to score; give a run folder, or --predictions FILE and --dataset")
    from ...runs.api import evaluate_run

    if a.split is not None:
        refuse(a, ("reliability", "local_mean"), "is of the run's own test rows, not of --split")
    windows = _windows(a.local_mean)
    if a.reliability is not None and Path(a.reliability).suffix.lower() != ".png":
        raise InputError(f"{a.reliability}: the picture is written as .png; give such a name")
    check_operator(a)
    metrics = evaluate_run(a.run, a.split, not a.no_operator)
    lines = []
    if windows:
        from ...runs.local_mean import local_mean_scores

        means = [local_mean_scores(a.run, wavelengths) for wavelengths in windows]
        metrics, lines = metrics | {"local_mean": [asdict(mean) for mean in means]}, [str(mean) for mean in means]
    if a.reliability is None:
        return show_metrics(metrics, None if a.split else Path(a.run), a.json, lines)
    from ...core.files import write_figure
    from ..maps.coverage import reliability_figure, run_reliability

    result = run_reliability(a.run)
    write_figure(Path(a.reliability), reliability_figure({Path(a.run).resolve().name: result}))
    coverage = {"error": result.error, "brier": result.brier, "threshold_db": result.threshold_db.tolist()}
    show_metrics(metrics | {"coverage": coverage}, Path(a.run), a.json, lines)
    if not a.json:
        text = f"off by {result.error:.3f} on average, Brier score {result.brier:.3f}"
        print(f"coverage: observed share {text}: {a.reliability}")
    return 0


def _windows(text: str | None) -> list[float]:
    """Numbers of wavelengths of ``--local-mean``."""
    try:
        return [] if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        raise InputError(f"--local-mean {text}: give numbers of wavelengths, such as 10 or 5,10,20") from None


def _score_predictions(a: Arguments) -> int:
    """Score predictions of another model."""
    from ...runs.other_models import score_predictions

    if a.run is not None:
        raise InputError("evaluate: --predictions makes a run folder; omit RUN")
    refuse(a, ("reliability", "local_mean", "no_operator"), "belongs to RUN, not to --predictions")
    if lacking := [name for name in ("dataset", "name", "out") if not stated(a, (name,))]:
        raise InputError(f"evaluate: --predictions needs --{lacking[0]}")
    options = {"n_train": a.n_train, "seed": a.seed or 0, "split": a.split or "official", "overwrite": a.replace}
    run = score_predictions(a.dataset, a.predictions, a.out, a.name, **options)
    return show_metrics(run.metrics, run.folder, a.json)


def _add_predict(commands: Any) -> None:
    parser = add_command(commands, "predict", predict_command, "predict at new transmitter positions")
    parser.add_argument("run", metavar="RUN", help="run folder")
    source = parser.add_mutually_exclusive_group(required=True)
    text = "transmitter: X,Y,Z in metres, or a CSV file with columns x,y,z and perhaps heading_rad and frequency_hz"
    source.add_argument("--tx", metavar="X,Y,Z|FILE.csv", help=text)
    text = "array tx_pos [m, 3] in metres (and heading_rad [m], frequency_hz [m]), or uplink [m, antennas, subcarriers]"
    source.add_argument("--input", metavar="FILE.npz", help=text)
    text = "file to write: FILE.npz, or FILE.csv (signal strengths; columns x, y, z in metres, NAME_dbm, NAME_std_db, "
    text += "NAME_received)"
    parser.add_argument("--out", required=True, metavar="FILE", help=text)
    text = "edited copy of the scene that the run was trained in (wrf-mi edit), in which to predict; nothing is fitted"
    parser.add_argument("--scene", metavar="SCENE", help=text)
    add_own(parser)
    add_operator(parser)
    add_scheduler(parser)


def predict_command(a: Arguments) -> int:
    """Write predictions to a file."""
    from ...parallel import open_scheduler
    from ...runs.predict_to_file import write_run_predictions
    from ...runs.prediction_file import read_inputs
    from ...runs.run import open_run
    from ..maps.locate_file import device_text, read_own

    check_operator(a)
    inputs = read_inputs(a.tx, a.input)
    with open_scheduler(a.scheduler) as scheduler:
        run = open_run(a.run, operator=not a.no_operator, scene=a.scene)
        if a.own is not None:
            run = read_own(run, a.own)
        shapes = write_run_predictions(run, inputs, Path(a.out), scheduler if a.scheduler else None, progress=True)
    value = {"out": str(a.out), "arrays": {key: list(shape) for key, shape in shapes.items()}}
    return show(a.json, value, f"{device_text(run)}{shapes['tx_pos'][0]} predictions: {a.out}")


def _add_compare(commands: Any) -> None:
    text = "write a page that compares runs: tables, paired differences, pictures, commands (docs/compare.md)"
    parser = add_command(commands, "compare", compare_command, text, json_output=False)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder to write to")


def compare_command(a: Arguments) -> int:
    """Compare runs."""
    from ...runs.compare import compare

    with Watch() as watch:
        page = compare(a.runs, a.out, watch.on_progress)
    print(f"comparison: {page}")
    return 0
