"""Scores of a model on held-out rows: ``metrics.json`` and ``predictions.npz`` of a run and of its folds."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.array_files import write_arrays
from ..core.carriers import FREQUENCY
from ..core.counts import Counts, added, counted
from ..core.files import write_atomically
from ..core.memory import peak_memory_mb
from ..core.task import IDW, NEIGHBOURS
from ..core.types import IntArray
from ..datasets import make_splits
from ..datasets.observations import FEW_ROWS, rows_received, scorable
from ..estimators.model import PredictAll, inputs_of
from ..estimators.receiver_places import stored_places
from ..models import Fitted, Problem
from ..tasks import TASKS
from ..tasks.scores import crps, inside_interval, signed_errors_db, summary
from .baselines import COUNT, NOT_STORED, against, against_rmse, against_simple, constant_scores, evenly_spaced
from .folder import METRICS, PREDICTIONS, RunConfig
from .reception import RUN, reception_arrays, reception_block
from .references import reference_arrays
from .results import RECEPTION, STD_MEAN, reference_key

Predict = Callable[[IntArray, int], "NDArray[Any] | Prediction"]
"""Predicts what the receiver of an index observes in rows [m] of the record: spectra [m, H, W], powers [m] in dBm or
channel coefficients [m, subcarriers] or [m, antennas, subcarriers]. It takes rows instead of positions because a model
may use heading or uplink."""
Scores = tuple[dict[str, Any], dict[str, Any]]
"""Blocks of ``metrics.json`` and arrays of ``predictions.npz``."""

NOT_SCORED = "n_not_scored"
"""Key of the number of observations in test rows that are not finite, though the receiver received something."""
FEW = "receivers_with_few_rows"
"""Key of the receivers with fewer than `FEW_ROWS` training rows, each with its number of them."""
COUNTS = "evaluated"  # key of the counts of what predictions of test rows evaluated, and of what they left out
PLACES = "receiver_places"  # key of positions that were estimated, with their standard deviations, metres
N_TRAIN_OF_FOLDS = "n_train_of_folds"  # key of the numbers of training rows of the folds that the scores are of
LEFT_OUT = "receivers_left_out"
"""Key of the receivers that have too few training rows to be fitted, each with its number of them."""
CROSS_VALIDATED = "cross_validated"
"""Key of the folds that the scores are of, where the model of the run was fitted to all rows."""
NOISE_FREE = "truth_without_noise"  # array of ``predictions.npz``: true for rows [m] whose truth has no noise
INTERVALS_OF = "intervals_of"  # key of what ``inside_90`` and ``crps`` are of: ``reading``, or the ``mean``
SHARED = (
    "row",
    "tx_pos",
    FREQUENCY,
    RUN,
    "receiver_name",
    NOISE_FREE,
)  # arrays of ``predictions.npz`` without an axis of receivers
REPEATS = 20  # largest number of single predictions that are timed
MOST_OF_STAGES = 400  # test rows by which the stages of a fit are scored
TIMED_S = 2.0  # time after which no further single prediction is begun: some models optimise for each sample


class FittedPart(NamedTuple):
    """Folder, split, fitted model and training time of a run or of a fold."""

    folder: Path
    split: Split
    fitted: Fitted
    seconds: float


def _milliseconds_per_sample(predict: Predict, rows: IntArray, receiver: int) -> float:
    """Median time of one prediction at one transmitter position, warm, in ms."""
    predict(rows[:1], receiver)
    times: list[float] = []
    while len(times) < REPEATS and sum(times) < TIMED_S:
        start = time.perf_counter()
        predict(rows[:1], receiver)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def evaluate(record: Record, split: Split, predict: Predict, single: Predict | None = None) -> Scores:
    """Score predictions on the test rows of a split, together with the references that the data allow.

    References (`wrf_mi.runs.references.reference_arrays`) use all training rows of the split, validation rows included.
    ``single`` is timed at one row; None: ``predict``.

    Returns:
        The blocks of ``metrics.json`` that scoring gives (``task``, ``score`` and the same by the name of the metric,
        ``reference``, ``constant`` and ``constant_rmse`` (`wrf_mi.runs.baselines.against_simple`),
        ``variation`` (`wrf_mi.runs.baselines.variation`), for several receivers ``receivers``, with
        standard deviations ``inside_90`` and ``crps``, with probabilities of reception ``reception``, ``n_train``,
        ``n_test``, ``n_not_scored``, ``ms_per_sample``), and the arrays of ``predictions.npz``. An observation that is
        not finite is not scored: its truth is NaN; so are those of trained receivers where a split holds out others.

    Raises:
        InputError: no test rows or none that is finite, predictions of another shape or not finite, or a receiver that
            received no training row.
    """
    rows = split.test
    truth, broken, scored = _truth(record, split)
    predicted = (predict(rows, receiver) for receiver in scored)
    predictions = [p if isinstance(p, Prediction) else Prediction(p) for p in predicted]
    prediction = np.full((len(truth), *predictions[0].mean.shape), np.nan, truth.dtype)
    prediction[scored] = [p.mean for p in predictions]
    arrays = {
        "row": rows,
        "prediction": prediction,
        "truth": truth,
        "tx_pos": record.tx_pos_m[rows],
        **({} if record.carriers_hz is None else {FREQUENCY: record.carriers_hz[rows]}),
        **({} if record.runs is None else {RUN: record.runs[rows]}),
        **reference_arrays(record, split),
        **constant_scores(record, split, truth),
        "receiver_name": np.asarray([r.name for r in record.receivers]),
    }
    if predictions[0].std is not None:
        arrays["std"] = np.full(prediction.shape, np.nan, np.float32)
        arrays["std"][scored] = [p.stated_std for p in predictions]
    of_mean = [p.std_mean for p in predictions if p.std_mean is not None]
    if len(of_mean) == len(predictions):
        arrays[STD_MEAN] = np.full(prediction.shape, np.nan, np.float32)
        arrays[STD_MEAN][scored] = of_mean
    if record.truth is not None:
        arrays[NOISE_FREE] = np.ones(len(rows), bool)
    if predictions[0].reception is not None:
        arrays |= reception_arrays(record, split, truth, dict(zip(scored, predictions, strict=True)))
    metrics = score(arrays, record.task.name) | {
        NOT_SCORED: broken,
        **_few_rows(record, split),
        "n_train": len(split.all_train),
        "ms_per_sample": _milliseconds_per_sample(single or predict, rows, scored[0]),
    }
    return metrics, arrays


def _truth(record: Record, split: Split) -> tuple[NDArray[Any], int, list[int]]:
    """Test rows' observations, NaN where they are not scored, the number of broken ones, and scored receivers."""
    if len(split.test) == 0:
        raise InputError(f"split {split.name}: no test rows to score; use another split")
    truth, broken = scorable(record.scored[:, split.test])
    scored = list(split.held_receivers or range(len(truth)))
    truth[np.setdiff1d(np.arange(len(truth)), scored)] = np.nan
    if np.isnan(truth).all():
        raise InputError(f"{record.name}, split {split.name}: no test row to score is finite; use another split")
    return truth, broken, scored


