"""Stated settings hold, whatever a fit chooses for others, or are refused."""

import dataclasses
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_channels import channels
from made_waves import wave_record, without_array

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core import settings as core_settings
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.settings import setting_texts
from wrf_mi.estimators.interpolation.strength_terms import PARTS_OF_NOISE as NOISE
from wrf_mi.estimators.interpolation.strength_terms import Hyperparameters
from wrf_mi.estimators.model import inputs_of
from wrf_mi.models import MODELS, Session
from wrf_mi.runs.api import open_run, plan_run, train
from wrf_mi.runs.folder import RunRequest
from wrf_mi.stages.hybrid import parts_of

OF_THE_RUN = {"checkpoint_every", "log_every", "model", "seed", "deterministic", "rounds", "simulation.noise_db"}
"""Settings of files that a fit writes meanwhile, and of what has no other value in these cases."""


def strengths(extent_m: float = 6.0, receivers: int = 2, rows: int = 60, turning: bool = False) -> Record:
    """A law of exponent 2.5 with shadowing and noise over a square; the last rows are the official test."""
    rng = np.random.default_rng(0)
    tx_pos_m = np.column_stack([rng.uniform(0, extent_m, (rows, 2)), np.full(rows, 1.3)])
    places_m = np.column_stack([rng.uniform(0, extent_m, (receivers, 2)), np.full(receivers, 2.5)])
    apart_m = np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2)
    lower = np.linalg.cholesky(np.exp(-apart_m / (extent_m / 6)) + 1e-9 * np.eye(rows))
    distance_m = np.linalg.norm(places_m[:, None] - tx_pos_m, axis=2)
    shadow_db = 4 * (lower @ rng.normal(size=(rows, receivers))).T
    heading = rng.uniform(-3, 3, rows)
    body_db = 3 * np.cos(heading) if turning else 0.0
    dbm = -50 - 25 * np.log10(distance_m) + shadow_db + body_db + rng.normal(0, 1.5, (receivers, rows))
    named = tuple(Receiver(f"r{k}", place_m, np.array(UPRIGHT)) for k, place_m in enumerate(places_m))
    official = np.arange(rows - 8), np.arange(rows - 8, rows)
    record = Record("made", "rssi", tx_pos_m, named, dbm.astype(np.float32), official=official)
    return replace(record, frequencies_hz=np.array([2.4e9]), tx_heading_rad=heading if turning else None)


def two_way() -> Record:
    """Channels of three antennas that vary with the position over metres, and their uplink."""
    record = channels()
    smooth = np.exp(3j * record.tx_pos_m[:, :1, None]) * (1 + np.arange(12).reshape(3, 4) / 12)
    uplink = (smooth + 0.1 * record.uplink).astype(np.complex64)
    return replace(record, observation=(uplink * np.exp(0.1j)).astype(np.complex64)[None], uplink=uplink)


def downlink() -> Record:
    """Channels of an antenna, without an uplink."""
    record = two_way()
    return replace(record, observation=record.observation[:, :, 0], uplink=None, uplink_hz=None)


