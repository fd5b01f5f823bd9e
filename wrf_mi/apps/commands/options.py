"""Parser of the command line, and the options that several commands share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable
from dataclasses import fields
from typing import Any, NoReturn, get_args

from ...core import AntennaOptions, InputError
from ...core.antenna import FRAMES, OMNIDIRECTIONAL, PATTERNS, POLARIZATIONS
from ...graph.settings import EvaluationName
from ...models import MODELS, no_model

Arguments = argparse.Namespace

DATASET = "name of a data set (`wrf-mi data list`) or a folder"
SCENE = "name of a scene, scene folder, Mitsuba XML, or mesh file"


class Parser(argparse.ArgumentParser):
    """Parser that reports an error in one line, and takes ``-1,2,3`` for a value instead of an option."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._negative_number_matcher = re.compile(r"^-\.?\d[\d.,eE+-]*$")

    def parse_known_args(self, *arguments: Any, **options: Any) -> tuple[Any, list[str]]:
        """Parse arguments; the command that an unknown one follows refuses it, and names its own help."""
        namespace, unknown = super().parse_known_args(*arguments, **options)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return namespace, unknown

    def error(self, message: str) -> NoReturn:
        """End the process with status 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def add_command(
    commands: Any, name: str, call: Callable[[Arguments], int], text: str, json_output: bool = True
) -> argparse.ArgumentParser:
    """Add a command; ``call`` takes its parsed arguments and returns the exit status."""
    parser: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(call=call)
    if json_output:
        parser.add_argument("--json", action="store_true", help="print figures as JSON")
    return parser


def add_training(parser: argparse.ArgumentParser) -> None:
    """Add data set, model, split and settings."""
    add = parser.add_argument
    add("dataset", nargs="?", metavar="DATASET", help=DATASET)
    text = "model to fit (default: hybrid); baselines: docs/models.md"
    add("--model", type=_model_name, choices=list(MODELS), help=text)
    text = "stages of the hybrid that may be used, from mean,calibration,correction,surfaces,field,residual"
    add("--stages", metavar="LIST", help=f"{text} (default: all that the data allow)")
    text = "scene to trace: for hybrid, beside wrf-gs, wrf-gs+, factorised and r2f2, or alone for ray-tracing"
    add("--scene", metavar="SCENE", help=text)
    text = "receiver of spectra: pixel (magnitude at each direction) or array (element signals; default with a scene)"
    add("--receiver-model", metavar="NAME", help=text)
    text = "of Gaussians: splatted (default) or traced by the Mitsuba plugins, through the walls of a scene (slower)"
    add("--evaluation", choices=get_args(EvaluationName), help=f"evaluation {text}")
    add_tracing(parser)
    add_rows(parser)
    add_run(parser)
    text = "settings for less time or a lower error, or the paper's of WRF-GS+ (default: default)"
    add("--preset", choices=("fast", "default", "best", "paper"), help=text)


def add_rows(parser: argparse.ArgumentParser) -> None:
    """Add options of the rows that are used, and of the fit to them, which all models and ``correct`` take."""
    add = parser.add_argument
    folded = "blocked, frequency, frequency-known, receiver, other-run"
    text = f"official, random, trajectory, or with folds in turn {folded}; one fold: blocked:K, frequency:K"
    default = "none: folds in space for the scores, then all rows for the model (default: official, or else none)"
    add("--split", help=f"{text}; {default}")
    add_n_train(parser)
    add("--seed", type=int, metavar="N", help="seed of split and fit (default: 0)")
    add("--deterministic", action="store_true", help="bit-identical results, on one thread of the CPU")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="setting to change; repeatable")


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add options of every run: the least number of rows, and intervals."""
    add = parser.add_argument
    text = "leave out receivers with fewer training rows (default: 0 of signal strengths, predicted from the others; 2)"
    add("--min-rows", type=int, metavar="N", help=text)
    text = "calibrate predicted standard deviations on training rows held out in space (one more fit)"
    add("--intervals", action="store_true", help=text)


def _model_name(name: str) -> str:
    if name not in MODELS:
        raise argparse.ArgumentTypeError(str(no_model(name)))
    return name


