"""``assets/capture``: the dressed figure, path-traced, in the capture format."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, CaptureLight, Frame, Split, load_capture, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_stage.film.dances import FPS, TRAIN_SECONDS, dance
from rnd_stage.people.remesh import Floats

from . import sky, stage
from .clothes import Wardrobe, dress
from .texture import paint

SIZE = 256
SAMPLES = {"train": 48, "novel_view": 64, "novel_pose": 64, "relight": 64}
TARGET_LUMINANCE = 0.20  # of the subject, mean over the exposure frames
EXPOSURE_FRAMES = (0, 40, 90, 130)
CLIPPED_AT_MOST = 0.03  # share of clipped pixels; more reduces the exposure
TRAIN_LIGHT = "noon"
NOVEL_VIEW_FRAMES = (24, 70, 122)
NOVEL_POSE_FRAMES = (158, 172, 186, 200, 214)
RELIGHT_FRAMES = (172, 200)
ALBEDO_EVERY = 10  # train frames
NORMAL_BLUR, NORMAL_TILT = 1.0, 0.16  # pixels; scale of the smooth tilt, about 8° on average

LIGHTS = {"noon": sky.noon, "evening": sky.evening, "studio": sky.studio}
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def cameras() -> dict[str, Camera]:
    """``cam00``, the training camera, in front; four more around, below and above."""
    places = {"cam00": (0, 4), "cam01": (50, -4), "cam02": (-65, 14), "cam03": (128, 8), "cam04": (-150, 30)}
    target, distance = np.array([0.0, 0.95, 0.0]), 4.4
    result = {}
    for name, (azimuth, elevation) in places.items():
        a, e = np.radians([azimuth, elevation])
        eye = target + distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        fov = 2 * np.arctan(1.12 / distance)  # a person of 1.75 m fills 78 % of the height
        result[name] = Camera.look_at(eye, target, width=SIZE, height=SIZE, fov_y=float(fov))
    return result


def views() -> list[tuple[Split, str, int, str]]:
    """Every image as (split, camera, frame, light)."""
    train = range(0, round(TRAIN_SECONDS * FPS), 2)
    return [
        *(("train", "cam00", frame, TRAIN_LIGHT) for frame in train),
        *(("novel_view", c, f, TRAIN_LIGHT) for c in ("cam01", "cam02", "cam03", "cam04") for f in NOVEL_VIEW_FRAMES),
        *(("novel_pose", c, f, TRAIN_LIGHT) for c in ("cam00", "cam02") for f in NOVEL_POSE_FRAMES),
        *(
            ("relight", c, f, light)
            for light in ("evening", "studio")
            for c in ("cam00", "cam02")
            for f in RELIGHT_FRAMES
        ),
    ]


def make_capture(folder: Path, body: Body) -> None:
    """Render everything into ``folder``; about ten minutes on two cores."""
    error = stage.check_environment()
    if error > 0.5:
        raise RuntimeError(f"Mitsuba puts the light {error:.2f}° off")
    filming = _Filming(body)
    lights = {}
    for name, light in LIGHTS.items():
        sky.make_light(folder / f"lights/{name}.exr", light())
        scale = filming.exposure(light())
        lights[name] = CaptureLight(f"lights/{name}.exr", (scale, scale, scale))
        print(f"{name}: scale {scale:.4f}")
    frames = []
    for split, camera, index, light in views():
        frames.append(filming.shoot(folder, split, camera, index, light, lights[light].scale[0]))
        print(f"{split} {camera} {index} {light}", flush=True)
    save_capture(
        Capture(folder, filming.cameras, lights, body, filming.motion, tuple(frames)),
        subject="generated",
        render={"engine": "mitsuba scalar_rgb", "samples": SAMPLES, "max_depth": stage.MAX_DEPTH},
    )
    contact_sheet(folder)


def contact_sheet(folder: Path) -> None:
    """``contact.png``: images of every split, with normals and albedo."""
    capture = load_capture(folder)
    train = capture.split("train")
    rows = [train[::7], capture.split("novel_view")[:11], [*capture.split("novel_pose"), train[-1]]]
    rows.append([*capture.split("relight"), *capture.split("novel_view")[9:12]])
    strips = []
    for row in rows:
        shown = [capture.load_frame(frame) for frame in row[:11]]
        strips.append([cv2.resize(s.image_srgb[:, 48:208], (80, 128), interpolation=cv2.INTER_AREA) for s in shown])
    shown = [capture.load_frame(frame) for frame in train[::7][:11]]
    normals = [0.5 * (s.normal + 1) * (s.mask[..., None] > 0.05) for s in shown]
    strips.append([cv2.resize(n[:, 48:208], (80, 128), interpolation=cv2.INTER_AREA) for n in normals])
    write_image(folder / "contact.png", to_bytes(np.concatenate([np.concatenate(s, axis=1) for s in strips])))


class _Filming:
    """The dressed figure in motion, and its cameras."""

    def __init__(self, body: Body) -> None:
        self.dressed = dress(body)
        self.colour, self.roughness = paint(self.dressed)
        self.motion = dance(body.skeleton)
        self.wardrobe = Wardrobe(self.dressed, body, self.motion)
        self.cameras = cameras()

    def exposure(self, radiance: Floats) -> float:
        """The factor on ``radiance`` for the target luminance of the subject, or less to limit clipping."""
        colours = []
        for frame in EXPOSURE_FRAMES:
            view = self._view("cam00", frame, radiance, samples=16)
            colours.append(view.radiance[view.coverage > 0.5])
        pixels = np.concatenate(colours)
        white = np.quantile(pixels.max(axis=1), 1 - CLIPPED_AT_MOST)
        return float(min(TARGET_LUMINANCE / (pixels @ LUMINANCE).mean(), 1.0 / white))

    def shoot(self, folder: Path, split: Split, camera: str, index: int, light: str, scale: float) -> Frame:
        """Render and write one image with its ground truth."""
        view = self._view(camera, index, scale * LIGHTS[light](), samples=SAMPLES[split])
        place = f"{camera}_{index:03d}"
        image, mask = f"images/{split}/{light}_{place}.png", f"masks/{place}.png"
        _write(folder / image, linear_to_srgb(np.clip(view.radiance, 0, 1)))
        _write(folder / mask, view.coverage)
        normals = self._camera_normals(view, camera)
        covered = view.coverage[..., None] >= 0.05
        albedo = None
        if split == "train":
            normal, normal_gt = f"normals/{place}.png", None
            _write(folder / normal, 0.5 * (_estimated(normals, view.coverage, seed=index) + 1) * covered)
        else:
            normal = normal_gt = f"normals_gt/{place}.png"
            _write(folder / normal, 0.5 * (normals + 1) * covered)
        if split != "train" or index % (2 * ALBEDO_EVERY) == 0:
            albedo = f"albedo/{place}.png"
            _write(folder / albedo, linear_to_srgb(np.clip(view.albedo, 0, 1)))
        return Frame(image, mask, camera, index, split, normal, normal_gt, albedo, light)

    def _view(self, camera: str, frame: int, radiance: Floats, *, samples: int) -> stage.View:
        vertices, normals = self.wardrobe.posed(frame)
        figure = stage.Surface(vertices, normals, self.dressed.faces, self.colour, self.roughness)
        return stage.render(figure, self.cameras[camera], radiance, samples=samples, seed=frame)

    def _camera_normals(self, view: stage.View, camera: str) -> Floats:
        turned = view.normals @ self.cameras[camera].world_to_camera[:3, :3].T
        return turned / np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-9)


def _estimated(normals: Floats, coverage: Floats, seed: int) -> Floats:
    """``normals`` [H, W, 3] blurred and smoothly tilted, as if by an estimator."""
    weight = cv2.GaussianBlur(coverage, (0, 0), NORMAL_BLUR)[..., None]
    blurred = cv2.GaussianBlur(normals * coverage[..., None], (0, 0), NORMAL_BLUR) / np.maximum(weight, 1e-3)
    coarse = np.random.default_rng(seed).normal(size=(6, 6, 3))
    tilted = blurred + NORMAL_TILT * cv2.resize(coarse, (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    tilted[..., 2] = np.minimum(tilted[..., 2], -0.02)  # facing the camera
    return tilted / np.maximum(np.linalg.norm(tilted, axis=-1, keepdims=True), 1e-9)


def _write(path: Path, values: Floats) -> None:
    write_image(path, to_bytes(values))
