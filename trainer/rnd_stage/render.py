"""Path tracing a posed surface with Mitsuba 3, in this project's conventions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera

from .materials import Material, material_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_SAMPLES = 2**24  # paths traced at once; LLVM needs about 200 B for each
NEAR = 0.1  # m
MASK_FLOOR = 0.05  # coverage below which ground truth is zero
GRAZING = 0.05  # n·l below which a light counts as not visible


@dataclass(frozen=True, eq=False)
class Surface:
    """A posed mesh with its materials.

    Attributes:
        vertices, normals: [V, 3] m and unit, world.
        faces: [F, 3].
        colour: [V, 3] linear albedo; roughness: [V] perceptual.
    """

    vertices: Floats
    normals: Floats
    faces: Ints
    colour: Floats
    roughness: Floats


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of one camera, means over a pixel's samples.

    Attributes:
        coverage: [H, W].
        albedo: [H, W, 3] linear, premultiplied.
        normals: [H, W, 3] unit, of the visible side, camera's OpenCV axes; zero where coverage is below 5 %.
        roughness: [H, W] and depth: [H, W] m along the camera's z, both of the covered part; zero elsewhere.
    """

    coverage: Floats
    albedo: Floats
    normals: Floats
    roughness: Floats
    depth: Floats


class RenderSet:
    """A surface of a material, for any camera and light; a ``max_depth`` of 2 is direct light alone."""

    def __init__(self, surface: Surface, *, max_depth: int = 5, material: Material = "layered") -> None:
        self.surface, self.max_depth = surface, max_depth
        self._mesh = mesh(surface, *material_of(material, surface.colour, surface.roughness))
        self._scenes: dict[int, tuple[Floats, Any]] = {}
        self._plain: list[Any] = []

    def radiance(self, camera: Camera, light: Floats, *, samples: int, seed: int) -> Floats:
        """Linear radiance [H, W, 3], premultiplied on black, under the lat-long ``light`` [h, 2h, 3]."""
        known, scene = self._scenes.get(id(light), (None, None))
        if known is not light:
            integrator = {"type": "path", "max_depth": self.max_depth, "hide_emitters": True}
            scene = mi.load_dict(
                {"type": "scene", "integrator": integrator, "light": environment(light), "figure": self._mesh}
            )
            self._scenes[id(light)] = (light, scene)
        return render(scene, camera, samples, seed)[..., :3]

    def truth(self, camera: Camera, *, samples: int, seed: int) -> Truth:
        """Attributes of the visible surface; both passes sample the same points."""
        if not self._plain:
            self._plain = self._attribute_scenes()
        seen, extra = (render(scene, camera, samples, seed, film="rgb") for scene in self._plain)
        roughness, coverage = extra[..., 0], extra[..., 1]
        share = np.maximum(coverage, 1e-6)
        covered = coverage >= MASK_FLOOR
        positions = seen[..., 6:9] / share[..., None]
        away = np.sum(seen[..., 9:12] * (positions - camera.position), axis=-1) > 0  # the inside of cloth
        facing = np.where(away, -1, 1)[..., None] * seen[..., 3:6] @ camera.world_to_camera[:3, :3].T
        facing /= np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-9)
        depth = positions @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
        return Truth(coverage, seen[..., :3], facing * covered[..., None], roughness / share * covered, depth * covered)

    def visibility(self, camera: Camera, directions: Floats, normals: Floats, *, samples: int, seed: int) -> Floats:
        """Visible share [L, H, W] of each pixel's surface for distant lights at ``directions`` [L, 3] (towards them).

        ``normals`` [H, W, 3] are ``Truth``'s. Three lights at a time illuminate a white, diffuse copy in red, green
        and blue; the result is divided by n·l. Zero below the surface's horizon.
        """
        white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
        copy = mesh(self.surface, {"type": "twosided", "sides": white}, {})
        world = normals @ camera.world_to_camera[:3, :3]
        result = np.zeros((len(directions), *normals.shape[:2]))
        for start in range(0, len(directions), 3):
            some = directions[start : start + 3]
            scene: dict[str, Any] = {"type": "scene", "figure": copy}
            scene["integrator"] = {"type": "path", "max_depth": 2, "hide_emitters": True}
            for k, direction in enumerate(some):
                power = {"type": "rgb", "value": [float(k == channel) * np.pi for channel in range(3)]}
                scene[f"light{k}"] = {"type": "directional", "direction": (-direction).tolist(), "irradiance": power}
            arriving = render(mi.load_dict(scene), camera, samples, seed)[..., : len(some)]
            cosines = world @ some.T
            share = np.where(cosines > GRAZING, arriving / np.maximum(cosines, GRAZING), 0)
            result[start : start + 3] = np.moveaxis(np.clip(share, 0, 1), -1, 0)
        return result

    def _attribute_scenes(self) -> list[Any]:
        """Scenes of albedo, normals and positions, and of roughness and coverage."""
        surface = self.surface
        one = np.ones_like(surface.roughness)
        plain = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        passes = (
            (surface.colour, "albedo:albedo,normal:sh_normal,place:position,side:geo_normal"),
            (np.stack([surface.roughness, one, 0 * one], axis=1), "albedo:albedo"),
        )
        scenes = []
        for colour, aovs in passes:
            figure = mesh(surface, plain, {"vertex_color": colour})
            scenes.append(
                mi.load_dict({"type": "scene", "integrator": {"type": "aov", "aovs": aovs}, "figure": figure})
            )
        return scenes