def add_tracing(parser: argparse.ArgumentParser) -> None:
    """Add options of ray tracing and of antennas."""
    add = parser.add_argument
    add("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete")
    kinds = "line-of-sight,reflection,transmission,diffraction,scattering"
    add("--paths", metavar="LIST", help=f"kinds of path, from {kinds} (default: the first three)")
    add("--depth", type=int, metavar="N", help="largest number of interactions per path (default: 3)")
    add("--reflections", type=int, metavar="N", help="largest number of reflections among these (default: all)")
    text = "standard deviation of the phase of each reflection: spectra are expected ones (docs/scenes.md; default: 0)"
    add("--phase-error", type=float, metavar="RAD", help=text)
    fit = "what to fit to training rows, separated by commas: gain, materials, planes, patterns, pose, surface"
    add("--calibrate", metavar="LIST", help=fit)
    add("--rays", metavar="N", help="number of rays from each source, or auto: until no more paths are found")
    add_antennas(parser)


def add_antennas(parser: argparse.ArgumentParser) -> None:
    """Add options of antennas that override the data set, fields of `AntennaOptions`."""
    add = parser.add_argument
    default = "overrides the data set, whose default is"
    text = f"pattern of the receivers' antennas: {', '.join(PATTERNS)} or a file (docs/data.md)"
    add("--rx-pattern", metavar="PATTERN", help=f"{text}; {default} iso")
    text = f"polarisation of the receivers' antennas; {default} V, vertical in --rx-frame"
    add("--rx-polarization", choices=POLARIZATIONS, help=text)
    text = f"frame of pattern and polarisation, the world's or the array's; {default} world"
    add("--rx-frame", choices=FRAMES, help=text)
    text = f"pattern of the transmitter's antenna: {', '.join(OMNIDIRECTIONAL)} or a file"
    add("--tx-pattern", metavar="PATTERN", help=text)
    add("--tx-polarization", choices=POLARIZATIONS, help="polarisation of the transmitter's antenna")


def antenna_options(a: Arguments) -> AntennaOptions:
    """The options of `add_antennas`."""
    return AntennaOptions(**{field.name: getattr(a, field.name) for field in fields(AntennaOptions)})


def add_n_train(parser: argparse._ActionsContainer) -> None:
    """Add ``--n-train``."""
    parser.add_argument("--n-train", type=_number, metavar="N", help="number or fraction of the training rows to use")


def add_replace(parser: argparse._ActionsContainer) -> None:
    """Add ``--replace`` of commands that make a run folder."""
    parser.add_argument("--replace", action="store_true", help="replace the run in --out")


def add_scheduler(parser: argparse.ArgumentParser) -> None:
    """Add ``--scheduler``."""
    text = "workers: local, local:N (on this machine) or the address of a Dask scheduler, tcp://HOST:PORT"
    parser.add_argument("--scheduler", metavar="WHERE", help=text)


def add_own(parser: argparse.ArgumentParser) -> None:
    """Add ``--own``."""
    text = "readings of the device to predict for, whose offset they tell: positions x, y and strengths, as of locate"
    parser.add_argument("--own", metavar="FILE.csv", help=text)


def add_operator(parser: argparse.ArgumentParser) -> None:
    """Add ``--no-operator``."""
    text = "splat each spectrum, also where geometry is static and one linear operator would do (docs/speed.md)"
    parser.add_argument("--no-operator", action="store_true", help=text)


def check_operator(a: Arguments) -> None:
    """Refuse ``--no-operator`` for a run that predicts without one.

    `InputError`: the run's model is no learned field, or the folder is no run.
    """
    if not a.no_operator:
        return
    from ...gaussians import FIELDS
    from ...runs.run import open_run

    config = open_run(a.run).config
    if config.model not in FIELDS or config.task != "spectrum":
        text = f"--no-operator belongs to learned fields of spectra, not to {config.model} on {config.task}"
        raise InputError(f"{a.run}: {text}; omit it")


def stated(a: Arguments, names: Iterable[str]) -> list[str]:
    """Options, of those names, that the command line states."""
    values = {name.replace("_", "-"): getattr(a, name.replace("-", "_"), None) for name in names}
    # 0 is a statement, though it equals False.
    return [f"--{name}" for name, value in values.items() if not (value is None or value is False or value == [])]


def refuse(a: Arguments, names: Iterable[str], reason: str) -> None:
    """Refuse options that would change nothing: `InputError` with the reason, naming the first that is stated."""
    if idle := stated(a, names):
        raise InputError(f"{idle[0]} {reason}; omit it")


def _number(text: str) -> int | float:
    try:
        return int(text) if text.strip().lstrip("+-").isdecimal() else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None


def comma_numbers(count: int, form: str) -> Callable[[str], tuple[float, ...]]:
    """Type of an option of numbers between commas."""

    def parsed(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(value) for value in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"{text!r}: give {form} in metres")
        return values

    return parsed
