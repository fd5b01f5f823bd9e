"""Differentiable structural similarity, equal to scikit-image's.

Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural
similarity", IEEE Trans. Image Processing 13 (2004), in the form of
``skimage.metrics.structural_similarity(truth, prediction, data_range=1)``: a uniform window of 7 x 7
pixels, sample (co)variances, and the mean over the windows that lie wholly inside the image.

Means and (co)variances are taken over each window's rows first and then merged (Chan, Golub and LeVeque,
1983), so that no large squares cancel: E[x^2] - E[x]^2 in float32 is too coarse on flat images. The adjoint
of a box filter is a box filter, so the reverse pass gathers and has no atomic sums.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from wrf_mi.backend.device import quads
from wrf_mi.core import InputError

WINDOW = 7
"""Side of the window in pixels, scikit-image's default."""
C1 = 0.01**2
C2 = 0.03**2
"""Stabilising constants of Wang et al. (2004) for a data range of one."""

BORDER = WINDOW - 1
PIXELS = WINDOW**2


def ssim(prediction: Any, truth: Any, batch: int, height: int, width: int) -> Any:
    """Mean structural similarity of each image, differentiable in the prediction.

    Args:
        prediction: flat Dr.Jit float array of ``batch * height * width`` values (a data range of one).
        truth: array of the same shape and type; taken as constant.
        batch: number of images.
        height: rows, at least 7.
        width: columns, at least 7.

    Returns:
        Dr.Jit float array [batch].

    Raises:
        InputError: an image smaller than the window, or arrays of another size or type.
    """
    _check(prediction, truth, batch, height, width)
    return dr.custom(_Ssim, prediction, dr.detach(truth), batch, height, width)


def _check(prediction: Any, truth: Any, batch: int, height: int, width: int) -> None:
    if height < WINDOW or width < WINDOW:
        raise InputError(f"image of {height} x {width} pixels: SSIM needs at least {WINDOW} x {WINDOW}")
    if type(prediction) is not type(truth):
        raise InputError(f"prediction is {type(prediction)} and truth {type(truth)}: convert one to the other's type")
    size = batch * height * width
    for name, array in (("prediction", prediction), ("truth", truth)):
        if len(array) != size:
            raise InputError(f"{name} has {len(array)} values, {batch} x {height} x {width} needs {size}: reshape it")


def _store(values: list[Any], float_type: Any) -> Any:
    """Interleave four arrays [n] into one [4 n]."""
    n = max(dr.width(v) for v in values)
    out = dr.empty(float_type, 4 * n)
    index = dr.arange(dr.uint32_array_t(float_type), n)
    dr.scatter(out, quads(float_type)(*values), index, mode=dr.ReduceMode.Permute)
    return out


