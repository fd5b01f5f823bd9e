"""Losses over what was received: flat Dr.Jit arrays of any task, NaN in the truth where nothing was."""

from __future__ import annotations

from typing import Any

import drjit as dr


def absolute_error(prediction: Any, truth: Any) -> Any:
    """Mean absolute difference over what was received, a Dr.Jit float of one value; 0 where nothing was."""
    return _mean(dr.abs(prediction - _filled(truth)), truth)


def squared_error(prediction: Any, truth: Any) -> Any:
    """Mean squared difference over what was received, a Dr.Jit float of one value; 0 where nothing was."""
    return _mean(dr.square(prediction - _filled(truth)), truth)


def _filled(truth: Any) -> Any:
    return dr.select(dr.isfinite(truth), truth, 0)


def _mean(error: Any, truth: Any) -> Any:
    known = dr.isfinite(truth)
    count = dr.sum(dr.select(known, type(truth)(1), 0))
    return dr.sum(dr.select(known, error, 0)) / dr.maximum(count, 1)
