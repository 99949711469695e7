"""Where each rule of a renderer is stated: package or repository, version, file and symbol, and the numbers there.

A rule is a field of :class:`.habits.Habits` or of its profile. A few numbers become ours by arithmetic: viewers that
put a factor of 4 on the covariance have a quarter of their low-pass, and bounds in pixels are divided by sqrt(8).
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from data_tools.conformance.fetching import repository_folder
from data_tools.conformance.habits import SQRT_8
from data_tools.conformance.storing import BYTES, COMPACT, PACKED, SPLAT, SPLAT_AND_HARMONICS
from data_tools.published.check import find
from data_tools.published.rows import Said, has, says


class Place(NamedTuple):
    """A file of a package of npm or PyPI, or of a repository of GitHub."""

    package: str
    """NAME@VERSION of npm, NAME==VERSION of PyPI, or OWNER/NAME@COMMIT."""
    path: str
    symbol: str
    """Function, class or shader in which it stands."""

    def __str__(self) -> str:
        """Return symbol, package and file, as Markdown."""
        return f"{self.symbol} in {self.package}, {self.path}".replace("_", r"\_")

    def file(self, cache: Path) -> Path:
        """Return where the file lies in a cache folder; that of PyPI is not in it."""
        name, _, version = self.package.rpartition("@")
        is_repository = len(version) == 40
        return (repository_folder(name, cache) if is_repository else cache / "node_modules" / name) / self.path


class Stated(NamedTuple):
    """A rule, and where it stands."""

    place: Place
    said: Said


def _at(place: Place, **rules: Said) -> dict[str, Stated]:
    return {name: Stated(place, said) for name, said in rules.items()}


_SPARK = partial(Place, "@sparkjsdev/spark@2.2.0", "dist/spark.module.js")
_PLAYCANVAS = partial(Place, "playcanvas@2.23.3", "build/playcanvas.mjs")
_KELLOGG = partial(Place, "@mkkellogg/gaussian-splats-3d@0.4.7", "build/gaussian-splats-3d.module.js")
_GSPLATJS = partial(Place, "gsplat@1.2.9", "dist/index.es.js")
_GSPLATJS_FILES = partial(Place, "huggingface/gsplat.js@7133e2b49bff4392ec0d507bd508aaae5305ccae")
_SPLAT = partial(Place, "antimatter15/splat@ba182b51b7c2ad5738cdd6741cd63336d27470fb", "main.js")
_BABYLON = partial(Place, "@babylonjs/core@9.35.0")
_TORCH = partial(
    Place, "hbb1/torch-splatting@3fa49bd6708b151b8fe1a3b96e9261fa08b2a958", "gaussian_splatting/gauss_render.py"
)
_OPENSPLAT = partial(
    Place, "pierotofy/OpenSplat@15b7e80016bb25107f07956b5682231f226f62b9", "rasterizer/gsplat-cpu/gsplat_cpu.cpp"
)
_LITESPLAT = partial(Place, "litesplat==0.1.1", "litesplat/core/camera_model.py")
_GSPLAT = partial(Place, "gsplat==1.5.3")

# Lines that splat's vertex shader has, and those that were made from it.
_FREE = has(True, "-(focal.x * cam.x) / (cam.z * cam.z)")
_AXIS = "normalize(vec2(cov2d[0][1], lambda1 - cov2d[0][0]))"
_BEYOND = says(1.2, r"float clip = ([\d.]+) \* pos2d\.w")
_WIDEST = says(1024 / SQRT_8, r"min\(sqrt\(2\.0 \* lambda1\), ([\d.]+)\)", numbers=(1024,))
_CUT = says(SQRT_8, r"if \(A < -([\d.]+)\) discard", numbers=(4,))
_NO_LEAST = has(0.0, "if (A < -4.0) discard")
_HALVES = says((2.0**15) ** 0.5 / 2, r"exp < (142)\)", numbers=(142,))

SOURCES: dict[str, dict[str, Stated]] = {
    "spark": {
        **_at(
            _SPARK("SparkRenderer"),
            deviations=says(SQRT_8, r"maxStdDev = options\.maxStdDev \?\? Math\.sqrt\((\d+)\)", numbers=(8,)),
            alpha_min=says(0.5 / 255, r"minAlpha = options\.minAlpha \?\? ([\d.]+) \*", numbers=(0.5,)),
            beyond=says(1.4, r"clipXY = options\.clipXY \?\? ([\d.]+)"),
            widest=says(512 / SQRT_8, r"maxPixelRadius = options\.maxPixelRadius \?\? (\d+)", numbers=(512,)),
            eps2d=says(0.3, r"\.blurAmount = options\.blurAmount \?\? ([\d.]+)"),
            has_distances=has(True, "options.sortRadial ?? true"),
        ),
        **_at(
            _SPARK("splatVertex_default"),
            is_antialiased=has(True, "rgba.a *= blurAdjust"),
            has_free_slopes=has(True, "vec2 J2 = -(J1 * viewCenter.xy) * invZ"),
        ),
        **_at(
            _SPARK("setPackedSplat"),
            storage=says(
                PACKED,
                r"LN_SCALE_MIN = (-\d+)",
                r"LN_SCALE_MAX = (\d+)",
                r"lnScaleScale = (\d+) /",
                numbers=(-12, 9, 254),
            ),
        ),
        **_at(  # of 2.1.0; that of 2.2.0 is compiled
            Place(
                "sparkjsdev/spark@78bc65e2cfc6216aeb82b2122426293f862d7749",
                "rust/spark-rs/src/sort.rs",
                "sort32_internal",
            ),
            is_last_first=has(True, "descending order (largest keys first)"),
        ),
    },
    "playcanvas": {
        **_at(
            _PLAYCANVAS("gsplatCorner_default"),
            eps2d=says(0.3 / 4, r"diagonal1 = cov\[0\]\[0\] \+ ([\d.]+)", numbers=(0.3,)),
            narrowest=says(0.1 / 4, r"lambda2 = max\(mid - radius, ([\d.]+)\)", numbers=(0.1,)),
            widest=has(64 / SQRT_8, "float vmin = min(1024.0, min(viewport_size.x, viewport_size.y))"),
            has_free_slopes=has(True, "vec2 J2 = -J1 / vp.z * vp.xy"),
        ),
        **_at(
            _PLAYCANVAS("GSplatParams"),
            least_size=says(1 / SQRT_8, r'setParameter\("minPixelSize", ([\d.]+)\)', numbers=(2,)),
            alpha_min=says(1 / 255, r'setParameter\("alphaClipForward", 1 / (\d+)\)', numbers=(255,)),
        ),
        **_at(
            _PLAYCANVAS("normExp"),
            deviations=says(SQRT_8, r"exp\(x \* -([\d.]+)\) - EXP4", numbers=(4,)),
            is_lowered=has(True, "(exp(x * -4.0) - EXP4) * INV_EXP4"),
        ),
        **_at(
            _PLAYCANVAS("containerCompactWrite_default"),
            storage=says(
                COMPACT,
                r"logMin = (-[\d.]+)",
                r"invLogRange = ([\d.]+) /",
                r"invLogRange = [\d.]+ / ([\d.]+)",
                r"p\.x \* 0\.5 \+ 0\.5\) \* ([\d.]+) \+ 0\.5, 0",
                r"p\.z \* 0\.5 \+ 0\.5\) \* ([\d.]+) \+ 0\.5, 0",
                numbers=(-12, 255, 21, 2047, 1023),
            ),
        ),
    },
    "mkkellogg": {
        **_at(
            _KELLOGG("buildVertexShaderProjection"),
            least_root=says(0.1**0.5, r"sqrt\(max\(([\d.]+)f, traceOver2", numbers=(0.1,)),
            axis_epsilon=has(0.0, "normalize(vec2(b, eigenValue1 - a))"),
            has_free_slopes=has(True, "-(focal.x * viewCenter.x) * s"),
        ),
        **_at(
            _KELLOGG("buildVertexShaderBase"),
            beyond=says(1.2, r"float clip = ([\d.]+) \* clipCenter\.w"),
            color_max=says(1.0, r"vColor\.rgb = clamp\(vColor\.rgb, vec3\(0\.\), vec3\(([\d.]+)\)\)"),
            degree=says(2, r"SH_C2\[(2)\] \* \(2\.0 \* zz"),
        ),
        **_at(
            _KELLOGG("buildFragmentShader"),
            deviations=says(SQRT_8, r"if \(A > ([\d.]+)\) discard", numbers=(8,)),
            alpha_min=has(0.0, "if (A > 8.0) discard"),
        ),
        **_at(
            _KELLOGG("Viewer"),
            eps2d=says(0.3, r"kernel2DSize === undefined\) \? ([\d.]+)"),
            widest=says(1024 / SQRT_8, r"maxScreenSpaceSplatSize \|\| (\d+)", numbers=(1024,)),
        ),
        **_at(
            _KELLOGG("INRIAV1PlyParser"),
            storage=says(BYTES, r"Math\.exp\(-rawSplat\[OPACITY\]\)\)\) \* (\d+)", numbers=(255,)),
        ),
        **_at(
            Place(
                "mkkellogg/GaussianSplats3D@2dfc83e497bd76e558fe970c54464b17b5f5c689",
                "src/worker/sorter.cpp",
                "sortIndexes",
            ),
            is_last_first=has(True, "indexesOut[renderCount - freq] = indexes[i]"),
        ),
    },
    "gsplatjs": {
        **_at(
            _GSPLATJS("RenderProgram"),
            eps2d=says(0.3 / 4, r"cov2d\[0\]\[0\] \+= ([\d.]+)", numbers=(0.3,)),
            beyond=_BEYOND,
            widest=_WIDEST,
            deviations=_CUT,
            alpha_min=_NO_LEAST,
            has_free_slopes=_FREE,
            axis_epsilon=has(0.0, _AXIS),
        ),
        **_at(_GSPLATJS("PLYLoader"), storage=says(SPLAT, r"Z\.w \* (\d+) \+ 128", numbers=(128,))),
        **_at(
            _GSPLATJS_FILES("src/cameras/CameraData.ts", "CameraData"),
            uses_principal_point=has(False, "(2 * this.fx) / this.width"),
        ),
        **_at(_GSPLATJS_FILES("wasm/data.cpp", "floatToHalf"), largest_scale=_HALVES),
        **_at(
            _GSPLATJS_FILES("src/renderers/webgl/utils/SortWorker.ts", "runSort"),
            is_in_file_order=has(True, "heapU32.set(sortData.transformIndices, transformIndicesPtr / 4)"),
        ),
    },
    "antimatter15": {
        **_at(
            _SPLAT("vertexShaderSource"),
            eps2d=has(0.0, "float mid = (cov2d[0][0] + cov2d[1][1]) / 2.0"),
            beyond=_BEYOND,
            widest=_WIDEST,
            has_free_slopes=_FREE,
            axis_epsilon=has(0.0, _AXIS),
        ),
        **_at(_SPLAT("fragmentShaderSource"), deviations=_CUT, alpha_min=_NO_LEAST),
        **_at(
            _SPLAT("getProjectionMatrix"),
            fades_at=says(0.2, "znear"),
            uses_principal_point=has(False, "[(2 * fx) / width, 0, 0, 0]"),
        ),
        **_at(
            _SPLAT("processPlyBuffer"),
            storage=says(SPLAT, r"attrs\.rot_0 / qlen\) \* (\d+) \+ 128", numbers=(128,)),
        ),
        **_at(_SPLAT("floatToHalf"), largest_scale=_HALVES),
    },
    "babylon": {
        **_at(
            _BABYLON("Shaders/ShadersInclude/gaussianSplatting.js", "gaussianSplatting"),
            beyond=says(1.2, r"float bounds=([\d.]+)\*pos2d\.w"),
            axis_epsilon=says(1e-4, "epsilon"),
            widest=says(1024 / SQRT_8, r"majorAxis=min\(sqrt\(2\.0\*lambda1\),([\d.]+)\)", numbers=(1024,)),
            has_free_slopes=has(True, "-(focal.x*camspace.x)/(camspace.z*camspace.z)"),
        ),
        **_at(
            _BABYLON("Shaders/ShadersInclude/gaussianSplattingFragmentDeclaration.js", "gaussianColor"),
            deviations=says(SQRT_8, r"if \(A<-([\d.]+)\) discard", numbers=(4,)),
            alpha_min=has(0.0, "if (A<-4.0) discard"),
        ),
        **_at(
            _BABYLON("Materials/GaussianSplatting/gaussianSplattingMaterial.pure.js", "GaussianSplattingMaterial"),
            eps2d=says(0.3 / 4, "KernelSize", numbers=(0.3,)),
        ),
        **_at(
            _BABYLON("Meshes/GaussianSplatting/gaussianSplattingMeshBase.pure.js", "GaussianSplattingMeshBase"),
            storage=says(
                SPLAT_AND_HARMONICS,
                r"q\.w \* ([\d.]+) \+ 127\.5",
                r"Clamp\(value \* ([\d.]+) \+ 127\.5",
                numbers=(127.5, 127.5),
            ),
        ),
    },
    "gsplat-torch": _at(
        _GSPLAT("gsplat/cuda/_torch_impl.py", "_fully_fused_projection"),
        eps2d=says(0.3, r"eps2d: float = ([\d.]+)"),
        near_plane=says(0.01, r"near_plane: float = ([\d.]+)"),
    ),
    "torch-splatting": {
        **_at(
            _TORCH("GaussRenderer.render"),
            alpha_min=has(0.0, "alpha = (gauss_weight[..., None] * sorted_opacity[None]).clip(max=0.99)"),
            alpha_max=says(0.99, r"sorted_opacity\[None\]\)\.clip\(max=([\d.]+)\)"),
            white_tiles=says(64, "TILE_SIZE"),
        ),
        **_at(
            _TORCH("projection_ndc"),
            near_plane=says(0.2, r"p_view\[\.\.\., 2\] >= ([\d.]+)"),
            uses_principal_point=has(False, "points_h = points_o @ viewmatrix @ projmatrix"),
        ),
        **_at(_TORCH("build_covariance_2d"), eps2d=says(0.3, r"\.to\(cov2d\) \* ([\d.]+)")),
        **_at(_TORCH("GaussRenderer.build_color"), has_raw_directions=has(True, "rays_d = means3D - rays_o")),
    },
    "opensplat": {
        **_at(
            _OPENSPLAT("project_gaussians_forward_tensor_cpu"),
            eps2d=says(0.3, r"\{\"\.\.\.\", 0, 0\}\) \+ ([\d.]+)f"),
            uses_principal_point=has(False, "static_cast<float>(img_width) - 1.0f)"),
            clamp_is_symmetric=has(True, "torch::min(limX, torch::max(-limX,"),
        ),
        **_at(
            _OPENSPLAT("rasterize_forward_tensor_cpu"),
            alpha_max=says(0.999, r"\(std::min\)\(([\d.]+)f"),
            alpha_min=says(1 / 255, r"alphaThresh = 1\.0f / ([\d.]+)f", numbers=(255,)),
            transmittance_min=says(1e-4, r"nextT <= (1e-4)f"),
            box=says((3.0, 2), r"sqCov2dX = ([\d.]+)f", r"std::floor\(gY - sqy\)\) - (\d+)\)"),
        ),
    },
    "litesplat": {
        **_at(
            _LITESPLAT("CameraLayer.render_pixel_color"),
            eps2d=has(0.0, "Sigma2D = keras.ops.einsum('bij,bkj->bik', T, T)"),
            alpha_min=has(0.0, "weights = keras.ops.exp(-0.5 * mahalanobis)"),
            degree=has(0, "sorted_gaussians = keras.ops.take(self.gaussians.colors"),
        ),
        **_at(_LITESPLAT("CameraLayer.call"), centres=has((0.0, 1.0), "xs = keras.ops.arange(0, full_W, step_x)")),
        **_at(
            _LITESPLAT("CameraLayer.projection_jacobians"),
            near_plane=says(1e-8, r"positions\[:, 2\], (1e-8)\)"),
            has_free_slopes=has(True, "-fx * X / (Z ** 2)"),
        ),
        **_at(
            _LITESPLAT("CameraLayer.get_sorted_keys"),
            has_distances=has(True, "distances = keras.ops.sqrt(keras.ops.sum(diffs**2, axis=-1))"),
        ),
    },
}
"""By a renderer's name, then by the rule."""


def is_said(stated: Stated, text: str) -> bool:
    """Return whether a file's text states a rule as the table does."""
    said: Any = stated.said
    if not said.numbers:
        return all(symbol in text for symbol in said.symbols)
    return [find(symbol, text) for symbol in said.symbols] == [float(number) for number in said.numbers]
