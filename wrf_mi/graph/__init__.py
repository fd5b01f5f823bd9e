"""The differentiable graph of Gaussians, traced paths and receiver models."""
