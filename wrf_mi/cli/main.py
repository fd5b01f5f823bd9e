"""The command ``wrf-mi``. Exit status 0 on success, 1 on failure, 2 with one line on bad input, 130 when stopped,
141 when the reader of its output has gone.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, get_args

from .. import __version__
from ..backend import init
from ..core import BackendError, InputError
from ..core.antenna import FRAMES, OMNIDIRECTIONAL, PATTERNS, POLARIZATIONS
from ..core.files import os_failure
from ..core.registry import resolve
from ..graph.settings import EvaluationName
from ..models import MODELS
from .train import print_json, progress_bar, show_metrics, sweep_command, trace_command, train_command

Arguments = argparse.Namespace


def _doctor(a: Arguments) -> int:
    from . import doctor

    if a.install_llvm:
        doctor.install_llvm()
    found = doctor.report()
    if a.json:
        print_json(found)
    else:
        print(doctor.render(found))
    return 0 if found["ok"] else 1


def _data_list(a: Arguments) -> int:
    from ..datasets import datasets

    rows = [
        {
            "name": s.dataset.name,
            "task": s.dataset.task,
            "licence": s.dataset.licence,
            "origin": s.dataset.origin,
            "location": str(s.location) if s.location else None,
        }
        for s in datasets()
    ]
    if a.json:
        print_json(rows)
        return 0
    for row in rows:
        print(f"{row['name']:<19}{row['task']:<9}{row['licence']:<10}{row['location'] or 'not here yet'}")
        print(f"{'':<19}{row['origin']}")
    return 0


def _data_fetch(a: Arguments) -> int:
    from ..datasets import fetch
    from ..datasets.registry import known
    from ..synthetic import load_record

    dataset = known(a.name)
    made_here = dataset.base_url is None
    where = load_record(a.name, progress=True).source if made_here else fetch(a.name)
    print(f"{a.name}: {where}")
    if made_here and dataset.note:
        print(f"{a.name}: {dataset.note}", file=sys.stderr)
    return 0


def _data_info(a: Arguments) -> int:
    from ..runs.data_info import data_info, render
    from ..synthetic import load_record

    found = data_info(load_record(a.dataset, progress=True))
    if a.json:
        print_json(found)
    else:
        print(render(found))
    return 0


def _mesh(a: Arguments) -> int:
    from ..scene.make import make_scene
    from ..scene.register import read_pairs, register_pairs

    pairs = None if a.register_pairs is None else register_pairs(*read_pairs(a.register_pairs), name=a.register_pairs)
    scene = make_scene(
        a.points,
        a.out,
        units=a.units,
        materials=a.materials,
        height_m=a.height,
        floor_m=a.floor,
        resolution_m=a.resolution,
        registration=None if pairs is None else pairs.matrix,
        register_walls_of=a.register_walls,
        positions=a.positions,
        row_0=a.row_0,
        replace=a.replace,
    )
    kinds = list(scene.materials.surfaces.values())
    counts = {kind: kinds.count(kind) for kind in ("floor", "ceiling", "wall", "other")}
    if a.json:
        print_json({"scene": str(scene.folder), "xml": str(scene.xml), "surfaces": counts, "counts": scene.counts})
    else:
        print(", ".join(f"{count} {kind}" for kind, count in counts.items()) + f": {scene.folder}")
        print(f"materials: {scene.folder / 'materials.yml'}\npicture: {scene.folder / 'preview.png'}")
    return 0


def _bench(a: Arguments) -> int:
    # Benchmarks are a package of their own, on top of this one. Its import starts the backend.
    if a.backend is not None:
        init(a.backend)
    status: int = resolve("wrf_mi_bench.command:bench_command")(a)
    return status


def _evaluate(a: Arguments) -> int:
    from ..runs.api import evaluate_run

    return show_metrics(evaluate_run(a.run, a.split, not a.no_operator), None if a.split else Path(a.run), a.json)


def _predict(a: Arguments) -> int:
    from ..parallel import open_scheduler
    from ..runs.api import predict_to_file
    from ..runs.tx_file import read_inputs

    inputs = read_inputs(a.tx, a.input)
    with open_scheduler(a.scheduler) as scheduler:
        given = scheduler if a.scheduler else None
        asked = (a.run, inputs.tx_pos_m, a.out, inputs.tx_heading_rad)
        shapes = predict_to_file(*asked, given, not a.no_operator, inputs.uplink, inputs.carriers_hz)
    if a.json:
        print_json({"out": str(a.out), "arrays": {key: list(shape) for key, shape in shapes.items()}})
    else:
        print(f"{shapes['tx_pos'][0]} predictions: {a.out}")
    return 0


def _compress(a: Arguments) -> int:
    from ..runs.compressed import compress_run, render
    from ..training.compress import Compression

    how = Compression(a.budget, a.width, a.layers, a.terms, a.distil, a.fine_tune, a.precision)
    with progress_bar() as watch:
        found = compress_run(a.run, a.out, how, on_progress=watch.on_progress)
    if a.json:
        print_json(found)
    else:
        print(render(found), f"results: {a.out}", sep="\n")
    return 0


def _compare(a: Arguments) -> int:
    from ..runs.compare import compare

    index = compare(a.runs, a.out)
    print(f"comparison: {index}")
    return 0


def _demo(a: Arguments) -> int:
    from .demo import demo

    with progress_bar() as watch:
        run, index = demo(Path(a.out) if a.out else None, watch.on_progress, watch.stop)
    show_metrics(run.metrics, run.folder, a.json)
    print(f"pictures: {index}", file=sys.stderr if a.json else sys.stdout)
    return 0


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="wrf-mi", description="Learned wireless radiation fields and ray tracing.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Any, text: str, json_output: bool = True, where: Any = commands) -> Any:
        sub = where.add_parser(name, help=text, description=text)
        sub.set_defaults(call=run)
        if json_output:
            sub.add_argument("--json", action="store_true", help="print figures as JSON")
        return sub

    sub = command("doctor", _doctor, "which backend, LLVM, GPU and data were found, and the remedy for what is missing")
    sub.add_argument("--install-llvm", action="store_true", help="install LLVM with the system's package manager first")

    data = commands.add_parser("data", help="data sets: list, fetch, info").add_subparsers(
        required=True, metavar="COMMAND"
    )
    command("list", _data_list, "known data sets and where they lie", where=data)
    sub = command("fetch", _data_fetch, "download a data set, checked by SHA-256", json_output=False, where=data)
    sub.add_argument("name", metavar="NAME")
    sub = command("info", _data_info, "read and check a data set, and say what it holds", where=data)
    sub.add_argument("dataset", metavar="DATASET", help="name of a data set or a folder")

    sub = command("mesh", _mesh, "make a scene for both tracers from a LiDAR scan, a plan or a mesh")
    sub.add_argument(
        "points", metavar="POINTS", help="scan (PLY, LAS, LAZ, XYZ, NPZ), plan (NPZ, PNG, ROS map YAML, CSV) or mesh"
    )
    sub.add_argument("--out", required=True, metavar="DIR", help="scene folder to make")
    sub.add_argument("--units", default="m", help="of the coordinates: m (default), cm, mm or ft")
    sub.add_argument("--height", type=float, metavar="M", help="from floor to ceiling; a plan needs it")
    sub.add_argument("--floor", type=float, default=0.0, metavar="M", help="z of a plan's floor (default: 0)")
    sub.add_argument("--resolution", type=float, metavar="M", help="side of a plan's cell where the file has none")
    text = "side of a plan where the first row of an NPZ grid lies, where the file does not state row_0"
    sub.add_argument("--row-0", choices=("top", "bottom"), help=text)
    sub.add_argument("--materials", metavar="FILE", help="materials.yml with rules and exceptions")
    sub.add_argument("--register-pairs", metavar="CSV", help="move by pairs of points: x,y[,z],to_x,to_y[,to_z]")
    sub.add_argument("--register-walls", metavar="CSV", help="move so that walls lie on those of a layout: x,y")
    text = "measured positions x,y[,z] in the scene's frame: refuse a plan that they fit better when it is mirrored"
    sub.add_argument("--positions", metavar="CSV", help=text)
    sub.add_argument("--replace", action="store_true", help="take the place of an existing scene folder")

    text = "fit a model to measurements and score it"
    sub = command("train", train_command, text)
    _add_training(sub)
    sub.add_argument("--out", metavar="RUN", help="run folder to make")
    sub.add_argument("--help-settings", action="store_true", help="list all settings with their defaults, and exit")
    sub.add_argument("--resume", metavar="RUN", help="go on with a run that was stopped")

    sub = command("trace", trace_command, "predict by ray tracing and score it like a learned field")
    sub.add_argument("scene", metavar="SCENE", help="name of a scene, scene folder, Mitsuba XML, or mesh file")
    sub.add_argument("dataset", metavar="DATASET", help="name of a data set or a folder")
    sub.add_argument("--out", metavar="RUN", required=True, help="run folder to make")
    _add_tracing(sub)
    target = "choose depth, rays, diffraction and scattering until power, and spectra, are converged to so many dB"
    sub.add_argument("--target-error", type=float, metavar="DB", help=target)
    sub.add_argument("--split", help="as for train; official by default")
    sub.add_argument("--n-train", type=_number, metavar="N", help="number or fraction of the training rows to use")
    sub.add_argument("--seed", type=int, metavar="N", help="of split and rays; default: 0")
    _add_scheduler(sub)

    run_sweep = partial(sweep_command, parse=parser.parse_args)
    sub = command("sweep", run_sweep, "train with every combination of settings, and put the scores in a table")
    _add_training(sub)
    vary = "setting or option of train and its values; repeatable, all combinations are run; e.g. seed=0,1,2"
    sub.add_argument("--vary", action="append", default=[], metavar="KEY=A,B,...", help=vary)
    sub.add_argument("--out", metavar="DIR", required=True, help="folder of all runs and their table")
    _add_scheduler(sub)

    sub = command("evaluate", _evaluate, "score a run on its held-out rows")
    sub.add_argument("run", metavar="RUN")
    sub.add_argument("--split", help="score on another split's test rows that the run has not seen; writes nothing")
    _add_operator(sub)

    sub = command("predict", _predict, "what a run predicts at new transmitter positions")
    sub.add_argument("run", metavar="RUN")
    given = sub.add_mutually_exclusive_group(required=True)
    text = "array tx_pos [m, 3] in metres (and heading_rad [m], frequency_hz [m]), or uplink [m, antennas, subcarriers]"
    given.add_argument(
        "--tx", metavar="FILE.csv", help="positions x, y, z in metres (and heading_rad, frequency_hz), with a header"
    )
    given.add_argument("--input", metavar="FILE.npz", help=text)
    text = "file to write: FILE.npz, or FILE.csv (signal strengths; columns x, y, z in metres, NAME_dbm, NAME_std_db)"
    sub.add_argument("--out", required=True, metavar="FILE", help=text)
    _add_operator(sub)
    _add_scheduler(sub)

    sub = command("compress", _compress, "a smaller and faster run of a run, with what that costs")
    sub.add_argument("run", metavar="RUN")
    sub.add_argument("--out", required=True, metavar="RUN2", help="run folder to make")
    sub.add_argument("--budget", type=int, default=0, metavar="N", help="Gaussians to keep (default: all)")
    sub.add_argument("--width", type=int, default=0, metavar="N", help="neurons a layer of a smaller network")
    sub.add_argument("--layers", type=int, default=0, metavar="N", help="hidden layers of a smaller network")
    sub.add_argument("--terms", type=int, default=0, metavar="K", help="make it a factorised field of K terms")
    sub.add_argument(
        "--distil", type=int, default=6000, metavar="STEPS", help="a smaller network learns the old one's (6000)"
    )
    sub.add_argument("--fine-tune", type=int, default=0, metavar="STEPS", help="then on the training rows (0)")
    sub.add_argument("--precision", default="half", help="of stored numbers: single, half (default) or 8bit")

    sub = command("compare", _compare, "table, distribution of scores and pictures of several runs", json_output=False)
    sub.add_argument("runs", nargs="+", metavar="RUN")
    sub.add_argument("--out", required=True, metavar="DIR")

    sub = command("bench", _bench, "measure the README's figures; goes on where it was stopped")
    sub.add_argument("names", nargs="*", metavar="NAME", help="cases to measure (default: all), or tables")
    sub.add_argument("--out", default="benchmarks/results", metavar="DIR", help="where results are written")
    sub.add_argument("--runs", default="runs/bench", metavar="DIR", help="where run folders are kept")
    text = "with --quick: compute with this one (default: CUDA where it works, else LLVM)"
    sub.add_argument("--backend", choices=("llvm", "cuda"), help=text)
    _add_scheduler(sub)
    text = "a minute: ratios of interleaved pairs, fails if one is clearly above twice the stored one; with the NAME"
    text += " stress few cases of it, fails if a bound is not held; with tables a small version in ten minutes"
    sub.add_argument("--quick", action="store_true", help=text)
    sub.add_argument("--store", action="store_true", help="with --quick: store the ratios instead")
    text = "with tables: begin no row after so many hours; the next call goes on (default: measure all)"
    sub.add_argument("--hours", type=float, metavar="H", help=text)

    sub = command("demo", _demo, "the main job on real spectra, or on a traced room where there are none")
    sub.add_argument("--out", metavar="RUN", help="run folder (default: a new one in runs/)")
    return parser


def _add_training(sub: Any) -> None:
    """What is fitted, to what."""
    sub.add_argument(
        "dataset", nargs="?", metavar="DATASET", help="name of a data set (`wrf-mi data list`) or a folder"
    )
    sub.add_argument("--model", choices=list(MODELS), help="default: wrf-gs+; baselines from idw on: docs/baselines.md")
    text = "trace SCENE too: together with wrf-gs, wrf-gs+ or factorised, for physics, or alone for ray-tracing"
    sub.add_argument("--scene", metavar="SCENE", help=text)
    text = "of spectra: pixel (magnitude at each direction) or array (element signals; default with a scene)"
    sub.add_argument("--receiver", metavar="NAME", help=text)
    text = "of Gaussians: splatted (default), or traced by the Mitsuba plugins, with a scene through its walls (slower)"
    sub.add_argument("--evaluation", choices=get_args(EvaluationName), help=text)
    _add_tracing(sub)
    sub.add_argument(
        "--split", help="official (default), random, blocked (every fold in turn), blocked:K, or trajectory"
    )
    sub.add_argument("--n-train", type=_number, metavar="N", help="number or fraction of the training rows to use")
    sub.add_argument("--seed", type=int, metavar="N", help="default: 0")
    sub.add_argument("--deterministic", action="store_true", help="bit-identical results, on one thread of the CPU")
    sub.add_argument("--preset", choices=("default", "paper", "quick"), help="a named set of settings")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting; repeatable")


def _add_tracing(sub: Any) -> None:
    """Options of what is traced."""
    sub.add_argument("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete")
    kinds = "line-of-sight,reflection,transmission,diffraction,scattering"
    sub.add_argument("--paths", metavar="LIST", help=f"kinds of path, from {kinds} (default: the first two)")
    sub.add_argument("--depth", type=int, metavar="N", help="interactions per path at most (default: 3)")
    sub.add_argument("--reflections", type=int, metavar="N", help="of these reflections at most (default: all)")
    fit = "train on the training rows, separated by commas: gain, materials, planes, patterns, pose"
    sub.add_argument("--calibrate", metavar="LIST", help=fit)
    sub.add_argument("--rays", metavar="N", help="that search from each source, or auto: until no more paths are found")
    stated = "in place of what the data state, which is by default"
    of_receivers = f"pattern of the receivers' antennas {stated} iso"
    sub.add_argument("--rx-pattern", choices=PATTERNS, help=of_receivers)
    text = f"polarisation of the receivers' antennas {stated} V: vertical in --rx-frame"
    sub.add_argument("--rx-polarization", choices=POLARIZATIONS, help=text)
    text = f"frame in which that is stated, the world's or the array's {stated} the world's"
    sub.add_argument("--rx-frame", choices=FRAMES, help=text)
    sub.add_argument("--tx-pattern", choices=OMNIDIRECTIONAL, help="pattern of the transmitter's antenna")
    sub.add_argument("--tx-polarization", choices=POLARIZATIONS, help="polarisation of the transmitter's antenna")


def _add_scheduler(sub: Any) -> None:
    """Where parts are computed."""
    text = "compute on several workers: local, local:N (on this machine) or a Dask scheduler's tcp://HOST:PORT"
    sub.add_argument("--scheduler", metavar="WHERE", help=text)


def _add_operator(sub: Any) -> None:
    """How a learned field is evaluated."""
    text = "splat each spectrum, where the field's geometry would allow one linear map for all (see docs/speed.md)"
    sub.add_argument("--no-operator", action="store_true", help=text)


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        The exit status.
    """
    a = _parser().parse_args(arguments)
    try:
        done: int = a.call(a)
        sys.stdout.flush()
        return done
    except InputError as error:
        print(f"wrf-mi: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # Whoever read the output has gone, as head does; Python flushes again on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        print(f"wrf-mi: {os_failure(error)}", file=sys.stderr)
        return 2
    except BackendError as error:
        print(f"wrf-mi: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("wrf-mi: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        # Errors of ours that say all there is to say; anything else keeps its traceback.
        status = getattr(error, "exit_status", None)
        if status is None:
            raise
        print(f"wrf-mi: {error}", file=sys.stderr)
        return status


if __name__ == "__main__":
    sys.exit(main())
