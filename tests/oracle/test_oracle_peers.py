"""gsplat's functions in plain PyTorch beside the reference: forward and gradients, float64."""

import importlib.util

import numpy as np
import pytest

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.oracle import gradients
from minisplat_ref.oracle.peers import gsplat_torch as adapter
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.oracle.stages import composite_stage, project_stage, render_stage, sh_stage
from minisplat_ref.oracle.tolerances import PEER_REL
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import TileGrid

HAS_PEERS = all(importlib.util.find_spec(name) for name in ("torch", "gsplat"))
needs_peers = pytest.mark.skipif(not HAS_PEERS, reason="needs torch and gsplat: pip install 'minisplat_ref[peers]'")


@pytest.fixture
def setting(rng):
    return make_setting(rng, 25, 40, 30, GSPLAT_1_5, sh_degree=3)


def assert_close(got, expected):
    assert got.shape == expected.shape
    assert np.abs(got - expected).max() <= PEER_REL * np.abs(expected).max()


@needs_peers
@pytest.mark.parametrize("make_stage", [project_stage, sh_stage, composite_stage, render_stage])
def test_forward_and_gradients_agree(setting, rng, make_stage):
    ours, theirs = (make_stage(backend, setting) for backend in (REFERENCE, adapter.gsplat_torch()))
    expected = ours.function(*ours.inputs.values()).outputs
    for got, want in zip(theirs.function(*ours.inputs.values()).outputs, expected, strict=True):
        assert np.abs(want).max() > 0.1
        assert_close(got, want)
    cotangents = [rng.normal(size=output.shape) for output in expected]
    for got, want in zip(theirs.vjp(*cotangents), ours.vjp(*cotangents), strict=True):
        assert np.abs(want).max() > 1e-3
        assert_close(got, want)


@needs_peers
def test_antialiased_projection_agrees(setting, rng):
    setting = setting._replace(conventions=setting.conventions._replace(is_antialiased=True))
    ours, theirs = (project_stage(backend, setting) for backend in (REFERENCE, adapter.gsplat_torch()))
    cotangents = [rng.normal(size=y.shape) for y in ours.function(*ours.inputs.values()).outputs]
    for got, want in zip(theirs.vjp(*cotangents), ours.vjp(*cotangents), strict=True):
        assert_close(got, want)


@needs_peers
def test_tile_lists_hold_all_that_ours_do(setting):
    camera, conventions = setting.camera, setting.conventions
    grid, lists = TileGrid(camera.width, camera.height, 16, 16), []
    for backend in (REFERENCE, adapter.gsplat_torch()):
        bins = backend.bin_gaussians(backend.project(*setting.primitives, camera, conventions), grid, conventions)
        lists.append(np.split(bins.gaussian_ids, bins.tile_offsets[1:-1]))
        assert len(bins.slots) == bins.gaussian_offsets[-1] == bins.tile_offsets[-1]
    for ours, theirs in zip(*lists, strict=True):  # gsplat's boxes do not shrink with the opacity
        assert list(ours) == [g for g in theirs if g in ours]


@needs_peers
def test_the_clamp_of_main_is_another():
    setting = tiny_setting(GSPLAT_MAIN)
    images = [
        stage.function(*stage.inputs.values()).outputs[0]
        for stage in (composite_stage(b, setting) for b in (REFERENCE, adapter.gsplat_torch()))
    ]
    assert np.abs(images[0] - images[1]).max() > 1e-5


@needs_peers
def test_what_gsplat_lacks_is_refused(setting):
    peer = adapter.gsplat_torch()
    projection = peer.project(*setting.primitives, setting.camera, setting.conventions)
    bins = peer.bin_gaussians(projection, TileGrid(40, 30, 16, 16), setting.conventions)
    arguments = projection, setting.gaussians.sh_dc, setting.background, bins, setting.conventions
    with pytest.raises(InputError, match="no blend statistics"):
        peer.composite(*arguments, with_stats=True)


def test_without_peers_the_gradient_check_says_so(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    adapter.load.cache_clear()
    with pytest.raises(InputError, match=r"minisplat_ref\[peers\]"):
        gradients.autograd_cases(REFERENCE)
