"""Depth order by compute shaders, against numpy's sort of the same keys and the CPU's order, on EGL and on OSMesa.

llvmpipe runs compute shaders too, if slowly: what is tested here is what a GPU runs.
"""

from __future__ import annotations

import moderngl
import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.gl import projection as projection_gl
from rnd_runtime.gl import sort as sort_gl
from rnd_runtime.gl.context import create_context, is_software
from rnd_runtime.gl.frame import GlRenderer
from rnd_runtime.gl.passes import GaussianTexture
from rnd_runtime.gl.projection import GlProjection
from rnd_runtime.gl.raster import GlRasterizer
from rnd_runtime.gl.sort import DepthSort
from rnd_runtime.shading.shader import Shader

BACKENDS = ("egl", "osmesa")
CAMERA = Camera.look_at([0.5, 0.3, 3.2], [0, 0, 0], width=96, height=128, fov_y=0.65)  # in the root's frame
FORWARD = np.array([0.36, -0.48, 0.8])


@pytest.fixture(scope="module", params=BACKENDS)
def context(request):
    made = create_context(request.param)
    yield made
    made.release()


@pytest.fixture
def device_order(context):
    """What the device makes of drawn [N, 4]: the Gaussian of each rank [N]."""

    def order(drawn, forward=FORWARD):
        texture = texels.write(np.ascontiguousarray(drawn, np.float32))
        ranks = np.frombuffer(sort.order(texture, len(drawn), forward).read(), np.int32)
        assert context.error == "GL_NO_ERROR"
        return ranks[: len(drawn)]

    with context:
        sort, texels = DepthSort(context), GaussianTexture(context, 4)
        yield order
        sort.release(), texels.release()


def _expected(drawn, forward=FORWARD):
    """Ranks by stable sort of the keys in float64 arithmetic: far first, equal keys by falling index, then −1."""
    seen = np.flatnonzero(drawn[:, 3] > 0)
    points = drawn[seen, :3].astype(np.float64)
    depths = forward[0] * points[:, 0] + forward[1] * points[:, 1] + forward[2] * points[:, 2]
    span = np.ptp(depths) if len(seen) else 0.0
    keys = np.floor((depths - depths.min(initial=np.inf)) * (4294967295.0 / span)) if span else np.zeros(len(seen))
    ranks = np.full(len(drawn), -1)
    ranks[: len(seen)] = seen[np.lexsort((-seen, -keys))]
    return ranks


def _cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    drawn = rng.normal(size=(count, 4)).astype(np.float32)
    drawn[:, 3] = np.where(rng.uniform(size=count) < 0.6, 1, -1)
    return drawn


@pytest.mark.parametrize("count", [1, 2, 255, 256, 257, 1023, 1024, 1025, 30_000])
def test_order_is_numpys_and_the_cpus(device_order, count):
    drawn = _cloud(count)
    got, expected = device_order(drawn), _expected(drawn)
    np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(got[got >= 0], projection_gl._back_to_front(drawn, FORWARD))


def test_equal_depths_come_by_falling_index(device_order):
    drawn = _cloud(5000)
    drawn[:, :3] = np.round(drawn[:, :3])
    forward = np.array([0.0, 0.0, 1.0])
    expected = _expected(drawn, forward)
    depths = drawn[expected[expected >= 0], 2]
    assert len(np.unique(depths)) < 12
    assert (np.diff(expected[expected >= 0])[np.diff(depths) == 0] < 0).all()
    np.testing.assert_array_equal(device_order(drawn, forward), expected)


def test_depths_that_float32_cannot_tell_apart_keep_their_order(device_order):
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.5, 0.5, (2, 4000))
    on_plane = 4.0 - (FORWARD[0] * x + FORWARD[1] * y)  # all but one depth, by what float32 means can hold
    drawn = np.stack([x, y, on_plane / FORWARD[2], np.ones_like(x)], axis=1).astype(np.float32)
    drawn[0, 2] += 1e-3  # m to span
    in_float32 = np.argsort(-(drawn[:, :3] @ FORWARD.astype(np.float32)), kind="stable")
    expected = _expected(drawn)
    assert (in_float32 != expected).mean() > 0.5
    np.testing.assert_array_equal(device_order(drawn), expected)


