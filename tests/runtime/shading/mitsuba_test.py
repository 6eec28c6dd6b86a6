"""Our sum over the light against a path tracer that shares no line with it."""

import numpy as np
import pytest

from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.shading.brdf import F0, specular
from rnd_runtime.shading.light import Light, downsize, texel_directions, texel_solid_angles
from rnd_runtime.shading.shader import Shader

mi = pytest.importorskip("mitsuba")

SIZE = 20  # pixels across a unit ball seen from +Z without perspective
SAMPLES = 512
AGREEMENT = 0.005  # relative, of the mean over the ball's pixels; measured 0.03 to 0.25 %
NOISE = 0.12  # relative, of the worst of 256 pixels of 2 % each; a mirrored map is 200 % off


def radiance(directions):
    """Smooth, coloured, and different towards every axis, so that a mirrored or turned map cannot pass."""
    x, y, z = np.moveaxis(directions, -1, 0)
    lobe = np.exp(6 * (directions @ [0.64, 0.48, 0.6] - 1))
    return np.stack([0.3 + 3 * lobe + 0.1 * x, 0.4 + 2 * lobe + 0.2 * y, 0.6 + lobe + 0.3 * z], axis=-1)


def mitsuba_light():
    """The same radiance as Mitsuba samples it: a node on either pole, columns from its −Z towards +X.

    Its map's centre is +Z with −X to the right, ours +X with +Z to the right: 90° about Y apart.
    """
    height, width = 256, 512
    azimuth = np.arange(width) / width * 2 * np.pi - np.pi  # ours
    polar = np.linspace(0, np.pi, height)[:, None]
    directions = np.stack(
        [
            np.sin(polar) * np.cos(azimuth),
            np.broadcast_to(np.cos(polar), (height, width)),
            np.sin(polar) * np.sin(azimuth),
        ],
        axis=-1,
    )
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(radiance(directions).astype(np.float32)),
        "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90),
    }


def rendered(bsdf):
    mi.set_variant("scalar_rgb")
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 2, "bsdf_samples": 2, "hide_emitters": True},
            "light": mitsuba_light(),
            "ball": {"type": "sphere", "bsdf": bsdf},
            "sensor": {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": SIZE,
                    "height": SIZE,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
                "sampler": {"type": "independent", "sample_count": SAMPLES},
            },
        }
    )
    return np.array(mi.render(scene))[..., :3]


def ball_points():
    """Points of the unit ball at 3 × 3 places a pixel, which count as normals, and the pixels well within it."""
    line = (np.arange(3 * SIZE) + 0.5) / (3 * SIZE) * 2 - 1
    x, y = np.meshgrid(line, -line)
    inside = x**2 + y**2 < 0.9
    z = np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))
    return np.stack([x, y, z], -1).reshape(-1, 3), inside.reshape(SIZE, 3, SIZE, 3).all((1, 3))


def to_pixels(values):
    return values.reshape(SIZE, 3, SIZE, 3, 3).mean((1, 3))


def our_light():
    return Light(downsize(radiance(texel_directions(128, 256)), 64, 128))


def compare(ours, theirs, whole):
    np.testing.assert_allclose(ours[whole].mean(0), theirs[whole].mean(0), rtol=AGREEMENT)
    assert (np.abs(ours - theirs)[whole] / theirs[whole]).max() < NOISE


def test_a_diffuse_ball_agrees():
    points, whole = ball_points()
    count = len(points)
    visibility = np.zeros((count, 16))
    visibility[:, 0] = np.sqrt(4 * np.pi)
    images = []
    for albedo in (1.0, 0.5):  # the specular term is the same in both
        arrays = (points, np.zeros((count, 6)), np.ones(count), points, np.full((count, 3), albedo))
        arrays = (*arrays, np.full(count, 0.99), visibility, np.eye(3))
        gaussians = Gaussians(*(np.asarray(a, np.float32) for a in arrays))
        shader = Shader(our_light(), "brute", texels=(64, 128))
        images.append(to_pixels(shader.shade(gaussians, [0, 0, 1e4])))
    theirs = rendered({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}})
    compare(images[0] - images[1], theirs, whole)


@pytest.mark.parametrize("roughness", [0.4, 0.8])
def test_a_specular_ball_agrees(roughness):
    # Mitsuba's conductor of no material has F = 1, ours has Schlick's F. Without it the rest must be the same.
    points, whole = ball_points()
    light, alpha = our_light(), roughness**2
    directions = texel_directions(64, 128).reshape(-1, 3)
    flux = (light.radiance * texel_solid_angles(64, 128)[..., None]).reshape(-1, 3)
    total = np.zeros((len(points), 3))
    on_ball = points[:, 2] > 0
    n_dot_v = points[on_ball, 2:]
    for part in np.array_split(np.arange(len(directions)), 16):
        n_dot_l = np.maximum(points[on_ball] @ directions[part].T, 1e-3)
        l_dot_v = directions[part, 2]
        fresnel = F0 + (1 - F0) * (1 - np.sqrt((1 + l_dot_v) / 2)) ** 5
        lit = np.where(n_dot_l > 1e-3, n_dot_l, 0)
        total[on_ball] += (specular(np.float64(roughness), n_dot_l, n_dot_v, l_dot_v) / fresnel * lit) @ flux[part]
    bsdf = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}
    compare(to_pixels(total), rendered(bsdf), whole)
