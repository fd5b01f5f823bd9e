"""Physics with measurements: planes, materials and paths fitted to the training rows, kriging of what they leave."""

from ...backend import init

init()
