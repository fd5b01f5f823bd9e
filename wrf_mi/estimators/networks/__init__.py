"""Neural networks from the transmitter position to an observation: VAE, DCGAN and NeRF2."""
