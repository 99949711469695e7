"""All Gaussians or all pixels: parallel loops over the formulas of ``scalar``."""
