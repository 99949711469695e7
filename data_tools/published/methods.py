"""The tables of 3DGS, 3DGS-accel, Mini-Splatting and Mini-Splatting2."""

from data_tools.published.repositories import (
    GS_ARGUMENTS,
    GS_MODEL,
    GS_TRAIN,
    MS2_ARGUMENTS,
    MS2_CONFIG,
    MS2_D_TRAIN,
    MS2_MODEL,
    MS2_TRAIN,
    MS_ARGUMENTS,
    MS_D_TRAIN,
    MS_MODEL,
    MS_TRAIN,
    TAMING_ARGUMENTS,
    TAMING_MODEL,
)
from data_tools.published.rows import (
    between,
    code,
    every,
    has,
    kept,
    once,
    ours,
    paper,
    says,
    steps,
    without,
)

POSITION_RATE = ("position_lr_init", "position_lr_final", "position_lr_max_steps")
DENSITY_CONTROL = ("collect_gradients", "clone_and_split", "prune_", "reset_opacity")  # of 3DGS, by how names begin
EACH_THOUSAND = r"iteration % (\d+) == 0:\s+gaussians\.oneupSHdegree"

GS = {
    **paper("3DGS, equation (7)", photometric=(1.0, 1)),
    **code(
        GS_ARGUMENTS,
        photometric__dssim_weight=says(0.2, "lambda_dssim"),
        iterations=says(30_000, "iterations"),
        rate__means=says((1.6e-4, 1.6e-6, 30_000), *POSITION_RATE),
        rate__quats=says(0.001, "rotation_lr"),
        rate__log_scales=says(0.005, "scaling_lr"),
        rate__opacity_logits=says(0.05, "opacity_lr"),
        rate__sh_dc=says(0.0025, "feature_lr"),
        collect_gradients=between(0, 15_000, "densify_until_iter"),
        clone_and_split=every(500, 15_000, 100, "densify_from_iter", "densify_until_iter", "densification_interval"),
        clone_and_split__threshold=says(2e-4, "densify_grad_threshold"),
        clone_and_split__size_fraction=says(0.01, "percent_dense"),
        prune_faint=every(500, 15_000, 100, "densify_from_iter", "densify_until_iter", "densification_interval"),
        prune_large=every(3_000, 15_000, 100, "opacity_reset_interval", "densify_until_iter", "densification_interval"),
        reset_opacity=says(
            [steps(3_000, 12_000, 3_000)], "opacity_reset_interval", "densify_until_iter", numbers=(3_000, 15_000)
        ),
        reset_opacity_on_white=once(500, "densify_from_iter"),
    ),
    **code(
        GS_MODEL,
        rate__sh_rest=says(0.000125, r"feature_lr / ([\d.]+)", numbers=(20,)),
        adam=says((False, True, 0.9, 0.999, 1e-15), r"eps=([\de.-]+)", numbers=(1e-15,)),
        per_extent=has(["means"], "training_args.position_lr_init * self.spatial_lr_scale"),
        prune_large__size_fraction=says(0.1, r"> ([\d.]+) \* extent"),
        reset_opacity__ceiling=says(0.01, r"get_opacity\)\*([\d.]+)\)"),
        reset_opacity_on_white__ceiling=says(0.01, r"get_opacity\)\*([\d.]+)\)"),
    ),
    **code(
        GS_TRAIN,
        sh_degree=says((3, 1_000, 2_000, 3_000), EACH_THOUSAND, numbers=(1_000,)),
        prune_faint__min_opacity=says(0.005, r"densify_grad_threshold, ([\d.]+), scene"),
    ),
    **ours("a training needs a photograph", min_views=1),
    **ours(
        "they concern runs shorter than published",
        short_run_exponent=0.0,
        clone_and_split__min_gap=100,
        prune_faint__min_gap=100,
        prune_large__min_gap=100,
        reset_opacity__min_gap=300,
    ),
}

GS_ACCEL = GS | {
    **code(TAMING_ARGUMENTS, rate__opacity_logits=says(0.025, "opacity_lr")),
    **code(
        TAMING_MODEL,
        adam=says(
            (True, False, 0.9, 0.999, 1e-15),
            r"SparseGaussianAdam\(l \+ sh_l, lr=0\.0, eps=([\de.-]+)",
            numbers=(1e-15,),
        ),
    ),
    **kept(
        "the rate of 3DGS, where Taming 3DGS has twice that (both are divided by 20)",
        TAMING_ARGUMENTS,
        rate__sh_rest=says(0.000125, "shfeature_lr", numbers=(0.005,)),
    ),
}

