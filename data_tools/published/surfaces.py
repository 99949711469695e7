"""The tables of the relatives that train surfels."""

from data_tools.published.methods import GS, GS_ACCEL
from data_tools.published.repositories import (
    REFLECTIVE_ARGUMENTS,
    REFLECTIVE_MODEL,
    REFLECTIVE_TRAIN,
    SDF_ARGUMENTS,
    SDF_MODEL,
    SDF_SCRIPT,
    SDF_TRAIN,
    SURFELS_ARGUMENTS,
    SURFELS_FORWARD,
    SURFELS_TRAIN,
    TEXTURE_ARGUMENTS,
    TEXTURE_MODEL,
)
from data_tools.published.rows import (
    Table,
    after,
    between,
    code,
    every,
    has,
    kept,
    once,
    ours,
    paper,
    says,
    select,
    steps,
    without,
)

_LOW_PASS = code(SURFELS_FORWARD, render__low_pass_cutoff=says(3.0, r"float cutoff = ([\d.]+)f;"))
_OPACITY_CULL = code(SURFELS_ARGUMENTS, prune_faint__min_opacity=says(0.05, "opacity_cull"))
_LATE_NORMALS = says(
    (0.05, 7_001), r"lambda_normal if iteration > (\d+)", numbers=(7_000,)
)  # the weight is an argument
_LATE_DISTORTION = says((0.0, 3_001), r"lambda_dist if iteration > (\d+)", numbers=(3_000,))
_HOUSE_OPTIMISER = "all relatives have the optimiser of 3dgs-accel, with which they are compared"

SURFELS: Table = {
    **without(GS_ACCEL, "prune_faint.min_opacity"),
    **_OPACITY_CULL,
    **_LOW_PASS,
    **code(
        SURFELS_TRAIN,
        normal_consistency=_LATE_NORMALS,
        median_normal_consistency=says((0.0, 7_001), r"lambda_normal if iteration > (\d+)", numbers=(7_000,)),
        distortion=_LATE_DISTORTION,
    ),
    **kept(_HOUSE_OPTIMISER, SURFELS_ARGUMENTS, rate__opacity_logits=says(0.025, "opacity_lr", numbers=(0.05,))),
}

MVG: Table = {
    **without(GS_ACCEL, "prune_faint.min_opacity"),
    **_OPACITY_CULL,
    **_LOW_PASS,
    **code(SURFELS_TRAIN, filtered_normals=_LATE_NORMALS),
    **paper("MVSNet (Yao et al. 2018), fusion of depth maps: a pixel and 1 %", insert_consistent__n_views=2),
    **ours(
        "no released code was found, and the paper gives no value",
        depth_steps=(0.1, 7_001),
        depth_steps__sharpness=10.0,
        insert_consistent=[steps(2_500, 10_000, 2_500)],
        insert_consistent__n_sources=4,
        insert_consistent__near_stride=4,
        insert_consistent__far_stride=2,
        insert_consistent__min_gap=20,
    ),
}

_DATES = ("densify_from_iter", "densify_until_iter", "densification_interval_when_prop")
_DEFERRED = "volume_render_until_iter"
REFLECTIVE: Table = {
    **select(GS_ACCEL, "photometric", "adam", "per_extent", "rate.means", "rate.quats", "rate.log_scales"),
    **select(GS_ACCEL, "min_views", "short_run_exponent", "reset_", "clone_and_split.", "prune_"),
    **code(
        REFLECTIVE_ARGUMENTS,
        iterations=says(50_000, "iterations"),
        rate__opacity_logits=says(0.05, "opacity_lr"),
        rate__sh_dc=says(0.0075, "features_lr"),
        rate__albedo_logits=says(0.0075, "ori_color_lr"),
        rate__metallic_logits=says(0.005, "refl_strength_lr"),
        rate__roughness_logits=says(0.005, "roughness_lr"),
        rate__around_dc=says(0.0075, "indirect_lr"),
        rate__log_environment=says(0.01, "envmap_cubemap_lr"),
        normal_consistency=after(0.05, 0, "lambda_normal_render_depth", "normal_loss_start"),
        collect_gradients=between(0, 25_000, "densify_until_iter"),
        clone_and_split=every(500, 25_000, 500, *_DATES, but=(18_000,)),
        prune_faint=every(500, 25_000, 500, *_DATES, but=(18_000,)),
        prune_faint__min_opacity=says(0.05, "prune_opacity_threshold"),
        prune_large=says(
            [steps(3_500, 24_500, 500, but=(18_000,))],
            "opacity_reset_interval",
            "densify_until_iter",
            "densification_interval_when_prop",
            numbers=(3_000, 25_000, 500),
        ),
        reset_opacity=says(
            [steps(3_000, 24_000, 3_000, but=(18_000,))],
            "opacity_reset_interval",
            "densify_until_iter",
            _DEFERRED,
            numbers=(3_000, 25_000, 18_000),
        ),
        spread_normals=says(
            [[step for step in steps(1_000, 24_000, 1_000) if step % 3_000]],
            "normal_prop_interval",
            "normal_prop_until_iter",
            "opacity_reset_interval",
            numbers=(1_000, 25_000, 3_000),
        ),
        spread_normals__growth=says(1.5, "enlarge_scale"),
        spread_normals__metallic=says(0.02, "refl_msk_thr"),
        spread_normals__roughness=says(0.01, "rough_msk_thr"),
        restart_materials=once(18_000, _DEFERRED),
        shade_by=says([[18_000], [20_000]], _DEFERRED, "indirect_from_iter", numbers=(18_000, 20_000)),
        sh_degree=says((3, 6_000, 7_000, 8_000), "sh_degree", "feature_rest_from_iter", numbers=(3, 5_000)),
    ),
    **code(
        REFLECTIVE_MODEL,
        rate__sh_rest=says(0.000375, r"features_lr / ([\d.]+)", numbers=(20,)),
        rate__around_rest=says(0.000375, r"indirect_lr / ([\d.]+)", numbers=(20,)),
        spread_normals__opacity=says(0.9, "RESET_V"),
        spread_normals__disturbance=says(0.4, "DIST_RANGE"),
    ),
    **code(REFLECTIVE_TRAIN, shade_by__stage=has([1, 2], "opt.indirect = 1", "reset_gaussian_para(gaussians, opt)")),
    **ours(
        "reflections can be left out; what an event sets; short runs",
        rate__shading_stage=0.0,
        render__mirrors=True,
        spread_normals__min_gap=100,
    ),
}

