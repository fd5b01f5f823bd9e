"""wrf_mi: learned wireless radiation fields and ray tracing in one differentiable program."""

__version__ = "0.1.0"
