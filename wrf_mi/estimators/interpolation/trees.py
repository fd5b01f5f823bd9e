"""Extremely randomised trees over position and heading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, Count
from ..model import Problem
from .by_receiver import ByReceiverModel, ReceiverRows, Single, observed_rows


@dataclass(frozen=True)
class Trees(CheckedSettings):
    """An average of extremely randomised regression trees over x, y, z and, if given, cosine and sine of the heading.

    Attributes:
        trees: number of trees.
        leaf_rows: least number of training rows in a leaf, which averages noise out.
        heading: whether headings count, where the data have them.

    Source: Geurts, Ernst and Wehenkel, "Extremely randomized trees" (2006); scikit-learn's `ExtraTreesRegressor`.
    """

    trees: Count = 300
    leaf_rows: Count = 5
    heading: bool = True

    def fit(
        self, tx_pos: ArrayLike, observation: ArrayLike, tx_heading_rad: ArrayLike | None = None, seed: int = 0
    ) -> GrownTrees:
        """Grow the trees, whose cuts are random, on the rows that were observed.

        Positions [n, 3] are in metres; real observations [n] are NaN where nothing was received; None leaves headings
        [n] out.

        Raises:
            InputError: no rows, none that was observed, different numbers of them, or complex observations.
        """
        # It takes a second to import, and only this class needs it.
        from sklearn.ensemble import ExtraTreesRegressor

        values = np.asarray(observation)
        if values.ndim != 1 or np.iscomplexobj(values):
            raise InputError(f"trees: observations {values.shape} of type {values.dtype}; give one real number per row")
        positions, values, heading = observed_rows(tx_pos, values, tx_heading_rad)
        like = np.empty((0, 3 if heading is None else 5), np.result_type(values, np.float32))
        model = ExtraTreesRegressor(self.trees, min_samples_leaf=self.leaf_rows, random_state=seed)
        model.fit(_features(positions, heading, like), values.astype(float))
        parts = [tree.tree_ for tree in model.estimators_]
        first = np.concatenate([[0], np.cumsum([part.node_count for part in parts])])
        of_tree = np.repeat(first[:-1], np.diff(first))
        nodes = np.arange(first[-1])

        def joined(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(part, name) for part in parts])

        # A leaf leads to itself, so that all trees can be followed for the same number of steps.
        leaf = joined("children_left") < 0
        left, right = (np.where(leaf, nodes, of_tree + joined(f"children_{side}")) for side in ("left", "right"))
        return GrownTrees(
            root=first[:-1].astype(np.int32),
            left=left.astype(np.int32),
            right=right.astype(np.int32),
            feature=np.maximum(joined("feature"), 0).astype(np.int8),
            threshold=joined("threshold"),
            value=joined("value")[:, 0, 0],
            depth=np.asarray(max(part.max_depth for part in parts)),
            like=like,
        )


@dataclass(frozen=True)
class GrownTrees(Single):
    """Trees as plain arrays, over all nodes of all trees: a run file holds arrays, not pickled objects."""

    root: NDArray[np.int32]  # first node of each tree
    left: NDArray[np.int32]  # next node where the feature is at most the threshold; of a leaf, itself
    right: NDArray[np.int32]  # next node where it is more
    feature: NDArray[np.int8]  # number of the feature that decides
    threshold: FloatArray
    value: FloatArray  # mean of the training rows in the node
    depth: NDArray[Any]  # longest path from a root to a leaf
    like: NDArray[Any]  # empty array [0, features] of the observations' type

    def predict(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> NDArray[np.floating]:
        """Average of the trees [m] at positions [m, 3] and, if and only if the fit had headings, headings [m].

        Raises:
            InputError: headings that the fit did not have, or the other way round.
        """
        return np.asarray(self.of_each(tx_pos, tx_heading_rad).mean(axis=0), self.like.dtype)

    def of_each(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> FloatArray:
        """Values of each tree [trees, m], otherwise as `predict`."""
        # scikit-learn cuts features in single precision.
        single = _features(tx_pos, tx_heading_rad, self.like).astype(np.float32)
        rows = np.arange(len(single))
        # All trees [trees, m] descend together, as many steps as the deepest has.
        node = np.broadcast_to(self.root[:, None], (len(self.root), len(single)))
        for _ in range(int(self.depth)):
            left = single[rows, self.feature[node]] <= self.threshold[node]
            node = np.where(left, self.left[node], self.right[node])
        return np.asarray(self.value[node])


def _features(tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None, like: NDArray[Any]) -> FloatArray:
    positions = np.atleast_2d(np.asarray(tx_pos, float))
    if (tx_heading_rad is not None) != (like.shape[1] > 3):
        had = "with" if like.shape[1] > 3 else "without"
        raise InputError(f"trees: fitted {had} headings; predict with the same")
    if tx_heading_rad is None:
        return positions
    heading = np.atleast_1d(np.asarray(tx_heading_rad, float))
    if heading.shape != (len(positions),):
        raise InputError(f"trees: {len(positions)} positions and headings {heading.shape}; give one per row")
    return np.column_stack([positions, np.cos(heading), np.sin(heading)])


class TreesModel(ByReceiverModel):
    """Extremely randomised trees of each receiver."""

    name, settings = "trees", Trees
    source = "Geurts, Ernst and Wehenkel, 'Extremely randomized trees'"
    summary = "extremely randomised trees"
    tasks = ("rssi",)

    def takes_headings(self, record: Record, settings: Trees) -> bool:
        """As the settings say."""
        return settings.heading

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """``heading`` where the data have none."""
        return {"heading": "the data have no headings"} if problem.record.tx_heading_rad is None else {}

    def fit_single(self, rows: ReceiverRows) -> GrownTrees:
        """Grow the trees of a receiver."""
        trees: Trees = rows.problem.settings
        return trees.fit(rows.tx_pos_m, rows.observation, rows.tx_heading_rad, rows.problem.seed)


MODEL = TreesModel()
