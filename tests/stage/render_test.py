"""The light stage's renderer: its energy against our own sum, both sides of cloth, where light comes from."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")
mi.set_variant("scalar_rgb")

from rnd_runtime.core.camera import Camera  # noqa: E402
from rnd_runtime.core.errors import InputError  # noqa: E402
from rnd_runtime.core.gaussians import Gaussians  # noqa: E402
from rnd_runtime.core.rotations import axis_angle_to_matrix  # noqa: E402
from rnd_runtime.shading.light import Light  # noqa: E402
from rnd_runtime.shading.reference import shade_reference  # noqa: E402
from rnd_stage import variants  # noqa: E402
from rnd_stage.film import lights  # noqa: E402
from rnd_stage.materials import Material  # noqa: E402
from rnd_stage.render import RenderSet, Surface  # noqa: E402

pytestmark = pytest.mark.slow
ENERGY = 0.01  # relative; what is left is Fresnel's exact term against Schlick's, 7 % of the gloss under a white sky


def ball(rings: int = 48) -> Surface:
    """A unit ball with true normals."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    index = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    points = points.reshape(-1, 3)
    return Surface(points, points, faces, np.tile([0.6, 0.5, 0.4], (len(points), 1)), np.full(len(points), 0.5))


@pytest.mark.parametrize("name", ["white", "split", "rainbow"])
def test_a_convex_body_has_the_energy_of_our_own_sum(name: str) -> None:
    light = next(light for light in lights.stage_lights() if light.name == name)
    eye = [0.0, 0, 40.0]  # far away: a pixel's rays are parallel, so its point follows from its place
    camera = Camera.look_at(eye, [0.0, 0, 0], width=64, height=64, fov_y=2 * np.arctan(1.0 / 40))
    theirs = RenderSet(ball()).radiance(camera, light.radiance, samples=36, seed=1)
    line = (np.arange(64) + 0.5) / 32 - 1
    x, y = np.meshgrid(line, -line)
    inside = x**2 + y**2 < 0.9
    points = np.stack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))], -1)[inside]
    count = len(points)
    seen = np.zeros((count, 16))
    seen[:, 0] = np.sqrt(4 * np.pi)
    gaussians = Gaussians(
        points,
        np.zeros((count, 6)),
        np.ones(count),
        points,
        np.tile([0.6, 0.5, 0.4], (count, 1)),
        np.full(count, 0.5),
        seen,
        np.eye(3),
    )
    ours = shade_reference(gaussians, Light(light.radiance), eye, texels=(64, 128))
    assert ours.mean() == pytest.approx(theirs[inside].mean(), rel=ENERGY)
    np.testing.assert_allclose(ours.mean(0), theirs[inside].mean(0), rtol=1.5 * ENERGY)


def test_cloth_is_seen_from_its_inside() -> None:
    """A sheet from behind: lit as from before, and its truth is that of the side that is seen."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces, diffuse = np.array([[0, 1, 2], [0, 2, 3]]), np.full(4, 0.9)
    sheet = Surface(corners, np.tile([0.0, 0, 1], (4, 1)), faces, np.full((4, 3), 0.5), diffuse)
    stage, sky = RenderSet(sheet), np.ones((16, 32, 3))
    pixels = []
    for z in (4.0, -4.0):
        camera = Camera.look_at([0.0, 0.5, z], [0.0, 0, 0], width=16, height=16, fov_y=0.4)
        pixels.append(stage.radiance(camera, sky, samples=16, seed=0).mean())
        truth = stage.truth(camera, samples=4, seed=0)
        assert (truth.normals[..., 2] < -0.95).all()
        towards = camera.world_to_camera[:3, :3].T @ [0, 0, -1]
        lit = stage.visibility(camera, np.array([towards, -towards]), truth.normals, samples=4, seed=0)
        assert lit[0].min() > 0.95 and lit[1].max() == 0
    assert pixels[1] == pytest.approx(pixels[0], rel=0.02) and pixels[0] > 0.4


def test_light_comes_from_where_it_is() -> None:
    """The footlight shines from below: the ball's lower half is brighter; the red light from the person's left (+X)."""
    camera = Camera.look_at([0.0, 0, 6], [0.0, 0, 0], width=16, height=16, fov_y=0.35)
    stage = RenderSet(ball(16))
    by_name = {light.name: light for light in lights.stage_lights()}
    foot = stage.radiance(camera, by_name["footlight"].radiance, samples=16, seed=0)[..., 0]
    assert foot[9:].mean() > 2 * foot[:7].mean()
    red = stage.radiance(camera, by_name["red"].radiance, samples=16, seed=0)[..., 0]
    assert red[:, 9:].mean() > 1.3 * red[:, :7].mean()  # seen from +Z, +X is right
    turned = axis_angle_to_matrix([0.0, np.pi, 0.0])
    behind = Camera.look_at((turned @ [0, 0, 6]).tolist(), [0.0, 0, 0], width=16, height=16, fov_y=0.35)
    red = stage.radiance(behind, by_name["red"].radiance, samples=16, seed=0)[..., 0]
    assert red[:, :7].mean() > 1.3 * red[:, 9:].mean()


def test_an_llvm_that_does_not_work_is_not_used(monkeypatch, tmp_path) -> None:
    broken = tmp_path / "libLLVM-99.so"
    broken.write_bytes(b"no library")
    monkeypatch.setenv(variants.LIBRARY_VARIABLE, str(broken))
    assert not variants._renders(str(broken))
    monkeypatch.setattr(variants, "_renders", lambda library: False)
    assert variants.use_variant("auto") == "scalar_rgb"
    with pytest.raises(InputError, match="LLVM"):
        variants.use_variant("llvm_ad_rgb")


def test_the_first_working_llvm_is_chosen(monkeypatch) -> None:
    monkeypatch.setattr(variants, "_candidates", lambda: iter(["old", "good", "other"]))
    monkeypatch.setattr(variants, "_renders", lambda library: library != "old")
    assert variants.working_llvm() == "good"


def test_the_principled_material_reflects_the_same_colours_and_more_at_grazing_angles_where_it_is_rough() -> None:
    light = np.ones((16, 32, 3))
    camera = Camera.look_at([0.0, 0, 40], [0.0, 0, 0], width=48, height=48, fov_y=2 * np.arctan(1.0 / 40))
    line = (np.arange(48) + 0.5) / 24 - 1
    radius = np.hypot(*np.meshgrid(line, line))
    ratios = {}
    for roughness in (0.3, 0.9):
        surface = replace(ball(), roughness=np.full(2 * 48**2, roughness))
        both = [RenderSet(surface, material=m).radiance(camera, light, samples=64, seed=1) for m in get_args(Material)]
        layered, principled = both
        rim = (radius > 0.85) & (radius < 0.95)
        ratios[roughness] = principled[rim].mean() / layered[rim].mean()
        front = radius < 0.5
        np.testing.assert_allclose(principled[front].mean(0), layered[front].mean(0), rtol=0.1)
    assert ratios[0.9] > 1.02 > ratios[0.3]
