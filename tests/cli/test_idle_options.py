"""Options that change nothing beside the others are refused, or named in a warning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, positions_file

from wrf_mi.core import InputError
from wrf_mi.estimators.ray_tracing import TracingSettings
from wrf_mi.runs.api import plan_run, train
from wrf_mi.runs.folder import RunRequest
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.options import without_effect

DIRECT = {"reflection": False, "depth": 0}


@pytest.mark.parametrize(
    ("settings", "idle"),
    [
        ({}, set()),
        (DIRECT, set()),
        ({"reflection": False}, set()),
        ({"reflection": False, "transmission": False, "depth": 5}, {"depth"}),
        ({"reflection": False, "depth": 5}, set()),
        ({"reflection": False, "reflections": 1}, {"reflections"}),
        ({"reflection": False, "diffraction": True, "rays": 1 << 12, "seed": 7}, set()),
        ({"reflection": False, "rays": "auto", "seed": 7}, {"rays", "seed"}),
        (DIRECT | {"scattering": True}, {"scattering"}),
        ({"reflections": 4}, {"reflections"}),
        ({"reflections": 2, "depth": 6}, set()),
        ({"reflections": 0, "rays": 64}, {"rays"}),
        ({"scattering_coefficient": 0.5}, {"scattering_coefficient"}),
        ({"scattering_coefficient": 0.5, "scattering": True}, set()),
        (DIRECT | {"phase_error": 1.0}, {"phase_error"}),
        ({"phase_error": 1.0}, set()),
    ],
)
def test_settings_of_kinds_of_path_that_are_not_traced_have_no_effect(settings: dict[str, Any], idle: set[str]) -> None:
    assert set(without_effect(TraceOptions(**settings))) & set(settings) == idle


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--phase-error", "1"], "phase_error=1.0: no effect on ray-tracing of .*: spectra alone are expectations"),
        (["--calibrate", "gain", "--scheduler", "local:1"], "--scheduler has no effect beside --calibrate"),
        (["--material", "concrete"], "radio materials of its own"),
        (["--target-error", "1", "--depth", "3"], "--depth is chosen by --target-error"),
    ],
)
def test_options_of_trace_without_effect_are_refused(
    arguments: list[str], message: str, flat_folder: Path, room: Path, tmp_path: Path, command: Command
) -> None:
    command.refused(["trace", flat_folder, "--scene", room, *arguments, "--out", tmp_path / "run"], message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"settings": TracingSettings(**DIRECT, rays=64)}, "rays=64: no effect on ray-tracing of .*: no reflection"),
        ({"settings": {**DIRECT, "seed": 1}}, "seed=1: no effect on .*: no reflection"),
        (
            {"settings": ["target_kinds=diffraction"]},
            "target_kinds=diffraction: no effect on .*: target_error_db is not",
        ),
        ({"settings": ["target_error_db=1", "depth=3"]}, "depth=3: no effect on .*: target_error_db chooses it"),
        ({"settings": ["scattering_coefficient=0.3"]}, "scattering_coefficient=0.3: .* no scattering is traced"),
    ],
)
def test_settings_of_ray_tracing_without_effect_are_refused(
    settings: dict[str, Any], reason: str, flat_folder: Path, room: Path
) -> None:
    with pytest.raises(InputError, match=f"setting {reason}.*; omit it"):
        plan_run(flat_folder, RunRequest("ray-tracing", scene=room, **settings))


def test_seed_of_a_trace_without_rays_is_that_of_a_drawn_split(flat_folder: Path, room: Path) -> None:
    plan_run(flat_folder, RunRequest("ray-tracing", scene=room, seed=3, settings={**DIRECT, "seed": 3}, split="random"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--depth 3", "--depth belongs to --model ray-tracing, not to hybrid; omit it"),
        ("--model idw --stages mean", "--stages belongs to --model hybrid, not to idw; omit it"),
        ("--stages mean,surfaces", "--stages mean,surfaces: mean has no effect: it is of a scene; give --scene"),
        ("--stages mean,surfaces --scene {room}", "surfaces has no effect: strengths are kriged about the local mean"),
        ("--set steps=9", "setting steps=9: no effect on hybrid of .*: no stage is trained step by step"),
        ("--model idw --set power=1 --set power=2", "setting power: stated as 1 and as 2; give one of both"),
        ("--model wrf-gs --seed 1 --set seed=2", "setting seed: 2, where the argument is 1; give one of both"),
        ("--stages residual --scene {room}", "not used by --stages residual; omit one of them"),
        ("--preset fast --stages residual", "preset fast: the settings state all that it does; omit one of them"),
        ("--model wrf-gs+ --receiver-model pixel", "receiver"),
        ("--material concrete", "--material and antenna options belong to a scene that is traced; give --scene"),
    ],
)
def test_options_of_train_without_effect_are_refused(
    options: str, message: str, flat_folder: Path, room: Path, tmp_path: Path, command: Command
) -> None:
    command.refused(["train", flat_folder, *options.format(room=room).split(), "--out", tmp_path / "run"], message)
    assert not (tmp_path / "run").exists()


def test_other_commands_refuse_or_name_options_without_effect(
    flat_folder: Path, room: Path, tmp_path: Path, command: Command, caplog: Any
) -> None:
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
    command.refused(["check", scan, "--dataset", flat_folder], "a scan; devices and carriers are checked in the scene")
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
