"""Runs of the tables of all methods: tasks, data sets, splits, methods, shares of the training rows, seeds."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

from wrf_mi.datasets.registry import locate

MADE_HERE = "traced-"  # names of data sets that this package makes begin with it
SEEDS = (0, 1, 2)
ONE = SEEDS[:1]
SHARES = (1.0, 0.3, 0.1)
"""Shares of the training rows; less than all only for the methods of `FEW` on the official split."""


@dataclass(frozen=True)
class Entry:
    label: str  # label in the table
    model: str  # name of the model
    scene: str = ""  # `NAMED` or `CORRECTED`; "": none
    options: tuple[str, ...] = ()  # further arguments of ``wrf-mi train`` except data set, split, rows and seed
    quick: tuple[str, ...] = ()  # further arguments of the small version, which takes half a minute
    seeds: Sequence[int] = ONE  # seeds; several for random methods of less than three minutes
    few_seeds: Sequence[int] = SEEDS  # seeds with fewer rows, which are random themselves


def _set(*settings: str) -> tuple[str, ...]:
    return tuple(word for setting in settings for word in ("--set", setting))


NAMED, CORRECTED = "{scene}", "{corrected}"
"""Arguments that are replaced by the arguments of a scene, as stated and corrected by the row's training rows."""
THROUGH_WALLS = ("--paths", "line-of-sight,reflection,transmission")
IN_A_FLAT = (*THROUGH_WALLS, "--depth", "6", "--reflections", "2")  # transmission through walls of two surfaces each
CALIBRATED = (*IN_A_FLAT, "--calibrate", "gain,patterns")  # calibration of uncalibrated strengths
ON_A_FLOOR = (*THROUGH_WALLS, "--depth", "5", "--reflections", "3")
"""Paths of the synthetic channels except diffuse scattering."""
FEWER, SIXTY = (_set(f"steps={steps}", f"validate_every={2 * steps // 5}") for steps in (250, 75))
"""Schedules of the small version: networks, and networks with slow steps."""
SHORT = _set("steps=400", "validate_every=200")  # schedule of fields of Gaussians in the small version
SPECTRUM: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", "wrf-gs+", quick=SHORT, seeds=SEEDS),
    "wrf-gs": Entry("WRF-GS", "wrf-gs", quick=SHORT, seeds=SEEDS),
    "nerf2": Entry("NeRF2", "nerf2", quick=SIXTY, seeds=SEEDS),
    "vae": Entry("VAE", "vae", quick=FEWER, seeds=SEEDS),
    "dcgan": Entry("DCGAN", "dcgan", quick=SIXTY),
    "ray-tracing": Entry("ray tracing", "ray-tracing", NAMED),
    "kriging": Entry("kriging", "kriging", seeds=SEEDS),
    "idw": Entry("IDW", "idw"),
}
ROOM = _set("steps=18000")
"""Schedule for transmitters anywhere in a room: SSIM 0.770 on validation rows, 0.754 after a third of the steps."""
FURNISHED = {
    **SPECTRUM,
    "wrf-gs+": replace(SPECTRUM["wrf-gs+"], options=ROOM),
    "wrf-gs": replace(SPECTRUM["wrf-gs"], options=ROOM),
    "wrf-gs+-joint": Entry("WRF-GS+ with the scan's paths", "wrf-gs+", NAMED, quick=SHORT),
    "hybrid": Entry("hybrid, knows the scan", "hybrid", NAMED),
    "ray-tracing": Entry("ray tracing in the scan", "ray-tracing", NAMED, THROUGH_WALLS),
    "ray-tracing-corrected": Entry("ray tracing in the scan, corrected", "ray-tracing", CORRECTED, THROUGH_WALLS),
}
UNSEEN = {**SPECTRUM, "ray-tracing": Entry("ray tracing, line of sight alone", "ray-tracing", NAMED, few_seeds=ONE)}
"""Methods without a mesh, where only the direct path can be traced."""
RSSI: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", "wrf-gs+", quick=SHORT, seeds=SEEDS),
    "wrf-gs": Entry("WRF-GS", "wrf-gs", quick=SHORT, seeds=SEEDS),
    "wrf-gs+-joint": Entry("WRF-GS+, knows walls", "wrf-gs+", NAMED, quick=SHORT, seeds=SEEDS),
    "hybrid": Entry("hybrid, knows walls and heading", "hybrid", NAMED),
    "nerf2": Entry("NeRF2", "nerf2", quick=FEWER, few_seeds=ONE),
    "ray-tracing": Entry("ray tracing, calibrated, knows walls and heading", "ray-tracing", NAMED, CALIBRATED),
    "ray-tracing-corrected": Entry(
        "ray tracing, calibrated, walls corrected, knows heading", "ray-tracing", CORRECTED, CALIBRATED
    ),
    "ray-tracing-offsets": Entry("ray tracing, one offset a receiver", "ray-tracing", NAMED, IN_A_FLAT),
    "trees": Entry("randomised trees, know the heading", "trees", seeds=SEEDS),
    "kriging": Entry("kriging, knows the heading", "kriging"),
    "idw": Entry("IDW", "idw"),
    "mri": Entry("MRI", "mri"),
}
UPLINK: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", "wrf-gs+", quick=SHORT, seeds=SEEDS),
    "wrf-gs": Entry("WRF-GS", "wrf-gs", quick=SHORT, seeds=SEEDS),
    "nerf2": Entry("NeRF2", "nerf2", quick=FEWER, few_seeds=ONE),
    "fire": Entry("FIRE", "fire", quick=FEWER, seeds=SEEDS),
    "r2f2": Entry("R2F2", "r2f2", seeds=SEEDS),
    "optml": Entry("OptML", "optml", quick=FEWER, seeds=SEEDS),
    "linear": Entry("linear map", "linear", seeds=SEEDS),
    "hybrid": Entry("hybrid, from the uplink and positions", "hybrid"),
    "kriging": Entry("kriging, from positions", "kriging"),
    "ray-tracing": Entry("ray tracing, from positions and walls", "ray-tracing", NAMED, ON_A_FLOOR, few_seeds=ONE),
}
NEW_CARRIERS: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+", "wrf-gs+", quick=SHORT),
    "wrf-gs+-joint": Entry("WRF-GS+ with the scan's paths", "wrf-gs+", NAMED, quick=SHORT),
    "hybrid": Entry("hybrid, knows the scan", "hybrid", NAMED),
    "ray-tracing": Entry("ray tracing in the scan", "ray-tracing", NAMED, THROUGH_WALLS),
    "kriging": Entry("kriging, over position and log frequency", "kriging"),
    "idw": Entry("IDW, over position and log frequency", "idw"),
}
KNOWN_POSITIONS = {name: entry for name, entry in NEW_CARRIERS.items() if not name.startswith("wrf-gs")}
"""Methods without a field of Gaussians, where the positions of the test rows were measured at other carriers."""
NEW_RECEIVERS: Mapping[str, Entry] = {
    "wrf-gs+": Entry("WRF-GS+, by the receiver's pose", "wrf-gs+", quick=SHORT),
    "hybrid": Entry("hybrid, knows walls", "hybrid", NAMED),
    "kriging": Entry("kriging, pooled over receivers", "kriging"),
    "ray-tracing": Entry("ray tracing, mean offset of the receivers", "ray-tracing", NAMED, IN_A_FLAT),
    "mri": Entry("one path-loss law (MRI)", "mri"),
}
CHEAP = ("ray-tracing", "ray-tracing-corrected", "linear", "trees", "kriging", "idw", "mri")
"""Methods measured first: seconds to a minute each."""
FEW = ("wrf-gs+", "nerf2", "linear", "kriging", "idw", "ray-tracing")  # methods measured with fewer rows too


