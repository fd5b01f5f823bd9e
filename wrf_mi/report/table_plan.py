"""Which runs the tables of all methods are made of: tasks, data sets, splits, methods, shares of the rows, seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ..measure.registry import locate

SEEDS = (0, 1, 2)
SHARES = (1.0, 0.3, 0.1)
"""Of the training rows; less than all for the methods of `FEW` alone, on the official split."""


@dataclass(frozen=True)
class Entry:
    """A method as a table has it.

    Attributes:
        label: for the table.
        arguments: of ``wrf-mi train`` beside data set, split, rows and seed.
        quick: the same of a small version that takes half a minute.
        seeds: more than one where a run takes less than three minutes and something is drawn.
        published: median (and what else is known) that the paper states, on other data; "" for none.
    """

    label: str
    arguments: tuple[str, ...]
    quick: tuple[str, ...] = ()
    seeds: Sequence[int] = SEEDS[:1]
    published: str = ""


def _set(*settings: str) -> tuple[str, ...]:
    return tuple(word for one in settings for word in ("--set", one))


def _model(name: str, *more: str) -> tuple[str, ...]:
    return ("--model", name, *more)


IN_A_FLAT = (
    *("--paths", "line-of-sight,reflection,transmission", "--depth", "6", "--reflections", "2"),
    *("--calibrate", "patterns"),
)
"""Walls are two surfaces each and let waves through; strengths are not calibrated."""
ON_A_FLOOR = ("--paths", "line-of-sight,reflection,transmission", "--depth", "5", "--reflections", "3")
"""As the channels were traced, but for what the rough surfaces scatter, which no mesh tells."""
FEWER = _set("training.steps=200", "training.rounds=2")
"""Of every network in the small version."""
SPECTRUM: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", _model("wrf-gs+"), _set("steps=400", "validate_every=400"), SEEDS, "0.90, p90 0.95"),
    "wrf-gs": Entry("WRF-GS", _model("wrf-gs"), _set("steps=400", "validate_every=400"), SEEDS, "0.82, p90 0.88"),
    "hybrid": Entry("hybrid", _model("hybrid"), (), SEEDS),
    "nerf2": Entry("NeRF2", _model("nerf2"), _set("training.steps=60", "training.rounds=2"), (0,), "0.78, p90 0.86"),
    "vae": Entry("VAE", _model("vae"), FEWER, SEEDS, "0.70, p90 0.82"),
    "dcgan": Entry("DCGAN", _model("dcgan"), _set("training.steps=60", "training.rounds=2"), (0,), "0.56, p90 0.69"),
    "ray-tracing": Entry("ray tracing", _model("ray-tracing", "--scene", "{scene}"), (), (0,), "0.38, p90 0.61"),
    "kriging": Entry("kriging", _model("kriging")),
    "idw": Entry("blend", _model("idw")),
}
RSSI: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+, one a receiver", _model("wrf-gs+"), FEWER, SEEDS, "2.4, p10 1.1, p90 4.6"),
    "wrf-gs": Entry("WRF-GS, one a receiver", _model("wrf-gs"), FEWER, SEEDS, "2.9"),
    "wrf-gs+-shared": Entry("WRF-GS+, one for all", _model("wrf-gs+", *_set("shared=true")), FEWER, SEEDS),
    "wrf-gs-shared": Entry("WRF-GS, one for all", _model("wrf-gs", *_set("shared=true")), FEWER, SEEDS),
    "hybrid": Entry("hybrid", _model("hybrid", "--scene", "{scene}"), (), (0,)),
    "nerf2": Entry("NeRF2", _model("nerf2"), FEWER, (0,), "3.1"),
    "ray-tracing": Entry("ray tracing, calibrated", _model("ray-tracing", "--scene", "{scene}", *IN_A_FLAT)),
    "trees": Entry("randomised trees", _model("trees"), (), SEEDS),
    "kriging": Entry("kriging", _model("kriging")),
    "idw": Entry("blend", _model("idw")),
    "mri": Entry("MRI", _model("mri"), published="8.3"),
}
POSITION: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", _model("wrf-gs+"), FEWER, SEEDS),
    "wrf-gs": Entry("WRF-GS", _model("wrf-gs"), FEWER, SEEDS),
    "hybrid": Entry("hybrid", _model("hybrid", "--scene", "{scene}"), (), (0,)),
    "nerf2": Entry("NeRF2", _model("nerf2"), FEWER, (0,)),
    "ray-tracing": Entry("ray tracing", _model("ray-tracing", "--scene", "{scene}")),
    "kriging": Entry("kriging", _model("kriging")),
    "idw": Entry("blend", _model("idw")),
}
UPLINK: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", _model("wrf-gs+"), FEWER, (0,), "23.91, p10 20.85, p90 25.52"),
    "wrf-gs": Entry("WRF-GS", _model("wrf-gs"), FEWER, (0,), "22.98, p10 20.82, p90 24.33"),
    "nerf2": Entry("NeRF2", _model("nerf2"), FEWER, (0,), "20.55"),
    "fire": Entry("FIRE", _model("fire"), FEWER, (0,), "15.29"),
    "r2f2": Entry("R2F2", _model("r2f2"), published="8.57"),
    "optml": Entry("OptML", _model("optml"), FEWER, (0,), "8.47"),
    "ray-tracing": Entry("ray tracing, from positions", _model("ray-tracing", "--scene", "{scene}", *ON_A_FLOOR)),
}
FEW = ("wrf-gs+", "hybrid", "nerf2", "kriging", "idw", "ray-tracing")
"""Measured with fewer rows too."""


@dataclass(frozen=True)
class Part:
    """One data set under one split.

    Attributes:
        task: which table it belongs to.
        dataset: name.
        split: name.
        entries: methods.
        few: whether fewer rows are measured too.
        scene: name of what `wrf_mi.report.tables.scene_of` makes; "" where no method needs one.
    """

    task: str
    dataset: str
    split: str
    entries: Mapping[str, Entry] = field(hash=False)
    few: bool = False
    scene: str = ""


PARTS = (
    Part("spectrum", "rfid-lab", "official", SPECTRUM, True, "laboratory"),
    Part("spectrum", "rfid-lab", "blocked", SPECTRUM, scene="laboratory"),
    Part("spectrum", "traced-room", "official", SPECTRUM, scene="room"),
    Part("rssi", "flat-ble", "official", RSSI, True, "flat"),
    Part("csi", "newrf-conference", "official", POSITION, True, "scan"),
    Part("csi", "newrf-office", "official", POSITION, scene="scan"),
    Part("csi", "traced-csi-flat", "official", UPLINK, True, "floor"),
    Part("csi", "traced-csi-office", "official", UPLINK, scene="floor"),
)
QUICK_PARTS = tuple(part for part in PARTS if part.dataset in ("rfid-lab", "flat-ble", "traced-csi-flat") and part.few)
BLOCKED_SETTINGS: Mapping[str, tuple[str, ...]] = {
    **{name: _set("steps=3000", "hold_out=0") for name in ("wrf-gs", "wrf-gs+")},
    "dcgan": _set("training.steps=600"),
}
"""Of the five folds of a blocked split, which are fitted in turn: ten minutes for all of them."""


@dataclass(frozen=True)
class Row:
    """One run of the tables.

    Attributes:
        part: where.
        method: key of the part's entries.
        share: of the training rows.
        seed: of subset and fit.
        quick: the small version.
    """

    part: Part
    method: str
    share: float
    seed: int
    quick: bool = False

    @property
    def entry(self) -> Entry:
        """The method."""
        return self.part.entries[self.method]

    @property
    def name(self) -> str:
        """For files."""
        p = self.part
        return f"{p.task}-{p.dataset}-{p.split}-{self.method}-{round(100 * self.share)}-seed{self.seed}"

    def arguments(self, scene: Sequence[str]) -> list[str]:
        """Of ``wrf-mi``, without ``--out``.

        Args:
            scene: arguments that take the place of ``--scene {scene}``.
        """
        words: list[str] = []
        for word in self.entry.arguments:
            if word == "{scene}":
                words[-1:] = scene
            else:
                words.append(word)
        if self.quick:
            words += self.entry.quick
        elif self.part.split == "blocked" and self.part.task == "spectrum":
            words += BLOCKED_SETTINGS.get(self.method, ())
        few = [] if self.share == 1 else ["--n-train", str(self.share)]
        return ["train", self.part.dataset, *words, "--split", self.part.split, "--seed", str(self.seed), *few]


def plan(quick: bool = False) -> list[Row]:
    """All rows: first one seed of every method at all rows, part by part, then fewer rows, then other seeds.

    So tables are whole early, and what an interruption leaves out is what is least needed.
    """
    if quick:
        return [Row(part, name, SHARES[-1], 0, True) for part in QUICK_PARTS for name in part.entries]
    first = [Row(part, name, 1.0, 0) for part in PARTS for name in part.entries]
    few = [
        Row(part, name, share, 0)
        for part in PARTS
        if part.few
        for share in SHARES[1:]
        for name in part.entries
        if name in FEW
    ]
    seeds = [Row(row.part, row.method, row.share, seed) for row in (*first, *few) for seed in row.entry.seeds[1:]]
    return [*first, *few, *seeds]


def available(part: Part) -> bool:
    """Whether the data of a part are on this machine or are made here."""
    return part.dataset.startswith("traced-") or locate(part.dataset) is not None
