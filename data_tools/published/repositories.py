"""The released code: repositories on GitHub at the commits that were read."""

from functools import partial

from data_tools.published.rows import Source

_GS = partial(Source, "graphdeco-inria/gaussian-splatting", "2eee0e26d2d5fd00ec462df47752223952f6bf4e")  # August 2023
GS_ARGUMENTS, GS_MODEL, GS_TRAIN = _GS("arguments/__init__.py"), _GS("scene/gaussian_model.py"), _GS("train.py")

_TAMING = partial(Source, "humansensinglab/taming-3dgs", "fd0f7d9edfe135eb4eefd3be82ee56dada7f2a16")
TAMING_ARGUMENTS, TAMING_MODEL = _TAMING("arguments/__init__.py"), _TAMING("scene/gaussian_model.py")

_MS = partial(Source, "fatPeter/mini-splatting", "c0d55811930dec3bfd3d61cad927093d166aaf82")
MS_ARGUMENTS, MS_MODEL = _MS("arguments/__init__.py"), _MS("scene/gaussian_model.py")
MS_TRAIN, MS_D_TRAIN = _MS("ms/train.py"), _MS("ms_d/train.py")

_MS2 = partial(Source, "fatPeter/mini-splatting2", "5ec9202c2db7d900728bfc09733e85467cff885e")
MS2_ARGUMENTS, MS2_CONFIG, MS2_MODEL = (
    _MS2("arguments/__init__.py"),
    _MS2("config/fast"),
    _MS2("scene/gaussian_model.py"),
)
MS2_TRAIN, MS2_D_TRAIN = _MS2("msv2/train.py"), _MS2("msv2_d/train.py")

_SURFELS = partial(Source, "hbb1/2d-gaussian-splatting", "1920a2395f13a285da80982acdb13a8b9e12f1cf")
SURFELS_ARGUMENTS, SURFELS_TRAIN = _SURFELS("arguments/__init__.py"), _SURFELS("train.py")
_RASTERIZER = partial(Source, "hbb1/diff-surfel-rasterization", "e0ed0207b3e0669960cfad70852200a4a5847f61")
SURFELS_FORWARD, SURFELS_HEADER = _RASTERIZER("cuda_rasterizer/forward.cu"), _RASTERIZER("cuda_rasterizer/auxiliary.h")

_REFLECTIVE = partial(Source, "fudan-zvg/ref-gaussian", "af7691aa1097cc6bf89dab6de0fcd358e8830bd8")
REFLECTIVE_ARGUMENTS, REFLECTIVE_TRAIN = _REFLECTIVE("arguments/__init__.py"), _REFLECTIVE("train.py")
REFLECTIVE_MODEL = _REFLECTIVE("scene/gaussian_model.py")

_TEXTURE_SPLAT = partial(Source, "maeyounes/TextureSplat", "655140415fd8b3f49b63ea835aa4643b8f73bae0")
TEXTURE_ARGUMENTS, TEXTURE_MODEL = _TEXTURE_SPLAT("arguments/__init__.py"), _TEXTURE_SPLAT("scene/gaussian_model.py")
TEXTURE_FORWARD = _TEXTURE_SPLAT("submodules/diff-surfel-rasterization/cuda_rasterizer/forward.cu")

_SDF = partial(Source, "NK-CS-ZZL/DiscretizedSDF", "890787761ba77a2d5daafcf9e06589e5a3f80ae3")
SDF_ARGUMENTS, SDF_MODEL, SDF_TRAIN = _SDF("arguments/__init__.py"), _SDF("scene/gaussian_model.py"), _SDF("train.py")
SDF_SCRIPT = _SDF("scripts/train_scripts/train_shiny.sh")

_MIP = partial(Source, "autonomousvision/mip-splatting", "dda02ab5ecf45d6edb8c540d9bb65c7e451345a9")
MIP_ARGUMENTS, MIP_MODEL, MIP_TRAIN = _MIP("arguments/__init__.py"), _MIP("scene/gaussian_model.py"), _MIP("train.py")

