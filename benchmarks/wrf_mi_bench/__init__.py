"""Benchmarks of `wrf_mi`, which ``wrf-mi bench`` runs.

The entry points `bench`, `check` and `subprocess_job` start the backend, so that a subprocess can choose its own.
"""