def _few_rows(record: Record, split: Split) -> dict[str, dict[str, int]]:
    """Block of the receivers of signal strengths with fewer than `FEW_ROWS` training rows that a split trains."""
    if not record.task.shares_law:
        return {}
    counts = rows_received(record, split.all_train)
    trained = np.setdiff1d(np.flatnonzero(counts < FEW_ROWS), split.held_receivers)
    few = {record.receivers[number].name: int(counts[number]) for number in trained}
    return {FEW: few} if few else {}


def score(arrays: dict[str, Any], task: str) -> dict[str, Any]:
    """Score blocks of ``metrics.json`` from the arrays of ``predictions.npz`` (with a first axis per receiver).

    Rows that a receiver did not receive are left out. With several receivers each has a block with its number of rows,
    and the block at the top pools all.
    """
    scorer = TASKS[task]
    scores = scorer.of_rows(arrays["prediction"], arrays["truth"])
    keys = [key for key in scorer.references if reference_key(key) in arrays]
    references = {key: scorer.of_rows(arrays[reference_key(key)], arrays["truth"]) for key in keys}

    def block(values: FloatArray, prediction: str, chosen: Any) -> dict[str, float]:
        errors = signed_errors_db(arrays[prediction][chosen], arrays["truth"][chosen]) if scorer.in_decibel else {}
        return summary(values[chosen]) | errors

    def blocks(chosen: Any) -> dict[str, Any]:
        reference = {key: block(values, reference_key(key), chosen) for key, values in references.items()}
        of_prediction = block(scores, "prediction", chosen)
        meaning = {"metric": scorer.block, "higher_is_better": scorer.higher_is_better}
        return {"score": meaning | of_prediction, scorer.block: of_prediction, "reference": reference}

    metrics: dict[str, Any] = {"task": task, **blocks(slice(None)), "n_test": len(arrays["row"])}
    for key, simple in references.items():
        metrics["reference"][key] |= against(scorer, scores, simple)
        if scorer.in_decibel:
            compared = arrays["prediction"], arrays[reference_key(key)], arrays["truth"]
            metrics["reference"][key] |= against_rmse(*compared)
    if COUNT in arrays:
        metrics["reference"][IDW][NEIGHBOURS] = np.unique(arrays[COUNT]).tolist()
    if len(scores) > 1:
        counts = np.count_nonzero(~np.isnan(scores), axis=1)
        metrics["receivers"] = {
            str(name): {**(blocks(r) if counts[r] else {}), "n_test": int(counts[r])}
            for r, name in enumerate(arrays["receiver_name"])
        }
    metrics |= against_simple(scorer, scores, arrays)
    if "std" in arrays:
        # Truth without noise lies in intervals of the mean, readings in their own.
        std = STD_MEAN if NOISE_FREE in arrays and STD_MEAN in arrays else "std"
        compared = arrays["prediction"], arrays[std], arrays["truth"]
        metrics["inside_90"], metrics["crps"] = inside_interval(*compared), crps(*compared)
        metrics[INTERVALS_OF] = "reading" if std == "std" else "mean"
    if RECEPTION in arrays:
        metrics["reception"] = reception_block(arrays)
    return metrics