RECORDS: dict[str, Callable[[], Record]] = {
    "strengths, turning": lambda: strengths(turning=True),
    "strengths": strengths,
    "strengths of one receiver, carrier unknown": lambda: replace(strengths(receivers=1), frequencies_hz=None),
    "spectra": lambda: wave_record(24, 6),
    "spectra of an unknown array": lambda: without_array(wave_record(24, 6, receivers=1)),
    "channels": downlink,
    "channels with an uplink": two_way,
}
TRAINED = ("strengths", "spectra of an unknown array", "channels", "channels with an uplink")
"""Records of models that train step by step, which take seconds each."""
SAME = {("wrf-gs", "strengths"), ("wrf-gs", "channels with an uplink")}
SAME |= {("factorised", "spectra of an unknown array"), ("factorised", "channels with an uplink")}
"""Models and records whose settings are those of this model's other records and of WRF-GS+ on this record."""
LOOP = ("steps=4", "batch=4", "validate_every=2", "patience=2")
ROUNDS = ("density.every=1", "density.start=0", "density.stop=1")
SMALL = ("initial.gaussians=4", "network.width=8", "network.layers=2", "view.height=3", "view.columns=6")
GAUSSIANS = (*LOOP, *ROUNDS, *SMALL)
QUICK: dict[str, tuple[str, ...]] = {
    "wrf-gs": GAUSSIANS,
    "wrf-gs+": GAUSSIANS,
    "factorised": (*GAUSSIANS, "network.terms=2"),
    "vae": (*LOOP, "width=8", "last=8", "latent=2"),
    "dcgan": (*LOOP, "hidden=8", "channels=8"),
    "nerf2": (*LOOP, "rays=8", "sphere_rays=8", "networks.width=8", "networks.layers=2", "networks.skip=1"),
    "fire": (*LOOP, "width=8", "latent=4"),
    "optml": (*LOOP, "width=4", "simulation.channels=20", "max_paths=2", "between=1", "final=1", "rounds=1"),
    "r2f2": ("max_paths=4", "final=2"),
    "kriging": (),
    "trees": ("trees=4",),
}
"""Settings of quick fits."""
CHEAP = ("idw", "kriging", "trees", "mri", "linear")
"""Models that are fitted anew with every setting changed."""
OTHER = {"kernel": ["matern32"], "trend": ["constant", "log-distance"], "trend_fit": ["ols", "gls"], "noise": ["0.3"]}
OTHER |= {"transmit_dbm": ["20"], "penalty": ["0.3"], "softening_m": ["0.5"], "length_m": ["0.8"], "lever_m": ["0.5"]}
OTHER |= {
    "heading_length": ["0.4"],
    "cone_deg": ["40"],
    "shadowing": ["searched", "likelihood", "trees", "none"],
    "likelihood_rows": ["8", "4"],
}
OTHER |= {"neighbours": ["2"]}
"""Other values than the default, of settings that are words or null."""
OPPOSITE = {"true": "false", "false": "true"}
QUICK_SPECTRA = ("directions=20", "lengths=2")


def request(model: str, texts: list[str]) -> RunRequest:
    return RunRequest(model, settings=texts, split="official")


def quick_settings(model: str, record: Record) -> dict[str, str]:
    """Quick settings by name, but for those that have no effect on the data."""
    texts = (*QUICK.get(model, ()), *(QUICK_SPECTRA if (model, record.task.name) == ("kriging", "spectrum") else ()))
    settings = dict(text.split("=") for text in texts)
    while refused := refused_setting(model, record, settings):
        del settings[refused]
    return settings


def accepted_settings(model: str, record: Record, base: dict[str, str]) -> dict[str, dict[str, str]]:
    """Settings that may be stated, each at its base value beside those of the base that then have an effect."""
    problem, _, _ = plan_run(record, request(model, texts_of(base)))
    accepted = {}
    for text in setting_texts(dataclasses.asdict(problem.settings)):
        name, _, value = text.partition("=")
        beside = dict(base)
        while (refused := refused_setting(model, record, beside | {name: value})) not in (None, name):
            del beside[refused]
        if refused is None:
            accepted[name] = beside | {name: value}
    return accepted


def refused_setting(model: str, record: Record, settings: dict[str, str]) -> str | None:
    """Name of the setting that is refused as one without effect; None: all are accepted."""
    try:
        plan_run(record, request(model, texts_of(settings)))
    except InputError as error:
        if refused := re.match(rf"setting ([\w.]+)=.*: no effect on {re.escape(model)} of .*; omit it$", str(error)):
            return refused[1]
        raise
    return None


def texts_of(settings: dict[str, str]) -> list[str]:
    return [f"{name}={value}" for name, value in settings.items()]


def fit(model: str, record: Record, settings: dict[str, str], folder: Any) -> tuple[Any, Split]:
    problem, config, splits = plan_run(record, request(model, texts_of(settings)))
    session = Session(folder, folder)
    problem.settings = config.entry.prepare(problem, splits, session)
    return config.entry.fit(problem, splits[0], session), splits[0]