DENSIFIED = steps(600, 14_900, 100, but=(5_000, 10_000))
_SKIPPED = r"iteration % (\d+)!=0"
MINI_SPLATTING_D = {
    **without(GS, "reset_opacity", "prune_large"),
    **paper("Mini-Splatting, section 4.1 and equation (2)", reinitialise_from_depth__points_of="midpoint_points"),
    **code(
        MS_ARGUMENTS,
        collect_blur=between(0, 15_000, "densify_until_iter"),
        store_sh=once(15_000, "densify_until_iter"),
        store_sh__sh_degree=says(3, "sh_degree"),
        restart_from_means=once(15_000, "densify_until_iter"),
        restart_from_means__sh_degree=says(3, "sh_degree"),
    ),
    **code(
        MS_D_TRAIN,
        collect_blur__area_fraction=says(2e-4, r"image\.shape\[2\]/(\d+)\)", numbers=(5_000,)),
        reinitialise_from_depth=says([[5_000, 10_000]], r"if iteration%(\d+)==0", numbers=(5_000,)),
        sh_degree=says(
            (0, 16_000, 17_000, 18_000),
            r"iteration % (\d+) == 0 and iteration>opt\.densify_until_iter",
            numbers=(1_000,),
        ),
        rate__means=says(
            (1.6e-4, 1.6e-6, 30_000, 15_000, 5_000), r"iteration-opt\.densify_until_iter\+(\d+)", numbers=(5_000,)
        ),
        clone_and_split=says([DENSIFIED], _SKIPPED, numbers=(5_000,)),
        prune_faint=says([DENSIFIED], _SKIPPED, numbers=(5_000,)),
        prune_large_by_distance=says([steps(3_100, 14_900, 100, but=(5_000, 10_000))], _SKIPPED, numbers=(5_000,)),
    ),
    **code(
        MS_MODEL,
        clone_and_split__draw_children=has("random_children", "samples = torch.normal(mean=means, std=stds)"),
        prune_large_by_distance__size_fraction=says(0.1, r"> ([\d.]+) \* extent"),
    ),
    **ours(
        "smaller photographs, sky and bare walls, short runs",
        collect_blur__min_area=64,
        reinitialise_from_depth__points_per_gaussian=1.0,
        reinitialise_from_depth__min_alpha=0.0,
        reinitialise_from_depth__depth_tolerance=0.05,
        reinitialise_from_depth__backdrop_extents=30.0,
        prune_large_by_distance__min_gap=100,
        restart_from_means__largest_size=0.1,  # of the extent or the distance, as pruned; the release has no limit here
        reinitialise_from_depth__largest_size=0.1,
        min_views=3,
        short_run_exponent=0.45,
    ),
}
MINI_SPLATTING = MINI_SPLATTING_D | {
    **paper("Mini-Splatting, appendix E, for indoor scenes", simplify__metric="indoor", prune_tail__metric="indoor"),
    **code(
        MS_TRAIN,
        simplify=once(15_000, "simp_iteration1"),
        simplify__choose=has("by_sampling", "np.random.choice"),
        simplify__keep_fraction=says(0.5, "sampling_factor"),
        simplify__is_intersecting=has(True, "prob"),
        prune_tail=once(20_000, "simp_iteration2"),
        prune_tail__mass=says(0.99, r"imp_score, thres=(0\.99)\)"),
        prune_tail__is_intersecting=has(True, "non_prune_mask"),
        restart_adam=once(20_000, "simp_iteration2"),
    ),
    **ours("a number of Gaussians can be asked for instead", simplify__budget=None),
}

