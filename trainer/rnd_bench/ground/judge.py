"""A body's shadow on a diffuse plane, path-traced by Mitsuba, and by the player from the same mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from rnd_bench.scenes.lights import sun_and_sky
from rnd_bench.scenes.psnr import decibels
from rnd_runtime.capture.body import Body, skin
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.ground.bounce import light_over, mean_share
from rnd_runtime.ground.shadow import GroundLight, Plane, footprint, remaining_light
from rnd_runtime.ground.standing import UP
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light, texel_directions
from rnd_runtime.shading.shader import Shader

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

TURNS = {"front": 0.0, "side": 1.2}
"""poses: rad about the vertical axis"""
EYE, TARGET, FOV = (1.6, 2.2, 2.6), (0.0, 0.4, 0.0), 50.0
GROUND = Plane(UP, 0.0)
HALF = 0.5
"""share of the sun's light at a shadow's edge"""


def lights() -> dict[str, Light]:
    """Sky alone, sky with a bright window, sky with a sun, and a sun alone."""
    directions = texel_directions(32, 64)
    window = np.exp(8 * (directions @ [0.6, 0.48, 0.64] - 1))[..., None] * np.array([6.0, 5, 3])
    sky = np.array([0.3, 0.5, 0.9]) * (1.2 + directions[..., 1:2])
    alone = sun_and_sky(256, radiance=4000.0).radiance - sun_and_sky(256, radiance=0.0).radiance
    return {
        "sky": Light(sky.astype(np.float32)),
        "window": Light((0.2 * sky + window).astype(np.float32)),
        "sun and sky": sun_and_sky(256, radiance=4000.0),
        "sun": Light(np.maximum(alone, 0)),
    }


def view(size: int) -> Camera:
    return Camera.look_at(list(EYE), list(TARGET), width=size, height=size, fov_y=math.radians(FOV))


def posed_body(template: Body, turn: float) -> tuple[Floats, NDArray[np.integer]]:
    """Vertices [V, 3] m and faces [F, 3] of ``template``, an arm raised, its feet on the ground."""
    angles = np.zeros((len(template.skeleton), 3))
    angles[0, 1] = turn
    angles[template.skeleton.names.index("left_shoulder"), 2] = 0.9
    bones = bone_transforms(template.skeleton, axis_angle_to_matrix(angles), np.zeros(3)).astype(np.float64)
    vertices = skin(template.vertices.astype(np.float64), template.skinning_weights.astype(np.float64), bones)
    return vertices - np.array([0, vertices[:, 1].min(), 0]), template.faces


def surface(points: Floats, normals: Floats, radii: Floats) -> tuple[Gaussians, Floats32]:
    """Opaque grey Gaussians with discs of ``radii`` m around them."""
    count = len(points)
    covariances = np.zeros((count, 6))
    covariances[:, [0, 3, 5]] = (0.6 * radii[:, None]) ** 2
    visibility, rest = np.zeros((count, 16)), np.full((count, 3), 0.5)
    visibility[:, 0] = math.sqrt(4 * math.pi)
    arrays = points, covariances, np.ones(count), normals, rest, np.full(count, 0.9), visibility, np.eye(3)
    return Gaussians(*(np.asarray(a, np.float32) for a in arrays)), np.asarray(radii, np.float32)


def body_surface(vertices: Floats, faces: NDArray[np.integer]) -> tuple[Gaussians, Floats32]:
    """``surface`` of a mesh, a Gaussian for each face."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1) / 2
    normals = crosses / np.maximum(2 * areas, 1e-12)[:, None]
    return surface(corners.mean(1), normals, 0.8 * np.sqrt(areas))


@dataclass(frozen=True)
class Traced:
    """A path-traced shadow.

    Attributes:
        remaining: [H, W, 3] share of the ground's light.
        visible: [H, W] pixels that see the ground alone.
    """

    remaining: Floats
    visible: NDArray[np.bool_]


def traced(light: Light, vertices: Floats, faces: NDArray[np.integer], camera: Camera, samples: int) -> Traced:
    """The shadow by Mitsuba: the plane's radiance with the mesh over that without it."""
    with_body = mitsuba_image(light, {"floor": FLOOR, "body": (vertices, faces, 0.0)}, camera, samples)
    without = mitsuba_image(light, {"floor": FLOOR}, camera, samples)
    body = mitsuba_image(light, {"body": (vertices, faces, 0.0)}, camera, 16)
    visible = (body[..., 3] == 0) & (without[..., :3].min(-1) > 0)
    return Traced(np.clip(with_body[..., :3] / np.maximum(without[..., :3], 1e-9), 0, 1), visible)


FLOOR = "floor"
GREY = 0.5
"""albedo of the lit body"""


