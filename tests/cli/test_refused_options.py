"""Options that are wrong, or that change nothing beside the others: refused in one line, or named in a warning."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import positions_file
from made_channels import channels

from wrf_mi.datasets import write_nerf2_csi
from wrf_mi.runs.api import plan_run, train
from wrf_mi.runs.folder import RunRequest
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.options import without_effect

TRACED = "train --model ray-tracing --scene {room}"
DIRECT = f"{TRACED} --set reflection=false --set depth=0"
REFUSED = [  # data set, command and options, and message
    ("unplaced", "train --model mri", "unplaced: holds csi; mri serves rssi, so choose another model: "),
    ("unplaced", "train --model idw", "positions are not known, from which idw predicts"),
    ("flat", "train --model fire", "flat: holds rssi; fire serves csi"),
    ("flat", "train --model mri --n-train 1", "anchor1: mri: 1 rows at one distance; an exponent shows at two or more"),
    ("flat", "train --model kriging --n-train 1 --set generic=true", "rows received: 1; its trend needs 2, so give"),
    # Values of settings.
    ("flat", "train --model mri --set shared=maybe", "expected bool, got 'maybe'"),
    ("flat", "train --model idw --set neighbours=0", "k = 0: IDW needs at least one"),
    ("flat", "train --model kriging --set trend=cubic", "trend 'cubic'; choose constant"),
    ("spectra", "train --model kriging --set lengths=0", "setting lengths: 0 is out of range, choose 1 or more"),
    ("spectra", "train --model kriging --set lengths=many", "expected int, got 'many'"),
    ("spectra", "train --model kriging --seed -1", "seed -1"),
    ("spectra", "train --model wrf-gs+ --set receiver=horn", "'horn': unknown; choose from pixel, array"),
    ("spectra", "train --model wrf-gs+ --set traced.pattern_degree=9", "setting traced.pattern_degree: 9"),
    ("spectra", "train --model wrf-gs+ --set steps", "--set steps: expected key=value"),
    ("spectra", "train --model wrf-gs+ --set stepz=3", "unknown setting stepz"),
    ("spectra", "train --model wrf-gs+ --set holdout_steps_fraction=2", "fraction: 2.0 is out of range, choose 0 to 1"),
    ("spectra", "train --model wrf-gs+ --set initial.points=none.ply", "none.ply: no such file"),
    (
        "spectra",
        "train --model wrf-gs+ --set model=nerf3",
        r"nerf3, where the model is wrf-gs\+; choose it with --model",
    ),
    ("spectra", "train --model wrf-gs+ --split blocked --set batch=0", "setting batch: 0 is out of range, choose 1 or"),
    ("spectra", "train --model wrf-gs+ --seed -1", "setting seed: -1 is out of range"),
    ("spectra", "train --model wrf-gs+ --split nowhere", "split 'nowhere'"),
    ("spectra", "train --model wrf-gs+ --n-train 0", "n_train 0; choose 1 to 19 rows"),
    ("flat", f"{TRACED} --set beta=1", "unknown setting beta"),
    ("flat", f"{TRACED} --set calibration=gain --set holdout_steps_fraction=2", r"2\.0 is out of range, choose 0 to 1"),
    ("flat", f"{TRACED} --set calibration=everything", "everything: choose of gain, materials, planes, patterns, pose"),
    ("flat", "trace --scene {room} --paths echo", "kind of path 'echo': unknown"),
    ("flat", "trace --scene {room} --rays many", "give a whole number"),
    ("flat", "trace --scene {room} --depth 99", "depth 99"),
    ("flat", "trace --scene {room} --reflections -3", "reflections -3"),
    # Scenes.
    ("flat", "train --model mri --scene x", "mri on .*flat: takes no scene; omit --scene"),
    ("flat", "train --model ray-tracing", "ray-tracing needs a scene; give --scene SCENE, or choose"),
    ("flat", "train --scene x", "x: no such scene file"),
    ("flat", "train --model wrf-gs+ --scene nowhere", "nowhere: no such scene"),
    ("spectra", "trace --scene laboratory", "carrier frequency unknown; state frequency_hz in its gateway_info"),
    ("none", "trace --scene {room}", "no such folder"),
    ("flat", "trace --scene {room} --material concrete", "radio materials of its own"),
    (
        "spectra",
        "train --model kriging --material x",
        "--material and antenna options belong to a scene that is traced",
    ),
    ("spectra", "train --model wrf-gs+ --rx-polarization H", "--material and antenna options belong to a scene"),
    # Options and settings without effect beside the others.
    ("flat", "train --model mri --preset fast", "--preset fast: mri for such data has no presets; use --set"),
    (
        "flat",
        "train --preset fast --stages residual --set search_seconds=9",
        "preset fast: the settings state all that it does; omit one of",
    ),
    (
        "flat",
        "train --set search_seconds=9",
        "search_seconds=9.0: no effect on hybrid of .*: no signal strengths are traced in",
    ),
    ("spectra", "train --model kriging --depth 2", "--depth belongs to --model ray-tracing, not to kriging; omit it"),
    ("flat", "train --model idw --stages mean", "--stages belongs to --model hybrid, not to idw; omit it"),
    ("spectra", "train --model kriging --receiver-model array", "--receiver-model belongs to fields of spectra"),
    ("flat", "train --model wrf-gs+ --receiver-model pixel", "receiver"),
    ("flat", "train --stages mean,surfaces", "mean has no effect: it is of a scene; give --scene"),
    ("flat", "train --stages mean,surfaces --scene {room}", "surfaces has no effect: strengths are kriged about the"),
    ("flat", "train --stages residual --scene {room}", "not used by --stages residual; omit one of them"),
    ("flat", "train --set steps=9", "setting steps=9: no effect on hybrid of .*: no stage is trained step by step"),
    ("flat", "train --model idw --set power=1 --set power=2", "setting power: stated as 1 and as 2; give one of both"),
    (
        "flat",
        "train --model wrf-gs --seed 1 --set seed=2",
        "setting seed: 2, where the argument is 1; give one of both",
    ),
    ("flat", f"{TRACED} --set steps=5", "setting steps=5: of a training, and nothing is calibrated"),
    ("flat", f"{TRACED} --set patience=2", "setting patience=2: of a training, and nothing is calibrated"),
    ("flat", f"{DIRECT} --set rays=64", "setting rays=64: no effect on ray-tracing of .*: no reflection.*; omit it"),
    ("flat", f"{DIRECT} --set seed=1", "setting seed=1: no effect on .*: no reflection.*; omit it"),
    (
        "flat",
        f"{TRACED} --set target_kinds=diffraction",
        "diffraction: no effect on .*: target_error_db is not.*; omit it",
    ),
    ("flat", f"{TRACED} --set target_error_db=1 --set depth=3", "depth=3: no effect on .*: target_error_db chooses it"),
    ("flat", f"{TRACED} --set scattering_coefficient=0.3", "scattering_coefficient=0.3: .* no scattering is traced"),
    (
        "flat",
        "trace --scene {room} --phase-error 1",
        "phase_error=1.0: no effect on .*: spectra alone are expectations",
    ),
    (
        "flat",
        "trace --scene {room} --calibrate gain --scheduler local:1",
        "--scheduler has no effect beside --calibrate",
    ),
    ("flat", "trace --scene {room} --target-error 1 --depth 3", "--depth is chosen by --target-error"),
]


@pytest.fixture(scope="module")
def data_sets(folder: Path, flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Spectra, strengths, channels without positions, and a folder that does not exist."""
    data_folder = tmp_path_factory.mktemp("data")
    unplaced = write_nerf2_csi(data_folder / "unplaced", channels(positions=False))
    return {"spectra": folder, "flat": flat_folder, "unplaced": unplaced, "none": data_folder / "none"}


