"""All numbers of ``adaptive``, each with its meaning, its unit, and the reason for its value as far as one is recorded.

Letters name the sections of ``docs/measured/adaptive.md``. ``--set`` reaches those that an action takes as a setting.
Three numbers are shared with others: how far halves are apart (:data:`minisplat_ref.strategy.halving.OFFSET`), the
minimum side of halved views (:data:`minisplat_ref.training.smaller_views.SIDE_MIN`), and the measurements to fit a line
through (:data:`minisplat_ref.training.pace.MEASUREMENTS_MIN`).
"""

# --- the recipe ---

ITERATIONS_MAX = 30_000
"""Iterations; a limit, as many as 3DGS trains. No reason recorded."""
TRAIN_VIEWS_MIN = 3
"""Training views that the recipe needs. With three it is above recipes with a schedule on fern (W); two were not
tried."""
RAISED = 2.24
"""Factor of the rates of ``3dgs-accel``: 6^0.45, as Mini-Splatting2's rates in a sixth of its iterations. For the
means, too, and not its square: a Gaussian that overshoots does not settle while the rates are constant (A)."""
DEGREE_STEPS = (2, 2, 2)
"""Iterations at which degrees 1 to 3 would begin for Gaussians without their own degree, which all have after
the first iteration."""
PERIOD = 100
"""Iterations from one growth to the next, and from one measurement to the next. No reason recorded."""
FAINT = 0.005
"""Opacity below which Gaussians are removed every 100 iterations, as in 3DGS."""

# --- growth ---

GRADIENT_MIN = 4e-4
"""Mean length of the screen gradient, in normalised device coordinates, from which Gaussians are halved. Measured
beside multiples from a half to eight (F)."""
GROWTH_MAX = 0.2
"""Fraction of the Gaussians that are halved at a time, at most. Measured beside greater ones at half the threshold
(F)."""
ERROR_VIEWS = 24
"""Views in which the error is looked for, at most. The order by error is worth 0.04 dB on the room (B); no reason
recorded for 24."""

# --- view dependence ---

VIEWS_PER_COEFFICIENT = 1.5
"""Training views for each coefficient of a channel of the colour. Fewer are a matter of taste (G)."""
VARIATION_MIN = 4 / 255
"""Standard deviation of a degree's part of the colour, out of 1, below which the degree is removed: a degree that is
hardly visible is not worth its parameters. Without this rule the room has 309,102 numbers, not 224,855, and 27.57 dB,
not 27.59 (B)."""

# --- measurement, the next size, and the end ---

HOLD_OUT_EVERY = 8
"""One in this many training views is held out. No reason recorded."""
HOLD_OUT_FROM = 2 * HOLD_OUT_EVERY
"""Training views from which on some are held out. Two are the least that have a standard error, and of fewer views
than this they would be a greater part than one in HOLD_OUT_EVERY (W)."""
VIEW_SIDE_MIN = 120
"""Pixels: no side of a halved view is shorter. With 60 some scenes gain, but on snowmiku calibrations were found
where there are none (J)."""
WHOLE_VIEWS_UNTIL = 1
"""Iteration after which large views are halved. No reason recorded."""
SLOPE_MIN = 0.3
"""dB for each doubling of the work that held-out views must gain for a training to continue as it is. Leaving small
views at 1 dB is much faster on fox and snowmiku, and ends lower (J)."""
DECISION_STEP_MIN = 800
"""Iteration before which nothing is decided: the first measurements rise steeply."""
COOLING_PART = 0.6
"""Length of the cool-down, as a fraction of the iterations before it. No reason recorded; without a cool-down the
room loses 0.2 dB (B)."""
COOLING_LAST, COOLING_LAST_PER_EXTENT = 0.1, 0.01
"""Factors of the rates at the end of the cool-down, and of those per unit of the extent. No reason recorded."""

# --- calibrations ---

SKY_STEP = 100
"""Iteration in which a sky is considered. No reason recorded for 100; large Gaussians have covered it by then
(H)."""
ANTIALIASING_STEP = 650
"""Iteration in which anti-aliasing is considered: after a few hundred, the scene is a blur in the right place. It comes
before poses, which in the other order were wrongly on in half of the trials with two sizes on the room (D)."""
POSE_STEP = 700
"""Iteration in which poses are considered, after anti-aliasing."""
GAIN_MIN = 0.1
"""dB of the squared error for which a calibration is worthwhile. With 0.05 dB exposures, which were once judged by it,
too, came on in some trials of brighton_beach, and cost 1.2 dB (D)."""
N_ERRORS = 1.0
"""Standard errors that the gain of a calibration must exceed. With two, one of ten planted gains was found on banana,
where eleven photographs provide the evidence (D)."""
RIDGE = 1e-3
"""Of the mean square of a field over the halves: where next to nothing is rendered, x would be arbitrary."""