@dataclass(frozen=True)
class TablePart:
    """A data set with a split."""

    task: str  # task of the data set
    table: str  # overview: the task, or the input from which channels are predicted
    dataset: str  # name of the data set
    split: str  # name of the split
    entries: Mapping[str, Entry] = field(hash=False)  # methods by name
    few: bool = False  # whether fewer rows are measured too
    scene: str = ""  # scene that `wrf_mi_bench.tables.scene_of` makes; "": none
    once: Collection[str] = ()  # methods of more than three minutes on one thread, with one seed


PARTS = (
    TablePart("spectrum", "spectrum", "rfid-lab", "official", UNSEEN, True, "open", once=("wrf-gs", "nerf2")),
    TablePart("spectrum", "spectrum", "rfid-lab", "blocked", UNSEEN, scene="open", once=("wrf-gs+", "nerf2", "vae")),
    TablePart("spectrum", "spectrum", "traced-room", "official", FURNISHED, scene="lidar", once=("wrf-gs+", "wrf-gs")),
    TablePart("rssi", "rssi", "flat-ble", "official", RSSI, True, "flat", once=("wrf-gs+-joint",)),
    TablePart("spectrum", "carriers", "traced-room-bands", "frequency", NEW_CARRIERS, scene="lidar"),
    TablePart("spectrum", "carriers", "traced-room-bands", "frequency-known", KNOWN_POSITIONS, scene="lidar"),
    TablePart("rssi", "receivers", "traced-floor-receivers", "receiver", NEW_RECEIVERS, scene="lidar"),
    TablePart("rssi", "receivers", "flat-ble", "receiver", NEW_RECEIVERS, scene="flat"),
    TablePart("csi", "uplink", "traced-csi-flat", "official", UPLINK, True, "floor"),
    TablePart("csi", "uplink", "traced-csi-office", "official", UPLINK, scene="floor", once=("wrf-gs+", "r2f2")),
)
QUICK_PARTS = tuple(part for part in PARTS if part.dataset in ("rfid-lab", "flat-ble", "traced-csi-flat") and part.few)
BLOCKED_SETTINGS: Mapping[tuple[str, str], tuple[str, ...]] = {
    **{("spectrum", name): _set("steps=3000", "holdout_steps_fraction=0") for name in ("wrf-gs", "wrf-gs+")},
    ("spectrum", "dcgan"): _set("steps=750", "validate_every=75"),
    ("spectrum", "nerf2"): _set("steps=2500", "validate_every=250"),
}
"""Settings of blocked splits by task and method: five folds are fitted in ten minutes."""