_MCMC = partial(Source, "ubc-vision/3dgs-mcmc", "7b4fc9f76a1c7b775f69603cb96e70f80c7e6d13")
MCMC_ARGUMENTS, MCMC_MODEL, MCMC_TRAIN = (
    _MCMC("arguments/__init__.py"),
    _MCMC("scene/gaussian_model.py"),
    _MCMC("train.py"),
)
MCMC_COPIES = _MCMC("utils/reloc_utils.py")

ANALYTIC = Source(
    "lzhnb/Analytic-Splatting",
    "a905939d4c5d9ac4a1500b8eca258028462de941",
    "submodules/diff-gaussian-rasterization/cuda_rasterizer/auxiliary.h",
)

GAUSTUDIO_SKY = Source(
    "GAP-LAB-CUHK-SZ/gaustudio",
    "132d749d863f11a6f158aa10c617ea4afc5b7268",
    "gaustudio/pipelines/initializers/gaussiansky.py",
)

_OMG = partial(Source, "maincold2/OMG", "6edeb72d4dbaf34ffe724deb0c1dc0ca3bece0bb")
OMG_ARGUMENTS, OMG_MODEL, OMG_README = _OMG("arguments/__init__.py"), _OMG("scene/gaussian_model.py"), _OMG("README.md")

_SCAFFOLD = partial(Source, "city-super/Scaffold-GS", "59c833b56bbbf510f3f64d40f81721995caced66")
SCAFFOLD_ARGUMENTS, SCAFFOLD_MODEL = _SCAFFOLD("arguments/__init__.py"), _SCAFFOLD("scene/gaussian_model.py")

_EOGS = partial(Source, "mezzelfo/EOGS", "cca973e7ea512091b52c8ff741c80ddade5793d2")
EOGS_ARGUMENTS, EOGS_TRAIN = (
    _EOGS("src/gaussiansplatting/arguments/__init__.py"),
    _EOGS("src/gaussiansplatting/train.py"),
)
EOGS_CAMERAS, EOGS_SCRIPT = _EOGS("src/gaussiansplatting/scene/cameras.py"), _EOGS("train.sh")
EOGS_AFFINE = _EOGS("scripts/dataset_creation/to_affine.py")
EOGS2 = Source(
    "gardiens/EOGS2",
    "46038189a79d2373456a6a70f7e6dab72670ea96",
    "src/gaussiansplatting/gs_config/train.yaml",
)

_VDGS = partial(Source, "gmum/ViewingDirectionGaussianSplatting", "c32f1f7ec80259a0b21176e896cc10e6b9ac495f")
VDGS_ARGUMENTS, VDGS_RENDERER = _VDGS("arguments/__init__.py"), _VDGS("gaussian_renderer/__init__.py")

_GAMES = partial(Source, "waczjoan/gaussian-mesh-splatting", "1722f7089c7ad94e875876c0216b10f89f11f026")
GAMES_ARGUMENTS = _GAMES("arguments_games/__init__.py")
GAMES_MODEL = _GAMES("games/mesh_splatting/scene/gaussian_mesh_model.py")

POLYGONS = Source("KByrski/REdiSplats", "5add1f3e5bc765e61be64a8daa9a6ff47538fae7", "Linux/output/config.txt")
FANS = Source("gwilczynski95/meshsplats", "6cf6c2399ed0964206431de22ed4f078400d5cde", "generate_pseudomesh.py")
TEXTURED = Source("ZhentaoHuang/Textured-GS", "06950fe2777efa9bc5e4dea26d95670ace04daae", "arguments/__init__.py")
QUEUES = Source("r4dl/StopThePop", "859b11bde9195e19a1c40536e1ab16765b64b365", "configs/hierarchical.json")
HEADSET = Source("Cekavis/VRSplat", "1c7616f75be0f26627d5f3747de7930761af94ab", "README.md")
