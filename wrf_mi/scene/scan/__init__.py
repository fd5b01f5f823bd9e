"""Surfaces of a building from LiDAR scans, and simulated scans."""

from .simulated import simulate_scan

__all__ = ["simulate_scan"]