def _middle(x: Any, y: Any, image: Any, height: int, width: int) -> tuple[Any, Any]:
    """Central pixel of an image, from which its values are counted.

    The reverse pass computes x_p - mean_x as a difference of two sums over windows, which cancels on flat images.
    """
    centre = image * (height * width) + (height // 2 * width + width // 2)
    return dr.gather(type(x), x, centre), dr.gather(type(y), y, centre)


def _row_moments(x: Any, y: Any, batch: int, height: int, width: int) -> Any:
    """Moments of 7 pixels of a row, [batch * height, width - 6, 4]: means of x and y from `_middle`, sum of their
    squared deviations, co-deviation.
    """
    inner = width - BORDER
    i = dr.arange(dr.uint32_array_t(type(x)), batch * height * inner)
    start = i + (i // inner) * BORDER
    mid_x, mid_y = _middle(x, y, i // (height * inner), height, width)
    xs = [dr.gather(type(x), x, start + k) - mid_x for k in range(WINDOW)]
    ys = [dr.gather(type(y), y, start + k) - mid_y for k in range(WINDOW)]
    mean_x, mean_y = sum(xs) * (1 / WINDOW), sum(ys) * (1 / WINDOW)
    squares: Any = 0
    products: Any = 0
    for xk, yk in zip(xs, ys, strict=True):
        dx, dy = xk - mean_x, yk - mean_y
        squares = dr.fma(dx, dx, dr.fma(dy, dy, squares))
        products = dr.fma(dx, dy, products)
    return _store([mean_x, mean_y, squares, products], type(x))


def _windows(x: Any, y: Any, moments: Any, batch: int, height: int, width: int) -> tuple[Any, Any]:
    """Similarity [batch, height - 6, width - 6] of each window, and the coefficients of the reverse pass.

    With the derivatives of the similarity by mean (a), variance (b) and covariance (c) of a window, pixel p receives
    the sum over its windows of a / 49 + b * 2 (x_p - mean_x) / 48 + c * (y_p - mean_y) / 48, which is box(offset) + x_p
    box(by_x) + y_p box(by_y); the second result holds (offset, by_x, by_y, 0), with x and y relative to `_middle`.
    """
    float_type = type(moments)
    inner_h, inner_w = height - BORDER, width - BORDER
    i = dr.arange(dr.uint32_array_t(float_type), batch * inner_h * inner_w)
    image = i // (inner_h * inner_w)
    start = i + image * (BORDER * inner_w)
    rows = [dr.gather(quads(float_type), moments, start + k * inner_w) for k in range(WINDOW)]
    total = sum(rows)
    mean_x, mean_y = total[0] * (1 / WINDOW), total[1] * (1 / WINDOW)
    squares: Any = 0
    products: Any = 0
    for row in rows:
        dx, dy = row[0] - mean_x, row[1] - mean_y
        squares = dr.fma(dx, dx, dr.fma(dy, dy, squares))
        products = dr.fma(dx, dy, products)
    variances = (total[2] + WINDOW * squares) * (1 / (PIXELS - 1))
    covariance = (total[3] + WINDOW * products) * (1 / (PIXELS - 1))

    mid_x, mid_y = _middle(x, y, image, height, width)
    ux, uy = mid_x + mean_x, mid_y + mean_y
    means_below = dr.rcp(dr.fma(ux, ux, dr.fma(uy, uy, C1)))
    spread_below = dr.rcp(variances + C2)
    means = dr.fma(2 * ux, uy, C1) * means_below
    spread = dr.fma(2, covariance, C2) * spread_below
    similarity = means * spread
    by_x = similarity * spread_below * (-2 / (PIXELS - 1))
    by_y = means * spread_below * (2 / (PIXELS - 1))
    # (uy - ux means) without its cancellation: means = 1 - apart^2 means_below.
    apart = (mid_y - mid_x) + (mean_y - mean_x)
    by_mean = spread * apart * dr.fma(ux * apart, means_below, 1) * means_below * (2 / PIXELS)
    offset = by_mean - by_x * mean_x - by_y * mean_y
    return similarity, _store([offset, by_x, by_y, float_type(0)], float_type)


def _gradient(x: Any, y: Any, parts: Any, batch: int, height: int, width: int) -> Any:
    """Derivative of the sum of each image's similarities by its pixels, [batch, height, width]."""
    float_type = type(x)
    uint, four = dr.uint32_array_t(float_type), quads(float_type)
    inner_h, inner_w = height - BORDER, width - BORDER
    i = dr.arange(uint, batch * height * inner_w)
    line = i // inner_w
    image = line // height
    row = line - image * height
    start = i - image * (BORDER * inner_w)
    columns: Any = 0
    for k in range(WINDOW):
        inside = (row >= k) & (row < inner_h + k)
        columns = columns + dr.gather(four, parts, start - k * inner_w, inside)
    columns = _store(list(columns), float_type)

    i = dr.arange(uint, batch * height * width)
    line = i // width
    column = i - line * width
    start = i - line * BORDER
    total: Any = 0
    for k in range(WINDOW):
        inside = (column >= k) & (column < inner_w + k)
        total = total + dr.gather(four, columns, start - k, inside)
    mid_x, mid_y = _middle(x, y, line // height, height, width)
    return dr.fma(x - mid_x, total[1], dr.fma(y - mid_y, total[2], total[0]))


class _Ssim(dr.CustomOp):
    """Structural similarity with a reverse pass of two box filters."""

    def eval(self, prediction: Any, truth: Any, batch: int, height: int, width: int) -> Any:
        moments = _row_moments(prediction, truth, batch, height, width)
        similarity, self.parts = _windows(prediction, truth, moments, batch, height, width)
        self.prediction, self.truth = prediction, truth
        self.shape = batch, height, width
        count = (height - BORDER) * (width - BORDER)
        # Like scikit-image: a float32 sum of 30,000 values near one is already off by 3e-5.
        single: Any = type(similarity)
        double: Any = dr.float64_array_t(single)
        return single(dr.block_sum(double(similarity), count) * (1 / count))

    def _pixel_gradient(self) -> tuple[Any, Any]:
        """Derivative of each image's mean by its pixels, and the image of each pixel."""
        batch, height, width = self.shape
        gradient = _gradient(self.prediction, self.truth, self.parts, *self.shape)
        image = dr.arange(dr.uint32_array_t(type(gradient)), batch * height * width) // (height * width)
        return gradient * (1 / ((height - BORDER) * (width - BORDER))), image

    def forward(self) -> None:
        gradient, _ = self._pixel_gradient()
        _, height, width = self.shape
        self.set_grad_out(dr.block_sum(gradient * self.grad_in("prediction"), height * width))

    def backward(self) -> None:
        gradient, image = self._pixel_gradient()
        self.set_grad_in("prediction", gradient * dr.gather(type(gradient), self.grad_out(), image))

    def name(self) -> str:
        return "ssim"