@pytest.mark.parametrize(("data", "words", "message"), REFUSED)
def test_options_that_are_wrong_or_without_effect_are_refused(data, words, message, data_sets, room, tmp_path, command):
    verb, *options = words.format(room=room).split()
    command.refused([verb, data_sets[data], *options, "--out", tmp_path / "out"], message)
    assert not (tmp_path / "out").exists()


SIGHT_ALONE = {"reflection": False, "depth": 0}


@pytest.mark.parametrize(
    ("settings", "idle"),
    [
        ({}, set()),
        (SIGHT_ALONE, set()),
        ({"reflection": False}, set()),
        ({"reflection": False, "transmission": False, "depth": 5}, {"depth"}),
        ({"reflection": False, "depth": 5}, set()),
        ({"reflection": False, "reflections": 1}, {"reflections"}),
        ({"reflection": False, "diffraction": True, "rays": 1 << 12, "seed": 7}, set()),
        ({"reflection": False, "rays": "auto", "seed": 7}, {"rays", "seed"}),
        (SIGHT_ALONE | {"scattering": True}, {"scattering"}),
        ({"reflections": 4}, {"reflections"}),
        ({"reflections": 2, "depth": 6}, set()),
        ({"reflections": 0, "rays": 64}, {"rays"}),
        ({"scattering_coefficient": 0.5}, {"scattering_coefficient"}),
        ({"scattering_coefficient": 0.5, "scattering": True}, set()),
        (SIGHT_ALONE | {"phase_error": 1.0}, {"phase_error"}),
        ({"phase_error": 1.0}, set()),
    ],
)
def test_settings_of_kinds_of_path_that_are_not_traced_have_no_effect(settings: dict[str, Any], idle: set[str]) -> None:
    assert set(without_effect(TraceOptions(**settings))) & set(settings) == idle


