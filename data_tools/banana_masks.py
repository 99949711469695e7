"""Masks of the bananas, made of the transparency of *banana_blender*, for the photographs of *banana*.

    python -m data_tools.banana_masks banana_blender photographs

Both are of the same capture. The folder ``photographs``, a copy of ``banana/images``, gets ``masks/NAME.jpg.png``,
where ``sfm`` and ``photos`` look for them: an object by itself, as ``docs/measured/adaptive.md`` measures it.
"""

import argparse
from pathlib import Path

from PIL import Image

OPAQUE = 128  # of 255, from which a pixel counts


def main() -> None:
    """Write a mask, of the size of the photograph, for each one that has a transparent copy."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.banana_masks", description=__doc__.split("\n")[0])
    parser.add_argument("transparent", type=Path, help="folder of banana_blender")
    parser.add_argument("photographs", type=Path, help="folder with copies of the photographs of banana/images")
    args = parser.parse_args()
    folder = args.photographs / "masks"
    folder.mkdir(exist_ok=True)
    for photograph in sorted(args.photographs.glob("*.jpg")):
        for cut_out in args.transparent.glob(f"*/{photograph.stem}.png"):
            with Image.open(photograph) as shown, Image.open(cut_out) as image:
                alpha = image.getchannel("A").resize(shown.size, Image.Resampling.LANCZOS)
            alpha.point(lambda value: 255 * (value >= OPAQUE)).save(folder / f"{photograph.name}.png")


if __name__ == "__main__":
    main()
