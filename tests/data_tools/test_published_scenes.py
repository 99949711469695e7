"""Rows of published scenes: which images remain of Lego, the cells by hand, and a row that is trained."""

import json
import re

import numpy as np
import pytest

from data_tools import published_scenes
from data_tools.few_images import FIRST, PAPERS, THREE, thin_out
from data_tools.published_scenes import ROWS, Variant, cells, main, shortened
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene, write_image

POSE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]


@pytest.fixture
def lego(tmp_path):
    """As many images as Lego has, of 12 x 12 pixels, each with its own gray value."""
    for split, n in (("train", 100), ("test", 200)):
        frames = []
        (tmp_path / "lego" / split).mkdir(parents=True)
        for k in range(n):
            pose = np.array(POSE)
            pose[0, 3] = 0.01 * k
            frames.append({"file_path": f"./{split}/r_{k}", "transform_matrix": pose.tolist()})
            write_image(tmp_path / "lego" / split / f"r_{k}.png", np.full((12, 12, 3), k, np.uint8))
        content = {"camera_angle_x": 0.69, "frames": frames}
        (tmp_path / "lego" / f"transforms_{split}.json").write_text(json.dumps(content))
    return tmp_path / "lego"


def test_eight_images_are_trained_on_and_every_eighth_is_measured(lego, tmp_path):
    scene = load_scene(thin_out(lego, PAPERS, tmp_path / "few"))
    assert sorted(int(view.image[0, 0, 0]) for view in scene.train_views) == [2, 16, 26, 55, 73, 75, 86, 93]
    assert [int(view.image[0, 0, 0]) for view in scene.test_views if view.name.endswith("_8")] == [8]
    assert len(scene.test_views) == 25
    by_value = {int(view.image[0, 0, 0]): view.camera.center[0] for view in scene.train_views}
    assert by_value[26] == pytest.approx(0.26)
    assert thin_out(tmp_path / "nowhere", PAPERS, tmp_path / "few") == tmp_path / "few"  # it is there already


def test_the_first_eight_images_and_all_test_images(lego, tmp_path):
    scene = load_scene(thin_out(lego, FIRST, tmp_path / "few"))
    assert sorted(int(view.image[0, 0, 0]) for view in scene.train_views) == list(range(8))
    assert len(scene.test_views) == 200


def test_another_scene_is_refused(lego, tmp_path):
    with pytest.raises(InputError, match=r"transforms_train\.json is missing"):
        thin_out(tmp_path, PAPERS, tmp_path / "few")
    content = json.loads((lego / "transforms_train.json").read_text())
    (lego / "transforms_train.json").write_text(json.dumps({**content, "frames": content["frames"][:50]}))
    with pytest.raises(InputError, match="has no image r_86"):
        thin_out(lego, PAPERS, tmp_path / "few")
    assert not (tmp_path / "few").exists()


def write_fern(path):
    """Twenty photographs of 12 x 16 pixels, each with its own gray value, whose cameras have its number as x."""
    rows = []
    for k in range(20):
        down, right, backward = [0.0, -1, 0], [1.0, 0, 0], [0.0, 0, 1]
        rows.append([*np.column_stack([down, right, backward, [k, 0, 0], [96, 128, 100]]).ravel(), 1.0, 9.0])
        (path / "images_4").mkdir(parents=True, exist_ok=True)
        write_image(path / "images_4" / f"image{k:03}.png", np.full((12, 16, 3), 10 * k, np.uint8))
    np.save(path / "poses_bounds.npy", np.array(rows))
    return path


