"""Input that must be refused, with one clear line instead of an image that cannot be trusted."""

from typing import Any

import numpy as np

from minisplat_ref.oracle.hard_cases.scenes import call, camera, cloud, intrinsics
from minisplat_ref.oracle.hard_cases.subjects import Call, HardCase, Parameters
from minisplat_ref.types import Gaussians

ARRAYS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
NAN, INF = float("nan"), float("inf")


def _spoil_parameters(field: str, value: float) -> HardCase:
    def build() -> Parameters:
        population = cloud(sh_degree=1)
        array = getattr(population, field).copy()
        array.flat[-1] = value
        return Parameters(population._replace(**{field: array}), camera())

    return HardCase(
        f"{value}-in-{field}".replace("_", "-"),
        "one value in thirty Gaussians; it would spread over the image, or vanish in a comparison",
        "refused, with the field and the index",
        build,
        refusal=f"scene: {field} is {value} at index [",
    )


def _spoil_array(name: str, value: float) -> HardCase:
    def build() -> Call:
        subject = call([[0, 0, 3.0], [0.1, 0, 4]])
        array = subject.arrays[name].copy()
        array.flat[0] = value
        return subject._replace(arrays=subject.arrays | {name: array})

    return HardCase(
        f"call-{value}-in-{name}",
        "one value; it would spread over the image, or vanish in a comparison",
        "refused, with the argument and the index",
        build,
        refusal=f"{name} is {value} at index [",
    )


def _spoil_call(name: str, why: str, refusal: str, **changes: Any) -> HardCase:
    """A call of two Gaussians in which something is wrong."""

    def build() -> Call:
        options = {key: value for key, value in changes.items() if key not in ARRAYS}
        subject = call([[0, 0, 3.0], [0.1, 0, 4]], **options)
        arrays = {key: value for key, value in changes.items() if key in ARRAYS}
        return subject._replace(arrays=subject.arrays | arrays)

    return HardCase(
        name,
        why,
        "refused, with what to give instead",
        build,
        refusal=refusal,
    )


def _zero_quaternion() -> Parameters:
    population = cloud()
    quats = population.quats.copy()
    quats[7] = 0
    return Parameters(population._replace(quats=quats), camera())


def _view(row: int, column: int, value: float) -> np.ndarray:
    viewmat = np.eye(4)
    viewmat[row, column] = value
    return viewmat[None]


def _intrinsic(row: int, column: int, value: float) -> np.ndarray:
    K = intrinsics(30, 30, 4.5, 4.5)
    K[0, row, column] = value
    return K


BAD_INPUT = (
    *(_spoil_parameters(field, NAN) for field in Gaussians._fields),
    *(_spoil_parameters(field, INF) for field in ("means", "log_scales", "opacity_logits", "sh_rest")),
    HardCase(
        "zero-quaternion",
        "no rotation: 0 / 0",
        "refused, with the row",
        _zero_quaternion,
        refusal="row 7 is a zero quaternion",
    ),
    *(_spoil_array(name, NAN) for name in ARRAYS),
    *(_spoil_array(name, -INF) for name in ("means", "colors")),
    _spoil_call(
        "call-nan-background", "it shines through every pixel", "backgrounds is nan", backgrounds=np.full((1, 3), NAN)
    ),
    _spoil_call(
        "call-zero-quaternion",
        "no rotation: 0 / 0",
        "row 1 is a zero quaternion",
        quats=np.array([[1.0, 0, 0, 0], [0] * 4]),
    ),
    _spoil_call(
        "call-negative-scale",
        "a logarithm that was not exponentiated",
        "give exp(log_scales)",
        scales=np.full((2, 3), -2.0),
    ),
    _spoil_call(
        "call-opacity-above-1",
        "a logit that was not activated",
        "give sigmoid(opacity_logits)",
        opacities=np.array([0.5, 1.5]),
    ),
    _spoil_call("call-opacity-below-0", "the same", "give sigmoid(opacity_logits)", opacities=np.array([0.5, -0.1])),
    _spoil_call(
        "call-transposed-view",
        "t is in the last row",
        "transposed if yours has t in its last row",
        viewmats=_view(3, 0, 1.0),
    ),
    _spoil_call(
        "call-singular-view",
        "it flattens the world: there is no camera's centre",
        "singular 3 x 3 part",
        viewmats=_view(2, 2, 0.0),
    ),
    _spoil_call("call-focal-length-0", "division by 0", "they must be positive pixels", Ks=_intrinsic(0, 0, 0.0)),
    _spoil_call(
        "call-focal-length-negative", "mirrors the image", "they must be positive pixels", Ks=_intrinsic(1, 1, -30.0)
    ),
    _spoil_call("call-skew", "not a pinhole of this renderer", "rectify the image", Ks=_intrinsic(0, 1, 0.1)),
    _spoil_call(
        "call-no-camera",
        "an empty batch",
        "give at least one",
        viewmats=np.zeros((0, 4, 4)),
        Ks=np.zeros((0, 3, 3)),
        backgrounds=None,
    ),
    _spoil_call("call-no-width", "an image without pixels", "width is 0", size=(0, 9)),
    _spoil_call(
        "call-near-behind-far", "nothing is between them", "must be 0 <= near < far", near_plane=2.0, far_plane=1.0
    ),
    _spoil_call("call-nan-near-plane", "no comparison with it is true", "must be 0 <= near < far", near_plane=NAN),
    _spoil_call("call-negative-low-pass", "a covariance that is not one", "eps2d is -1", eps2d=-1.0),
    _spoil_call(
        "call-integers",
        "whole numbers would round everything",
        "cast all arrays",
        means=np.array([[0, 0, 3], [0, 0, 4]]),
    ),
    _spoil_call("call-wrong-shape", "one scale for each", "scales has shape [2]", scales=np.full(2, 0.1)),
    _spoil_call(
        "call-sh-degree-4",
        "there are constants up to degree 3",
        "must be 0 to 3",
        colors=np.zeros((2, 25, 3)),
        sh_degree=4,
    ),
    _spoil_call(
        "call-sh-too-few",
        "degree 2 needs nine coefficients",
        "needs 9 coefficients",
        colors=np.zeros((2, 4, 3)),
        sh_degree=2,
    ),
    _spoil_call("call-unknown-profile", "conventions are not guessed", "profile 'gsplat' is unknown", profile="gsplat"),
)
