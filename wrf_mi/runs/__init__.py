"""Run folders: training, evaluation, prediction, comparison, sweeps."""
