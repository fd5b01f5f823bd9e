"""Extremely randomised trees over position and heading: what signal strengths tell a learner without physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wrf_mi.core import InputError, Prediction, Receiver, Record, Split
from wrf_mi.core.angles import FloatArray

from ...training.session import FitSession
from ..method import Method
from .by_receiver import ByReceiver, fit_each, load_each

NAME = "trees"


class Trees:
    """An average of extremely randomised regression trees over x, y, z and, if given, cosine and sine of the heading.

    Args:
        trees: number of trees.
        leaf_rows: least number of training rows in a leaf: what averages the noise out.
        seed: of the random cuts.

    Source: Geurts, Ernst and Wehenkel, "Extremely randomized trees" (2006); scikit-learn's `ExtraTreesRegressor`.
    """

    def __init__(self, trees: int = 300, leaf_rows: int = 5, seed: int = 0) -> None:
        if trees < 1 or leaf_rows < 1:
            raise InputError(f"{trees} trees with {leaf_rows} rows in a leaf: choose 1 or more of both")
        self.trees, self.leaf_rows, self.seed = trees, leaf_rows, seed

    def fit(self, tx_pos: ArrayLike, observation: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> Trees:
        """Grow the trees on the rows that were observed.

        Args:
            tx_pos: shape [n, 3], metres.
            observation: real, shape [n]; NaN, where nothing was received, is left out.
            tx_heading_rad: shape [n], or None to leave headings out.

        Raises:
            InputError: no rows, none that was observed, different numbers of them, or observations that are no numbers.
        """
        # It takes a second to import, and only this class needs it.
        from sklearn.ensemble import ExtraTreesRegressor

        values = np.asarray(observation)
        if values.ndim != 1 or np.iscomplexobj(values):
            raise InputError(f"trees: observations {values.shape} of type {values.dtype}; give one real number per row")
        features = _features(tx_pos, tx_heading_rad)
        if len(features) == 0 or len(features) != len(values):
            raise InputError(
                f"{len(features)} positions and {len(values)} observations: give one per row, at least one"
            )
        observed = ~np.isnan(values)
        if not observed.any():
            raise InputError(f"{len(values)} training rows: none of them was received; use another split")
        self._type, self._width = np.result_type(values, np.float32), features.shape[1]
        model = ExtraTreesRegressor(self.trees, min_samples_leaf=self.leaf_rows, random_state=self.seed)
        self._model = model.fit(features[observed], values[observed].astype(float))
        return self

    def predict(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> NDArray[np.floating]:
        """Average of the trees.

        Args:
            tx_pos: shape [m, 3], metres.
            tx_heading_rad: shape [m], if and only if the fit had headings.

        Returns:
            Shape [m], in the observations' unit and type.

        Raises:
            InputError: headings that the fit did not have, or the other way round.
        """
        return self._model.predict(self._asked(tx_pos, tx_heading_rad)).astype(self._type)

    def estimate(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> Prediction:
        """Average of the trees, and the standard deviation of a training row drawn from a leaf of a random tree.

        The variance within leaves and that between trees add up (law of total variance).
        """
        features = self._asked(tx_pos, tx_heading_rad)
        mean, square = np.zeros(len(features)), np.zeros(len(features))
        for tree in self._model.estimators_:
            leaf = tree.apply(features)
            value = tree.tree_.value[leaf, 0, 0]
            mean += value / self.trees
            square += (tree.tree_.impurity[leaf] + value**2) / self.trees
        return Prediction(mean.astype(self._type), np.sqrt(np.maximum(square - mean**2, 0)))

    def grown(self) -> GrownTrees:
        """The trees without what grew them."""
        parts = [tree.tree_ for tree in self._model.estimators_]
        first = np.concatenate([[0], np.cumsum([part.node_count for part in parts])])
        leaf = [part.children_left < 0 for part in parts]
        # A leaf leads to itself, so that all trees can be followed for the same number of steps.
        own = [start + np.arange(part.node_count) for start, part in zip(first, parts, strict=False)]
        ways = [
            np.concatenate(
                [
                    np.where(end, at, start + child)
                    for start, at, end, child in zip(first, own, leaf, side, strict=False)
                ]
            )
            for side in ([part.children_left for part in parts], [part.children_right for part in parts])
        ]
        return GrownTrees(
            root=first[:-1].astype(np.int32),
            left=ways[0].astype(np.int32),
            right=ways[1].astype(np.int32),
            feature=np.concatenate([np.maximum(part.feature, 0) for part in parts]).astype(np.int8),
            threshold=np.concatenate([part.threshold for part in parts]),
            value=np.concatenate([part.value[:, 0, 0] for part in parts]),
            depth=np.asarray(max(part.max_depth for part in parts)),
            like=np.empty((0, self._width), self._type),
        )

    def _asked(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None) -> FloatArray:
        features = _features(tx_pos, tx_heading_rad)
        _same_width(features, self._width)
        return features


@dataclass(frozen=True)
class GrownTrees:
    """Trees as plain arrays, over all nodes of all trees.

    Attributes:
        root: first node of each tree.
        left: node where a feature is at most the threshold; of a leaf itself.
        right: node where it is more.
        feature: that decides.
        threshold: of it.
        value: mean of the training rows in the node.
        depth: longest way from a root to a leaf.
        like: empty array [0, features] of the observations' type.
    """

    root: NDArray[np.int32]
    left: NDArray[np.int32]
    right: NDArray[np.int32]
    feature: NDArray[np.int8]
    threshold: FloatArray
    value: FloatArray
    depth: NDArray[Any]
    like: NDArray[Any]

    def predict(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> NDArray[np.floating]:
        """As `Trees.predict`."""
        features = _features(tx_pos, tx_heading_rad)
        _same_width(features, self.like.shape[1])
        # scikit-learn cuts features in single precision.
        single = features.astype(np.float32)
        rows = np.arange(len(features))
        node = np.broadcast_to(self.root[:, None], (len(self.root), len(features)))
        for _ in range(int(self.depth)):
            left = single[rows, self.feature[node]] <= self.threshold[node]
            node = np.where(left, self.left[node], self.right[node])
        return self.value[node].mean(axis=0).astype(self.like.dtype)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of them."""
        return dict(vars(self))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> GrownTrees:
        """What `arrays` returned."""
        return cls(**{name: arrays[name] for name in cls.__dataclass_fields__})


