"""Mixtures of other models, weighted by the distance to the nearest training row."""