# --- a sky ---

SKY_GAIN_MIN = 3.0
"""dB of the squared error, where a sky shows: it explains nearly all that is there. The skies of *outdoor* and
*glossy* explain 5 dB and more, bare walls up to 2.05; most that are planted in *glossy* explain less, too (H)."""
SKY_N_ERRORS = 3.0
"""Standard errors that the gain of a sky must exceed: nearly all photographs gain by it, because they see one sky."""
LARGE, HUGE = 0.25, 1.0
"""Standard deviation along the longest axis, in units of the scene's extent: to question a Gaussian, and to remove
it. The extent is the path of the cameras; no reason recorded for a quarter."""
SKY_RIDGE = 1e-3
"""Of the mean diagonal entry of the normal matrix: directions that no photograph shows get no large colour."""
SKY_VIEWS_MAX = 24
"""Photographs that are looked at, evenly spread, at most. No reason recorded."""
SKY_VIEWS_MIN = 4
"""Photographs that must show something behind the scene: two to fit, two to judge."""
OPEN = 0.5
"""Transmittance above which a pixel shows the background. No reason recorded."""
OPEN_MIN = 0.005
"""Fraction of a photograph's pixels that must be open: fewer are no evidence."""

# --- veils ---

VEIL_SHARE = 0.5
"""Of a Gaussian's weight on the rays of sparse points, above which it is a veil: more of it is before the points than
at or behind them."""
VEIL_WEIGHT_MIN = 0.1
"""Weight before points, in opaque pixels, below which a Gaussian is left alone: a tenth of one pixel."""
VEIL_START = 500
"""Iteration before which nothing is removed: until then Gaussians are large and lie on several surfaces."""
VEIL_VIEWS_MAX, VEIL_RAYS_MAX = 8, 256
"""Training views that are looked at each time, and rays of each, at most, so that this takes a small part of the time:
a quarter of a second, every 100 iterations."""
CLEARANCE = 0.5
"""Radius of the free ball around a camera, in units of the distance of its nearest sparse points. The other half of the
way is for surfaces between these points: those of a wall may be 2.4 times as far apart as the wall is from the camera
before it lies within half of their distance."""
CLEARANCE_SIGMAS = 1.0
"""Standard deviations that a Gaussian is blurred by the ball. With two, bare walls that training has not yet sharpened
count as fog: 78 of their Gaussians, not 22 (M)."""

MASK_SHARE = 0.5
"""Of a Gaussian's weight in training views, below which masks say that it is not of the scene: more of it is where no
pixel counts than where one does (R)."""
MASK_VIEWS_MAX = 24
"""Photographs with masks that are looked at each time, at most, as many as for a sky."""

# --- pruning ---

SEEN_BY_MIN = 2
"""Views that must see a Gaussian when the first slice comes. No reason recorded."""
REMOVAL_SLOPE_MIN = 1.0
"""Relative rise of the squared error over the relative fall of the count, from which a Gaussian stays: 3 dB for each
doubling of the count, before training adapts the others to replace it. Less keeps more Gaussians for under 0.1 dB
(C)."""
PRUNED_MAX = 0.2
"""Fraction of the Gaussians in a slice, at most. No reason recorded."""
PSNR_COST_MAX, SSIM_COST_MAX = 0.1, 0.005
"""dB and SSIM that the prune may cost on held-out training views, in all slices together (L)."""
N_UNPRUNED = 5
"""Moments before that of the first slice at which held-out views are measured, while the rates fall, to predict what
they would have without a prune (S)."""
N_SLICES = 8
"""Slices, at most. At once, all of several Gaussians that replace each other would go (C); no reason recorded for
eight."""
LAST_SLICE = 0.64
"""Part of the cool-down after which no slice comes, so that it can converge. Later slices were tried and are no
better (C)."""
GAP_MIN = 20
"""Iterations from slice to slice, in which training adapts the others to replace what is gone."""
SLICE_MIN = 0.01
"""Fraction of the Gaussians; a smaller slice is not worth a disturbance."""
