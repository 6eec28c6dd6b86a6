"""Path tracing one view of the dressed figure with Mitsuba 3, in this project's conventions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from rnd_runtime.camera import Camera

from .remesh import Floats, Ints

mi.set_variant("scalar_rgb")  # needs no LLVM

MAX_DEPTH = 4
# Mitsuba's map has u = atan2(x, −z)/2π. A quarter turn about Y makes that our u = 0.5 + atan2(z, x)/2π.
LIGHT_TO_WORLD = mi.ScalarTransform4f().rotate([0, 1, 0], 90)


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees, linear, premultiplied by coverage.

    ``radiance`` [H, W, 3], ``coverage`` [H, W], ``normals`` [H, W, 3] in the world, ``albedo`` [H, W, 3].
    """

    radiance: Floats
    coverage: Floats
    normals: Floats
    albedo: Floats


@dataclass(frozen=True, eq=False)
class Surface:
    """A posed mesh with its materials: vertices, normals, colour [V, 3], faces [F, 3], roughness [V]."""

    vertices: Floats
    normals: Floats
    faces: Ints
    colour: Floats
    roughness: Floats


def environment(radiance: Floats) -> dict[str, Any]:
    """An emitter from a lat-long map [H, W, 3] in this project's convention.

    Mitsuba puts the first and the last row on the poles, we put them half a texel away. With rows at every
    half texel, both read the same bilinear function.
    """
    doubled = np.empty((2 * len(radiance) + 1, *radiance.shape[1:]), np.float32)
    doubled[0], doubled[1::2], doubled[-1] = radiance[0], radiance, radiance[-1]
    doubled[2:-1:2] = 0.5 * (radiance[:-1] + radiance[1:])
    bitmap = mi.Bitmap(doubled)
    return {"type": "envmap", "bitmap": bitmap, "to_world": LIGHT_TO_WORLD}


def sensor(camera: Camera, samples: int) -> dict[str, Any]:
    """Mitsuba's camera for an OpenCV one; its x points left and its y up. The principal point is the centre."""
    camera_to_world = np.linalg.inv(camera.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.K[0, 0]))),
        "fov_axis": "x",
        "near_clip": 0.1,
        "to_world": mi.ScalarTransform4f(camera_to_world),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},  # so that alpha is coverage
        },
        "sampler": {"type": "multijitter", "sample_count": samples},
    }


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
            "figure": _mesh(surface),
        }
    )
    pixels = np.array(mi.render(scene, seed=seed), np.float64)
    return View(pixels[..., :3], pixels[..., 3], pixels[..., 4:7], pixels[..., 7:10])


def check_environment() -> float:
    """Look at single lit texels and return the worst error in degrees between where they are and should be."""
    from rnd_runtime.light import texel_directions

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


def _mesh(surface: Surface) -> mi.Mesh:
    properties = mi.Properties()
    properties["material"] = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
            "metallic": 0.0,
            "specular": 0.5,  # F0 = 0.04
        }
    )
    mesh = mi.Mesh(
        "figure", len(surface.vertices), len(surface.faces), has_vertex_normals=True, props=properties
    )
    mesh.add_attribute("vertex_color", 3, np.ascontiguousarray(surface.colour, np.float32).ravel())
    mesh.add_attribute("vertex_roughness", 1, np.ascontiguousarray(surface.roughness, np.float32).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(surface.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(surface.normals, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(surface.faces, np.uint32).ravel()
    parameters.update()
    return mesh
