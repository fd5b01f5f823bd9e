"""Benchmarks of `wrf_mi`, which ``wrf-mi bench`` runs."""

from wrf_mi.backend import init

init()