@dataclass(frozen=True)
class Row:
    """A run of the tables: part, method, share of the training rows, seed of subset and fit, and small version."""

    part: TablePart
    method: str
    share: float
    seed: int
    quick: bool = False

    @property
    def entry(self) -> Entry:
        return self.part.entries[self.method]

    @property
    def name(self) -> str:
        p = self.part
        return f"{p.task}-{p.dataset}-{p.split}-{self.method}-{round(100 * self.share)}-seed{self.seed}"

    @property
    def command(self) -> str:
        """Command with a placeholder for the scene, the same on every machine."""
        corrected = ", corrected" if self.entry.scene == CORRECTED else ""
        return " ".join(["wrf-mi", *self.arguments(["--scene", f"{{{self.part.scene}{corrected}}}"])])

    @property
    def rows(self) -> list[str]:
        """Arguments of split, seed and number of training rows."""
        few = [] if self.share == 1 else ["--n-train", str(self.share)]
        return ["--split", self.part.split, "--seed", str(self.seed), *few]

    def arguments(self, scene: Sequence[str]) -> list[str]:
        """Arguments of ``wrf-mi`` without ``--out``; ``scene`` replaces the arguments of the scene."""
        words = ["--model", self.entry.model, *(scene if self.entry.scene else ()), *self.entry.options]
        if self.quick:
            words += self.entry.quick
        elif self.part.split == "blocked":
            words += BLOCKED_SETTINGS.get((self.part.task, self.method), ())
        return ["train", self.part.dataset, *words, *self.rows]


def plan(quick: bool = False) -> list[Row]:
    """All rows: a seed of every method with all training rows, cheap methods first, then fewer rows, then seeds."""
    if quick:
        return [Row(part, name, SHARES[-1], 0, True) for part in QUICK_PARTS for name in part.entries]
    first = [Row(part, name, 1.0, 0) for part in PARTS for name in part.entries]
    first.sort(key=lambda row: row.method not in CHEAP)
    pairs = product(PARTS, SHARES[1:])
    few = [Row(part, name, share, 0) for part, share in pairs for name in part.entries if part.few and name in FEW]
    few.sort(key=lambda row: row.method not in CHEAP)
    again = [replace(row, seed=n) for row in first for n in row.entry.seeds[1:] if row.method not in row.part.once]
    again += [replace(row, seed=n) for row in few for n in row.entry.few_seeds[1:]]
    return [*first, *few, *again]


def available(part: TablePart) -> bool:
    """Whether the data of a part are on this machine or can be made here."""
    return part.dataset.startswith(MADE_HERE) or locate(part.dataset) is not None
