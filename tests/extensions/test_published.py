"""The dates and constants of all recipes with a paper, as published, typed by hand with where they are stated.

Released code counts where a paper gives no number. What a row calls ours is a choice of this program, which has its
reason beside it in the code. ``adaptive`` has no paper.
"""

import functools
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import pytest

from minisplat_ref.extensions.extension import find_recipe, load_extensions
from minisplat_ref.methods import RECIPES
from minisplat_ref.training.rates import LogLinear
from minisplat_ref.training.schedule import During, SmallerViews, action_name

OURS = "ours"


class Row(NamedTuple):
    """A fact, and where it is stated."""

    value: Any
    source: str


def rows(source, **values):
    """The rows of one source; ``__`` in a name stands for the point between an action and its setting."""
    return {name.replace("__", "."): Row(value, source) for name, value in values.items()}


def steps(first, last, period=1, *, but=()):
    """Iterations from the first to the last."""
    return [step for step in range(first, last + 1, period) if step not in but]


# --- the tables ---

DENSITY_CONTROL = ("collect_gradients", "clone_and_split", "prune_", "reset_opacity")  # of 3DGS, by how names begin

GS = {
    **rows("3DGS, section 5.1", photometric=(1.0, 1), photometric__dssim_weight=0.2),
    **rows(
        "3DGS, section 5.2",
        clone_and_split__threshold=2e-4,
        clone_and_split=[steps(600, 14_900, 100)],
        reset_opacity=[steps(3_000, 12_000, 3_000)],
    ),
    **rows("3DGS, section 7.1", sh_degree=(3, 1_000, 2_000, 3_000)),
    **rows(
        "3DGS, released code of 2023",
        iterations=30_000,
        adam=(False, True, 0.9, 0.999, 1e-15),
        rate__means=(1.6e-4, 1.6e-6, 30_000),
        rate__quats=0.001,
        rate__log_scales=0.005,
        rate__opacity_logits=0.05,
        rate__sh_dc=0.0025,
        rate__sh_rest=0.000125,
        per_extent=["means"],
        collect_gradients=[steps(1, 14_999)],
        clone_and_split__size_fraction=0.01,
        prune_faint=[steps(600, 14_900, 100)],
        prune_faint__min_opacity=0.005,
        prune_large=[steps(3_100, 14_900, 100)],
        prune_large__size_fraction=0.1,
        reset_opacity__ceiling=0.01,
        reset_opacity_on_white=[[500]],
        reset_opacity_on_white__ceiling=0.01,
        min_views=1,
    ),
    **rows(
        f"{OURS}: they concern runs shorter than published",
        short_run_exponent=0.0,
        clone_and_split__min_gap=100,
        prune_faint__min_gap=100,
        prune_large__min_gap=100,
        reset_opacity__min_gap=300,
    ),
}

GS_ACCEL = GS | {
    **rows("3DGS, released code of late 2024", rate__opacity_logits=0.025),
    **rows("Taming 3DGS, released code", adam=(True, False, 0.9, 0.999, 1e-15)),
}