def pool(parts: Sequence[Scores]) -> Scores:
    """Metrics and predictions of several folds together: every row's score counts once.

    ``n_train`` is the mean over the folds, ``n_train_of_folds`` lists them; ``ms_per_sample`` is the median.
    """
    blocks, every = zip(*parts, strict=True)
    arrays = {
        key: values if key == "receiver_name" else np.concatenate([a[key] for a in every], axis=int(key not in SHARED))
        for key, values in every[0].items()
    }
    few: dict[str, int] = {}
    for block in blocks:  # the fewest of any fold
        few |= {name: min(count, few.get(name, count)) for name, count in block.get(FEW, {}).items()}
    metrics = score(arrays, blocks[0]["task"]) | {
        NOT_SCORED: sum(m[NOT_SCORED] for m in blocks),
        **({FEW: few} if few else {}),
        "n_train": round(float(np.mean([m["n_train"] for m in blocks]))),
        N_TRAIN_OF_FOLDS: [m["n_train"] for m in blocks],
        **({COUNTS: counts} if (counts := added([m.get(COUNTS, {}) for m in blocks])) else {}),
        "ms_per_sample": float(np.median([m["ms_per_sample"] for m in blocks])),
    }
    return metrics, arrays


def score_part(run: Path, config: RunConfig, problem: Problem, part: FittedPart) -> Scores:
    """Scores of a run's part; those of a fold are written to its folder."""
    metrics, arrays = _evaluate_part(problem, part)
    if part.folder != run:
        header = _header(part.folder, replace(config, split=part.split.name), [part])
        write_results(part.folder, header | metrics, arrays)
    return metrics, arrays


def score_run(run: Path, config: RunConfig, parts: Sequence[FittedPart], scores: Sequence[Scores]) -> dict[str, Any]:
    """Write ``metrics.json`` and ``predictions.npz`` of a run from the scores of its parts that have test rows.

    Returns:
        The metrics. With a part that trains on all rows ``n_train`` is their number, and ``cross_validated`` states the
        folds of the scores: ``folds`` and their mean ``n_train``. Without test rows in any part there are no scores,
        and no ``predictions.npz``.
    """
    if not scores:
        counts = {"task": config.task, "n_train": len(parts[-1].split.all_train), "n_test": 0}
        unscored = _header(run, config, parts) | counts
        write_metrics(run, unscored)
        return unscored
    metrics, arrays = scores[0] if len(scores) == 1 else pool(scores)
    final = parts[-1]
    if not len(final.split.test):
        parts = [final, *parts[:-1]]  # the model of the run, whose facts come first
        metrics[CROSS_VALIDATED] = {"folds": len(scores), "n_train": metrics["n_train"]}
        metrics["n_train"] = len(final.split.all_train)
    merged = _header(run, config, parts) | metrics
    write_results(run, merged, arrays)
    return merged


def score_other(config: RunConfig, problem: Problem, part: FittedPart, split: str) -> dict[str, Any]:
    """Metrics on the test rows of another split that were not used in training; `InputError` if there are none."""
    asked = np.unique(np.concatenate([s.test for s in make_splits(problem.record, split, config.seed)]))
    unseen = np.setdiff1d(asked, part.split.all_train)
    if not len(unseen):
        raise InputError(f"{part.folder}: trained on all test rows of split {split}; nothing is left to score")
    metrics, _ = _evaluate_part(problem, part._replace(split=replace(part.split, test=unseen)))
    named = replace(config, split=f"{split} (rows unseen by {config.split})")
    return _header(part.folder, named, [part]) | metrics


