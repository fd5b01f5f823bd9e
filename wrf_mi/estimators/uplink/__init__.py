"""Downlink channels from uplink channels: FIRE, R2F2, OptML and the linear estimator."""
