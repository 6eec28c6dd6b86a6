"""Rendered people in captured motions, and what the landmark network sees of them: pairs of truth and error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import moderngl
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.core.npz import save_npz
from rnd_runtime.gl.context import create_context
from rnd_stage.people.characters import load_character
from rnd_stage.people.dressing import Dressed, dress
from rnd_stage.people.subjects import subject
from rnd_trainer.estimating.lifted import JOINTS
from rnd_trainer.estimating.observing.landmarks import LandmarkNetwork
from rnd_trainer.estimating.observing.networks import open_network
from rnd_trainer.estimating.observing.regions import Region
from rnd_trainer.estimating.observing.sides import merge_views
from rnd_trainer.estimating.observing.tracking import Start, follow

from .motions import FPS, Clips, Floats32, Generator, sampled
from .views import positions, sampled_cameras

SIZE = (384, 512)
"""width and height of the rendered images"""
FRAMES = 12
"""of a window"""
STEP = 2
"""motion frames between two images: 15 images a second"""
SEED = 53
DESIGNS = (0, 1, 2, 3, 11, 12)
"""seeds of the stage's people beside the characters"""

_VERTEX = """#version 330
uniform mat4 clip; in vec3 position; in vec3 colour; out vec3 world; out vec3 albedo;
void main() { world = position; albedo = colour; gl_Position = clip * vec4(position, 1); }"""
_FRAGMENT = """#version 330
uniform vec3 sun; uniform vec3 sky; uniform vec3 ground; uniform vec3 direction;
in vec3 world; in vec3 albedo; out vec4 radiance;
void main() {
  vec3 n = normalize(cross(dFdx(world), dFdy(world)));
  vec3 light = mix(ground, sky, 0.5 + 0.5 * n.y) + sun * max(dot(n, direction), 0);
  radiance = vec4(albedo * light, 1);
}"""


@dataclass(frozen=True, eq=False)
class Filmed:
    """One window of images.

    Attributes:
        images: [T, H, W, 3] uint8 sRGB.
        focal: pixels.
        rotations, joints: [T, 22, 3, 3] and [T, 22, 3], in camera axes.
    """

    images: NDArray[np.uint8]
    focal: float
    rotations: Floats32
    joints: Floats32


class Painter:
    """Renders triangles of one colour a vertex, lit by a sky and a sun, over an image."""

    def __init__(self) -> None:
        self.context = create_context("egl")
        with self.context:
            gl = self.context
            gl.enable(moderngl.DEPTH_TEST)
            self.program = gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
            targets = gl.renderbuffer(SIZE, 4, samples=4, dtype="f2"), gl.depth_renderbuffer(SIZE, samples=4)
            self.target = gl.framebuffer([targets[0]], targets[1])
            self.resolved = gl.framebuffer([gl.renderbuffer(SIZE, 4, dtype="f2")])

    def render(
        self,
        vertices: Floats32,
        colours: Floats32,
        faces: NDArray[np.int32],
        clip: Floats32,
        light: dict[str, Floats32],
    ) -> Floats32:
        """Radiance and coverage [H, W, 4] of triangles seen by ``clip`` [4, 4]."""
        with self.context:
            gl = self.context
            buffers = [gl.buffer(np.ascontiguousarray(a)) for a in (vertices, colours, faces)]
            content = [(buffers[0], "3f", "position"), (buffers[1], "3f", "colour")]
            array = gl.vertex_array(self.program, content, buffers[2])
            self.program["clip"].write(np.ascontiguousarray(clip.T))
            for name, value in light.items():
                self.program[name].write(np.ascontiguousarray(value))
            self.target.use()
            self.target.clear()
            array.render()
            gl.copy_framebuffer(self.resolved, self.target)
            pixels = np.frombuffer(self.resolved.read(components=4, dtype="f2"), np.float16)
            for thing in (array, *buffers):
                thing.release()
        return pixels.reshape(SIZE[1], SIZE[0], 4)[::-1].astype(np.float32)


def people(characters: Path) -> list[Dressed]:
    """The stage's people and the characters in a folder of .npz."""
    found = [load_character(file) for file in sorted(characters.glob("*.npz"))]
    return found + [dress(subject(seed), step=0.012) for seed in DESIGNS]


