"""Stored results that are older than the source that makes them (``wrf-mi bench --stale``).

A result states digests of its source (`wrf_mi_bench.sources`). One that states none is compared with the source of the
commit that stored it, in a git repository, and is unknown elsewhere.
"""

import io
import json
import subprocess
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from wrf_mi.core import InputError
from wrf_mi.core.files import one_line

from .bench import CASES, CHECKS, modules_of
from .comparison import MEASURED
from .quick import FILE as QUICK
from .sources import PACKAGES, SOURCE, by_folder, modules_of_benchmark, modules_of_command, needed_files, source_digests
from .table_plan import plan
from .tables import FOLDER

UNKNOWN = "unknown"  # source of a result that states none, outside a git repository
SHOWN = 4  # changed folders in a line; ``--json`` has all


def stale(out: Path) -> tuple[list[dict[str, Any]], int]:
    """Results in ``out`` whose source has changed or is unknown, and the number of all results.

    A result has ``name``, ``date``, ``command``, which measures it anew, and ``changed``: folders of source files, or
    `UNKNOWN`. `InputError` for a result that cannot be read.
    """
    history, older, count = History(out), [], 0
    digests = cache(lambda modules: source_digests(*modules))
    for path, result, modules, command in results(out):
        count += 1
        measured = result.get(MEASURED, result)
        date, now = measured.get("date", UNKNOWN), digests(modules)
        before = measured.get(SOURCE) or history.digests(path, date, modules)
        changed = sorted(name for name in {*now, *(before or {})} if before and before.get(name) != now.get(name))
        if changed or not before:
            name = path.relative_to(out if out in path.parents else out.parent).with_suffix("").as_posix()
            older.append({"name": name, "date": date, "command": command, "changed": changed or UNKNOWN})
    return older, count


def results(out: Path) -> Iterator[tuple[Path, dict[str, Any], tuple[str, ...], str]]:
    """Each result's file, content, modules and command; other JSON files are passed over."""
    planned = {row.name for row in plan()}
    for path in sorted([*out.rglob("*.json"), *(out.parent / FOLDER).glob("*.json")]):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{path}: not readable ({one_line(error)}); restore it, or delete it") from None
        folder, name = path.parent.name, path.stem
        if path.parent == out and (name in CHECKS or name in CASES):
            yield path, content, modules_of(name), f"wrf-mi bench {name}"
        elif path.parent == out and name.startswith(Path(QUICK).stem):
            yield path, content, modules_of_benchmark(f"{__package__}.quick"), content["command"]
        elif folder == FOLDER and name in planned:
            words = content["command"].split()
            yield path, content, modules_of_command(words), f"rm {path}; wrf-mi bench tables"
        elif folder in CHECKS:
            yield path, content, modules_of(folder), f"rm {path}; wrf-mi bench {folder}"


def stale_lines(older: Sequence[Mapping[str, Any]], count: int) -> str:
    """A line for each result, and their number."""
    lines = []
    for item in older:
        folders = [UNKNOWN] if item["changed"] == UNKNOWN else item["changed"]
        more = f" and {len(folders) - SHOWN} more" if len(folders) > SHOWN else ""
        lines.append(f"{item['name']}: {item['date']}; {item['command']}; changed: {', '.join(folders[:SHOWN])}{more}")
    unknown = sum(item["changed"] == UNKNOWN for item in older)
    lines.append(f"{len(older) - unknown} of {count} results are older than their source, {unknown} unknown")
    return "\n".join(lines)


@dataclass
class History:
    """Commits of the git repository of a folder; none where it is in no repository."""

    folder: Path  # a folder of results
    _texts: dict[str, dict[str, str]] = field(default_factory=dict)
    _digests: dict[tuple[str, ...], dict[str, str]] = field(default_factory=dict)

    def digests(self, path: Path, date: str, modules: tuple[str, ...]) -> dict[str, str]:
        """Digests of what modules need now as it was when a result of a date was stored; {}: unknown."""
        commit = self._commit(path, date)
        if not commit:
            return {}
        if commit not in self._texts:
            self._texts[commit] = self._python_files(commit)
        if (commit, *modules) not in self._digests:
            self._digests[commit, *modules] = self._digest(self._texts[commit], modules)
        return self._digests[commit, *modules]

    @staticmethod
    def _digest(texts: Mapping[str, str], modules: tuple[str, ...]) -> dict[str, str]:
        tops = {name: name.partition("/")[0] for name in needed_files(*modules)}
        if not texts or not PACKAGES.keys() >= set(tops.values()):
            return {}
        return by_folder({name: texts.get(f"{PACKAGES[top]}/{name}".lstrip("/"), "") for name, top in tops.items()})

    def _commit(self, path: Path, date: str) -> str:
        """The last commit of a file on its date, as later ones may have changed its layout, or else of anything."""
        until = f"--until={date}T23:59:59"
        for more in (["--", str(path.resolve())], []):
            if commit := self._git("log", "-1", "--format=%H", until, *more).decode().strip():
                return commit
        return ""

    def _python_files(self, commit: str) -> dict[str, str]:
        root = self._git("rev-parse", "--show-toplevel").decode().strip()
        packed = self._git("-C", root, "archive", "--format=tar", commit)  # in a folder below, of that folder alone
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            files = [member for member in archive if member.isfile() and member.name.endswith(".py")]
            return {member.name: stream.read().decode() for member in files if (stream := archive.extractfile(member))}

    def _git(self, *words: str) -> bytes:
        """Output of git in the folder; nothing where it fails or is not installed."""
        call = ["git", "-C", str(self.folder), *words]
        try:
            return subprocess.run(call, capture_output=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return b""