def traced_bounce(light: Light, vertices: Floats, faces: NDArray[np.integer], albedo: float, samples: int) -> Floats:
    """Linear RGBA [H, W, 4] of the body: with a ground of ``albedo`` less with a black one; its alpha."""
    camera, body = view(BOUNCE_SIZE), (vertices, faces, GREY)
    bright, black = (
        mitsuba_image(light, {"floor": FLOOR, "body": body}, camera, samples, depth=3, floor=a) for a in (albedo, 0.0)
    )
    alone = mitsuba_image(light, {"body": body}, camera, 16)
    return np.dstack([(bright - black)[..., :3], alone[..., 3]])


BOUNCE_SIZE = 96


def played_bounce(light: Light, vertices: Floats, faces: NDArray[np.integer], albedo: float) -> Floats32:
    """The same radiance [H, W, 3] by the player."""
    gaussians, radii = body_surface(vertices, faces)
    camera = view(BOUNCE_SIZE)
    shadow = GroundLight(light).shadow(gaussians, radii, GROUND, np.eye(3))
    share = albedo * mean_share(gaussians, shadow)
    bright, black = (
        Shader(light_over(light, UP, a), "table+sun").shade(gaussians, camera.position) for a in (share, 0 * share)
    )
    raster = rasterize(gaussians.means, gaussians.covariances, gaussians.opacities, bright - black, camera)
    return raster.image


def mitsuba_image(
    light: Light, objects: dict[str, Any], camera: Camera, samples: int, *, depth: int = 2, floor: float = 0.5
) -> Floats:
    """Linear RGBA [H, W, 4]; objects are ``FLOOR`` or (vertices, faces, diffuse albedo)."""
    import mitsuba as mi  # type: ignore[import-not-found,import-untyped,unused-ignore]

    mi.set_variant("scalar_rgb")
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "hide_emitters": True},
        "light": {
            "type": "envmap",
            "bitmap": mi.Bitmap(_nodes_of(light)),
            "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90),
        },
        "sensor": {
            "type": "perspective",
            "fov": FOV,
            "to_world": mi.ScalarTransform4f().look_at(list(EYE), list(TARGET), [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgba",
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
    }
    for name, item in objects.items():
        if item == FLOOR:
            turned = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([50, 50, 1])
            plain = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 3 * [floor]}}
            scene[name] = {"type": "rectangle", "to_world": turned, "bsdf": plain}
            continue
        vertices, faces, albedo = item
        properties = mi.Properties()
        colour = {"type": "rgb", "value": np.broadcast_to(albedo, 3).tolist()}
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": colour})
        mesh = mi.Mesh(name, len(vertices), len(faces), props=properties)
        params = mi.traverse(mesh)
        params["vertex_positions"], params["faces"] = np.float32(vertices).ravel(), np.uint32(faces).ravel()
        params.update()
        scene[name] = mesh
    return np.array(mi.render(mi.load_dict(scene)), np.float64)


def _nodes_of(light: Light) -> Floats32:
    """The map as Mitsuba samples it: a node on either pole, columns from its −Z towards +X."""
    height, width = 1024, 2048
    azimuth = np.arange(width) / width * 2 * np.pi - np.pi
    polar = np.linspace(0, np.pi, height)[:, None]
    ring = np.sin(polar)
    directions = [ring * np.cos(azimuth), np.broadcast_to(np.cos(polar), (height, width)), ring * np.sin(azimuth)]
    return light.sample(np.stack(directions, -1))


def played(light: Light, vertices: Floats, faces: NDArray[np.integer], camera: Camera) -> Floats32:
    """The same share [H, W, 3] by the player."""
    gaussians, radii = body_surface(vertices, faces)
    pixel = footprint(camera, GROUND, np.zeros(2))
    return remaining_light(GroundLight(light).shadow(gaussians, radii, GROUND, np.eye(3), pixel=pixel), camera)


def shadow_db(ours: Floats32, theirs: Traced) -> float:
    """PSNR of the shares where the ground is seen."""
    return decibels(ours[theirs.visible], theirs.remaining[theirs.visible])


def edge_pixels(ours: Floats32, theirs: Traced) -> tuple[float, float]:
    """Distance in pixels from every pixel that one has in shadow and the other not to the latter's edge: mean and max.

    Pixels next to the body, whose outline both share, are left out; 0 where both agree.
    """
    inside, other = ours.mean(-1) < HALF, theirs.remaining.mean(-1) < HALF
    distance = np.maximum(distance_transform_edt(other), distance_transform_edt(~other)) - HALF
    differs = (inside != other) & (distance_transform_edt(theirs.visible) > 2)
    edge = (distance < 1) & theirs.visible
    return float(distance[differs].sum() / max(edge.sum(), 1)), float(distance[differs].max(initial=0))
