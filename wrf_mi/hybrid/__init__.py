"""Traced and learned fields combined at a receiver, in one differentiable graph."""
