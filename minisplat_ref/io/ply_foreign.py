"""What 3DGS does not draw of a PLY of Gaussians: columns of other methods, and values that are not those of 3DGS.

A file of a relative of 3DGS has its six fields, and others without which the six mean something else: Gaussians that
move, that a filter makes larger, whose colours a network computes. Read as 3DGS they render without an error, and
wrongly. So the columns that are left out are named, with what draws them where that is known.

Values after their activation (opacities instead of logits, sizes instead of logarithms, colours instead of
coefficients) are numbers like any others. Only where all of a file lie where such values lie, and not where those of
3DGS do, a sentence says so; nothing is converted.
"""

import re
from collections.abc import Sequence

import numpy as np

from minisplat_ref.types import Floats, Gaussians

KNOWN = (
    (
        r"filter_3d",
        "the 3D filter of Mip-Splatting: --extension antialiasing draws it, create_fused_ply.py there removes it",
    ),
    (r"t|scale_t(_\d+)?|rot_r_\d+", "4D Gaussian Splatting, whose Gaussians appear and move with time"),
    (r"motion_\d+|omega_\d+|trbf_(center|scale)|trbf", "SpacetimeGaussians, which move along curves"),
    (r"delta_[a-z]+_t\d+|delta_rot_\d+_t\d+|velocity(_[\dxyz])?|v[xyz]", "a method whose Gaussians move"),
    (r"f_offset_\d+|f_anchor_feat_\d+|anchor_feat.*", "Scaffold-GS, whose networks make Gaussians of anchors"),
    (r"beta|sb_params_\d+", "Deformable Beta Splatting, whose primitives are no Gaussians"),
    (r"shape(_\d+)?|gen_coeff.*", "generalised exponentials (GES), which are no Gaussians"),
    (r"nu_degree|negative", "Student Splatting, whose primitives are no Gaussians"),
    (r"(base_color|albedo|kd|roughness|metallic|specular|diffuse|refl_strength|ks)(_\d+)?|ind_(dc|rest|asg)_\d+|env.*",
     "a method that lights materials"),
    (r"(obj_dc|semantic|sem|ins_feat|language_feature|lang_feat|seg|identity)(_\d+)?", "labels, not of the image"),
    (r"red|green|blue|r|g|b|alpha|a|uchar_.*", "colours for programs that show points"),
    (r"importance(_score)?|max_radii2d|mask(_\d+)?|confidence|error|class|id|level", "notes of a training"),
)  # fmt: skip
"""Names of columns, upper and lower case alike, and what they belong to."""

OWN = frozenset({"label"})  # columns that commands here write, and that nothing draws
N_NAMED = 6  # columns of one kind that are named
N_MIN = 10  # Gaussians from which on ranges say something
LOG_SCALE_LOW = 0.5  # median below which logarithms that are all positive are sizes
SHARE_OF_EXTENT = 0.1  # or that they are larger than this part of the scene
COLOR_MAX = 20.0  # of a coefficient; 1.8 is white


def describe_columns(names: Sequence[str]) -> list[str]:
    """Return sentences about columns that 3DGS does not draw, one for each method and one for those nobody knows."""
    by_reason: dict[str, list[str]] = {}
    for name in (name for name in names if name not in OWN):
        reason = next((reason for pattern, reason in KNOWN if re.fullmatch(pattern, name.casefold())), "")
        by_reason.setdefault(reason, []).append(name)
    unknown = by_reason.pop("", [])
    said = [f"{_enumerate(group)} ({reason})" for reason, group in by_reason.items()]
    return [*said, *([f"{_enumerate(unknown)} (unknown here)"] if unknown else [])]


def _enumerate(names: Sequence[str]) -> str:
    return ", ".join(names[:N_NAMED]) + (f" and {len(names) - N_NAMED} more" if len(names) > N_NAMED else "")


def describe_ranges(gaussians: Gaussians) -> list[str]:
    """Return sentences about values that look as if they were not those of 3DGS."""
    if len(gaussians.means) < N_MIN:
        return []
    said = []
    opacities, dc = gaussians.opacity_logits, gaussians.sh_dc
    if opacities.min() >= 0 and opacities.max() <= 1 and np.ptp(opacities) > 0:
        said.append("all opacities are between 0 and 1, as after the sigmoid; 3DGS stores logits")
    if gaussians.log_scales.min() > 0 and _are_sizes(gaussians.means, gaussians.log_scales):
        smallest = float(np.exp(np.float64(gaussians.log_scales.min())))
        said.append(
            f"all scales are positive, as after the exponential; 3DGS stores logarithms, of which the smallest here is"
            f" a size of {smallest:.3g}"
        )
    if dc.min() >= 0 and (dc.max() > COLOR_MAX or (dc.max() <= 1 and np.ptp(dc) > 0)):
        white = 1 if dc.max() <= 1 else 255
        said.append(f"all f_dc are between 0 and {white}, like colours; 3DGS stores (colour - 0.5) / 0.282")
    return said


def _are_sizes(means: Floats, log_scales: Floats) -> bool:
    """Return whether positive logarithms would be sizes that the scene cannot have."""
    median = float(np.median(log_scales))
    low, high = np.quantile(means, (0.01, 0.99), axis=0).astype(np.float64)
    extent = float(np.linalg.norm(high - low))
    return median < LOG_SCALE_LOW or median > np.log(max(SHARE_OF_EXTENT * extent, np.finfo(np.float64).tiny))
