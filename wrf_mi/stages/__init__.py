"""Fits in stages: what each stage may fit, and the engine that selects by held-out rows."""
