"""The tables of the other relatives, and those of all recipes by name."""

from data_tools.published.methods import (
    DENSITY_CONTROL,
    GS,
    GS_ACCEL,
    MINI_SPLATTING,
    MINI_SPLATTING2,
    MINI_SPLATTING2_D,
    MINI_SPLATTING_D,
)
from data_tools.published.repositories import (
    EOGS2,
    EOGS_ARGUMENTS,
    EOGS_CAMERAS,
    EOGS_SCRIPT,
    EOGS_TRAIN,
    FANS,
    GAMES_ARGUMENTS,
    GAUSTUDIO_SKY,
    HEADSET,
    MCMC_ARGUMENTS,
    MCMC_MODEL,
    MCMC_TRAIN,
    MIP_MODEL,
    MIP_TRAIN,
    OMG_ARGUMENTS,
    OMG_README,
    SCAFFOLD_ARGUMENTS,
    SURFELS_TRAIN,
    TEXTURED,
    VDGS_ARGUMENTS,
)
from data_tools.published.rows import (
    Table,
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
from data_tools.published.surfaces import DISCRETIZED_SDF, MVG, REFLECTIVE, SURFELS, TEXTURE_SPLAT

_OF_NETWORK = ("weights", "biases")

ANTIALIASING: Table = {
    **{name.replace("reset_opacity", "reset_smoothed_opacity"): row for name, row in GS_ACCEL.items()},
    **code(
        MIP_TRAIN,
        measure_filters=says([[1], steps(100, 30_000, 100)], r"if iteration % (\d+) == 0 and", numbers=(100,)),
    ),
    **code(
        MIP_MODEL,
        measure_filters__variance=says(0.2, r"focal_length \* \(([\d.]+) \*\*"),
        rate__filter_sigmas=has(0.0, "self.filter_3D = filter_3D[..., None]"),
    ),
    **ours("half that of densification", measure_filters__min_gap=50),
}

_RELOCATED = ("densify_from_iter", "densify_until_iter", "densification_interval")
MCMC: Table = {
    **without(GS, *DENSITY_CONTROL),
    **code(
        MCMC_ARGUMENTS,
        relocate=every(500, 25_000, 100, *_RELOCATED),
        add_copies=every(500, 25_000, 100, *_RELOCATED),
        add_noise=between(0, 30_000, "iterations"),
        add_noise__noise=says(5e5, "noise_lr"),
        opacity_reg=says((0.01, 1), "opacity_reg", numbers=(0.01,)),
        scale_reg=says((0.01, 1), "scale_reg", numbers=(0.01,)),
        add_copies__budget=says(None, "cap_max", numbers=(-1,)),
    ),
    **code(
        MCMC_TRAIN,
        relocate__dead_opacity=says(0.005, r"get_opacity <= ([\d.]+)\)"),
    ),
    **code(
        MCMC_MODEL,
        add_copies__growth=says(0.05, r"int\(([\d.]+) \* current_num_points", numbers=(1.05,)),
        extend__initial_opacity=says(0.5, r"opacities = inverse_sigmoid\(([\d.]+) \*"),
        extend__initial_size=says(0.1, r"torch\.sqrt\(dist2\)\*([\d.]+)\)"),
    ),
    **ours(
        "the release asks for a cap: in its examples 0.003 to 0.034 a pixel; short runs see ten photographs between",
        add_copies__per_pixel=0.03,
        relocate__min_gap=10,
        add_copies__min_gap=10,
    ),
}

MICRO: Table = {
    **without(GS_ACCEL, "clone_and_split"),
    "clone_and_split_by_detail": GS["clone_and_split"],
    "clone_and_split_by_detail.threshold": GS["clone_and_split.threshold"],
    "clone_and_split_by_detail.size_fraction": GS["clone_and_split.size_fraction"],
    "collect_detail": GS["collect_gradients"],
    **paper("Micro-splatting: large Gaussians are halved during densification", halve_large=[steps(600, 14_900, 100)]),
    **ours(
        "the abstract gives neither lambda nor tau nor beta, and no threshold of merging",
        trace=(1e-3, 1),
        trace__trace_limit=0.05,
        halve_large__trace=1e-3,
        halve_large__trace_limit=0.05,
        clone_and_split_by_detail__beta=0.5,
        clone_and_split_by_detail__min_gap=100,
        halve_large__min_gap=100,
        merge_alike__min_gap=100,
        merge_alike=[steps(15_000, 24_000, 1_000)],
        merge_alike__merge_reach=1.0,
        merge_alike__merge_color=0.1,
        prune_least=[steps(15_000, 24_000, 1_000)],
        prune_least__score_mass=0.99,
        prune_least__min_gap=100,
    ),
}

FANS_TABLE: Table = {
    **without(GS_ACCEL, "clone_and_split", "prune_", "reset_", "collect_"),
    **paper("MeshSplats: vertices have colours of degree 0", sh_degree=(0,)),
    **code(FANS, extend__n_sides=says(8, r"--no_points\",\s+default=(\d+)"), extend__is_flat=has(True, '"2dgs"')),
    **kept(
        "the fan that shows no holes",
        FANS,
        extend__reach=says(3.0, r"--scale_min\",\s+default=([\d.]+)", numbers=(2.3,)),
    ),
    **ours(
        "what a vertex shares with a Gaussian has its rate; opacities stay in their range, and faint fans go",
        rate__rims=(1.6e-4, 1.6e-6, 30_000),
        rate__colors=0.0025,
        per_extent=["means", "rims"],
        extend__rim=0.0,
        render__max_layers=None,
        rate__opacities=0.005,
        keep_in_range=[steps(1, 30_000)],
        prune_faint_fans=[steps(1_000, 30_000, 1_000)],
        prune_faint_fans__min_opacity=0.02,
        prune_faint_fans__min_gap=100,
    ),
}

GDGS: Table = {
    **GS_ACCEL,
    **paper(
        "GDGS, the schedule of training",
        surface_attraction=(1.0, 5_001),
        surface_attraction__period=100,
        dispersion=(0.001, 10_001),
        dispersion__period=100,
        contraction=(0.0, 10_001),
        contraction__period=100,
        dispersion__is_printed=False,
        contraction__is_printed=True,
        collect_gradients=[steps(1, 30_000)],
        clone_and_split=[steps(600, 9_900, 100)],
        control_by_region=[steps(10_000, 29_900, 100)],
    ),
    "control_by_region.threshold": GS["clone_and_split.threshold"],
    **ours(
        "the paper gives neither weights nor sizes of regions",
        surface_attraction__weights=(1.0, 0.01, 0.0),
        surface_attraction__offset=0.0,
        dispersion__n_cells=5,
        dispersion__n_top=20,
        contraction__n_cells=5,
        contraction__n_top=20,
        control_by_region__n_cells=5,
        control_by_region__min_unevenness=1.0,
        control_by_region__jitter=0.1,
        control_by_region__min_gap=100,
    ),
}

GAUSTUDIO: Table = {
    **without(GS_ACCEL, "clone_and_split", "photometric."),
    "control_density": GS["clone_and_split"],
    **code(GAUSTUDIO_SKY, render__background=has("ball", "@initializers.register('gaussiansky')")),
    **paper(
        "GauStudio, modules of 3DGS",
        photometric__photo_loss="l1_and_dssim",
        control_density__density="clones",
        initialise=[[1]],
        initialise__initialiser="points",
        extend__representation="gaussians",
        render__representation="gaussians",
    ),
    **ours(
        "the weight of the loss, the rate of the background, masks without a network",
        sky_opacity=(0.1, 1),
        sky_opacity__sky_mask="by_color",
        sky_opacity__mask_folder="",
        rate__sky=0.005,
        control_density__min_gap=100,
    ),
}

SATELLITE: Table = {
    **without(GS, "collect_gradients", "clone_and_split", "prune_", "reset_opacity", "sh_degree", "iterations"),
    **code(
        EOGS_SCRIPT,
        iterations=says(5_000, "numiterations"),
        sh_degree=says((0,), r"--sh_degree (\d)"),
    ),
    **code(
        EOGS_ARGUMENTS,
        opacity_sparsity=says((0.1, 1), "w_L_opacity", "iterstart_L_opacity", numbers=(0.1, -1)),
        shadow_entropy=says((0.01, 1_001), "w_L_translucentshadows", "iterstart_shadowmapping", numbers=(0.01, 1_000)),
        view_consistency=says((1.0, 1_001), "iterstart_L_new_resample", numbers=(1_000,)),
        view_consistency__altitude=says(0.01, "w_L_new_altitude_resample"),
        view_consistency__color=says(0.1, "w_L_new_rgb_resample"),
        view_consistency__noise=says(0.01, "virtual_camera_extent"),
        cast_shadows=once(1_000, "iterstart_shadowmapping"),
    ),
    **code(
        EOGS_TRAIN,
        view_consistency__limit=says(0.3, r"new_altitude_diff\.abs\(\) < ([\d.]+)"),
        rate__radiometry=says(0.01, r"s in scene\.getTrainCameras\(\)\],\s+lr=([\de.-]+)"),
        rate__in_shadow=says(0.01, r"s in scene\.getTrainCameras\(\)\],\s+lr=([\de.-]+)"),
        fold_reference=has([[5_000]], "# Color normalization before saving for the last time"),
    ),
    **code(EOGS_CAMERAS, rate__has_shadows=has(0.0, "if sun_altitude_diff is not None:")),
    **kept(
        "with them heights of the boxes were the best, by seed 0",
        EOGS_ARGUMENTS,
        rate__means=says((6.4e-3, 6.4e-4, 5_000), "position_lr_init", "position_lr_final", numbers=(1.6e-4, 1.6e-6)),
        rate__opacity_logits=says(0.1, "opacity_lr", numbers=(0.05,)),
    ),
    **kept(
        "points that fill a volume are a fog at once",
        EOGS2,
        begin_transparent__opacity=says(0.005, "opacity_init_value", numbers=(0.01,)),
        prune_faint__min_opacity=says(0.005, "min_opacity", numbers=(-6.0,)),
    ),
    **ours(
        "sizes at the start, pruning as in 3DGS, the light of the sky within bounds",
        begin_transparent=[[1]],
        begin_transparent__size=0.5,
        prune_faint=[steps(600, 5_000, 100)],
        prune_faint__min_gap=20,
        hold_sky=[steps(1, 5_000)],
    ),
}

OMG: Table = {
    **without(MINI_SPLATTING, "prune_tail"),
    **code(
        OMG_ARGUMENTS,
        prune_indistinct=once(20_000, "simp_iteration2"),
        prune_indistinct__distinct_power=says(2.0, "lambda_ld"),
        start_networks=once(15_000, "net_itr"),
        start_codes=once(29_000, "svq_itr"),
        start_codes__scale_codes=says(64, r"cluster_scale = 2\*\*(\d+)", numbers=(6,)),
        start_codes__rotation_codes=says(512, r"cluster_rot = 2\*\*(\d+)", numbers=(9,)),
        start_codes__feature_codes=says(1024, r"cluster_app = 2\*\*(\d+)", numbers=(10,)),
        rate__features=says(0.0025, "feature_lr"),
    ),
    **code(OMG_README, prune_indistinct__distinct_mass=has(0.99, "0.96, 0.98, 0.99, 0.999, 0.9999 for XS to XL")),
    **paper("Mini-Splatting, appendix E, for indoor scenes", prune_indistinct__metric="indoor"),
    **ours(
        "rates of networks and codes, half floats, and fields for files",
        **{
            f"rate__{network}_{kind}_{k}": (1e-3, 1e-4, 30_000)
            for network in ("space", "color", "opacity", "harmonics")
            for kind in _OF_NETWORK
            for k in (0, 1)
        },
        rate__codes=0.0,
        rate__place=0.0,
        rate__scale_codes=0.005,
        rate__rotation_codes=0.001,
        rate__feature_codes=0.0025,
        start_codes__rows_per_code=8,
        round_centres=[steps(29_001, 30_000)],
        write_fields=[steps(15_001, 30_000)],
    ),
}

CUS: Table = {
    **without(GS_ACCEL, *DENSITY_CONTROL),
    **paper(
        "CUS-GS: the 10 Gaussians and the latent of a voxel, the share that is pruned",
        extend__children=10,
        extend__latent=32,
        prune_insignificant__share=0.001,
    ),
    **code(
        SCAFFOLD_ARGUMENTS,
        collect_gradients_of_children=says([steps(501, 14_999)], "start_stat", "update_until", numbers=(500, 15_000)),
        collect_gradients_of_children__growth_threshold=says(2e-4, "densify_grad_threshold"),
        grow_anchors=every(1_500, 15_000, 100, "update_from", "update_until", "update_interval"),
        grow_anchors__growth_threshold=says(2e-4, "densify_grad_threshold"),
        rate__latents=says(7.5e-3, "feature_lr"),
        rate__log_scales=says(7e-3, "scaling_lr"),
        rate__offsets=says((1e-2, 1e-4, 30_000), "offset_lr_init", "offset_lr_final", "offset_lr_max_steps"),
        rate__camera_embeddings=says(
            (5e-2, 5e-4, 30_000), "appearance_lr_init", "appearance_lr_final", "appearance_lr_max_steps"
        ),
        **{
            f"rate__opacity_{kind}_{k}": says(
                (2e-3, 2e-5, 30_000), "mlp_opacity_lr_init", "mlp_opacity_lr_final", "mlp_opacity_lr_max_steps"
            )
            for kind in _OF_NETWORK
            for k in (0, 1)
        },
        **{
            f"rate__shape_{kind}_{k}": says(4e-3, "mlp_cov_lr_init", "mlp_cov_lr_final", numbers=(4e-3, 4e-3))
            for kind in _OF_NETWORK
            for k in (0, 1)
        },
        **{
            f"rate__color_{kind}_{k}": says(
                (8e-3, 5e-5, 30_000), "mlp_color_lr_init", "mlp_color_lr_final", "mlp_color_lr_max_steps"
            )
            for kind in _OF_NETWORK
            for k in (0, 1)
        },
    ),
    **ours(
        "voxels as large as the points are apart; what is not trained; weights, and what Scaffold-GS does not have",
        extend__voxel=1.0,
        sh_degree=(0,),
        feature_loss=(0.1, 1),
        feature_loss__features="",
        feature_loss__samples=2_048,
        anchor_scale=(0.01, 1),
        prune_insignificant=[steps(2_000, 14_000, 1_000)],
        prune_insignificant__min_gap=100,
        grow_anchors__voxel=1.0,
        grow_anchors__min_gap=100,
        rate__memory_keys=(1e-2, 1e-4, 30_000),
        rate__adapter=(1e-2, 1e-4, 30_000),
        per_extent=["means", "offsets"],
        **{f"rate__{name}": 0.0 for name in ("means", "quats", "opacity_logits", "sh_dc", "sh_rest", "memory")},
        **{
            f"rate__{name}_{kind}_{k}": (5e-3, 5e-5, 30_000)
            for name, layers in (("query", (0, 1)), ("query_mix", (0,)))
            for kind in _OF_NETWORK
            for k in layers
        },
    ),
}

TABLES: dict[str, Table] = {
    "3dgs": GS,
    "3dgs-accel": GS_ACCEL,
    "mini-splatting": MINI_SPLATTING,
    "mini-splatting-d": MINI_SPLATTING_D,
    "mini-splatting2": MINI_SPLATTING2,
    "mini-splatting2-d": MINI_SPLATTING2_D,
    "surfels": SURFELS,
    "mvg": MVG,
    "reflective": REFLECTIVE,
    "texture-splat": TEXTURE_SPLAT,
    "discretized-sdf": DISCRETIZED_SDF,
    "analytic": GS_ACCEL,
    "antialiasing": ANTIALIASING,
    "cus": CUS,
    "cuts": GS_ACCEL
    | ours(
        "the paper's edges are hard, with another gradient",
        extend__n_curves=1,
        rate__curves=0.01,
        rate__widths=0.0,
        set_width=[[15_000], [30_000]],
        set_width__width=[0.5, 0.0],
    ),
    "fans": FANS_TABLE,
    "games": {
        **without(GS_ACCEL, *DENSITY_CONTROL),
        **code(GAMES_ARGUMENTS, rate__log_sizes=says(5e-3, "scaling_lr")),
        **kept(
            "weights are a softmax, not positive numbers",
            GAMES_ARGUMENTS,
            rate__corner_logits=says(1e-2, "alpha_lr", numbers=(0.001,)),
        ),
        **ours(
            "what follows from a face, and no density control",
            refresh_places=[steps(1, 30_000)],
            **{f"rate__{name}": 0.0 for name in ("means", "quats", "log_scales", "p0", "p1", "p2")},
        ),
    },
    "gaustudio": GAUSTUDIO,
    "gdgs": GDGS,
    "lens": GS_ACCEL,
    "lucas-kanade": GS_ACCEL
    | ours(
        "no released code was found",
        flow=(5.0, 1),
        flow__flows="",
        depth_order=(0.0, 1),
        depth_order__depths="",
        depth_order__margin=0.01,
        rate__warp_centers=(1.6e-4, 1.6e-6, 30_000),
        rate__warp_log_width=(1e-3, 1e-5, 30_000),
        rate__warp_shifts=(1e-3, 1e-5, 30_000),
        rate__warp_turns=(2e-3, 2e-5, 30_000),
        rate__warp_growths=(1e-3, 1e-5, 30_000),
        per_extent=["means", "warp_centers", "warp_shifts"],
    ),
    "mcmc": MCMC,
    "micro": MICRO,
    "mixed": {
        **GS_ACCEL,
        **paper(
            "MP-GS, settings of the training",
            rate__vertices=2e-4,
            per_extent=["means", "vertices"],
            simplify_hulls__least=0.5,
        ),
        **code(
            SURFELS_TRAIN,
            normal_consistency=says((0.05, 7_001), r"lambda_normal if iteration > (\d+)", numbers=(7_000,)),
            distortion=says((0.0, 3_001), r"lambda_dist if iteration > (\d+)", numbers=(3_000,)),
        ),
        **ours(
            "dates, promotion, and altitude for Pearson's r",
            rate__n_vertices=0.0,
            simplify_hulls=[steps(1_500, 14_500, 500)],
            simplify_hulls__min_height=0.5,
            simplify_hulls__min_gap=100,
            promote=[steps(1_500, 14_500, 500)],
            promote__ratio=6.0,
            promote__size_fraction=0.01,
            promote__min_gap=100,
        ),
    },
    "multi-scale": {
        **GS,
        **paper(
            "Multi-Scale 3DGS, released code as it was read before; no clone of it was found",
            coarse=(0.1, 15_001),
            coarse__factor=4,
            coarse__n_levels=3,
            coarse__period=4,
            coarse__dssim_weight=0.2,
            insert_levels=[[15_000]],
            insert_levels__factor=4,
            insert_levels__n_levels=3,
            rate__cells=0.0,
        ),
        **ours("an opaque deviation of 0.6 pixels", insert_levels__min_coverage=4.0),
    },
    "negative": GS_ACCEL | paper("NegGS, as a third party reports it", extend__fraction=0.2),
    "omg": OMG,
    "pixel-order": GS_ACCEL | ours("exact by default", render__buffer_size=None),
    "polygons": GS_ACCEL,
    "rays": GS_ACCEL,
    "satellite": SATELLITE,
    "textured": GS_ACCEL
    | code(
        TEXTURED,
        rate__color_textures=says(0.0025, "texture_lr_init", "texture_lr_final", numbers=(0.0025, 0.0025)),
        rate__opacity_textures=says(0.005, "opacity_lr"),
    ),
    "vdgs": {
        **GS_ACCEL,
        **code(
            VDGS_ARGUMENTS,
            render__modulation=has("opacity_times", 'self.vdgs_operator = "mul"', 'self.vdgs_type = "opacity"'),
        ),
        **kept(
            "a network and a grid that are smaller, for a CPU",
            VDGS_ARGUMENTS,
            **{
                f"rate__network_{kind}_{k}": says((5e-3, 5e-4, 30_000), "vdgs_lr", numbers=(0.001,))
                for kind in _OF_NETWORK
                for k in (0, 1)
            },
            rate__hash_table=says((1e-2, 1e-3, 30_000), "vdgs_lr", numbers=(0.001,)),
        ),
        **ours("the place of the scene is not trained", rate__place_center=0.0, rate__place_radius=0.0),
    },
    "velocity": GS_ACCEL
    | ours(
        "five times the rate of the means",
        rate__velocities=(8e-4, 8e-6, 30_000),
        per_extent=["means", "velocities"],
    ),
    "vr": MINI_SPLATTING2 | ours("in place of StopThePop's queues of tiles, blocks and pixels", render__buffer_size=16),
    "vr-fine-tuning": {
        **select(GS, "photometric", "rate", "adam", "per_extent"),
        **code(HEADSET, iterations=says(5_000, r"--iterations (35000)", numbers=(35_000,))),
        **paper(
            "VRSplat: a finished model, whose number stays, at the last rate of its means",
            sh_degree=(3, 0, 0, 0),
            rate__means=1.6e-6,
        ),
        **ours("they concern short runs and few views", min_views=1, short_run_exponent=0.0),
        **ours("in place of StopThePop's queues of tiles, blocks and pixels", render__buffer_size=16),
    },
}
"""By the name of a recipe."""
