"""Losses of flat Dr.Jit arrays, NaN in the truth where nothing was received, and structural similarity.

Structural similarity: Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to
structural similarity", IEEE Trans. Image Processing 13 (2004), in the form of
``skimage.metrics.structural_similarity(truth, prediction, data_range=1)``: a uniform window of 7 x 7
pixels, sample (co)variances, and the mean over the windows that lie wholly inside the image.

Moments are float64, as E[x^2] - E[x]^2 in float32 is too coarse on flat images. The adjoint of a box filter is a box
filter, so the reverse pass gathers and has no atomic sums.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from ..backend.device import quads
from ..core import InputError
from .scores import SSIM_C1, SSIM_C2, SSIM_SAMPLE, WINDOW

SSIM_WEIGHT = 0.2  # Weight of the structural term, eta of the paper
BORDER = WINDOW - 1
LEAST_LIGHT = 1e-3  # light of a spectrum that counts as none: a quarter of one grey level of 8 bits in one pixel


def absolute_error(prediction: Any, truth: Any, *shape: int) -> Any:
    """Mean absolute difference over received observations, a Dr.Jit float of one value; 0 without any.

    Batch and shape of an observation, which other losses need, change nothing.
    """
    return _mean_error(dr.abs, prediction, truth)


def squared_error(prediction: Any, truth: Any, *shape: int) -> Any:
    """Mean squared difference of known values."""
    return _mean_error(dr.square, prediction, truth)


def _mean_error(function: Callable[[Any], Any], prediction: Any, truth: Any) -> Any:
    finite = dr.isfinite(truth)
    count = dr.sum(dr.select(finite, type(truth)(1), 0))
    error = function(prediction - dr.select(finite, truth, 0))
    return dr.sum(dr.select(finite, error, 0)) / dr.maximum(count, 1)


def light_error(prediction: Any, truth: Any, pixels: int) -> Any:
    """Absolute error of spectra of ``pixels`` values each, a Dr.Jit float of one value: half by pixels, half by light.

        D = 1/2 mean |p - t| + 1/2 sum q |p - t| / sum q,   q = t - min t,   of each spectrum; the mean of a batch

    The light q of a spectrum is its grey above its darkest pixel.
    """
    # Of a narrow lobe on a dark ground the mean over pixels counts few bright ones against many dark ones. Gaussians
    # wider than the lobe would rather be dark: the fit loses the lobe at once, and learns the ground alone.
    error, truth = dr.abs(prediction - dr.detach(truth)), dr.detach(truth)
    light = truth - dr.repeat(dr.block_reduce(dr.ReduceOp.Min, truth, pixels), pixels)
    by_light = dr.block_sum(light * error, pixels) / dr.maximum(dr.block_sum(light, pixels), LEAST_LIGHT)
    return 0.5 * (dr.mean(error) + dr.mean(by_light))


def spectrum_loss(
    prediction: Any, truth: Any, batch: int, height: int, width: int, eta: float = SSIM_WEIGHT
) -> tuple[Any, Any]:
    """(1 - eta) D + eta (1 - SSIM), averaged over a batch of spectra; arguments and errors as of `ssim`.

    D is the `light_error`, in place of the paper's L1.

    Returns:
        The loss, a Dr.Jit float of one value, and the structural similarity of each spectrum [batch].

    Source: WRF-GS+, the loss of the spectrum synthesis; SSIM of scikit-image.
    """
    similarity = ssim(prediction, truth, batch, height, width)
    difference = light_error(prediction, truth, height * width)
    return (1 - eta) * difference + eta * (1 - dr.mean(similarity)), similarity


def ssim(prediction: Any, truth: Any, batch: int, height: int, width: int) -> Any:
    """Mean structural similarity of each image, a Dr.Jit float array [batch], differentiable in the prediction.

    Prediction and truth, which is taken as constant, are flat Dr.Jit float arrays of one type, of ``batch * height *
    width`` values in a range of one.

    Raises:
        InputError: an image smaller than the window, or arrays of another size or type.
    """
    if height < WINDOW or width < WINDOW:
        raise InputError(f"image of {height} x {width} pixels: SSIM needs at least {WINDOW} x {WINDOW}")
    if type(prediction) is not type(truth):
        raise InputError(f"prediction is {type(prediction)} and truth {type(truth)}: convert one to the other's type")
    for name, array in (("prediction", prediction), ("truth", truth)):
        if len(array) != (size := batch * height * width):
            raise InputError(f"{name} has {len(array)} values, {batch} x {height} x {width} needs {size}: reshape it")
    single: Any = type(prediction)
    double: Any = dr.float64_array_t(single)
    x, y = double(prediction), double(dr.detach(truth))
    moments = [x, y, x * x + y * y, x * y]
    mean_x, mean_y, squares, product = dr.custom(_WindowMeans, moments, batch, height, width)
    means, across = mean_x * mean_x + mean_y * mean_y, mean_x * mean_y
    similarity = (2 * across + SSIM_C1) / (means + SSIM_C1)
    similarity *= (2 * SSIM_SAMPLE * (product - across) + SSIM_C2) / (SSIM_SAMPLE * (squares - means) + SSIM_C2)
    count = (height - BORDER) * (width - BORDER)
    return single(dr.block_sum(similarity, count) / count)


def _packed(values: list[Any]) -> Any:
    """Four arrays [n] as one [4 n], whose gathers move four numbers at once."""
    kind: Any = type(values[0])
    count = max(dr.width(part) for part in values)
    out, index = dr.empty(kind, 4 * count), dr.arange(dr.uint32_array_t(kind), count)
    dr.scatter(out, quads(kind)(*values), index, mode=dr.ReduceMode.Permute)
    return out


def _window_means(values: list[Any], batch: int, height: int, width: int) -> list[Any]:
    """Means of four arrays over the windows wholly inside each image, [batch, height - 6, width - 6]."""
    kind: Any = type(values[0])
    inner_h, inner_w = height - BORDER, width - BORDER
    along_rows = batch * height * inner_w, inner_w, BORDER, 1
    along_columns = batch * inner_h * inner_w, inner_h * inner_w, BORDER * inner_w, inner_w
    for size, line, skipped, step in (along_rows, along_columns):
        i, table = dr.arange(dr.uint32_array_t(kind), size), _packed(values)
        start = i + (i // line) * skipped
        values = list(sum(dr.gather(quads(kind), table, start + k * step) for k in range(WINDOW)) * (1 / WINDOW))
    return values


def _padded(values: list[Any], batch: int, height: int, width: int) -> list[Any]:
    """Four arrays of images with a border of 6 zeros on each side, [batch, height + 12, width + 12]."""
    kind: Any = type(values[0])
    wide, high = width + 2 * BORDER, height + 2 * BORDER
    i = dr.arange(dr.uint32_array_t(kind), batch * high * wide)
    line = i // wide
    row, column = line % high - BORDER, i % wide - BORDER  # below zero they wrap around to large numbers
    source, inside = (line // high * height + row) * width + column, (row < height) & (column < width)
    return [dr.gather(kind, part, source, inside) for part in values]


class _WindowMeans(dr.CustomOp):
    """`_window_means` with a reverse pass of the same kind."""

    def eval(self, values: list[Any], batch: int, height: int, width: int) -> list[Any]:
        self.shape = batch, height, width
        return _window_means(values, batch, height, width)

    def forward(self) -> None:
        values: Any = self.grad_in("values")
        self.set_grad_out(_window_means(values, *self.shape))

    def backward(self) -> None:
        batch, height, width = self.shape
        gradient: Any = self.grad_out()
        dr.eval(gradient)  # Dr.Jit 1.5 crashes where gathers would evaluate it
        padded = _padded(gradient, batch, height - BORDER, width - BORDER)
        self.set_grad_in("values", _window_means(padded, batch, height + BORDER, width + BORDER))

    def name(self) -> str:
        return "window means"
