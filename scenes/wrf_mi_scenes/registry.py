"""The scenes of the package, with their licence, checksum, frame and units."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml


@dataclass(frozen=True)
class SceneInfo:
    """A scene folder: Mitsuba XML and PLY meshes that Mitsuba and Sionna RT both open.

    Attributes:
        name: name of the folder, unique.
        folder: path of the folder.
        xml: path of the scene file.
        description: one line.
        licence: SPDX name.
        origin: module that made it.
        frame: axes and origin of the coordinates.
        units: unit of the coordinates, ``"m"``.
        thickness_m: slab thickness of each radio material (``itu_*``) in metres; Mitsuba XML cannot hold it.
        sha256: checksum of the scene file and its meshes (`content_sha256`).
    """

    name: str
    folder: Path
    xml: Path
    description: str
    licence: str
    origin: str
    frame: str
    units: str
    thickness_m: Mapping[str, float]
    sha256: str

    def is_intact(self) -> bool:
        """Whether the files have the stated checksum."""
        return content_sha256(self.folder, self.xml.name) == self.sha256


def content_sha256(folder: Path, xml: str) -> str:
    """SHA-256 (hex) over the scene file ``xml`` and every ``meshes/*.ply``, names included, in sorted order.

    Line ends of the XML are read as LF, so that a checkout that converts them keeps the checksum.
    """
    digest = hashlib.sha256()
    digest.update(xml.encode() + b"\0" + (folder / xml).read_bytes().replace(b"\r\n", b"\n"))
    for path in sorted((folder / "meshes").glob("*.ply")):
        digest.update(b"\0" + path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def scenes() -> dict[str, SceneInfo]:
    """The scenes by name: every folder beside this file that holds a ``scene.yml``."""
    infos = {}
    for path in sorted(Path(__file__).parent.glob("*/scene.yml")):
        facts = yaml.safe_load(path.read_text(encoding="utf-8"))
        xml = path.parent / facts.pop("xml")
        infos[path.parent.name] = SceneInfo(name=path.parent.name, folder=path.parent, xml=xml, **facts)
    return infos
