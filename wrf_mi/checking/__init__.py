"""Checks of whole data sets: every fault, and data that are likely wrong."""

from .check import SUSPICIONS, check_data, warn_of_suspicions
from .report import DataReport, Suspicion

__all__ = ["SUSPICIONS", "DataReport", "Suspicion", "check_data", "warn_of_suspicions"]