def _evaluate_part(problem: Problem, part: FittedPart) -> Scores:
    record, fitted = problem.record, part.fitted

    def single(rows: IntArray, receiver: int) -> Prediction:
        return fitted.predict(inputs_of(record, rows), receiver)

    of_calls = list[Counts]()

    def predict(rows: IntArray, receiver: int) -> Prediction:
        with counted() as counts:
            of_calls.append(counts)
            return fitted.predict_rows(rows, receiver) or single(rows, receiver)

    metrics, arrays = evaluate(record, part.split, predict, single)
    metrics |= {COUNTS: counts} if (counts := added(of_calls)) else {}
    return metrics | _stage_scores(record, part, metrics, arrays), arrays


def _stage_scores(record: Record, part: FittedPart, metrics: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """``stages`` of a fit in stages with ``test`` and ``ms`` of those that were kept.

    They are the mean score of test rows and the milliseconds of a prediction by the stages up to each; of many test
    rows `MOST_OF_STAGES`, evenly spaced, are scored.
    """
    reports = [dict(report) for report in part.fitted.facts().get("stages", [])]
    used = [report for report in reports if report["kept"]]
    if not used:
        return {}
    predictions = part.fitted.by_stage(part.split)
    task, rows = record.task, arrays["row"]
    spaced = evenly_spaced(len(rows), MOST_OF_STAGES)
    truth = arrays["truth"][:, spaced]
    for report in used:
        if report["stage"] in predictions:
            predict = predictions[report["stage"]]
            prediction = np.asarray(predict(inputs_of(record, rows[spaced])))

            def single(row: IntArray, receiver: int, predict: PredictAll = predict) -> NDArray[Any]:
                return predict(inputs_of(record, row))

            milliseconds = _milliseconds_per_sample(single, rows, 0) / len(truth)
        elif report is used[-1]:
            prediction, milliseconds = arrays["prediction"][:, spaced], metrics["ms_per_sample"]
        else:
            continue
        report |= {"test": float(np.nanmean(task.of_rows(prediction, truth))), "ms": milliseconds}
    return {"stages": reports}


def _header(folder: Path, config: RunConfig, parts: Sequence[FittedPart]) -> dict[str, Any]:
    header: dict[str, Any] = {key: getattr(config, key) for key in ("model", "dataset", "split", "seed")}
    header |= {} if config.scene is None else {"scene": config.scene}
    header |= {LEFT_OUT: dict(config.left_out)} if config.left_out else {}
    header |= {PLACES: places} if (places := stored_places(folder)) else {}
    # The peak of the fit, if it is stored already.
    memory_mb = stored_metrics(folder).get("peak_memory_mb", peak_memory_mb())
    seconds = sum(part.seconds for part in parts)
    return {**header, "train_seconds": seconds, "peak_memory_mb": memory_mb, **parts[0].fitted.facts()}


def write_results(folder: Path, metrics: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write ``predictions.npz`` and then ``metrics.json``, which marks the run as finished."""
    write_predictions(folder / PREDICTIONS, {key: values for key, values in arrays.items() if key not in NOT_STORED})
    write_metrics(folder, metrics)


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``, which marks the run as finished."""
    write_atomically(folder / METRICS, json.dumps(metrics, indent=1) + "\n")


def write_predictions(path: Path, arrays: dict[str, Any]) -> dict[str, Any]:
    """Write predictions as ``.npz``, without the first axis where there is one receiver; return the arrays.

    ``row`` [m] are rows from 0, ``tx_pos`` [m, 3] metres, ``frequency_hz`` [m] the carriers of rows that have several,
    ``run`` [m] the runs of the measurement that rows are of, where the data name them,
    ``receiver_name`` [n_rx]. ``prediction`` and, if known, ``truth`` and ``reference_<name>`` are grey values in 0..1
    [n_rx, m, H, W] float32, power in dBm [n_rx, m] float32 (NaN: not received), or channel coefficients
    [n_rx, m, subcarriers] or [n_rx, m, antennas, subcarriers] complex64. ``std`` and ``std_mean``, if stated, are
    predicted standard deviations of the same shape, real: of a reading, its noise included, and of the mean.
    ``truth_without_noise`` [m], if present, is true for rows whose truth has no noise. ``probability_of_reception``
    [n_rx, m], if stated, is the probability that anything is received, with the references ``reception_rate``, the
    receiver's share of received training rows, and ``reception_neighbours``, that of the nearest ones.
    """
    written = without_single_axis(arrays)
    write_arrays(path, written, compressed=True)
    return written


def without_single_axis(arrays: dict[str, Any]) -> dict[str, Any]:
    """Arrays without their first axis where there is one receiver."""
    if len(arrays["receiver_name"]) > 1:
        return arrays
    return {key: values if key in SHARED else values[0] for key, values in arrays.items()}


def stored_metrics(folder: Path) -> dict[str, Any]:
    """Content of ``metrics.json``; empty where it is missing or damaged, since scoring writes it anew."""
    try:
        stored = json.loads((folder / METRICS).read_text())
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) else {}