def _same_width(features: FloatArray, width: int) -> None:
    if features.shape[1] != width:
        raise InputError(f"trees: fitted {'with' if width > 3 else 'without'} headings; predict with the same")


def _features(tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None) -> FloatArray:
    positions = np.atleast_2d(np.asarray(tx_pos, float))
    if tx_heading_rad is None:
        return positions
    heading = np.atleast_1d(np.asarray(tx_heading_rad, float))
    if heading.shape != (len(positions),):
        raise InputError(f"trees: {len(positions)} positions and headings {heading.shape}; give one per row")
    return np.column_stack([positions, np.cos(heading), np.sin(heading)])


@dataclass(frozen=True)
class TreesSettings:
    """Settings of the trees.

    Attributes:
        trees: number of trees.
        leaf_rows: least number of training rows in a leaf.
        heading: whether headings count, where the data have them.
    """

    trees: int = 300
    leaf_rows: int = 5
    heading: bool = True


def fit(record: Record, split: Split, settings: TreesSettings, seed: int, session: FitSession) -> ByReceiver:
    """Grow trees on what each receiver received.

    Raises:
        InputError: settings out of range, positions that are not known, or no row that was received.
    """

    def one(receiver: Receiver, tx_pos: FloatArray, observed: Any, heading: FloatArray | None) -> GrownTrees:
        return Trees(settings.trees, settings.leaf_rows, seed).fit(tx_pos, observed, heading).grown()

    return fit_each(NAME, record, split, session.report, one, settings.heading)


def load(arrays: dict[str, NDArray[Any]], record: Record) -> ByReceiver:
    """What `ByReceiver.arrays` returned."""
    return load_each(NAME, arrays, record, lambda receiver, kept: GrownTrees.from_arrays(kept))


SOURCE = "Geurts, Ernst and Wehenkel, 'Extremely randomized trees'"
METHOD = Method(NAME, ("rssi",), TreesSettings, fit, load, SOURCE, several_carriers=True)
