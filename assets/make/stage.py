"""Path tracing one view of the embedded capture: light and attributes in one pass, Disney's material."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from rnd_runtime.core.camera import Camera
from rnd_stage.people.remesh import Floats
from rnd_stage.render import Surface, environment, mesh, sensor

mi.set_variant("scalar_rgb")  # needs no LLVM

MAX_DEPTH = 4


@dataclass(frozen=True, eq=False)
class View:
    """Images of one camera, linear, premultiplied by coverage.

    ``radiance`` [H, W, 3], ``coverage`` [H, W], ``normals`` [H, W, 3] in the world, ``albedo`` [H, W, 3].
    """

    radiance: Floats
    coverage: Floats
    normals: Floats
    albedo: Floats


def render(surface: Surface, camera: Camera, radiance: Floats, *, samples: int, seed: int) -> View:
    """One view under the light ``radiance`` [H, W, 3]."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aov",
                "aovs": "normal:sh_normal,albedo:albedo",
                "image": {"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True},
            },
            "sensor": sensor(camera, samples),
            "light": environment(radiance),
            "figure": _figure(surface),
        }
    )
    pixels = np.array(mi.render(scene, seed=seed), np.float64)
    return View(pixels[..., :3], pixels[..., 3], pixels[..., 4:7], pixels[..., 7:10])


def check_environment() -> float:
    """Largest error in degrees of the rendered positions of single lit texels."""
    from rnd_runtime.shading.light import texel_directions

    height, width = 16, 32
    directions, worst = texel_directions(height, width), 0.0
    for row, column in ((7, 16), (7, 24), (3, 2), (12, 9)):
        radiance = np.full((height, width, 3), 1e-3)
        radiance[row, column] = 1.0
        wanted = directions[row, column]
        camera = Camera.look_at([0.0, 0, 0], wanted.tolist(), width=64, height=64, fov_y=np.radians(60))
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path"},
                "sensor": sensor(camera, 64),
                "light": environment(radiance),
            }
        )
        seen = np.array(mi.render(scene, seed=0), np.float64)[..., 0]
        seen = np.where(seen > 0.02, seen, 0)
        v, u = np.mgrid[:64, :64] + 0.5
        rays = np.stack([(u - 32) / camera.K[0, 0], (v - 32) / camera.K[1, 1], np.ones_like(u)], axis=-1)
        mean = (rays * seen[..., None]).sum(axis=(0, 1)) @ camera.world_to_camera[:3, :3]
        worst = max(worst, np.degrees(np.arccos(mean @ wanted / np.linalg.norm(mean))))
    return float(worst)


def _figure(surface: Surface) -> mi.Mesh:
    material = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
        "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
        "metallic": 0.0,
        "specular": 0.5,  # F0 = 0.04
    }
    return mesh(surface, material, {"vertex_color": surface.colour, "vertex_roughness": surface.roughness[:, None]})
