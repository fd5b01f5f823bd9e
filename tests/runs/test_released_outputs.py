"""Outputs in the form of NeRF2's and WRF-GS+'s test scripts, made here as their code writes them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_channels import channels
from PIL import Image
from scipy.io import savemat

from wrf_mi import InputError, Record, load, score_predictions
from wrf_mi.receivers import minmax_scale

DRAWN = 0.003  # mean error of grey values that are drawn with 256 colours on 460 pixels and read back


def paint(file: Path, predicted: Any, measured: Any, cmap: str) -> None:
    """`paint_spectrum_compare` of both repositories' ``utils/data_painter.py``, at a lower resolution."""
    from matplotlib import pyplot as plt

    height, width = predicted.shape
    theta, r = np.meshgrid(np.linspace(0, 2 * np.pi, width + 1), np.linspace(0, 1, height + 1), indexing="ij")
    _, axes = plt.subplots(1, 2, subplot_kw={"projection": "polar"}, figsize=(12, 6))
    for axis, spectrum in zip(axes, (predicted, measured), strict=True):
        axis.pcolormesh(theta, r, np.flipud(spectrum).T, cmap=cmap, shading="flat")
        axis.axis("off")
    plt.savefig(file, dpi=100, bbox_inches="tight", transparent=True)
    plt.close()


def stored(run: Any) -> tuple[Any, Any]:
    """Rows [m] and predictions [m, ...] of a run."""
    with np.load(run.folder / "predictions.npz") as arrays:
        return arrays["row"], arrays["prediction"]


def shuffled(record: Record) -> Record:
    """The record with test rows out of order, as a random ``test_index.txt`` has them."""
    assert record.official is not None
    train, test = record.official
    return replace(record, official=(train, np.roll(test, 2)[::-1]))


@pytest.fixture(scope="module")
def spectra(one_gateway: Record) -> Record:
    return shuffled(one_gateway)


