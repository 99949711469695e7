"""Names of properties in PLY files of other programs, one by one, and what is made of colours and infinities."""

import numpy as np
import pytest

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io.ply_dialects import as_usual, renamed, usual_name

USUAL = {
    **{"X": "x", "pos_0": "x", "means_1": "y", "position[2]": "z", "xyz.1": "y", "center_z": "z", "mean_x": "x"},
    **{"scaling_0": "scale_0", "scale_x": "scale_0", "sy": "scale_1", "log_scales_2": "scale_2", "Scale_1": "scale_1"},
    **{"rot_w": "rot_0", "qx": "rot_1", "quat_y": "rot_2", "rotation_3": "rot_3", "quaternion(1)": "rot_1"},
    **{"features_dc_2": "f_dc_2", "sh_dc_0": "f_dc_0", "features_rest_44": "f_rest_44", "F_REST_7": "f_rest_7"},
    **{"opacities": "opacity", "opacity_0": "opacity", "Opacity": "opacity", "logit_opacity": "opacity"},
}
OTHERS = ("nx", "red", "opacity_1", "pos_3", "scale_w", "semantic_0", "filter_3D", "w", "t", "rot_r_0", "scale_t")


@pytest.mark.parametrize(("name", "usual"), USUAL.items())
def test_a_name_of_another_program(name, usual):
    assert usual_name(name) == usual


@pytest.mark.parametrize("name", OTHERS)
def test_other_names_stay(name):
    assert usual_name(name) == name


def test_a_name_that_is_there_is_not_taken_twice():
    assert renamed(["scale_0", "scaling_0", "qw"]) == {"qw": "rot_0"}


def columns(**changed):
    names = ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    return {name: np.full(3, 0.5, np.float32) for name in names} | changed


def test_colours_by_hand():
    """(255 / 255 - 0.5) / 0.28209479 = 1.7725 of white, its negative of black."""
    colors = {name: np.array([0, 255, 128], np.uint8) for name in ("red", "green", "blue")}
    with pytest.warns(InputWarning, match="its colours are red, green, blue: the same from all sides"):
        usual = as_usual("a.ply", columns(**colors))
    np.testing.assert_allclose(usual["f_dc_1"], [-1.7724539, 1.7724539, 0.0069508], rtol=1e-4)
    bad = {name: np.array([0, 256, 1], np.int32) for name in ("red", "green", "blue")}
    with pytest.raises(InputError, match="red goes from 0 to 256"):
        as_usual("a.ply", columns(**bad))


def test_colours_as_floats_by_hand():
    """White is 1, not 255: (0.25 - 0.5) / 0.28209479 = -0.8862."""
    colors = {name: np.array([0, 1, 0.25], np.float32) for name in ("red", "green", "blue")}
    with pytest.warns(InputWarning, match="its colours are red, green, blue"):
        usual = as_usual("a.ply", columns(**colors))
    np.testing.assert_allclose(usual["f_dc_2"], [-1.7724539, 1.7724539, -0.8862269], rtol=1e-6)
    bad = {name: np.array([0, 1, 200], np.float32) for name in ("red", "green", "blue")}
    with pytest.raises(InputError, match="red goes from 0 to 200"):
        as_usual("a.ply", columns(**bad))


def test_two_scales_and_infinities_by_hand():
    """ln 1000 = 6.9078 below the smaller; +-16 and -30 in the place of infinities, and the others as they were."""
    given = columns(opacity=np.array([np.inf, -np.inf, 2], np.float32), scale_1=np.array([-3, -np.inf, 1], np.float32))
    del given["scale_2"]
    with pytest.warns(
        InputWarning, match="two scales: .* 2 of 3 opacities are infinite.* 1 of 3 Gaussians have a scale"
    ):
        usual = as_usual("a.ply", given)
    np.testing.assert_allclose(usual["opacity"], [16, -16, 2])
    np.testing.assert_allclose(usual["scale_1"], [-3, -30, 1])
    np.testing.assert_allclose(usual["scale_2"], [-9.907755, -30, -6.407755], rtol=1e-6)


def test_files_of_something_else_stay():
    cloud = {"X": np.zeros(2), "qw": np.zeros(2)}
    assert as_usual("a.ply", cloud) == cloud
