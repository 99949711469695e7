"""The order in which to read the code: one list, from which README.md and docs/ARCHITECTURE.md are generated.

README.md shows the parts, docs/ARCHITECTURE.md every step, and notebook 00 displays the table of docs/ARCHITECTURE.md.

    python -m data_tools.reading_order            # write both, between the markers
    python -m data_tools.reading_order --check    # exit with 1 where one of them differs
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- reading order: begin -->", "<!-- reading order: end -->"


class Step(NamedTuple):
    """What to read together."""

    files: tuple[str, ...]
    """Files and folders of ``minisplat_ref/``."""
    notebooks: tuple[int, ...]
    """Numbers of the notebooks that show the same with images."""
    content: str
    """What the reader knows afterwards."""


class Part(NamedTuple):
    """Steps on one subject, after which a reader may stop."""

    subject: str
    files: tuple[str, ...]
    """The files and folders in which those of the steps are."""
    steps: tuple[Step, ...]


ORDER = (
    Part(
        "the renderer",
        ("types.py", "constants.py", "reference/", "rendering/"),
        (
            Step(("types.py", "constants.py"), (0,), "what is passed around, in which frames and units"),
            Step(("reference/covariance.py", "reference/projection.py"), (1,), "from an ellipsoid to an ellipse"),
            Step(("reference/spherical_harmonics.py",), (2,), "how a colour depends on the viewing direction"),
            Step(
                ("reference/tiling.py", "reference/hits.py", "reference/compositing.py"),
                (3, 4),
                "how ellipses become pixels; how an error reaches every parameter",
            ),
            Step(("reference/depth.py", "reference/loss.py"), (5,), "depth maps; what is minimised"),
            Step(("rendering/",), (6,), "from parameters to an image and back"),
        ),
    ),
    Part(
        "training",
        ("strategy/", "methods/", "training/"),
        (
            Step(
                ("strategy/initialization.py", "strategy/clone_split.py"),
                (6, 7),
                "the first Gaussians; which of them become two",
            ),
            Step(
                ("strategy/blur_split.py", "strategy/depth_reinit.py"),
                (7, 8),
                "blur split; where surfaces are, and what misleads the search for them",
            ),
            Step(("strategy/importance.py", "strategy/simplify.py"), (9,), "which Gaussians may be removed"),
            Step(
                ("strategy/aggressive_clone.py", "strategy/visibility.py"),
                (10,),
                "many Gaussians early, few in each view",
            ),
            Step(
                ("methods/gaussian_splatting.py", "methods/mini_splatting.py", "methods/mini_splatting2.py"),
                (11,),
                "recipes: what happens at which iteration, in three methods",
            ),
            Step(("training/iteration.py", "training/loop.py"), (6,), "what happens in an iteration, and around it"),
            Step(("methods/adaptive/", "training/pace.py"), (17,), "how a scene determines its own size"),
        ),
    ),
    Part(
        "the kernels",
        ("scalar/", "cpu/", "cuda/"),
        (
            Step(
                ("scalar/", "cpu/compositing/plain.py", "cpu/"),
                (15,),
                "the same formulas for one Gaussian or one pixel, and fast loops over them",
            ),
            Step(
                ("cuda/target.py", "cuda/compositing/", "cuda/"), (20,), "the loops again, for a block of 256 threads"
            ),
        ),
    ),
    Part(
        "the oracle",
        ("oracle/", "bench/"),
        (
            Step(
                ("oracle/differences.py", "oracle/gradients.py", "oracle/planted.py"),
                (12,),
                "how to check a gradient, and how a check lies",
            ),
            Step(
                ("oracle/golden/", "oracle/comparison/", "oracle/thresholds.py"),
                (13,),
                "where another renderer differs",
            ),
            Step(("bench/",), (14,), "speed beside error"),
        ),
    ),
    Part(
        "relatives of 3DGS",
        ("mechanisms/", "extensions/"),
        (
            Step(("extensions/velocity/",), (), "a whole extension, explained in docs/EXTENDING.md"),
            Step(
                ("extensions/antialiasing/", "extensions/multi_scale/", "extensions/compression/"),
                (16,),
                "scale, compactness, storage, editing",
            ),
            Step(
                (
                    "mechanisms/orders.py",
                    "mechanisms/tangent/",
                    "extensions/pixel_order/",
                    "mechanisms/rays/",
                    "extensions/rays/",
                ),
                (18,),
                "depth order per pixel; rays, shadows and mirrors",
            ),
            Step(
                ("mechanisms/payload/", "extensions/textured/", "mechanisms/peeling/", "extensions/fans/"),
                (19,),
                "textures and sharp edges; lines, polygons, meshes",
            ),
            Step(
                (
                    "mechanisms/surfels/",
                    "extensions/surfels/",
                    "extensions/mvg/",
                    "extensions/gdgs/",
                    "mechanisms/fusion/",
                ),
                (21,),
                "discs with depths and normals; from depth maps to a mesh",
            ),
            Step(("extensions/games/",), (), "Gaussians that are trained on the faces of a mesh"),
            Step(
                (
                    "mechanisms/gbuffer/",
                    "extensions/reflective/",
                    "extensions/texture_splat/",
                    "extensions/discretized_sdf/",
                ),
                (22,),
                "materials blended, then shaded per pixel in an environment that is learned; opacity from distances",
            ),
            Step(
                ("mechanisms/motion/", "extensions/lucas_kanade/"),
                (24,),
                "a warp that moves a scene, three forms of its velocity, and flow from photographs",
            ),
            Step(
                ("mechanisms/networks/", "extensions/vdgs/"),
                (24,),
                "small networks trained with a scene: opacities that depend on the view",
            ),
            Step(
                ("mechanisms/features/", "extensions/style/"),
                (25,),
                "features of images; a scene in the style of an image",
            ),
            Step(
                ("extensions/cus/",),
                (),
                "voxels that networks decode to Gaussians, and a memory in which pixels read features",
            ),
            Step(("extensions/segment/",), (25,), "labels of Gaussians from masks of photographs, by a vote"),
            Step(("extensions/satellite/",), (), "affine cameras of satellites, the sun's shadows, surface models"),
            Step(
                ("mechanisms/cameras/", "extensions/lens/", "extensions/wave/"),
                (23,),
                "lenses that are not pinholes, along exact rays; a hologram of a scene",
            ),
        ),
    ),
    Part(
        "the application",
        ("app/",),
        (
            Step(
                ("app/cli/train.py", "app/runs/options.py", "app/runs/run_folder.py", "app/runs/run.py"),
                (),
                "from a command line to a run and its folder",
            ),
            Step(
                ("app/comparison/", "app/blocks/", "app/reports/"),
                (),
                "recipes side by side; a large scene in blocks; the page of a result",
            ),
        ),
    ),
)
"""The whole order. Everything in the first two parts is NumPy and can be read without Numba."""


def short() -> str:
    """Return the parts as a numbered list in Markdown, for README.md."""
    lines = []
    for number, part in enumerate(ORDER, 1):
        notebooks = _ranges({notebook for step in part.steps for notebook in step.notebooks})
        line = f"{number}. {part.subject}: {_quote_files(part.files)}"
        lines.append(f"{line}; notebook{'s' if len(notebooks) > 2 else ''} {notebooks}" if notebooks else line)
    return "\n".join(lines)


def full() -> str:
    """Return every step as a table in Markdown, for docs/ARCHITECTURE.md and notebook 00."""
    lines = ["| part | read | notebook | content |", "|---|---|---|---|"]
    for part in ORDER:
        for k, step in enumerate(part.steps):
            notebooks = ", ".join(f"{number:02}" for number in step.notebooks)
            cells = (part.subject if k == 0 else "", _quote_files(step.files), notebooks, step.content)
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


PAGES = {ROOT / "README.md": short, ROOT / "docs" / "ARCHITECTURE.md": full}


def _quote_files(files: tuple[str, ...]) -> str:
    return ", ".join(f"`{file}`" for file in files)


def _ranges(numbers: set[int]) -> str:
    """Return numbers as text, three or more in a row as a range: ``00 to 06, 11``."""
    rows: list[list[int]] = []
    for number in sorted(numbers):
        if rows and number == rows[-1][-1] + 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    texts = [[f"{row[0]:02} to {row[-1]:02}"] if len(row) > 2 else [f"{n:02}" for n in row] for row in rows]
    return ", ".join(text for row in texts for text in row)


def with_order(text: str, order: str) -> str:
    """Return the text of a page with the order between its markers."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{order}\n\n{END}{after}"


def main(argv: list[str] | None = None) -> int:
    """Write the pages, or check that nothing would change."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.reading_order", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 where a page differs")
    args = parser.parse_args(argv)
    stale = []
    for page, order in PAGES.items():
        text = page.read_text(encoding="utf-8")
        new = with_order(text, order())
        if new != text:
            stale.append(page.relative_to(ROOT))
            if not args.check:
                page.write_text(new, encoding="utf-8")
    for name in stale:
        print(f"{name}: {'differs: python -m data_tools.reading_order' if args.check else 'written'}")
    return 1 if args.check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