DENSIFIED = steps(600, 14_900, 100, but=(5_000, 10_000))
MINI_SPLATTING_D = {
    **{name: row for name, row in GS.items() if not name.startswith(("reset_opacity", "prune_large"))},
    **rows(
        "Mini-Splatting, section 4.1 and equation (2)",
        collect_blur=[steps(1, 14_999)],
        collect_blur__area_fraction=2e-4,
        reinitialise_from_depth=[[5_000, 10_000]],
        reinitialise_from_depth__points_of="midpoint_points",
    ),
    **rows(
        "Mini-Splatting, released code",
        sh_degree=(0, 16_000, 17_000, 18_000),
        rate__means=(1.6e-4, 1.6e-6, 30_000, 15_000, 5_000),
        clone_and_split=[DENSIFIED],
        clone_and_split__draw_children="random_children",
        prune_faint=[DENSIFIED],
        prune_large_by_distance=[steps(3_100, 14_900, 100, but=(5_000, 10_000))],
        prune_large_by_distance__size_fraction=0.1,
        store_sh=[[15_000]],
        store_sh__sh_degree=3,
        restart_from_means=[[15_000]],
        restart_from_means__sh_degree=3,
        restart_from_means__largest_size=0.1,
        reinitialise_from_depth__largest_size=0.1,
    ),
    **rows(
        f"{OURS}: smaller photographs, sky and bare walls, short runs",
        collect_blur__min_area=64,
        reinitialise_from_depth__points_per_gaussian=1.0,
        reinitialise_from_depth__min_alpha=0.0,
        reinitialise_from_depth__depth_tolerance=0.05,
        reinitialise_from_depth__backdrop_extents=30.0,
        prune_large_by_distance__min_gap=100,
        min_views=3,
        short_run_exponent=0.45,
    ),
}
MINI_SPLATTING = MINI_SPLATTING_D | {
    **rows("Mini-Splatting, appendix E, for indoor scenes", simplify__metric="indoor", prune_tail__metric="indoor"),
    **rows(
        "Mini-Splatting, released code, for Mip-NeRF 360",
        simplify=[[15_000]],
        simplify__choose="by_sampling",
        simplify__keep_fraction=0.5,
        simplify__budget=None,
        simplify__is_intersecting=True,
        prune_tail=[[20_000]],
        prune_tail__mass=0.99,
        prune_tail__is_intersecting=True,
        restart_adam=[[20_000]],
    ),
}

DENSIFIED_2 = steps(600, 2_900, 100, but=(2_000,))
MINI_SPLATTING2_COMMON = {
    **{
        name: row
        for name, row in MINI_SPLATTING_D.items()
        if not name.startswith(("prune_large", "restart_", "rate.means"))
    },
    **rows(
        "Mini-Splatting2, released code",
        iterations=18_000,
        adam=(True, True, 0.9, 0.999, 1e-15),
        rate__means=(1.6e-4, 1.6e-6, 30_000),
        rate__opacity_logits=0.025,
        sh_degree=(0, 4_000, 5_000, 6_000),
        halve_large_views=[steps(1, 3_000)],
        halve_large_views__max_halvings=1,
        collect_gradients=[steps(1, 2_999)],
        collect_blur=[steps(1, 2_999)],
        clone_and_split=[DENSIFIED_2],
        prune_faint=[DENSIFIED_2],
        reinitialise_from_depth=[[2_000]],
        reinitialise_from_depth__drawn_mass=0.99,
        aggressive_clone=[steps(500, 2_750, 250, but=(2_000,))],
        aggressive_clone__critical="critical_by_mass",
        aggressive_clone__factor=2,
        aggressive_clone__tail_mass=0.999,
        aggressive_clone__min_views=2,
        aggressive_clone__visibility_mass=0.99,
        store_sh=[[3_000]],
        stop_culling=[[13_000]],
        prune_tail__metric="indoor",
        prune_tail__mass=0.99,
        prune_tail__min_views=2,
    ),
    **rows(
        f"{OURS}: a limit of growth, and views that are small already",
        aggressive_clone__max_per_pixel=0.1,
        clone_and_split__max_per_pixel=0.1,
        halve_large_views__min_side=100,
    ),
}
MINI_SPLATTING2 = MINI_SPLATTING2_COMMON | rows(
    "Mini-Splatting2, released code",
    simplify=[[3_000]],
    simplify__metric="indoor",
    simplify__choose="by_sampling",
    simplify__keep_fraction=0.6,
    simplify__budget=None,
    simplify__min_views=2,
    simplify__is_intersecting=True,
    simplify__visibility_mass=0.99,
    prune_tail=[[8_000]],
    prune_tail__is_intersecting=True,
)
MINI_SPLATTING2_D = MINI_SPLATTING2_COMMON | rows(
    "Mini-Splatting2, released code of the dense variant",
    prune_tail=[[3_000], [8_000]],
    prune_tail__is_intersecting=False,
    prune_tail__visibility_mass=0.99,
)

