"""Constants of modules that no recipe holds, by their place in the package."""

import numpy as np

from data_tools.published.repositories import (
    ANALYTIC,
    EOGS2,
    EOGS_AFFINE,
    EOGS_CAMERAS,
    EOGS_TRAIN,
    GAMES_MODEL,
    GAUSTUDIO_SKY,
    GS_ARGUMENTS,
    MCMC_COPIES,
    MCMC_MODEL,
    MCMC_TRAIN,
    MIP_ARGUMENTS,
    OMG_MODEL,
    POLYGONS,
    QUEUES,
    REFLECTIVE_ARGUMENTS,
    SCAFFOLD_ARGUMENTS,
    SDF_MODEL,
    SURFELS_HEADER,
    TEXTURE_FORWARD,
    TEXTURE_MODEL,
    TEXTURED,
    VDGS_ARGUMENTS,
)
from data_tools.published.rows import Said, Source, Table, code, has, kept, ours, paper, says

_EXTENSIONS = "minisplat_ref.extensions."
_MECHANISMS = "minisplat_ref.mechanisms."


def _of(table: Table, module: str) -> Table:
    return {f"{module}.{name}": row for name, row in table.items()}


def _code(module: str, source: Source, **facts: Said) -> Table:
    return _of(code(source, **facts), module)