_DENSIFIED_2 = steps(600, 2_900, 100, but=(2_000,))
MINI_SPLATTING2_COMMON = {
    **without(MINI_SPLATTING_D, "prune_large", "restart_", "rate.means"),
    **code(
        MS2_CONFIG,
        iterations=says(18_000, "iterations"),
        collect_gradients=between(0, 3_000, "densify_until_iter"),
        collect_blur=between(0, 3_000, "densify_until_iter"),
        clone_and_split=says([_DENSIFIED_2], "densify_until_iter", "depth_reinit_iter", numbers=(3_000, 2_000)),
        prune_faint=says([_DENSIFIED_2], "densify_until_iter", "depth_reinit_iter", numbers=(3_000, 2_000)),
    ),
    **code(
        MS2_ARGUMENTS,
        rate__means=says((1.6e-4, 1.6e-6, 30_000), *POSITION_RATE),
        rate__opacity_logits=says(0.025, r"self\.opacity_lr = (0\.05)/2", numbers=(0.05,)),
    ),
    **code(
        MS2_TRAIN,
        adam=has((True, True, 0.9, 0.999, 1e-15), "optimizer"),
        sh_degree=says(
            (0, 4_000, 5_000, 6_000),
            r"iteration % (\d+) == 0 and iteration>args\.simp_iteration1",
            "simp_iteration1",
            numbers=(1_000, 3_000),
        ),
        halve_large_views=says([steps(1, 3_000)], "warn_until_iter", numbers=(3_000,)),
        halve_large_views__max_halvings=says(1, r"scale2=([\d.]+)", numbers=(2.0,)),
        reinitialise_from_depth=once(2_000, "depth_reinit_iter"),
        aggressive_clone=says(
            [steps(500, 2_750, 250, but=(2_000,))],
            "aggressive_clone_from_iter",
            "aggressive_clone_interval",
            "depth_reinit_iter",
            numbers=(500, 250, 2_000),
        ),
        store_sh=once(3_000, "simp_iteration1"),
        stop_culling=says(
            [[13_000]], "simp_iteration2", r"\(args\.simp_iteration2\+opt\.iterations\)//(\d)", numbers=(8_000, 2)
        ),
    ),
    **code(
        MS2_MODEL,
        reinitialise_from_depth__drawn_mass=says(0.99, r"imp_score, thres=(0\.99)\)"),
        aggressive_clone__critical=has(
            "critical_by_mass", "intersection_pts_mask = init_cdf_mask(importance=imp_score, thres=0.99)"
        ),
        aggressive_clone__factor=says(2, r"new_scaling = \(temp_opacity_old / \((\d)\*new_opacity"),
        aggressive_clone__tail_mass=says(
            0.999, r"non_prune_mask = init_cdf_mask\(importance=imp_score, thres=(0\.999)\)"
        ),
        aggressive_clone__min_views=says(2, r"\(count_vis<=(\d)\)", numbers=(1,)),
        aggressive_clone__visibility_mass=says(0.99, r"importance=accum_weights, thres=([\d.]+)\)"),
        prune_tail__mass=says(0.99, r"imp_score, thres=(0\.99)\)"),
        prune_tail__min_views=says(2, r"\(count_vis<=(\d)\)", numbers=(1,)),
    ),
    **paper("Mini-Splatting, appendix E, for indoor scenes", prune_tail__metric="indoor"),
    **ours(
        "a limit of growth, and views that are small already",
        aggressive_clone__max_per_pixel=0.1,
        clone_and_split__max_per_pixel=0.1,
        halve_large_views__min_side=100,
    ),
}
MINI_SPLATTING2 = {
    **MINI_SPLATTING2_COMMON,
    **paper("Mini-Splatting, appendix E, for indoor scenes", simplify__metric="indoor"),
    **code(
        MS2_TRAIN,
        simplify=once(3_000, "simp_iteration1"),
        simplify__keep_fraction=says(0.6, "sampling_factor"),
        prune_tail=once(8_000, "simp_iteration2"),
        simplify__is_intersecting=has(True, "gaussians.culling_with_interesction_sampling"),
        prune_tail__is_intersecting=has(True, "gaussians.culling_with_interesction_preserving"),
    ),
    **code(
        MS2_MODEL,
        simplify__choose=has("by_sampling", "np.random.choice"),
        simplify__min_views=says(2, r"\(count_vis<=(\d)\)", numbers=(1,)),
        simplify__visibility_mass=says(0.99, r"importance=accum_weights, thres=([\d.]+)\)"),
    ),
    **ours("a number of Gaussians can be asked for instead", simplify__budget=None),
}
MINI_SPLATTING2_D = {
    **MINI_SPLATTING2_COMMON,
    **code(
        MS2_D_TRAIN,
        prune_tail=says([[3_000], [8_000]], "simp_iteration1", "simp_iteration2", numbers=(3_000, 8_000)),
        prune_tail__is_intersecting=has(False, "gaussians.culling_with_importance_pruning"),
    ),
    **code(MS2_MODEL, prune_tail__visibility_mass=says(0.99, r"importance=accum_weights, thres=([\d.]+)\)")),
}
