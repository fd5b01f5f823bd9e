"""Checks of whole data sets: every fault, and data that are likely wrong."""

from .check import SUSPICIONS, DataReport, Suspicion, check_data, warn_of_suspicions

__all__ = ["SUSPICIONS", "DataReport", "Suspicion", "check_data", "warn_of_suspicions"]