CONSTANTS: Table = {
    **_of(
        kept(
            "the released near zero has no unit; a thousandth of the face's lengths has",
            GAMES_MODEL,
            THINNESS=says(1e-3, "eps_s0", numbers=(1e-8,)),
        ),
        f"{_EXTENSIONS}games.model",
    ),
    **_code(f"{_EXTENSIONS}antialiasing.model", MIP_ARGUMENTS, EPS2D=says(0.1, "_kernel_size")),
    **_code(
        f"{_EXTENSIONS}analytic.response",
        ANALYTIC,
        LINEAR=says(1.6, r"val = ([\d.]+)f \* x"),
        CUBIC=says(0.07, r"\+ ([\d.]+)f \* x \* x \* x"),
    ),
    **_of(paper("Discretized SDF: the opacity is one half", HALF=1.762747), f"{_EXTENSIONS}discretized_sdf.model"),
    **_code(
        f"{_EXTENSIONS}discretized_sdf.model",
        SDF_MODEL,
        WIDTH=says(1.0, r"inverse_deviation = torch\.nn\.Parameter\(torch\.tensor\(([\d.]+),"),
        SHARPNESS_NEAR=says(4.549, r"return torch\.tensor\(([\d.]+),"),
        NEAR=says(0.1, r"med_sdf <= ([\d.]+)"),
        START_MAX=says(2.0, r"sdfs = torch\.rand\(.*\) \* ([\d.]+)"),
        START_ON_SPHERE=says(
            0.2 / 1.1, r"sdfs = torch\.zeros\(.*\) \+ ([\d.]+)", r"sphere_sampling\(.*\* ([\d.]+)", numbers=(0.2, 1.1)
        ),
        ROUGHNESS_LOGIT=says(0.6, "default_roughness"),
    ),
    **_code(
        f"{_MECHANISMS}gbuffer.population",
        REFLECTIVE_ARGUMENTS,
        METALLIC=says(0.01, "init_refl_value"),
        ROUGHNESS=says(0.1, "init_roughness_value"),
    ),
    **_of(
        ours("a texel of 5.6 degrees in latitude and longitude, where the release has a cube", ROWS=32),
        f"{_MECHANISMS}gbuffer.population",
    ),
    **_code(
        f"{_EXTENSIONS}gaustudio.backgrounds",
        GAUSTUDIO_SKY,
        N_BALL=says(10_000, r"'resolution', (\d+)", numbers=(100,)),
    ),
    **_code(
        f"{_EXTENSIONS}gaustudio.alternatives",
        GS_ARGUMENTS,
        THRESHOLD=says(2e-4, "densify_grad_threshold"),
        SIZE_FRACTION=says(0.01, "percent_dense"),
        DSSIM_WEIGHT=says(0.2, "lambda_dssim"),
    ),
    **_code(
        f"{_EXTENSIONS}mcmc.model",
        MCMC_TRAIN,
        SHARPNESS=says(100.0, r"op_sigmoid\(x, k=([\d.]+)"),
        THRESHOLD=says(0.995, r"op_sigmoid\(x, k=100, x0=([\d.]+)\)"),
    ),
    **_code(
        f"{_EXTENSIONS}mcmc.model",
        MCMC_COPIES,
        COPIES_MAX=says(50, "N_max", r"max=N_max-(\d)", numbers=(51, 1)),
    ),
    **_code(
        f"{_EXTENSIONS}mcmc.model",
        MCMC_MODEL,
        OPACITY_MIN=says(0.005, r"float32\)\.eps, min=([\d.]+)\)"),
        OPACITY_MAX=has(1 - 2.0**-23, "max=1.0 - torch.finfo(torch.float32).eps"),
    ),
    **_code(
        f"{_EXTENSIONS}omg.model",
        OMG_MODEL,
        N_STATIC=has(3, "self._features_static = nn.Parameter(self._features_dc[:, 0].clone().detach())"),
        N_VIEW=says(3, r"self\._features_view = nn\.Parameter\(torch\.zeros\(\(self\.get_xyz\.shape\[0\], (\d)\)"),
        N_SPACE=says(13, r"n_output_dims=(13),"),
        N_OCTAVES=says(16, "n_frequencies"),
        HIDDEN=says(64, "n_neurons"),
    ),
    **_code(
        f"{_EXTENSIONS}polygons.model",
        POLYGONS,
        LOG_THICKNESS=says(np.log(1e-5), r"(0\.00001) <Epsilon", numbers=(1e-5,)),
    ),
    **_of(
        paper("MP-GS: colours of a group are less than 5 apart in Lab", COLOR_DISTANCE=5.0),
        f"{_EXTENSIONS}mixed.population",
    ),
    **_of(ours("the paper says that volumes are normalised", LARGE=0.9), f"{_EXTENSIONS}cus.recipe"),
    **_of(paper("CUS-GS: the side of a voxel", UNIT=0.01), f"{_EXTENSIONS}cus.recipe"),
    **_code(
        f"{_EXTENSIONS}cus.recipe",
        SCAFFOLD_ARGUMENTS,
        N_LEVELS=says(3, "update_depth"),
        COARSEST=says(16, "update_init_factor"),
        FINER=says(4, "update_hierachy_factor"),
        STEEPER=says(2, "update_hierachy_factor", numbers=(4,)),
        THRESHOLD=says(2e-4, "densify_grad_threshold"),
    ),
    **_of(ours("a memory for a CPU", ROWS_MAX=512), f"{_EXTENSIONS}cus.memory"),
    **_of(paper("RaySplats, section 3.3", BOUNCES_MAX=3), f"{_EXTENSIONS}rays.lights"),
    **_of(ours("window glass", INDEX=1.5), f"{_EXTENSIONS}rays.lights"),
    **_of(ours("pixels", WINDOW=2.0), f"{_EXTENSIONS}lucas_kanade.pyramid"),
    **_of(ours("pixels, what the flow of photographs is right within", SOFT=0.1), f"{_EXTENSIONS}lucas_kanade.recipe"),
    **_of(ours("spacings of the centres", WIDTH=2.0), f"{_MECHANISMS}motion.field"),
    **_code(f"{_MECHANISMS}surfels.losses", SURFELS_HEADER, NEAR=says(0.2, "near_n"), FAR=says(100.0, "far_n")),
    **_code(
        f"{_EXTENSIONS}texture_splat.textures", TEXTURE_FORWARD, REACH=says(4.0, r"texture_coords = \{s\.x / ([\d.]+)f")
    ),
    **_code(f"{_EXTENSIONS}texture_splat.textures", TEXTURE_MODEL, TILT_MAX=says(0.99, r"clamp\(max=([\d.]+)\)")),
    **_code(
        f"{_EXTENSIONS}satellite.model",
        EOGS_CAMERAS,
        DARKENING=says(0.4, r"\n\s+shadow = torch\.exp\(([\d.]+)\*shadow\.clip"),
    ),
    **_code(f"{_EXTENSIONS}satellite.cameras", EOGS_AFFINE, GRID=says((31, 37, 29), "Nu", "Nv", "Na")),
    **_code(f"{_EXTENSIONS}satellite.recipe", EOGS_CAMERAS, SKY_LIGHT=says(0.05, r"reshape\(3,1,1\)\+([\d.]+)\)")),
    **_code(f"{_EXTENSIONS}satellite.recipe", EOGS_TRAIN, FLOOR=says(0.05, r"shadowmap\.clip\(([\d.]+),")),
    **_of(
        kept(
            "points that fill a volume are a fog at once",
            EOGS2,
            START_OPACITY=says(0.005, "opacity_init_value", numbers=(0.01,)),
        ),
        f"{_EXTENSIONS}satellite.recipe",
    ),
    **_code(f"{_EXTENSIONS}textured.model", TEXTURED, DEGREE=says(3, "sh_degree")),
    **_of(ours("um, of displays of phases that can be bought", PITCH=8.0), f"{_EXTENSIONS}wave.hologram"),
    **_of(ours("nm, of laser diodes", WAVELENGTHS=(638.0, 520.0, 450.0)), f"{_EXTENSIONS}wave.hologram"),
    **_of(
        ours("the bound of alpha in 3DGS; the release has none on opacities", OPACITY_MAX=0.99),
        f"{_EXTENSIONS}vdgs.model",
    ),
    **_of(ours("a hash grid for a CPU", N_LEVELS=4), f"{_EXTENSIONS}vdgs.model"),
    **_code(f"{_EXTENSIONS}vdgs.model", VDGS_ARGUMENTS, HIDDEN=says(32, "vdgs_width")),
    **_of(
        paper("Guenter et al. 2012, Foveated 3D Graphics", ACUITY_OFFSET=1 / 48, ACUITY_SLOPE=0.0275),
        f"{_EXTENSIONS}vr.foveation",
    ),
    **_code(
        "data_tools.claims.vr.queues",
        QUEUES,
        SIZES=says((64, 8, 4), "tile_4x4", "tile_2x2", "per_pixel"),
    ),
}
"""By MODULE.NAME."""
