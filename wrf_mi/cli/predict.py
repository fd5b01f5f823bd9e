"""``wrf-mi predict``."""

from __future__ import annotations

from typing import Any

from .options import Arguments, add_command, add_operator, add_scheduler, check_operator
from .output import print_json


def add_parser(commands: Any) -> None:
    """Add ``predict`` to the commands."""
    parser = add_command(commands, "predict", predict_command, "predict at new transmitter positions")
    parser.add_argument("run", metavar="RUN", help="run folder")
    given = parser.add_mutually_exclusive_group(required=True)
    text = "positions x, y, z in metres (and heading_rad, frequency_hz), with a header"
    given.add_argument("--tx", metavar="FILE.csv", help=text)
    text = "array tx_pos [m, 3] in metres (and heading_rad [m], frequency_hz [m]), or uplink [m, antennas, subcarriers]"
    given.add_argument("--input", metavar="FILE.npz", help=text)
    text = "file to write: FILE.npz, or FILE.csv (signal strengths; columns x, y, z in metres, NAME_dbm, NAME_std_db)"
    parser.add_argument("--out", required=True, metavar="FILE", help=text)
    add_operator(parser)
    add_scheduler(parser)


def predict_command(a: Arguments) -> int:
    """Write predictions to a file."""
    from ..parallel import open_scheduler
    from ..runs.api import predict_to_file
    from ..runs.prediction_file import read_inputs

    check_operator(a)
    inputs = read_inputs(a.tx, a.input)
    with open_scheduler(a.scheduler) as scheduler:
        positions = (inputs.tx_pos_m, a.out, inputs.tx_heading_rad)
        workers = scheduler if a.scheduler else None
        given: dict[str, Any] = {"uplink": inputs.uplink, "carriers_hz": inputs.carriers_hz}
        shapes = predict_to_file(a.run, *positions, workers, not a.no_operator, **given, progress=True)
    if a.json:
        print_json({"out": str(a.out), "arrays": {key: list(shape) for key, shape in shapes.items()}})
    else:
        print(f"{shapes['tx_pos'][0]} predictions: {a.out}")
    return 0