def film(clips: Clips, dressed: Dressed, probes: list[Path], painter: Painter, rng: Generator) -> Filmed:
    """Film one person in one random window of ``clips`` from a random camera, over a random probe."""
    rotations, roots = sampled(clips, 1, FRAMES * STEP, rng)
    rotations, roots = rotations[:, ::STEP], roots[:, ::STEP]
    skeleton = dressed.body.skeleton
    rest = skeleton.rest_joints.astype(np.float32)
    offsets = rest.copy()
    offsets[1:] -= rest[skeleton.parents[1:]]
    joints = positions(rotations, roots, offsets[None, :22])
    cameras = sampled_cameras(joints, rng)
    seen = cameras.seen(joints)[0]
    turned = (cameras.rotations[0] @ rotations[0]).astype(np.float32)
    near = seen[..., :2] / np.maximum(seen[..., 2:], 0.3)
    spread = np.ptp(near.reshape(-1, 2), 0) * 1.15 + 0.02
    focal = float(min(SIZE[0] / spread[0], SIZE[1] / spread[1]) * rng.uniform(0.55, 0.9))

    bones = np.concatenate([turned, turned[:, [20, 21]]], 1)
    hands = seen[:, [20, 21]] + (turned[:, [20, 21]] @ offsets[22:24, :, None])[..., 0]
    shifts = np.concatenate([seen, hands], 1) - (bones @ rest[:24, :, None])[..., 0]
    near_plane, far_plane = 0.1, 60.0
    clip = np.zeros((4, 4), np.float32)
    clip[0, 0], clip[1, 1] = 2 * focal / SIZE[0], -2 * focal / SIZE[1]
    clip[2, 2:] = (
        (far_plane + near_plane) / (far_plane - near_plane),
        -2 * far_plane * near_plane / (far_plane - near_plane),
    )
    clip[3, 2] = 1
    up = cameras.rotations[0] @ np.float32([0, 1, 0])
    colour = rng.uniform(0.7, 1.3, 3).astype(np.float32)
    direction = rng.normal(size=3) + 1.2 * up
    light = {
        "sky": np.float32(rng.uniform(0.3, 1.2)) * colour,
        "ground": np.float32(rng.uniform(0.1, 0.5)) * colour[::-1].copy(),
        "sun": np.float32(rng.uniform(0, 2.0)) * np.ones(3, np.float32),
        "direction": (direction / np.linalg.norm(direction)).astype(np.float32),
    }
    behind = _background(probes[rng.integers(len(probes))], cameras.rotations[0], focal, rng)
    weights, colours = dressed.weights.astype(np.float32), dressed.colour.astype(np.float32)
    rest_surface, faces = dressed.vertices.astype(np.float32), dressed.faces.astype(np.int32)
    images = np.empty((len(seen), SIZE[1], SIZE[0], 3), np.uint8)
    for k in range(len(seen)):
        blend = weights @ np.concatenate([bones[k], shifts[k][..., None]], -1).reshape(24, 12)
        blend = blend.reshape(-1, 3, 4)
        vertices = (blend[:, :, :3] * rest_surface[:, None]).sum(-1) + blend[:, :, 3]
        pixels = painter.render(vertices, colours, faces, clip, light)
        image = linear_to_srgb(np.clip(pixels[..., :3] + (1 - pixels[..., 3:]) * behind, 0, 1)) * 255
        images[k] = np.clip(image + rng.normal(0, 2.0, image.shape) + 0.5, 0, 255)
    return Filmed(images, focal, turned, seen)


def _background(probe: Path, rotation: Floats32, focal: float, rng: Generator) -> Floats32:
    """Radiance [H, W, 3] of a lat-long probe behind a camera, its median at a fifth."""
    pixels = oiio.ImageBuf(str(probe)).get_pixels(oiio.FLOAT)
    if pixels is None:
        raise InputError("light probe", expected="an image", got="none", file=probe)
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2, np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2)
    rays = np.stack([u, v, np.full_like(u, max(focal, 400.0))], -1) @ rotation  # a zoomed image shows few texels
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    height, width = pixels.shape[:2]
    x = ((np.arctan2(rays[..., 2], rays[..., 0]) / (2 * np.pi) + rng.random()) % 1) * width - 0.5
    y = np.arccos(np.clip(rays[..., 1], -1, 1)) / np.pi * height - 0.5
    behind = cv2.remap(
        pixels[..., :3], x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    return np.asarray(behind * (0.2 / max(float(np.median(behind.max(-1))), 1e-6)), np.float32)


class _Images:
    """Images as the frames of a video."""

    def __init__(self, images: NDArray[np.uint8]) -> None:
        self.images = images
        self.numbers = range(len(images))

    def frame(self, number: int) -> NDArray[np.uint8]:
        return self.images[number]


def observed(filmed: Filmed, network: LandmarkNetwork) -> dict[str, NDArray[np.generic]] | None:
    """What the landmark network sees of a window, beside the truth; None where it loses the person."""
    pixels = filmed.joints[0, :, :2] / filmed.joints[0, :, 2:] * filmed.focal + np.array(SIZE) / 2
    up = pixels[JOINTS.index("neck")] - pixels[0]
    radius = 1.2 * np.linalg.norm(pixels - pixels[0], axis=1).max()
    start = Start(0, Region.of_body(pixels[0], pixels[0] + radius * up / max(float(np.linalg.norm(up)), 1e-6)))
    video = _Images(filmed.images)
    views = [seen for _, seen in follow(video, list(video.numbers), start, lambda image: [], network)]
    if any(seen is None for seen in views):
        return None
    found = [seen for seen in views if seen is not None]
    merged = merge_views(
        np.stack([seen.points for seen in found]),
        np.stack([seen.metres for seen in found]),
        np.stack([seen.confidence for seen in found]),
        np.array([seen.region.size for seen in found]),
        np.arange(len(found)) * STEP / FPS,
    )
    rays = (merged.points - np.array(SIZE) / 2) / filmed.focal
    seen = {"rays": rays, "confidence": merged.confidence, "hint_m": merged.metres}
    truth = {"rotations": filmed.rotations, "joints": filmed.joints}
    return {name: np.asarray(array, np.float32) for name, array in {**seen, **truth}.items()}


def film_windows(
    clips: Clips, characters: Path, probes: Path, out: Path, count: int, on_progress: Callable[[int], None]
) -> None:
    """Write ``count`` windows to ``out``, one .npz each; those that are there are kept.

    A window of number k depends on k alone. Windows in which the network loses the person are empty files.
    """
    out.mkdir(parents=True, exist_ok=True)
    cast = people(characters)
    places = sorted(probes.glob("*.hdr"))
    painter, network = Painter(), LandmarkNetwork(open_network("pose_landmarks", 1))
    for number in range(count):
        file = out / f"{number:05d}.npz"
        if not file.exists():
            rng = np.random.default_rng([SEED, number])
            dressed = cast[int(rng.integers(len(cast)))]
            window = observed(film(clips, dressed, places, painter, rng), network)
            save_npz(file, window or {"rays": np.zeros((0, 33, 2), np.float32)})
        on_progress(number + 1)