def outcome(model: str, record: Record, settings: dict[str, str], folder: Any) -> tuple[str, np.ndarray]:
    fitted, split = fit(model, record, settings, folder)
    predictions = [fitted.predict(inputs_of(record, split.test), k) for k in range(len(record.receivers))]
    values = [np.stack([p.mean, p.mean if p.std is None else p.std]) for p in predictions]
    return json.dumps(fitted.facts(), default=str), np.stack(values)


@pytest.fixture
def read_settings(monkeypatch: pytest.MonkeyPatch) -> set[tuple[type, str]]:
    """Settings by class and name that code reads, but for copies and checks of all settings of a class."""
    read: set[tuple[type, str]] = set()
    copies = (dataclasses.__file__, core_settings.__file__)

    def reading(self: Any, name: str) -> Any:
        if sys._getframe(1).f_code.co_filename not in copies:
            read.add((type(self), name))
        return object.__getattribute__(self, name)

    kinds = {kind for model in MODELS.values() for kind in model.settings_by_data().values()}
    while kinds:
        kind: Any = kinds.pop()
        kinds |= {type(f.default_factory()) for f in dataclasses.fields(kind) if callable(f.default_factory)}
        monkeypatch.setattr(kind, "__getattribute__", reading)
    return read


def cases(models: Any, records: Any) -> list[Any]:
    tasks = {name: RECORDS[name]().task.name for name in records}
    return [
        pytest.param(model, name, id=f"{model}-{name}")
        for model in models
        for name in records
        if MODELS[model].serves(tasks[name]) and MODELS[model].scene != "required"
        if (model, name) not in SAME
        if MODELS[model].uplink != "required" or name == "channels with an uplink"
        if MODELS[model].uplink != "none" or name != "channels with an uplink"
    ]


@pytest.mark.parametrize(("model", "name"), cases(sorted({*MODELS} - {*CHEAP, "hybrid"}), TRAINED))
def test_accepted_setting_is_read_by_a_fit(model: str, name: str, tmp_path: Any, read_settings: Any) -> None:
    record = RECORDS[name]()
    base = quick_settings(model, record)
    accepted = accepted_settings(model, record, base)
    problem, _, _ = plan_run(record, request(model, texts_of(base)))
    kinds = {key: type(problem.settings) for key in accepted}
    for key in accepted:
        *parents, _ = key.split(".")
        for parent in parents:
            kinds[key] = type(getattr(problem.settings, parent))
    read_settings.clear()
    fitted, split = fit(model, record, base, tmp_path)
    fitted.predict(inputs_of(record, split.test), 0)
    unread = {key for key, kind in kinds.items() if (kind, key.rpartition(".")[2]) not in read_settings}
    assert not unread - OF_THE_RUN


@pytest.mark.parametrize(("model", "name"), cases(CHEAP, RECORDS))
def test_accepted_setting_changes_the_fit(model: str, name: str, tmp_path: Any) -> None:
    record = RECORDS[name]()
    base = quick_settings(model, record)
    plain, unchanged = outcome(model, record, base, tmp_path), []
    for name_of_setting, beside in accepted_settings(model, record, base).items():
        value = beside[name_of_setting]
        for other in OTHER.get(name_of_setting) or [OPPOSITE.get(value) or str(round(1.5 * float(value)) + 1)]:
            changed = beside | {name_of_setting: other}
            if refused_setting(model, record, changed):  # beside this value another setting has no effect
                break
            facts, values = outcome(model, record, changed, tmp_path)
            if facts != plain[0] or not np.array_equal(values, plain[1]):
                break
        else:
            unchanged.append(name_of_setting)
    assert not {*unchanged} - {"generic"}  # it may be set where the data are kriged so in any case