@pytest.fixture(scope="module")
def plots(spectra: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder ``pred_spectrum``: the prediction of each test row is the measurement of the one before it."""
    folder = tmp_path_factory.mktemp("logs") / "pred_spectrum"
    folder.mkdir()
    for number, row in enumerate(spectra.official[1]):
        predicted, measured = spectra.observation[0, [row - 1, row]]
        paint(folder / f"{number}.png", predicted, measured, "jet" if number % 2 else "viridis")
    return folder


def test_plots_are_read_as_the_spectra_drawn(spectra, plots, tmp_path, caplog):
    run = score_predictions(spectra, plots, tmp_path / "run", "theirs")
    rows, prediction = stored(run)
    error = prediction - minmax_scale(spectra.observation[0, rows - 1])
    assert np.abs(error).mean(axis=(1, 2)).max() < DRAWN
    assert "from its minimum to its maximum" in caplog.text


@pytest.mark.parametrize("first", [0, 1])
def test_grey_pictures_are_numbered_like_plots_or_named_like_the_data(first, spectra, tmp_path):
    folder = tmp_path / "grey"
    folder.mkdir()
    grey = np.round(255 * spectra.observation[0] * 0.9).astype(np.uint8)
    for number, row in enumerate(test := spectra.official[1]):
        Image.fromarray(grey[row]).save(folder / (f"{row + 1:05d}.png" if first else f"{number}.png"))
    run = score_predictions(spectra, folder, tmp_path / "run", "theirs")
    rows, prediction = stored(run)
    assert sorted(rows) == sorted(test)
    assert np.allclose(prediction, grey[rows] / 255, atol=1e-6)


def write_strengths(file: Path, record: Record, offset_db: float = 0.0) -> None:
    """``result.txt`` of `eval_network_rssi`."""
    observed = record.observation[:, record.official[1]].T
    file.write_text("".join(f"{value + offset_db:.2f}, {value + 3:.2f}\n" for value in observed[np.isfinite(observed)]))


@pytest.fixture(scope="module")
def strengths(flat_folder: Path) -> Record:
    record = shuffled(load(flat_folder))
    observed = record.observation.copy()
    observed[1, record.official[1][2]] = np.nan
    return replace(record, observation=observed)


def test_strengths_are_those_of_receivers_that_received(strengths: Record, tmp_path: Path) -> None:
    write_strengths(tmp_path / "result.txt", strengths)
    metrics = score_predictions(strengths, tmp_path / "result.txt", tmp_path / "run", "theirs").metrics
    assert metrics["abs_error_db"]["p10"] == pytest.approx(3, abs=0.01)
    assert metrics["abs_error_db"]["p90"] == pytest.approx(3, abs=0.01)


def write_channels(file: Path, record: Record, **changes: Any) -> None:
    """``result.mat`` of `eval_network_csi`."""
    truth = record.observation[0, record.official[1]]
    savemat(file, {"pred_csi": 1.1 * truth, "gt_csi": truth, "snr": np.zeros(len(truth))} | changes)


def test_channels_are_read(tmp_path: Path) -> None:
    record = shuffled(channels())
    write_channels(tmp_path / "result.mat", record)
    metrics = score_predictions(record, tmp_path / "result.mat", tmp_path / "run", "theirs").metrics
    assert metrics["cea_db"]["median"] == pytest.approx(20, abs=1e-3)  # -10 log10 of 0.1^2


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "0.png").rename(folder / "9.png"), "9.png: no row belongs to it"),
        (lambda folder: (folder / "1.png").unlink(), "1 of the 5 test rows have no prediction"),
        (lambda folder: (folder / "0.png").replace(folder / "1.png"), "differs by .* give the data set whose"),
        (lambda folder: (folder / "2.png").write_bytes(b"no picture"), "2.png: unreadable"),
        (lambda folder: Image.new("RGBA", (40, 20), "red").save(folder / "2.png"), "not two polar plots"),
        (lambda folder: Image.new("L", (4, 4)).save(folder / "2.png"), "4 x 4 pixels"),
        (lambda folder: recolour(folder / "3.png"), "colours of neither viridis nor jet"),
    ],
)
def test_unusable_pictures_are_refused(damage, message, spectra, plots, tmp_path):
    folder = tmp_path / "copied"
    folder.mkdir()
    for file in plots.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    damage(folder)
    refused(spectra, folder, message)


def recolour(file: Path) -> None:
    pixels = np.array(Image.open(file))
    pixels[..., 0] ^= 64
    Image.fromarray(pixels).save(file)


def refused(record: Record, path: Path, message: str, split: str = "official") -> None:
    with pytest.raises(InputError, match=message) as error:
        score_predictions(record, path, path.parent / "run", "theirs", split)
    assert "\n" not in str(error.value)
    assert not (path.parent / "run").exists()


def test_unusable_results_are_refused(strengths: Record, spectra: Record, tmp_path: Path) -> None:
    text, channel, matrix = tmp_path / "result.txt", channels(), tmp_path / "result.mat"
    write_strengths(text, strengths, offset_db=0.1)
    refused(strengths, text, "differs by 0.1 dB from")
    refused(spectra, text, "hold rssi, made-here spectrum")
    refused(replace(strengths, official=None), text, "has no test_index.txt", split="random")
    text.write_text(text.read_text() + "-50.0, -51.0\n")
    refused(strengths, text, "12 lines, but flat has 11 strengths in its 6 test rows")
    text.write_text("-50.0; -51.0\n")
    refused(strengths, text, "line 1: '-50.0; -51.0' is not measured, predicted")
    refused(channel, matrix, "no such file")
    write_channels(matrix, channel, pred_csi=np.zeros((2, 3)))
    refused(channel, matrix, r"pred_csi has shape \[2, 3\]")
    write_channels(matrix, channel, gt_csi=channel.observation[0, :10])
    refused(channel, matrix, "of the largest coefficient from")
    matrix.write_bytes(matrix.read_bytes()[:200])
    refused(channel, matrix, "run the test script again")
    refused(spectra, tmp_path, "no pictures 0.png")
