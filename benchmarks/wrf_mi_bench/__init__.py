"""Benchmarks of `wrf_mi`, which ``wrf-mi bench`` runs.

The entry points `bench` and `check` start the backend, so that a subprocess can choose its own.
"""
