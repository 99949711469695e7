"""The recipe ``adaptive``: the schedule of its rules, with numbers of :mod:`minisplat_ref.methods.adaptive.numbers`."""

from functools import partial

from minisplat_ref.methods.adaptive import numbers
from minisplat_ref.methods.adaptive.degrees import cut_degrees_when_cooling, raise_degrees
from minisplat_ref.methods.adaptive.growth import collect_while_growing, grow
from minisplat_ref.methods.adaptive.pose import hold_mean_pose, turn_held_out
from minisplat_ref.methods.adaptive.progress import measure_progress, proceed_when_little_is_gained
from minisplat_ref.methods.adaptive.prune import prune_in_slices
from minisplat_ref.methods.adaptive.switches import switch_antialiasing_on, switch_pose_on, switch_sky_on
from minisplat_ref.methods.adaptive.veils import remove_veils
from minisplat_ref.methods.gaussian_splatting import GS, GS_ACCEL, prune_faint
from minisplat_ref.strategy.halving import OFFSET
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.calibration import REFINED
from minisplat_ref.training.exposure_gauge import hold_mean_exposure
from minisplat_ref.training.pace import Cooling
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.schedule import At, During, Every, SmallerViews
from minisplat_ref.training.smaller_views import halve_large_views

_always = partial(During, reads_parameters=False)  # those that seldom do call iteration.fetch()
_regularly = partial(Every, numbers.PERIOD, start=numbers.PERIOD)  # not in the first of these iterations

ADAPTIVE = GS._replace(
    name="adaptive",
    iterations=numbers.ITERATIONS_MAX,
    learning_rates=Rates(
        {name: numbers.RAISED * rate for name, rate in GS_ACCEL.learning_rates.at(0, extent=1.0).items()}
    ),
    adam=AdamRule(is_visible_only=True, has_bias_correction=True),
    sh_milestones=numbers.DEGREE_STEPS,
    events=(
        SmallerViews(
            partial(halve_large_views, min_side=numbers.VIEW_SIDE_MIN),
            start=numbers.WHOLE_VIEWS_UNTIL,
        ),
        _always(collect_while_growing),
        _always(partial(raise_degrees, views_per_coefficient=numbers.VIEWS_PER_COEFFICIENT)),
        _always(hold_mean_exposure),
        _always(hold_mean_pose),
        At(numbers.SKY_STEP, partial(switch_sky_on, min_sky_gain=numbers.SKY_GAIN_MIN)),
        At(numbers.ANTIALIASING_STEP, partial(switch_antialiasing_on, min_antialiasing_gain=numbers.GAIN_MIN)),
        At(numbers.POSE_STEP, partial(switch_pose_on, min_pose_gain=numbers.GAIN_MIN)),
        _regularly(turn_held_out),
        _regularly(measure_progress),
        _regularly(
            partial(proceed_when_little_is_gained, min_gain=numbers.SLOPE_MIN, min_step=numbers.DECISION_STEP_MIN)
        ),
        _regularly(
            partial(
                grow,
                threshold=numbers.GRADIENT_MIN,
                max_growth=numbers.GROWTH_MAX,
                offset=OFFSET,
                error_views=numbers.ERROR_VIEWS,
                budget=None,
            )
        ),
        _regularly(partial(prune_faint, min_opacity=numbers.FAINT)),
        _regularly(
            partial(
                remove_veils,
                max_share_before=numbers.VEIL_SHARE,
                min_weight_before=numbers.VEIL_WEIGHT_MIN,
                clearance=numbers.CLEARANCE,
                min_share_counted=numbers.MASK_SHARE,
                start=numbers.VEIL_START,
            )
        ),
        _always(
            partial(
                prune_in_slices,
                min_views=numbers.SEEN_BY_MIN,
                min_slope=numbers.REMOVAL_SLOPE_MIN,
                max_pruned=numbers.PRUNED_MAX,
                max_psnr_cost=numbers.PSNR_COST_MAX,
                max_ssim_cost=numbers.SSIM_COST_MAX,
            )
        ),
        _always(partial(cut_degrees_when_cooling, min_variation=numbers.VARIATION_MIN)),
    ),
    min_views=numbers.TRAIN_VIEWS_MIN,
    starts_densely=True,
    exposure=REFINED,
    cooling=Cooling(
        numbers.COOLING_PART,
        numbers.COOLING_LAST,
        numbers.COOLING_LAST_PER_EXTENT,
        numbers.HOLD_OUT_EVERY,
        numbers.HOLD_OUT_FROM,
        prune_passes=numbers.N_SLICES + 1,
    ),
)
"""``adaptive``."""
