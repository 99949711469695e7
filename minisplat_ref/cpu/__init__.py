"""The CPU backend: parallel loops over all Gaussians or all pixels, around the formulas of ``scalar``."""
