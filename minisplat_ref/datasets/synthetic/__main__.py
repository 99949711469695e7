"""``minisplat-ref synthetic NAME --out DIR``: make a synthetic scene and write it as a COLMAP folder."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tqdm import tqdm

from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.datasets.synthetic.files import check_free, write_scene
from minisplat_ref.errors import InputError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when the scene is written, 2 when the input is wrong."""
    parser = argparse.ArgumentParser(
        prog="minisplat-ref synthetic",
        description="Ray-trace a scene with exact depth and normals, and write it as a COLMAP folder.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("name", metavar="NAME", help=f"scene: {', '.join(SCENE_NAMES)}")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, required=True, default=argparse.SUPPRESS, help="folder to make"
    )
    parser.add_argument("--views", metavar="N", type=int, default=24, help="training views; test views come on top")
    parser.add_argument("--width", metavar="PX", type=int, default=160, help="image width")
    parser.add_argument("--height", metavar="PX", type=int, default=120, help="image height")
    parser.add_argument("--seed", metavar="S", type=int, default=0, help="of textures, camera path and points")
    parser.add_argument("--supersampling", metavar="N", type=int, default=2, help="N x N colour samples a pixel")
    parser.add_argument("--points", metavar="N", type=int, default=4000, help="sparse points")
    parser.add_argument("--point-noise", metavar="M", type=float, default=0.0, help="their standard error, metres")
    parser.add_argument("--test-every", metavar="N", type=int, default=8, help="every Nth view is for testing; 0: none")
    options = parser.parse_args(arguments)
    settings = {
        "n_views": options.views,
        "width": options.width,
        "height": options.height,
        "seed": options.seed,
        "supersampling": options.supersampling,
        "n_points": options.points,
        "point_noise": options.point_noise,
        "test_every": options.test_every,
    }
    try:
        check_free(options.out)
        progress = partial(tqdm, desc=options.name, unit=" views", leave=False)
        synthetic = make_scene(options.name, **settings, progress=progress)
        write_scene(synthetic, options.out, {"scene": options.name, **settings})
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    n_train, n_test = len(synthetic.scene.train_views), len(synthetic.scene.test_views)
    print(f"{options.out}: {n_train} training and {n_test} test views, {len(synthetic.scene.points)} points")
    return 0


if __name__ == "__main__":
    sys.exit(main())
