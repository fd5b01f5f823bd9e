"""Extremely randomised trees over position and heading: what signal strengths tell a learner without physics."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wrf_mi.core import InputError
from wrf_mi.core.angles import FloatArray
from wrf_mi.hybrid.estimate import Estimate


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

    def estimate(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> Estimate:
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
        return Estimate(mean.astype(self._type), np.sqrt(np.maximum(square - mean**2, 0)))

    def _asked(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None) -> FloatArray:
        features = _features(tx_pos, tx_heading_rad)
        if features.shape[1] != self._width:
            raise InputError(
                f"trees: fitted {'with' if self._width > 3 else 'without'} headings; predict with the same"
            )
        return features


def _features(tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None) -> FloatArray:
    positions = np.atleast_2d(np.asarray(tx_pos, float))
    if tx_heading_rad is None:
        return positions
    heading = np.atleast_1d(np.asarray(tx_heading_rad, float))
    if heading.shape != (len(positions),):
        raise InputError(f"trees: {len(positions)} positions and headings {heading.shape}; give one per row")
    return np.column_stack([positions, np.cos(heading), np.sin(heading)])