def test_three_photographs_of_fern_are_trained_on_and_the_published_ones_measured(tmp_path):
    """Held out are 0, 8 and 16; of the others, 1 2 3 4 5 6 7 9 10 ... 19, the first, ninth and last remain."""
    fern = write_fern(tmp_path / "fern")
    scene = load_scene(thin_out(fern, THREE, tmp_path / "few"), test_every=2)
    for views, numbers in ((scene.train_views, [1, 10, 19]), (scene.test_views, [0, 8, 16])):
        assert [int(view.image[0, 0, 0]) // 10 for view in views] == numbers
        assert [view.camera.center[0] for view in views] == numbers
        assert {view.image.shape for view in views} == {(12, 16, 3)}
    held_out = {view.name for view in load_scene(fern, test_every=8).test_views}
    assert held_out == {view.name for view in scene.test_views}


def test_a_fern_without_its_photographs_is_refused(tmp_path):
    fern = write_fern(tmp_path / "fern")
    (fern / "images_4" / "image019.png").unlink()
    with pytest.raises(InputError, match=r"images_4 has 19 files, and poses_bounds\.npy 20 rows: it is not fern"):
        thin_out(fern, THREE, tmp_path / "few")
    assert not (tmp_path / "few").exists()


def test_cells_by_hand():
    metrics = {"psnr": 35.0, "ssim": 0.98, "n_gaussians": 300_000, "iterations": 30_000, "train_cpu_seconds": 5400.4}
    expected = ["lego-3dgs", "30,000", "35.78", "35.00", "-0.78", "0.9800", "300,000", "5,400"]
    assert cells("lego-3dgs", metrics, 35.78) == expected
    assert cells("lego-adaptive", metrics, None)[2:5] == ["-", "35.00", "-"]


def test_a_part_of_the_iterations():
    """Of 30,000 iterations that are measured every 7,000, a tenth is 3,000, every 700; other numbers stay."""
    options = shortened(ROWS["lego-3dgs"].options, 10)
    assert options[options.index("--iterations") + 1] == "3000" and options[options.index("--eval-every") + 1] == "700"
    assert "255,255,255" in options and shortened(ROWS["lego-adaptive"].options, 10) == [*ROWS["lego-adaptive"].options]


def test_another_seed_is_compared_with_what_is_published_and_another_setting_is_not():
    row = ROWS["lego-3dgs"]
    seed, setting = Variant(seed=2), Variant(settings=("budget=9", "min_opacity=0.1"))
    assert seed.options(row) == [*row.options, "--seed", "2"] and seed.published(row) == 35.78
    assert setting.options(row)[-4:] == ["--set", "budget=9", "--set", "min_opacity=0.1"]
    assert setting.published(row) is None and Variant(part=10).published(row) is None
    assert seed.name("lego-3dgs") == "lego-3dgs, seed 2" and Variant().name("lego-3dgs") == "lego-3dgs"
    assert setting.name("lego-3dgs") == "lego-3dgs, budget=9, min_opacity=0.1"


def test_a_row_from_the_command_line(lego, tmp_path, monkeypatch, capsys):
    short = ROWS["lego-first-8-3dgs-accel"]._replace(options=("--recipe", "3dgs-accel", "--iterations", "2"))
    monkeypatch.setitem(published_scenes.ROWS, "lego-first-8-3dgs-accel", short)
    command = ["lego-first-8-3dgs-accel", "--data", str(lego), "--out", str(tmp_path / "run")]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "| lego-first-8-3dgs-accel | 2" in printed
    assert "published, for all iterations: 22.48 dB, issue 40 of Fictionarry/DNGaussian" in printed
    assert re.search(r"\| 2 +\| 22\.48 ", printed)
    assert main([*command[:-1], str(tmp_path / "half"), "--part", "2"]) == 0
    assert re.search(r"\| 1 +\| - ", capsys.readouterr().out)  # what is published is of all iterations
    other = [*command[:-1], str(tmp_path / "other"), "--seed", "3", "--set", "dropout=0.1"]
    assert main(other) == 0 and "3dgs-accel, seed 3, dropout=0.1 | 2" in capsys.readouterr().out
    config = json.loads((tmp_path / "other" / "config.json").read_text())["settings"]
    assert config["seed"] == 3 and config["set"] == {"dropout": "0.1"}
    assert main(other[:-2]) == 2 and "with settings dropout=0.1, not of the recipe alone" in capsys.readouterr().err
    assert main([*command, "--seed", "3"]) == 2 and "with seed 0, not 3" in capsys.readouterr().err
    monkeypatch.setitem(published_scenes.ROWS, "lego-8-3dgs-accel", short._replace(few=PAPERS))
    assert main(["lego-8-3dgs-accel", *command[1:]]) == 2 and "was trained with scene " in capsys.readouterr().err
    assert not (tmp_path / "lego-8").exists()  # nothing is copied for a row that is refused
    log = (tmp_path / "run" / "log.jsonl").read_bytes()
    assert main(command) == 0 and (tmp_path / "run" / "log.jsonl").read_bytes() == log  # not trained again
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    smaller = short._replace(options=(*short.options, "--downscale", "4"))
    monkeypatch.setitem(published_scenes.ROWS, "lego-first-8-3dgs-accel", smaller)
    assert main(command) == 2 and "with downscale 1, not 4" in capsys.readouterr().err
    longer = short._replace(options=(*short.options[:-1], "3"))
    monkeypatch.setitem(published_scenes.ROWS, "lego-first-8-3dgs-accel", longer)
    assert main(command) == 2 and "was trained with iterations 2, not 3: give another --out" in capsys.readouterr().err
    config["settings"]["iterations"] = 3  # as if it had been stopped after two of them, which are measured, too
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    assert main(command) == 0 and re.search(r"3dgs-accel \| 3 ", capsys.readouterr().out)
    assert main(["lego-8-3dgs", "--data", str(tmp_path / "no"), "--out", str(tmp_path / "b" / "run")]) == 2
    assert "is missing: give the folder" in capsys.readouterr().err
    assert main([]) == 0 and "fern-adaptive" in capsys.readouterr().out
