"""Interpolation of the training rows: IDW, kriging, trees and the path-loss law."""
