"""Metrics: PSNR, SSIM and LPIPS of renders against photographs.

:mod:`.evaluation` has the metrics of images and of a set of views, :mod:`.lpips` the perceptual distance.
"""

from minisplat_ref.metrics.evaluation import Evaluation, ViewMetrics, correct_colors, evaluate, psnr, ssim

__all__ = ["Evaluation", "ViewMetrics", "correct_colors", "evaluate", "psnr", "ssim"]
