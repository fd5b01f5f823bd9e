"""Models with Gaussians: WRF-GS, WRF-GS+ and the factorised field, alone or with the paths of a scene."""
