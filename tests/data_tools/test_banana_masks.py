"""Masks of the transparency of copies, in the size of the photographs."""

import sys

import numpy as np
from PIL import Image

from data_tools.banana_masks import main


def test_a_mask_for_each_photograph_with_a_transparent_copy(tmp_path, monkeypatch):
    """Half of a copy is opaque; its mask is so, too, at twice the size. Another photograph has no copy."""
    photographs, copies = tmp_path / "photographs", tmp_path / "copies" / "train"
    for folder in (photographs, copies):
        folder.mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (16, 12)).save(photographs / name)
    pixels = np.zeros((6, 8, 4), np.uint8)
    pixels[:, :4, 3] = 255
    Image.fromarray(pixels).save(copies / "a.png")
    monkeypatch.setattr(sys, "argv", ["banana_masks", str(tmp_path / "copies"), str(photographs)])
    main()
    assert [file.name for file in (photographs / "masks").iterdir()] == ["a.jpg.png"]
    with Image.open(photographs / "masks" / "a.jpg.png") as mask:
        found = np.asarray(mask)
    assert found.shape == (12, 16) and (found[:, :8] == 255).all() and (found[:, 8:] == 0).all()
