"""The README's film: what is left and right of the line, how the file is written, and the one that the README shows."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from data_tools import readme_film
from data_tools.readme_film import divided, film, write
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.model_source import open_source
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from run_commands import RECIPE, SCENE

LEFT, RIGHT = np.full((2, 10, 3), 10, np.uint8), np.full((2, 10, 3), 200, np.uint8)


def test_the_line_stands_between_both():
    row = divided(LEFT, RIGHT, 0.3)[0, :, 0].tolist()
    assert row == [10] * 6 + [255] * 2 + [200] * 2  # three tenths are of the right one, the line takes a column of each


@pytest.mark.parametrize(("share", "image"), [(0.0, LEFT), (1.0, RIGHT)])
def test_one_image_alone_has_no_line(share, image):
    assert_array_equal(divided(LEFT, RIGHT, share), image)


def test_a_film_is_written_whole_and_a_large_one_is_refused(tmp_path, monkeypatch):
    images = [np.full((8, 12, 3), 40 * k, np.uint8) for k in range(5)]
    write(tmp_path / "film.webp", images, 50)
    with Image.open(tmp_path / "film.webp") as shown:
        assert (shown.n_frames, shown.size, shown.info["loop"]) == (5, (12, 8), 0)
        shown.seek(3)
        assert abs(int(np.asarray(shown.convert("RGB")).mean()) - 120) <= 3
    monkeypatch.setattr(readme_film, "BYTES_MAX", 10)
    with pytest.raises(InputError, match=r"would have [\d,]+ bytes: lower --frames"):
        write(tmp_path / "other.webp", images, 50)
    assert not (tmp_path / "other.webp").exists()


def test_a_film_goes_around_a_run_and_back(tmp_path):
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "scene", SCENE)
    run = tmp_path / "run"
    assert main(["train", str(tmp_path / "scene"), "--out", str(run), *RECIPE, "--iterations", "2"]) == 0
    source = open_source(run)
    images = film(source, 4, 20)
    assert len(images) == 4 and images[0].shape == (16, 20, 3)  # 32 x 24 photographs: 15 rows, made even
    assert not (images[0] == 255).all(axis=(0, 2)).any()  # the first has no line, and the second one between
    lines = [np.flatnonzero((images[k] == 255).all(axis=(0, 2))).tolist() for k in (1, 3)]
    assert lines == [[9, 10], [9, 10]]  # a quarter of the way, and a quarter before the end: in the middle
    assert images[2].mean() < images[0].mean()  # smaller Gaussians leave gaps, in which the background is black
    with pytest.raises(InputError, match="give the folder of a training"):
        film(open_source(run / "point_cloud.ply"), 4, 20)


def test_the_film_of_the_readme_is_small():
    path = readme_film.DOCS / "figures" / "readme.webp"
    assert path.stat().st_size <= readme_film.BYTES_MAX
    text = (readme_film.DOCS.parent / "README.md").read_text(encoding="utf-8")
    assert text.index("docs/figures/readme.webp") < text.index("The oracle has found") < text.index("## Installation")
