"""Scene folders: rooms that Mitsuba 3 and Sionna RT both open."""

from .registry import SceneInfo, content_sha256, scenes

__all__ = ["SceneInfo", "content_sha256", "scenes"]
