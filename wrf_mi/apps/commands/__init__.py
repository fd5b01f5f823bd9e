"""The command ``wrf-mi``."""
