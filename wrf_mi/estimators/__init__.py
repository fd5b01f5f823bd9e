"""What a stage fits: interpolation, Gaussians, networks, ray tracing, models of an uplink."""
