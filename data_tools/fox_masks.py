"""Masks of the fox's head in five photographs, drawn by hand as polygons, for ``minisplat-ref segment``.

    python -m data_tools.fox_masks masks
    minisplat-ref train fox --downscale 2 --out runs/fox
    minisplat-ref segment label runs/fox --masks masks --extract 1 --out head.ply

Five of fifty photographs are enough to take the head out; it is what docs/family/segment.md describes.
"""

import argparse
from pathlib import Path

from PIL import Image, ImageDraw

SIZE = (270, 480)  # of the masks, pixels; of photographs of the scene, which a training at --downscale 2 halves
HEAD = {
    "0002": "170 38 190 70 195 100 225 95 243 85 228 115 230 160 255 185 250 205 225 215 195 210 180 245 160 290 "
    "110 300 78 290 75 225 85 180 105 140 125 115 133 75",
    "0014": "38 38 65 55 88 85 130 90 155 80 185 50 180 80 165 120 172 160 168 200 155 225 150 270 125 300 85 305 "
    "60 290 48 250 45 200 50 150 40 90",
    "0029": "35 115 65 135 95 135 120 120 140 90 158 110 160 160 165 190 190 220 190 290 185 345 160 362 120 350 "
    "95 320 85 270 40 268 38 245 55 215 50 150",
    "0044": "125 0 265 0 262 60 235 110 225 180 190 235 150 250 95 230 55 195 62 140 90 90 110 50",
    "0115": "0 0 65 0 85 60 130 130 138 190 125 260 110 310 70 318 20 290 0 250",
}
"""Corners x y of each polygon, pixels."""


def main() -> None:
    """Write a PNG for each photograph: 1 is the head, 0 everything else."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder to write to")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, corners in HEAD.items():
        mask = Image.new("L", SIZE)
        ImageDraw.Draw(mask).polygon([int(number) for number in corners.split()], fill=1)
        mask.save(folder / f"{name}.png")


if __name__ == "__main__":
    main()