@pytest.mark.parametrize("value", [1, -1])
def test_all_at_one_place_or_none_at_all(device_order, value):
    drawn = np.tile(np.float32([0.3, 0.2, 0.1, value]), (700, 1))
    expected = np.arange(700)[::-1] if value > 0 else np.full(700, -1)
    np.testing.assert_array_equal(device_order(drawn), expected)


def test_more_and_fewer_leave_nothing_behind(device_order):
    clouds = [_cloud(count, seed) for seed, count in enumerate((3000, 40, 9000, 1024, 1))]
    for _ in range(2):
        for drawn in clouds:
            np.testing.assert_array_equal(device_order(drawn), _expected(drawn))


@pytest.mark.parametrize("cull", [None, 0.2])
@pytest.mark.parametrize("mode", ["ao", "table+sun", "brute"])
def test_pictures_are_the_same_bits_and_only_they_come_back(avatar, motion, sky, context, monkeypatch, mode, cull):
    shader = Shader(sky, mode)
    bodies = [avatar.unposed(avatar.encode(motion, time)) for time in (0.0, 0.4)]
    pictures = {}
    for sorting in ("cpu", "device"):
        with GlRasterizer(context.extra.backend) as rasterizer:
            renderer = GlRenderer(rasterizer, sorting)
            with monkeypatch.context() as patch:
                reads = _counted_reads(patch)
                pictures[sorting] = [renderer.draw(body, shader, CAMERA, cull=cull) for body in bodies]
            finished = 2 if is_software(context) else 3  # radiance, coverage, a graphics card's codes
            assert len(reads) == 2 * (finished + (sorting == "cpu"))  # of two frames
            renderer.close()
    for ours, theirs in zip(pictures["device"], pictures["cpu"]):
        assert ours.alpha.max() > 0.9
        np.testing.assert_array_equal(ours.image, theirs.image)
        np.testing.assert_array_equal(ours.alpha, theirs.alpha)


def _counted_reads(patch):
    """A list that grows with each read of something on the device."""
    reads: list[str] = []
    for kind, names in (
        (moderngl.Framebuffer, ("read", "read_into")),
        (moderngl.Texture, ("read", "read_into")),
        (moderngl.Buffer, ("read", "read_into", "read_chunks")),
    ):
        for name in names:
            before = getattr(kind, name)

            def counted(*args, _before=before, _name=f"{kind.__name__}.{name}", **kwargs):
                reads.append(_name)
                return _before(*args, **kwargs)

            patch.setattr(kind, name, counted)
    return reads


def test_what_cannot_sort_says_so(context, monkeypatch):
    monkeypatch.setattr(sort_gl, "can_sort", lambda _: False)
    with context, pytest.raises(InputError, match=r"sorting on the device: expected OpenGL 4\.3, got "):
        GlProjection(context, "device")
    with context, pytest.raises(InputError, match=r"sorting: expected auto \| cpu \| device, got 'gpu'"):
        GlProjection(context, "gpu")


def test_a_driver_that_refuses_the_shaders_leaves_it_to_the_cpu(context, monkeypatch):
    monkeypatch.setattr(projection_gl, "is_software", lambda _: False)
    monkeypatch.setattr(sort_gl, "shader_source", lambda names: "no GLSL")
    refused = r"sorting on the device: expected a driver that compiles depth_range\.comp, got \S"
    with context, pytest.raises(InputError, match=refused) as caught:
        GlProjection(context, "device")
    assert "\n" not in str(caught.value)
    with context:
        GlProjection(context, "auto").release()