@pytest.mark.parametrize(
    "stated",
    [{"shadow_m": 2.0}, {"shadow_m": 10.0, "shadow_db": 5.0}, {"noise_db": 2.8}, dict.fromkeys(NOISE, 1.0)],
)
@pytest.mark.parametrize("extent_m", [6.0, 200.0])
def test_stated_hyperparameters_hold_beside_those_that_are_chosen(stated, extent_m, tmp_path):
    record, likely = strengths(extent_m), {"shadowing": "likelihood"}
    run = train(record, "kriging", settings=stated | likely, out=tmp_path / "run", split="official")
    fitted = run.metrics["fitted"]
    assert {name: fitted[name] for name in stated} == stated
    chosen = {"shadow_db", "shadow_m", *NOISE} - stated.keys()
    assert any(fitted[name] != getattr(Hyperparameters(), name) for name in chosen)
    assert open_run(run.folder, record).problem.stated_settings == stated.keys() | likely.keys()


def test_stated_steps_are_those_of_a_field_in_the_hybrid() -> None:
    record = RECORDS["spectra of an unknown array"]()
    problem, _, splits = plan_run(record, request("hybrid", ["stages=field", "steps=3"]))
    assert parts_of(problem, splits[0])["field"][1].settings.steps == 3


def test_stages_of_an_uplink_that_are_not_named_are_not_fitted() -> None:
    record = two_way()
    problem, _, splits = plan_run(record, request("hybrid", ["stages=residual"]))
    assert [*parts_of(problem, splits[0])] == ["kriging"]
    with pytest.raises(InputError, match="--stages field,residual: field has no effect: data with an uplink have"):
        plan_run(record, request("hybrid", ["stages=field,residual"]))


def test_generic_kriging_that_is_ruled_out_refuses_its_settings() -> None:
    with pytest.raises(InputError, match=r"setting length_m=2.0: no effect on kriging of made: generic=false"):
        plan_run(strengths(), request("kriging", ["generic=false", "length_m=2"]))


def test_stated_default_of_generic_kriging_chooses_it() -> None:
    problem, _, _ = plan_run(strengths(), request("kriging", ["kernel=exponential"]))
    assert not MODELS["kriging"].serving("rssi", with_scene=False).pools_receivers(problem)
    with pytest.raises(InputError, match=r"setting shadow_m=2.0: .* kriged alone with kernel; omit it"):
        plan_run(strengths(), request("kriging", ["kernel=exponential", "shadow_m=2"]))


@pytest.mark.parametrize(
    ("model", "name", "settings"),
    [
        ("nerf2", "strengths", "batch=16"),
        ("nerf2", "channels with an uplink", "tx_octaves=4"),
        ("nerf2", "spectra of an unknown array", "sphere_rays=64"),
        ("nerf2", "strengths", "networks.skip=8"),
        ("fire", "channels with an uplink", "batch=256 sample=row"),
        ("fire", "channels with an uplink", "spacing_hz=1e6"),
        ("r2f2", "channels with an uplink", "depth=5"),
        ("wrf-gs", "strengths", "optimiser.opacity=0.02"),
        ("wrf-gs", "strengths", "network.terms=0"),
        ("wrf-gs+", "strengths", "loss.ssim_weight=0.2"),
        ("wrf-gs+", "strengths", "density.start=0.05"),
        ("wrf-gs+", "strengths", "view.components=6"),
        ("wrf-gs+", "spectra of an unknown array", "density.growth_fraction=0.1 steps=50"),
        ("wrf-gs", "spectra of an unknown array", "density.reset_every=2"),
        ("wrf-gs+", "spectra of an unknown array", "optimiser.level=0.02"),
        ("wrf-gs+", "spectra of an unknown array", "traced.depth=3"),
        ("factorised", "strengths", "encoding.position_octaves=4"),
        ("kriging", "strengths", "body_m=1.5"),
        ("trees", "strengths", "heading=true"),
    ],
)
def test_setting_that_a_fit_replaces_or_leaves_is_refused(model: str, name: str, settings: str) -> None:
    assigned = dict(text.split("=") for text in settings.split())
    assert refused_setting(model, RECORDS[name](), assigned) == next(iter(assigned))