def mesh(surface: Surface, material: dict[str, Any], attributes: dict[str, Floats]) -> Any:
    """A Mitsuba mesh with per-vertex ``attributes`` [V, 1 or 3] of ``material``."""
    properties = mi.Properties()
    properties["material"] = mi.load_dict(material)
    result = mi.Mesh("figure", len(surface.vertices), len(surface.faces), has_vertex_normals=True, props=properties)
    for name, values in attributes.items():
        result.add_attribute(name, values.shape[1], np.ascontiguousarray(values, np.float32).ravel())  # type: ignore[arg-type]
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = np.ascontiguousarray(surface.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(surface.normals, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(surface.faces, np.uint32).ravel()
    parameters.update()
    return result


def environment(radiance: Floats) -> dict[str, Any]:
    """An emitter from a lat-long map [H, W, 3] in this project's convention.

    In Mitsuba the first and the last row are at the poles, in ours half a texel away; with rows at every half texel
    both are the same bilinear function.
    """
    doubled = np.empty((2 * len(radiance) + 1, *radiance.shape[1:]), np.float32)
    doubled[0], doubled[1::2], doubled[-1] = radiance[0], radiance, radiance[-1]
    doubled[2:-1:2] = 0.5 * (radiance[:-1] + radiance[1:])
    # Mitsuba's u = atan2(x, −z)/2π becomes our u = 0.5 + atan2(z, x)/2π by a rotation of 90° about Y.
    return {"type": "envmap", "bitmap": mi.Bitmap(doubled), "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90)}


def sensor(camera: Camera, samples: int, film: str = "rgba") -> dict[str, Any]:
    """Mitsuba's camera (x left, y up) for an OpenCV one with a centred principal point."""
    camera_to_world = np.linalg.inv(camera.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.K[0, 0]))),
        "fov_axis": "x",
        "near_clip": NEAR,
        "to_world": mi.ScalarTransform4f(camera_to_world),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": film,
            "component_format": "float32",
            "rfilter": {"type": "box"},  # so that alpha is coverage
        },
        "sampler": {"type": "multijitter", "sample_count": samples},
    }


def render(scene: Any, camera: Camera, samples: int, seed: int, film: str = "rgba") -> Floats:
    """All channels [H, W, C] of ``scene``; the same seed gives the same image."""
    passes = -(-samples * camera.width * camera.height // MAX_SAMPLES) if mi.variant() != "scalar_rgb" else 1
    each = -(-samples // passes)
    view = mi.load_dict(sensor(camera, each, film))
    pixels = [
        np.array(mi.render(scene, sensor=view, spp=each, seed=passes * seed + k), np.float64) for k in range(passes)
    ]
    return np.mean(pixels, axis=0)


def probe() -> None:
    """Render a lit triangle in the current variant; an unsuitable LLVM aborts the process here."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    facing = np.tile([0.0, 0, 1], (3, 1))
    surface = Surface(corners, facing, np.array([[0, 1, 2]]), np.full((3, 3), 0.5), np.full(3, 0.5))
    camera = Camera.look_at([0.0, 0, 3], [0.0, 0, 0], width=8, height=8, fov_y=0.5)
    stage = RenderSet(surface)
    pixels = stage.radiance(camera, np.ones((8, 16, 3)), samples=4, seed=0)
    assert 0.3 < pixels[4, 4, 0] < 0.8, pixels[4, 4]
    stage.truth(camera, samples=4, seed=0)