def test_seed_of_a_trace_without_rays_is_that_of_a_drawn_split(flat_folder: Path, room: Path) -> None:
    settings = {**SIGHT_ALONE, "seed": 3}
    plan_run(flat_folder, RunRequest("ray-tracing", scene=room, seed=3, settings=settings, split="random"))


def test_other_commands_refuse_or_name_options_without_effect(flat_folder, room, tmp_path, command, caplog):
    run = train(flat_folder, "kriging", out=tmp_path / "run", settings=("generic=true",)).folder
    positions = positions_file(tmp_path / "positions.csv", [[1, 1, 1]])
    predict = ["predict", run, "--tx", positions, "--out", tmp_path / "new.csv"]
    command.refused([*predict, "--no-operator"], "--no-operator belongs to learned fields of spectra, not to kriging")
    command.refused(["evaluate", run, "--no-operator"], "--no-operator belongs to learned fields")
    correct = ["correct", flat_folder, "--scene", room, "--out", tmp_path / "corrected", "--shift-sd", "0.1"]
    command.refused(correct, "shift_sd_m=0.1: of planes and frame, which materials,gain leaves")
    command.refused(["edit", room, "--replace"], "--out")
    view = ["view", run, "--out", tmp_path / "view.html"]
    command.refused([*view, "--material", "concrete"], "material concrete: of a bare mesh, and no source is one")
    command.refused([*view, "--max-paths", 9], "--max-paths is of a layer that these sources lack; omit it")
    glb = ["export", room, "--format", "glb", "--out", tmp_path / "room.glb", "--replace"]
    command.refused(glb, "--replace belongs to formats that are folders, not to glb; omit it")
    scan = tmp_path / "scan.xyz"
    np.savetxt(scan, np.random.default_rng(0).uniform(0, 5, (100, 3)))
    command.refused(
        ["check", scan, "--dataset", flat_folder], "a scan or plan; devices and carriers are checked in the scene"
    )
    paths = ["export", room, "--format", "paths", "--tx", "1,1,1", "--rx", "2,1,1", "--frequency", "1e9"]
    paths += ["--out", tmp_path / "paths.csv"]
    for more, option in (("", "--depth"), (",scattering", "--paths scattering")):
        caplog.clear()
        depth = ["--depth", 0 if more else 2]
        command.done([*paths, "--paths", f"line-of-sight{more}", *depth])
        assert f"{option} has no effect: " in caplog.text
    status, _, err = command(["map", run, "--step", "2", "--threshold", "-60", "--json", "--out", tmp_path / "m.nc"])
    assert status == 0
    assert "no coverage: the model states no standard deviation" in err
    assert not (tmp_path / "corrected").exists()