MICRO = {
    **{name: row for name, row in GS_ACCEL.items() if not name.startswith("clone_and_split")},
    **rows("3DGS, section 5.2", clone_and_split_by_detail=[steps(600, 14_900, 100)]),
    **rows("3DGS, section 5.2", clone_and_split_by_detail__threshold=2e-4),
    **rows("3DGS, released code of 2023", clone_and_split_by_detail__size_fraction=0.01),
    **rows("Micro-splatting, densification of 3DGS", collect_detail=[steps(1, 14_999)]),
    **rows("Micro-splatting, densification of 3DGS", halve_large=[steps(600, 14_900, 100)]),
    **rows(
        f"{OURS}: the abstract gives neither lambda nor tau nor beta, and no threshold of merging",
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

FANS = {
    **{
        name: row
        for name, row in GS_ACCEL.items()
        if not name.startswith(("clone_and_split", "prune_", "reset_", "collect_"))
    },
    **rows("MeshSplats: vertices have colours of degree 0", sh_degree=(0,)),
    **rows("MeshSplats, released code", extend__n_sides=8, extend__is_flat=True),
    **rows("3DGS, for what a vertex shares with a Gaussian", rate__rims=(1.6e-4, 1.6e-6, 30_000), rate__colors=0.0025),
    **rows("3DGS, for what a vertex shares with a Gaussian", per_extent=["means", "rims"]),
    **rows(
        f"{OURS}: the fan that shows no holes, and when one is seen no more",
        extend__reach=3.0,
        extend__rim=0.0,
        render__max_layers=None,
        rate__opacities=0.005,
        keep_in_range=[steps(1, 30_000)],
        prune_faint_fans=[steps(1_000, 30_000, 1_000)],
        prune_faint_fans__min_opacity=0.02,
        prune_faint_fans__min_gap=100,
    ),
}

GDGS = {
    **GS_ACCEL,
    **rows(
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
    **rows("3DGS, section 5.2", control_by_region__threshold=2e-4),
    **rows(
        f"{OURS}: the paper gives neither weights nor sizes of regions",
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

MVG = {
    **{name: row for name, row in GS_ACCEL.items() if name != "prune_faint.min_opacity"},
    **rows("2DGS, released code", prune_faint__min_opacity=0.05, filtered_normals=(0.05, 7_001)),
    **rows("MVSNet's fusion, a pixel and 1 % in at least two views", insert_consistent__n_views=2),
    **rows(
        f"{OURS}: no value of the paper was found",
        depth_steps=(0.1, 7_001),
        depth_steps__sharpness=10.0,
        insert_consistent=[steps(2_500, 10_000, 2_500)],
        insert_consistent__n_sources=4,
        insert_consistent__near_stride=4,
        insert_consistent__far_stride=2,
        insert_consistent__min_gap=20,
    ),
}

GAUSTUDIO = {
    **{name: row for name, row in GS_ACCEL.items() if not name.startswith(("clone_and_split", "photometric."))},
    **rows("GauStudio, modules of 3DGS", photometric__photo_loss="l1_and_dssim", control_density__density="clones"),
    **rows("3DGS, section 5.2", control_density=[steps(600, 14_900, 100)]),
    **rows("GauStudio, initialisers", initialise=[[1]], initialise__initialiser="points"),
    **rows(
        "GauStudio, released code, the ball",
        extend__representation="gaussians",
        render__representation="gaussians",
        render__background="ball",
    ),
    **rows(
        f"{OURS}: the weight of the loss, the rate of the background, masks without a network",
        sky_opacity=(0.1, 1),
        sky_opacity__sky_mask="by_color",
        sky_opacity__mask_folder="",
        rate__sky=0.005,
        control_density__min_gap=100,
    ),
}

_OF_DENSITY = ("collect_gradients", "clone_and_split", "prune_", "reset_opacity", "sh_degree", "iterations")
SATELLITE = {
    **{name: row for name, row in GS.items() if not name.startswith(_OF_DENSITY)},
    **rows(
        "EOGS, released code",
        iterations=5_000,
        sh_degree=(0,),
        opacity_sparsity=(0.1, 1),
        shadow_entropy=(0.01, 1),
        view_consistency__altitude=0.01,
        view_consistency__color=0.1,
        view_consistency__noise=0.01,
        view_consistency__limit=0.3,
    ),
    **rows(
        f"{OURS}: a transparent start, rates, pruning as in 3DGS, the light of the sky within bounds",
        view_consistency=(1.0, 1),
        rate__means=(6.4e-3, 6.4e-4, 5_000),
        rate__opacity_logits=0.1,
        rate__radiometry=0.001,
        begin_transparent=[[1]],
        begin_transparent__opacity=0.005,
        begin_transparent__size=0.5,
        rate__in_shadow=0.01,
        prune_faint=[steps(600, 5_000, 100)],
        prune_faint__min_opacity=0.005,
        prune_faint__min_gap=20,
        hold_sky=[steps(1, 5_000)],
        fold_reference=[[5_000]],
    ),
}

TABLES = {
    "3dgs": GS,
    "3dgs-accel": GS_ACCEL,
    "mini-splatting": MINI_SPLATTING,
    "mini-splatting-d": MINI_SPLATTING_D,
    "mini-splatting2": MINI_SPLATTING2,
    "mini-splatting2-d": MINI_SPLATTING2_D,
    "analytic": GS_ACCEL,
    "lens": GS_ACCEL,
    "satellite": SATELLITE,
    "antialiasing": {name.replace("reset_opacity", "reset_smoothed_opacity"): row for name, row in GS_ACCEL.items()}
    | rows(
        "Mip-Splatting, equations (7) to (9) and released code",
        measure_filters=[[1], steps(100, 30_000, 100)],
        measure_filters__variance=0.2,
        rate__filter_sigmas=0.0,
    )
    | rows(f"{OURS}: half that of densification", measure_filters__min_gap=50),
    "cuts": GS_ACCEL
    | rows(
        f"{OURS}: the paper's edges are hard, with another gradient",
        extend__n_curves=1,
        rate__curves=0.01,
        rate__widths=0.0,
        set_width=[[15_000], [30_000]],
        set_width__width=[0.5, 0.0],
    ),
    "fans": FANS,
    "gaustudio": GAUSTUDIO,
    "games": {
        **{name: row for name, row in GS_ACCEL.items() if not name.startswith(DENSITY_CONTROL)},
        **rows(
            f"{OURS}: what is trained on a face, how fast, and no density control",
            refresh_places=[steps(1, 30_000)],
            rate__corner_logits=1e-2,
            rate__log_sizes=5e-3,
            **{f"rate__{name}": 0.0 for name in ("means", "quats", "log_scales", "p0", "p1", "p2")},
        ),
    },
    "gdgs": GDGS,
    "micro": MICRO,
    "mvg": MVG,
    "mixed": GS_ACCEL
    | rows(
        "MP-GS, settings of the training",
        rate__vertices=2e-4,
        per_extent=["means", "vertices"],
        simplify_hulls__least=0.5,
    )
    | rows("2DGS, whose losses MP-GS has", normal_consistency=(0.05, 7_001), distortion=(0.0, 3_001))
    | rows(
        f"{OURS}: dates, promotion, and altitude for Pearson's r",
        rate__n_vertices=0.0,
        simplify_hulls=[steps(1_500, 14_500, 500)],
        simplify_hulls__min_height=0.5,
        simplify_hulls__min_gap=100,
        promote=[steps(1_500, 14_500, 500)],
        promote__ratio=6.0,
        promote__size_fraction=0.01,
        promote__min_gap=100,
    ),
    "multi-scale": GS
    | rows(
        "Multi-Scale 3DGS, released code",
        coarse=(0.1, 15_001),
        coarse__factor=4,
        coarse__n_levels=3,
        coarse__period=4,
        coarse__dssim_weight=0.2,
        insert_levels=[[15_000]],
        insert_levels__factor=4,
        insert_levels__n_levels=3,
        rate__cells=0.0,
    )
    | rows(f"{OURS}: an opaque deviation of 0.6 pixels", insert_levels__min_coverage=4.0),
    "negative": GS_ACCEL | rows("NegGS, as a third party reports it", extend__fraction=0.2),
    "omg": {name: row for name, row in MINI_SPLATTING.items() if not name.startswith("prune_tail")}
    | rows(
        "OMG, released code, the paper's model M",
        prune_indistinct=[[20_000]],
        prune_indistinct__metric="indoor",
        prune_indistinct__distinct_mass=0.99,
        prune_indistinct__distinct_power=2.0,
        start_networks=[[15_000]],
        start_codes=[[29_000]],
        start_codes__scale_codes=64,
        start_codes__rotation_codes=512,
        start_codes__feature_codes=1024,
        rate__codes=0.0,
        rate__place=0.0,
    )
    | rows(
        f"{OURS}: rates of networks, features and codes, half floats, and fields for files",
        **{
            f"rate__{network}_{kind}_{k}": (1e-3, 1e-4, 30_000)
            for network in ("space", "color", "opacity", "harmonics")
            for kind in ("weights", "biases")
            for k in (0, 1)
        },
        rate__features=0.0025,
        rate__scale_codes=0.005,
        rate__rotation_codes=0.001,
        rate__feature_codes=0.0025,
        start_codes__rows_per_code=8,
        round_centres=[steps(29_001, 30_000)],
        write_fields=[steps(15_001, 30_000)],
    ),
    "pixel-order": GS_ACCEL | rows(f"{OURS}: exact by default", render__buffer_size=None),
    "polygons": GS_ACCEL,
    "rays": GS_ACCEL,
    "reflective": {name: row for name, row in GS_ACCEL.items() if name != "prune_faint.min_opacity"}
    | rows(
        "Ref-Gaussian, section 4 and released code; 2DGS",
        normal_consistency=(0.05, 7_001),
        prune_faint__min_opacity=0.05,
        spread_normals__growth=1.5,
    )
    | rows("Ref-Gaussian, the stages of training", shade_by=[[18_000], [20_000]], shade_by__stage=[1, 2])
    | rows(
        f"{OURS}: rates, what counts as a mirror, how much others are disturbed, and no disturbance up to 2,000",
        rate__albedo_logits=0.01,
        rate__metallic_logits=0.01,
        rate__roughness_logits=0.01,
        rate__log_environment=0.01,
        rate__shading_stage=0.0,
        render__mirrors=True,
        spread_normals=[steps(3_000, 17_000, 1_000)],
        spread_normals__turn=0.02,
        spread_normals__metallic=0.5,
        spread_normals__roughness=0.3,
    ),
    "surfels": {name: row for name, row in GS_ACCEL.items() if name != "prune_faint.min_opacity"}
    | rows(
        "2DGS, section 6.1 and released code",
        normal_consistency=(0.05, 7_001),
        median_normal_consistency=(0.0, 7_001),
        distortion=(0.0, 3_001),
        prune_faint__min_opacity=0.05,
    ),
    "texture-splat": {
        **{name: row for name, row in GS.items() if name.startswith(("photometric", "rate", "adam", "per_extent"))},
        **{name: GS[name] for name in ("iterations", "min_views", "short_run_exponent")},
        **rows(
            "TextureSplat, released code: 30,000 more iterations, centres and their number stay, 2 x 2 texels",
            sh_degree=(3, 0, 0, 0),
            rate__means=0.0,
            extend__texels=2,
        ),
        **rows(
            f"{OURS}: those of reflective",
            rate__normal_textures=0.01,
            rate__albedo_logits=0.01,
            rate__metallic_logits=0.01,
            rate__roughness_logits=0.01,
            rate__log_environment=0.01,
            rate__shading_stage=0.0,
        ),
    },
    "textured": GS_ACCEL
    | rows(f"{OURS}: between 3DGS's rates", rate__color_textures=0.000625, rate__opacity_textures=0.0125),
    "vdgs": GS_ACCEL
    | rows("VDGS, its default mode", render__modulation="opacity_times")
    | rows(
        f"{OURS}: rates of the network and of the hash grid, and the place of the scene, which is not trained",
        **{f"rate__network_{kind}_{k}": (5e-3, 5e-4, 30_000) for kind in ("weights", "biases") for k in (0, 1)},
        rate__hash_table=(1e-2, 1e-3, 30_000),
        rate__place_center=0.0,
        rate__place_radius=0.0,
    ),
    "velocity": GS_ACCEL
    | rows(
        f"{OURS}: five times the rate of the means",
        rate__velocities=(8e-4, 8e-6, 30_000),
        per_extent=["means", "velocities"],
    ),
    "vr": MINI_SPLATTING2
    | rows(f"{OURS}: in place of StopThePop's queues of tiles, blocks and pixels", render__buffer_size=16),
    "vr-fine-tuning": {
        **{name: row for name, row in GS.items() if name.startswith(("photometric", "rate", "adam", "per_extent"))},
        **rows(
            "VRSplat, released code: 5,000 more iterations on a finished model, whose number stays",
            iterations=5_000,
            sh_degree=(3, 0, 0, 0),
            rate__means=1.6e-6,
        ),
        **rows(f"{OURS}: they concern short runs and few views", min_views=1, short_run_exponent=0.0),
        **rows(f"{OURS}: in place of StopThePop's queues of tiles, blocks and pixels", render__buffer_size=16),
    },
}

TABLES["discretized-sdf"] = {
    name.replace("reset_opacity", "reset_distances"): row for name, row in TABLES["reflective"].items()
} | {
    **rows(
        "Discretized SDF, its losses",
        normal_consistency=(0.2, 7_001),
        distortion=(100.0, 3_001),
        median=(100.0, 1_001),
        silhouette=(1e-3, 1),
        projection__reach=0.1,
    ),
    **rows(
        f"{OURS}: weight of the projection, the foreground, rates, and opacities for others",
        projection=(1.0, 1),
        extend__foreground=0.5,
        rate__distances=1.25e-3,
        rate__log_width=1e-3,
        rate__opacity_logits=0.0,
        refresh_opacities=[steps(1, 30_000)],
    ),
}

TABLES["lucas-kanade"] = GS_ACCEL | rows(
    f"{OURS}: no released value was found",
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
)

TABLES["cus"] = {
    **{name: row for name, row in GS_ACCEL.items() if not name.startswith(DENSITY_CONTROL)},
    **rows(
        "CUS-GS: the 10 Gaussians and the latent of a voxel, the share that is pruned",
        extend__children=10,
        extend__latent=32,
        prune_insignificant__share=0.001,
    ),
    **rows(
        "Scaffold-GS, released code: between 500 and 15,000 gradients are collected, from 1,500 on anchors grow",
        collect_gradients_of_children=[steps(501, 14_999, 1)],
        collect_gradients_of_children__growth_threshold=2e-4,
        grow_anchors=[steps(1_600, 14_900, 100)],
        grow_anchors__growth_threshold=2e-4,
    ),
    **rows(
        f"{OURS}: voxels as large as the points are apart; what is not trained; weights, rates and dates",
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
        rate__latents=2e-2,
        rate__offsets=(1.6e-4, 1.6e-6, 30_000),
        rate__camera_embeddings=(1e-3, 1e-5, 30_000),
        rate__memory_keys=(1e-2, 1e-4, 30_000),
        rate__adapter=(1e-2, 1e-4, 30_000),
        per_extent=["means", "offsets"],
        **{f"rate__{name}": 0.0 for name in ("means", "quats", "opacity_logits", "sh_dc", "sh_rest", "memory")},
        **{
            f"rate__{name}_{kind}_{k}": (rate, rate / 100, 30_000)
            for name, rate in (
                ("opacity", 2e-3),
                ("shape", 2e-3),
                ("color", 8e-3),
                ("query", 5e-3),
                ("query_mix", 5e-3),
            )
            for kind in ("weights", "biases")
            for k in range(1 if name == "query_mix" else 2)
        },
    ),
}

CONSTANTS = [
    ("games.model", "THINNESS", 1e-3, f"{OURS}: the paper has a constant near zero, of no unit"),
    ("antialiasing.model", "EPS2D", 0.1, "Mip-Splatting, released code"),
    ("analytic.response", "LINEAR", 1.6, "Analytic-Splatting, its logistic curve"),
    ("analytic.response", "CUBIC", 0.07, "Analytic-Splatting, its logistic curve"),
    ("discretized_sdf.model", "HALF", 1.762747, "Discretized SDF, the gamma of the median loss"),
    ("discretized_sdf.model", "WIDTH", 0.05, f"{OURS}: half of the projection's reach"),
    ("gaustudio.backgrounds", "N_BALL", 10_000, "GauStudio, released code"),
    ("gaustudio.alternatives", "THRESHOLD", 2e-4, "3DGS, section 5.2"),
    ("gaustudio.alternatives", "SIZE_FRACTION", 0.01, "3DGS, released code of 2023"),
    ("gaustudio.alternatives", "DSSIM_WEIGHT", 0.2, "3DGS, section 5.1"),
    ("omg.model", "N_STATIC", 3, "OMG, static features"),
    ("omg.model", "N_VIEW", 3, "OMG, view-dependent features"),
    ("omg.model", "N_SPACE", 13, "OMG, features of the place"),
    ("omg.model", "N_OCTAVES", 16, "OMG, encoding of the place"),
    ("omg.model", "HIDDEN", 64, "OMG, hidden layers"),
    ("polygons.model", "LOG_THICKNESS", np.log(1e-5), "REdiSplats, released code"),
    ("mixed.population", "COLOR_DISTANCE", 5.0, "MP-GS, the distance of like colours in Lab"),
    ("cus.recipe", "LARGE", 0.9, f"{OURS}: the paper says that volumes are normalised"),
    ("cus.recipe", "UNIT", 0.01, "CUS-GS, the side of a voxel"),
    ("cus.recipe", "N_LEVELS", 3, "Scaffold-GS, section 3.3"),
    ("cus.recipe", "COARSEST", 16, "Scaffold-GS, released code"),
    ("cus.recipe", "FINER", 4, "Scaffold-GS, section 3.3"),
    ("cus.recipe", "STEEPER", 2, "Scaffold-GS, section 3.3"),
    ("cus.recipe", "THRESHOLD", 2e-4, "Scaffold-GS, released code"),
    ("cus.memory", "ROWS_MAX", 512, f"{OURS}: a memory for a CPU"),
    ("rays.lights", "BOUNCES_MAX", 3, "RaySplats, section 3.3"),
    ("rays.lights", "INDEX", 1.5, "of window glass"),
    ("lucas_kanade.pyramid", "WINDOW", 2.0, f"{OURS}: pixels"),
    ("lucas_kanade.recipe", "SOFT", 0.1, f"{OURS}: pixels, what the flow of photographs is right within"),
    ("mechanisms.motion.field", "WIDTH", 2.0, f"{OURS}: spacings of the centres"),
    ("mechanisms.gbuffer.population", "ROWS", 32, f"{OURS}: a texel of 5.6 degrees"),
    ("mechanisms.surfels.losses", "NEAR", 0.2, "2DGS, released code"),
    ("mechanisms.surfels.losses", "FAR", 100.0, "2DGS, released code"),
    ("texture_splat.textures", "REACH", 4.0, "TextureSplat, released code"),
    ("texture_splat.textures", "TILT_MAX", 0.99, "TextureSplat, released code"),
    ("satellite.model", "DARKENING", 0.4, "EOGS, released code"),
    ("satellite.cameras", "GRID", (31, 37, 29), "EOGS, released code"),
    ("satellite.recipe", "SKY_LIGHT", 0.05, "EOGS, released code"),
    ("textured.model", "DEGREE", 3, "Textured-GS, released code"),
    ("wave.hologram", "PITCH", 8.0, f"{OURS}: um, of displays of phases that can be bought"),
    ("wave.hologram", "WAVELENGTHS", (638.0, 520.0, 450.0), f"{OURS}: nm, of laser diodes"),
    ("vdgs.model", "OPACITY_MAX", 0.99, "VDGS, the bound of opacities"),
    ("vdgs.model", "N_LEVELS", 4, f"{OURS}: a hash grid for a CPU"),
    ("vdgs.model", "HIDDEN", 32, f"{OURS}: a network for a CPU"),
    ("vr.foveation", "ACUITY_OFFSET", 0.02083333333, "Guenter et al. 2012"),
    ("vr.foveation", "ACUITY_SLOPE", 0.0275, "Guenter et al. 2012"),
    ("data_tools.claims.vr.queues", "SIZES", (64, 8, 4), "StopThePop, released code"),
]


# --- the recipes ---


@functools.cache
def dates_of(event, iterations):
    """The iterations of an event whose action is left out, as most recipes share them."""
    return [step for step in range(1, iterations + 1) if event.is_due(step)]


def settings_of(name, function):
    """The numbers bound to a function, and the names of the functions bound to it."""
    bound = function.keywords if isinstance(function, partial) else {}
    return {f"{name}.{key}": getattr(value, "__name__", value) for key, value in bound.items()}


def facts_of(recipe):
    """All dates and constants of a recipe, named as in the tables; several events of an action have lists."""
    facts = {name: getattr(recipe, name) for name in ("iterations", "min_views", "short_run_exponent")}
    facts |= {"sh_degree": (recipe.sh_degree, *recipe.sh_milestones), "adam": tuple(recipe.adam)}
    for name, rate in recipe.rates.of.items():
        is_number = not isinstance(rate, LogLinear)
        facts[f"rate.{name}"] = rate if is_number else (*rate[:3], *(rate.rewind or ()))
    facts["per_extent"] = sorted(recipe.rates.per_extent)
    for term in recipe.losses:
        facts |= {term.name: (term.weight, term.start + 1)} | settings_of(term.name, term.function)
        assert term.stop is None
    together = {}
    for event in recipe.events:
        name = action_name(event)
        facts.setdefault(name, []).append(dates_of(event._replace(action=None), recipe.iterations))
        gap = {f"{name}.min_gap": event.min_gap} if getattr(event, "min_gap", 1) > 1 else {}
        for key, value in (settings_of(name, event.action) | gap).items():
            together.setdefault(key, []).append(value)
    facts |= {key: found[0] if len(set(found)) == 1 else found for key, found in together.items()}
    facts |= settings_of("extend", recipe.representation.extend)
    return facts | settings_of("render", recipe.representation.renderer.render)


@pytest.mark.parametrize("name", TABLES)
def test_a_recipe_has_the_published_dates_and_constants(name):
    found, table = facts_of(find_recipe(name)), TABLES[name]
    assert found.keys() == table.keys()
    for key, row in table.items():
        expected = pytest.approx(row.value, rel=1e-12) if isinstance(row.value, float) else row.value
        assert found[key] == expected, (key, row.source)


def test_every_recipe_with_a_paper_has_a_table():
    names = {recipe.name for extension in load_extensions() for recipe in extension.recipes}
    assert names | RECIPES.keys() - {"adaptive"} <= TABLES.keys()


@pytest.mark.parametrize(("module", "name", "value", "source"), CONSTANTS)
def test_a_constant_is_the_published_one(module, name, value, source):
    place = "minisplat_ref." if module.startswith("mechanisms") else "minisplat_ref.extensions."
    whole = module if module.startswith("data_tools") else f"{place}{module}"
    assert getattr(import_module(whole), name) == pytest.approx(value, rel=1e-6), source


@pytest.mark.parametrize("event", [During, SmallerViews])
def test_dates_leave_out_what_they_say(event):
    """By hand: strictly between for ``During``, the last one included for smaller views."""
    assert dates_of(event(None, 2, 5), 9) == ([3, 4] if event is During else [3, 4, 5])
