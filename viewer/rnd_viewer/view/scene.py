"""The content of ``rnd-view``: an avatar, a motion, lights, a capture; and an image for each state."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.networks import Networks
from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.core.camera import Camera, Floats
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.ground.shadow import GroundLight, Plane
from rnd_runtime.ground.standing import ground_of
from rnd_runtime.motion.edit import edit_motion
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.aov import aov_image
from rnd_runtime.playback.frame import FrameRenderer, PosedAvatar, RenderedFrame, ground_share
from rnd_runtime.playback.framing import CameraOptions, Framing, frame_motion, front_path
from rnd_runtime.playback.scene import Person
from rnd_runtime.raster.tone import tone_map
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light, brightest_direction, downsize, light_notes
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.background import Background
from rnd_viewer.inputs.options import parse_gain

from .options import SIZES, ViewOptions, probes
from .people import ViewedPeople
from .state import ViewState

Floats32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]

CLAY = np.float32(0.18)  # a grey card's, albedo of the output "light"
MAX_SHADERS = 12  # tables of up to 1.5 MB each; building one takes 30–300 ms
LARGEST_SKY = 1024  # rows of a cached background map: 25 MB


class View:
    """One rendered image.

    Attributes:
        srgb: [H, W, 3] uint8.
        joints: [J, 3] px, px and z in metres, z ≤ 0 behind the camera.
        seconds: time of each stage.
    """

    def __init__(self, srgb: Bytes, joints: Floats32, seconds: dict[str, float]) -> None:
        self.srgb, self.joints, self.seconds = srgb, joints, seconds


class Scene:
    """Renders any ``ViewState`` of what ``options`` name, one at a time.

    Args:
        ahead: the avatar's networks, where they are being loaded already.

    Raises:
        InputError: for whatever cannot be used.
    """

    def __init__(self, options: ViewOptions, ahead: Future[Networks] | None = None) -> None:
        self._load(options, ahead)
        self._files, self._up = probes(options.hdr), options.hdr_up
        self.name, self.size, self.threads = options.avatar.name, options.width_height, options.threads
        self._fit = options.size is None
        self._shader = lru_cache(MAX_SHADERS)(self._build_shader)
        self._light = lru_cache(1)(self._load_light)  # in full: only until its shaders are built
        self._sky = lru_cache(MAX_SHADERS // 2)(self._smaller_light)
        self._light_notes: dict[str | Path | None, list[str]] = {}
        self._suns: dict[str | Path | None, list[float]] = {}
        self._background: tuple[tuple[Any, ...], Floats32] | None = None
        self._posed: tuple[Motion, float, PosedAvatar] | None = None
        self._ground_light = lru_cache(MAX_SHADERS)(self._build_ground_light)
        self._ground = lru_cache(2)(partial(ground_of, self.avatar))
        self._alone = lru_cache(2)(self._person)
        first = self._shader(self._files[0] if self._files else None, "table+sun")
        self.renderer = FrameRenderer(self.avatar, first, raster=options.raster)

    def description(self) -> dict[str, Any]:
        """The description of the scene for a page."""
        framing, names = self.framing(), self.avatar.skeleton.names
        view = CameraOptions(*self.size)
        home = front_path(framing, view)(0, 0.0)
        return {
            "avatar": self.name,
            "gaussians": self.gaussians,
            "parents": self.parents(),
            "motion": {"name": self.motion_name, "duration": self.duration, "fps": self.motion.fps},
            "lights": ["the avatar's own", *(file.name for file in self._files)],
            "light": 1 if self._files else 0,
            "head": names.index("head") if "head" in names else -1,
            "fit": self._fit,
            "size": self.size,
            "sizes": SIZES,
            "raster": self.renderer.draws_with,
            "view": {
                "azimuth": framing.facing,
                "elevation": view.elevation,
                "distance": float(np.linalg.norm(home.position - framing.centre)),
                "target": tuple(framing.centre.tolist()),
                "fov": view.fov_y,
            },
            "truths": self._truths(),
            "ground": True,
            "notes": self.notes(),
        }

    @property
    def gaussians(self) -> int:
        """Number of the Gaussians, as of all properties here: of what is played."""
        return self.avatar.gaussians

    @property
    def duration(self) -> float:
        """s."""
        return self.motion.duration

    @property
    def motion_name(self) -> str:
        return Path(self.motion.source).name

    def framing(self) -> Framing:
        """Where the body is in the whole motion."""
        return frame_motion(self.avatar.skeleton, self.motion)

    def parents(self) -> list[int]:
        """Of the joints of a ``View``, −1 for none."""
        return list(self.avatar.skeleton.parents.tolist())

    def notes(self) -> list[str]:
        """Of the motion's reader."""
        return list(self.motion.notes)

    def frames_at(self, fps: float) -> int:
        """Frames of a clip."""
        return self.motion.frames_at(fps)

    def warm_up(self) -> None:
        """Render the first view once: a first run compiles the kernels, up to two minutes."""
        about = self.description()
        width, height = self.size
        self.render(ViewState(time=0.0, width=width, height=height, light=about["light"], **about["view"]))

    def render(self, state: ViewState) -> View:
        """The image of ``state`` with the times of its stages."""
        seconds: dict[str, float] = {}
        if state.truth is not None:
            state = structs.replace(state, yaw=0.0, exposure=0.0)
        camera, motion, time_s = self._view(state)
        lit = not aovs_of(state)
        background = self._background_radiance(state, camera) if lit or state.output == "albedo" else None
        grounded = lit and state.ground and state.truth is None and background is not None and bool(background.any())
        self.renderer.shader = self._rotated_shader(state)
        frame = self._draw(state, camera, motion, time_s, grounded, seconds)
        started = perf_counter()
        if background is not None:
            radiance = frame.radiance * np.float32(2.0**state.exposure) if lit else frame.aovs["albedo"]
            tone = state.tone if lit else "srgb"
            srgb = tone_map(radiance, frame.alpha, background, frame.ground if grounded else None, tone=tone)
        else:
            shown = aov_image(state.output, frame.aovs[state.output], frame.alpha)
            srgb = np.broadcast_to(shown, (*frame.alpha.shape, 3))
        seconds |= {**frame.stage_seconds, "tone map": perf_counter() - started}
        return View(srgb, self._joints(motion, time_s, camera), seconds)

    def notes_of_light(self, state: ViewState) -> list[str]:
        """Notes on the light of a rendered ``state``."""
        return self._light_notes[self._light_name(state)]

    def sun_of_light(self, state: ViewState) -> list[float]:
        """Where the light of a rendered ``state`` is brightest, a unit vector at yaw 0."""
        return self._suns[self._light_name(state)]

    def truth_file(self, index: int) -> Path:
        """The capture's image ``index``."""
        capture, frame = self._capture_frame(index)
        return existing_file(capture.folder / frame.image, what="image of the capture")

    def close(self) -> None:
        self.renderer.close()

    def _load(self, options: ViewOptions, ahead: Future[Networks] | None) -> None:
        """Set ``avatar``, ``capture`` and ``motion``."""
        self.avatar = Avatar.load(options.avatar, threads=options.threads, ahead=ahead)
        self.avatar.scale_albedo(parse_gain(options.albedo_gain))
        self.capture: Capture | None = load_capture(options.capture) if options.capture else None
        self.motion = self._motion(options)

    def _motion(self, options: ViewOptions) -> Motion:
        if options.motion:
            return options.reading.read_motion(options.motion, self.avatar.skeleton)
        if self.capture:
            return edit_motion(self._captured_motion, options.reading.edits)
        joints = len(self.avatar.skeleton)
        rest = np.broadcast_to(np.eye(3), (1, joints, 3, 3))
        return Motion(rest, np.zeros((1, 3)), 30.0, self.avatar.skeleton.names, "at rest")

    @cached_property
    def _captured_motion(self) -> Motion:
        assert self.capture
        return self.capture.motion_for(self.avatar.skeleton)

    def _truths(self) -> list[dict[str, Any]]:
        if not self.capture:
            return []
        return [
            {
                "label": " · ".join(filter(None, [frame.split, frame.camera, f"frame {frame.frame}", frame.light])),
                "time": frame.frame / self.capture.fps,
                "width": self.capture.cameras[frame.camera].width,
                "height": self.capture.cameras[frame.camera].height,
            }
            for frame in self.capture.frames
        ]

    def _capture_frame(self, index: int) -> tuple[Capture, Any]:
        if self.capture is None or index >= len(self.capture.frames):
            raise InputError("truth", expected="an image of --capture", got=index)
        return self.capture, self.capture.frames[index]

    def _view(self, state: ViewState) -> tuple[Camera, Motion, float]:
        if state.truth is None:
            return state.camera(), self.motion, float(np.clip(state.time, 0, self.duration))
        capture, frame = self._capture_frame(state.truth)
        camera = capture.cameras[frame.camera]
        scale = min(state.width / camera.width, state.height / camera.height)
        size = (max(round(side * scale), 1) for side in (camera.width, camera.height))
        return camera.resized(*size), self._captured_motion, frame.frame / capture.fps

    def _draw(
        self, state: ViewState, camera: Camera, motion: Motion, time_s: float, grounded: bool, seconds: dict[str, float]
    ) -> RenderedFrame:
        """The frame of ``state``, with the ``ground`` where it is ``grounded``; adds to the stages' ``seconds``."""
        alone = self._alone(motion)
        if state.gaussians is None and any(alone.levels_at(time_s, camera)):
            plane = self._ground(motion) if grounded else None
            return self._draw_people(alone, state, camera, time_s, plane, seconds)
        body = self._pose(motion, time_s, seconds)
        shown = body._replace(gaussians=self._changed(state, body.gaussians))
        frame = self.renderer.draw(shown, camera, aovs=aovs_of(state), lit=not aovs_of(state), srgb=False)
        if not grounded:
            return frame
        started = perf_counter()
        share = ground_share(self._ground(motion), self._turned_ground_light(state), body, camera)
        times = {**frame.stage_seconds, "ground": perf_counter() - started}
        return replace(frame, ground=share, stage_seconds=times)

    def _draw_people(
        self,
        people: ViewedPeople,
        state: ViewState,
        camera: Camera,
        time_s: float,
        ground: Plane | None,
        seconds: dict[str, float],
    ) -> RenderedFrame:
        """The frame of ``state`` at the levels of detail that it needs."""
        bodies, change = people.bodies(time_s, camera, seconds), partial(self._changed, state)
        self.renderer.ground, light = ground, None if ground is None else self._turned_ground_light(state)
        frame = people.draw(bodies, camera, aovs=aovs_of(state), srgb=False, change=change, ground_light=light)
        self.renderer.ground = None
        return frame

    def _changed(self, state: ViewState, gaussians: Gaussians) -> Gaussians:
        """Fewer, or of one albedo, where ``state`` wants that."""
        if state.gaussians is not None:
            share = state.gaussians / self.gaussians
            gaussians = _fewer(gaussians, max(round(len(gaussians.means) * share), 1))
        if state.output == "light":
            gaussians = replace(gaussians, albedo=np.full_like(gaussians.albedo, CLAY))
        return gaussians

    def _person(self, motion: Motion) -> ViewedPeople:
        return ViewedPeople([Person(self.avatar, motion)], self.renderer)

    def _pose(self, motion: Motion, time_s: float, seconds: dict[str, float]) -> PosedAvatar:
        """Cached while only camera and light move."""
        if self._posed is None or self._posed[0] is not motion or self._posed[1] != time_s:
            started = perf_counter()
            encoded = self.avatar.encode(motion, time_s)
            known = perf_counter()
            body = PosedAvatar(self.avatar.posed(encoded), encoded.root, self.avatar.joints(encoded))
            self._posed = motion, time_s, body
            seconds |= {"encoders": known - started, "posing": perf_counter() - known}
        return self._posed[2]

    def _rotated_shader(self, state: ViewState) -> Shader:
        shader = self._shader(self._light_name(state), state.shade)
        return shader.with_yaw(shader.light.yaw + state.yaw)

    def _light_name(self, state: ViewState) -> str | Path | None:
        """The key of the light in use: a probe's file, a light of the capture, or None for the avatar's own."""
        if state.truth is not None:
            light = self._capture_frame(state.truth)[1].light
            return light if self.capture is not None and self.capture.has_map(light) else None
        if state.light > len(self._files):
            raise InputError("light", expected=f"0 to {len(self._files)}", got=state.light)
        return self._files[state.light - 1] if state.light else None

    def _build_shader(self, name: str | Path | None, shade: str) -> Shader:
        shader = Shader(self._light(name), shade)
        # from here on the light is only rotated: its texels can be freed
        shader.light = replace(shader.light, radiance=np.zeros((1, 2, 3), np.float32))
        self._light.cache_clear()
        return shader

    def _build_ground_light(self, name: str | Path | None) -> GroundLight:
        light = self._light(name)
        self._light.cache_clear()
        return GroundLight(light).with_yaw(replace(light, radiance=np.zeros((1, 2, 3), np.float32)))

    def _turned_ground_light(self, state: ViewState) -> GroundLight:
        light = self._ground_light(self._light_name(state))
        return light.with_yaw(light.light.with_yaw(light.light.yaw + state.yaw))

    def _load_light(self, name: str | Path | None) -> Light:
        light = self._read_light(name)
        self._light_notes[name], self._suns[name] = light_notes(light), brightest_direction(light).tolist()
        return light

    def _read_light(self, name: str | Path | None) -> Light:
        if name is None:
            return Light(self.avatar.trained_light)
        if isinstance(name, Path):
            return load_light(name, up=self._up)
        assert self.capture
        return self.capture.load_light(name)

    def _smaller_light(self, name: str | Path | None) -> Light:
        light = self._light(name)
        self._light.cache_clear()
        if len(light.radiance) <= LARGEST_SKY:
            return light
        return replace(light, radiance=downsize(light.radiance, LARGEST_SKY, 2 * LARGEST_SKY))

    def _background_radiance(self, state: ViewState, camera: Camera) -> Floats32:
        """The background; a map's is cached while map and camera are the same."""
        background = Background.parse(state.background)
        if background.kind != "hdr":
            return np.array(background.colour, np.float32)
        name = self._light_name(state)
        size = camera.width, camera.height
        key = (name, state.yaw, size, camera.K.tobytes(), camera.world_to_camera.tobytes())
        if self._background is None or self._background[0] != key:
            light = self._sky(name)
            rotated = light.with_yaw(light.yaw + state.yaw)
            self._background = key, background.radiance(camera, rotated)
        return self._background[1] * np.float32(2.0**state.exposure)

    def _joints(self, motion: Motion, time_s: float, camera: Camera) -> Floats32:
        now = motion.at([time_s])
        world = self.avatar.skeleton.joint_transforms(now.rotations[0], now.translations[0])[:, :3, 3]
        return projected(world, camera)


def projected(world: Floats, camera: Camera) -> Floats32:
    """px, px and z in metres [N, 3] of points [N, 3] m."""
    seen = world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.where(np.abs(seen[:, 2:]) > 1e-6, seen[:, 2:], 1e-6)
    pixels = (seen / depth) @ camera.K.T
    return np.column_stack([pixels[:, :2], seen[:, 2]]).astype(np.float32)


def aovs_of(state: ViewState) -> tuple[str, ...]:
    """The material that ``state`` shows, none for light."""
    return () if state.output in ("lit", "light") else (state.output,)


def _fewer(gaussians: Gaussians, count: int) -> Gaussians:
    """``count`` Gaussians at even steps through the file, which is in spatial order, scaled to cover the same area."""
    total = len(gaussians.means)
    if count >= total:
        return gaussians
    kept = np.arange(count) * total // count
    fewer = gaussians.only(kept)
    return replace(fewer, covariances=fewer.covariances * np.float32(total / count))