TEXTURE_SPLAT: Table = {
    **select(GS, "photometric", "rate", "adam", "per_extent", "min_views", "short_run_exponent"),
    **select(REFLECTIVE, "rate."),
    **code(
        TEXTURE_ARGUMENTS,
        iterations=says(30_000, "iterations", "texture_from_iter", numbers=(60_000, 30_000)),
        rate__normal_textures=says(1e-3, "normal_lr"),
        extend__texels=says(4, "texture_size"),
        normal_consistency=after(0.05, 0, "lambda_normal_render_depth", "normal_loss_start"),
        sh_degree=says((3, 0, 0, 0), "sh_degree", numbers=(3,)),
    ),
    **code(TEXTURE_MODEL, rate__means=has(0.0, "self._xyz.requires_grad_(False)")),
}

_LIGHT_RATE = ("envmap_lr_init", "envmap_lr_final", "envmap_lr_max_steps")
_OF_SCHEDULE = '["envmap", "roughness", "f_dc", "f_rest", "metallic", "albedo"]'
_SHADING_RATE = has((1.6e-2, 1.6e-3, 30_000), _OF_SCHEDULE, "self.envmap_scheduler_args)(iteration)")
DISCRETIZED_SDF: Table = {
    **{name.replace("reset_opacity", "reset_distances"): row for name, row in GS_ACCEL.items()},
    **code(
        SDF_ARGUMENTS,
        extend__foreground=has(0.0, "self.sphere_init = False"),
        projection__reach=says(0.1, "proj_thres"),
        distortion=after(100.0, 1_000, "lambda_distortion", "dist_from_iteration"),
        rate__quats=says(0.002, "rotation_lr"),
        rate__log_scales=says(0.035, "scaling_lr", numbers=(0.007,)),
        rate__distances=says(0.05, "sdf_lr"),
        rate__log_width=says(5e-3, "deviation_lr"),
        rate__log_environment=says((1.6e-2, 1.6e-3, 30_000), *_LIGHT_RATE),
        prune_faint__min_opacity=says(0.005, "opacity_cull"),
    ),
    **code(
        SDF_MODEL,
        rate__albedo_logits=_SHADING_RATE,
        rate__metallic_logits=_SHADING_RATE,
        rate__roughness_logits=_SHADING_RATE,
    ),
    **code(
        SDF_SCRIPT,
        normal_consistency=says((0.2, 1), r"--lambda_predicted_normal ([\d.]+)", numbers=(0.2,)),
        silhouette=says((0.2, 1), r"--lambda_zero_one ([\d.]+)", numbers=(0.2,)),
        base_smoothness=says((0.02, 1), r"--lambda_base_smoothness ([\d.]+)", numbers=(0.02,)),
        neutral_light=says((0.001, 1), r"--lambda_light_reg ([\d.]+)", numbers=(0.001,)),
        projection=says((5.0, 1_001), r"--lambda_proj ([\d.]+)", numbers=(5.0,)),
    ),
    **code(SDF_TRAIN, median=says((1.0, 1_001), r"gaussians\.use_sdf and iteration > (\d+)", numbers=(1_000,))),
    **ours(
        "what is not trained, and opacities for others",
        rate__shading_stage=0.0,
        rate__opacity_logits=0.0,
        rate__sh_dc=0.0,
        rate__sh_rest=0.0,
        refresh_opacities=[steps(1, 30_000)],
        render__mirrors=True,
    ),
}
