"""Positions that tell of losses at surfaces: greedy variances against dense normal equations in double precision."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.constants import epsilon_0

from wrf_mi.apps.maps.plan_losses import SURFACE_DB, Told, greedy_losses, loss_std_db, losses_of
from wrf_mi.estimators.error_prior import ErrorPrior
from wrf_mi.estimators.interpolation.kriging_equations import correlation

EXACT = 1e-6  # relative, of variances: the process has a jitter of 1e-9 of its own
STD_DB = np.array([2.0, 3.0, 1.0])


def dense_variance(priors: list[ErrorPrior], rows_m: list[np.ndarray], slopes: list[np.ndarray]) -> np.ndarray:
    """Covariance [s, s] of the losses by the normal equations of all rows of all receivers at once."""
    information = np.diag(1 / STD_DB**2)
    for prior, at, slope in zip(priors, rows_m, slopes, strict=True):
        noise = np.concatenate([prior.noise, np.full(len(at) - len(prior.noise), prior.new_noise)])
        information += slope.T @ np.linalg.solve(prior.covariance(at, at) + np.diag(noise), slope)
    return np.linalg.inv(information)


def test_choices_and_variances_are_those_of_trying_every_position() -> None:
    rng = np.random.default_rng(0)
    at, table = rng.uniform(0, 6, (25, 3)), rng.uniform(0, 1, (2, 25, 3)) * [1, 1, 0]  # nothing tells of the third
    priors, rows = [], [np.arange(4), np.arange(2, 7)]
    for place in rows:
        field = lambda a, b: 9.0 * correlation(a / 2, b / 2)  # noqa: E731
        priors.append(ErrorPrior(field, at[place], np.full(len(place), 4.0), 5.0))
    told = [Told.of(prior, at, slope[place], slope) for prior, slope, place in zip(priors, table, rows, strict=True)]
    allowed, measurable = np.arange(25) > 6, np.array([True, True, False])
    chosen, std_db, variances = greedy_losses(told, STD_DB, measurable, allowed, 3)

    def tried(more: list[int]) -> np.ndarray:
        places = [[*place, *more] for place in rows]
        pairs = list(zip(table, places, strict=True))
        return dense_variance(priors, [at[p] for p in places], [slope[p] for slope, p in pairs])

    for count, best in enumerate(chosen):
        before = tried(chosen[:count]).diagonal()
        target = int(np.argmax(before[:2]))
        options = [tried([*chosen[:count], place])[target, target] for place in np.flatnonzero(allowed)]
        assert best == np.flatnonzero(allowed)[np.argmin(options)]
        np.testing.assert_allclose(std_db[count] ** 2, before, rtol=EXACT)
    np.testing.assert_allclose(std_db[-1] ** 2, tried(chosen).diagonal(), rtol=EXACT)
    assert std_db[-1, 2] == STD_DB[2]
    assert (variances[1] < variances[0] + EXACT).all()


def test_loss_of_a_slab_is_as_uncertain_as_its_constants(tmp_path: Path) -> None:
    thin_lossless = np.array([[4.0, 0.0, 1e-4]])  # transmits all, whatever it is made of
    assert loss_std_db(thin_lossless, np.array([[0.7, 1.4, 0.35]]), 1e9)[0] < 0.1
    # The front face of a wall from whose back nothing returns: r = (n - 1) / (n + 1), n^2 = permittivity - 0.36 j.
    thick = np.array([[4.0, 0.2, 2.0]])
    spread = loss_std_db(thick, np.array([[0.1, 0, 0]]), 10e9)[0]
    ends = [np.sqrt(1 + 3 * np.exp(sign * 0.1) - 0.2j / (2 * np.pi * 10e9 * epsilon_0)) for sign in (1, -1)]
    expected = (20 * np.log10([np.abs((n - 1) / (n + 1)) for n in ends]) * [1, -1]).sum() / 2
    np.testing.assert_allclose(spread, expected, rtol=EXACT)
    known = {"surface": "wall", "absent": False, "sd_log": [0.1, 0, 0]}
    known |= dict(zip(("permittivity", "conductivity", "thickness_m"), ([9, 4.0], [0, 0.2], [1, 2.0]), strict=True))
    (tmp_path / "correction.json").write_text(json.dumps({"materials": [known], "data": {}}))
    losses = losses_of(tmp_path, ["floor", "wall"], 10e9)
    np.testing.assert_allclose(losses.std_db, [SURFACE_DB, spread])
    assert losses.knows_rows
    assert not losses_of(None, ["floor"], 10e9).knows_rows
