"""The stages on an NVIDIA GPU: the loops over ``scalar/`` again, one thread for a Gaussian or a pixel."""
