"""The options of ``rnd-play``, and those that other commands share; each comment is the option's help."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rnd_runtime.cli.command import (
    Flag,
    Number,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalNumber,
    OptionalSize,
    group,
    option,
)
from rnd_runtime.cli.jobs import On
from rnd_runtime.core.errors import InputError, check_cull, check_option, flag, refuse_changed, refuse_outside
from rnd_runtime.core.images import Tone
from rnd_runtime.motion.edit import EDIT_LIMITS, MotionEdits, edit_motion
from rnd_runtime.motion.readers.arrays import FPS_LIMITS
from rnd_runtime.playback.framing import ELEVATION, FIELD_OF_VIEW
from rnd_runtime.shading.light import Up

if TYPE_CHECKING:
    from rnd_runtime.motion.motion import Motion
    from rnd_runtime.motion.skeleton import Skeleton

_EDITS = tuple(edit.name for edit in fields(MotionEdits))  # each of them an option of the same name
OWN_CAMERAS = ("front", "orbit")


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """How the motion's file is read and edited."""

    motion_up: Annotated[Literal["auto", "y", "z"], option()] = "auto"
    """Up axis of the motion's file."""
    motion_fps: OptionalNumber = None
    """Frames per second of the motion's recording, whatever its file says. Default: the file's, else what its program
    records: 60 for an .npz, 30 for WHAM and its like, 120 for an .amc."""
    joint_map: OptionalFile = None
    """TOML or JSON file with the avatar's joints and their names in the motion, where those are unknown."""
    smooth: Annotated[float | None, option("HZ")] = None
    """Smooth jitter by a One-Euro filter of this cutoff, 1 to 5; lower is smoother."""
    speed: Number = 1.0
    """Playback speed."""
    in_place: Flag = False
    """Keep the root above its first position."""
    loop: Flag = False
    """Blend the motion's end into its beginning, for a clip that repeats."""
    plant_feet: Flag = False
    """Keep feet on the ground from sliding, by up to 8 cm; legs follow."""

    @property
    def edits(self) -> MotionEdits:
        """Edits of the motion after it is read."""
        return MotionEdits(**{name: getattr(self, name) for name in _EDITS})

    def read_motion(self, path: Path, skeleton: Skeleton) -> Motion:
        """Read and edit the motion in ``path`` for ``skeleton``."""
        from rnd_runtime.motion.motion import load_motion  # loads numba, which run_command prepares for
        from rnd_runtime.motion.planting import plant_feet

        motion = load_motion(path, skeleton, up=self.motion_up, fps=self.motion_fps, joint_map=self.joint_map)
        edited = edit_motion(motion, self.edits)
        return plant_feet(edited, skeleton) if self.plant_feet else edited

    def refuse_unread(self, why: str, *, edited: bool = False) -> None:
        """Refuse options of a motion's file if there is none, and edits unless a motion is edited."""
        names = (field.name for field in fields(MotionOptions))
        refuse_changed(self, (name for name in names if not (edited and name in _EDITS)), why)

    def __post_init__(self) -> None:
        refuse_outside(self, {"motion_fps": FPS_LIMITS, **EDIT_LIMITS})


def parse_gain(text: str) -> tuple[float, float, float]:
    """Factors of --albedo-gain from ``R,G,B`` or one number; raises ``InputError`` outside 0 to 100."""
    words = text.split(",")
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) not in (1, 3) or not all(0 <= value <= 100 for value in values):
        raise InputError("--albedo-gain", expected="R,G,B or one number, 0 to 100", got=text)
    red, green, blue = values * (3 // len(values))
    return red, green, blue


GAIN = "R,G,B"
MotionGroup = Annotated[MotionOptions, *group("motion")]
ProbeUp = Annotated[Up, option()]


@dataclass(frozen=True)
class _Camera:
    """The view: a camera that shows the whole motion, or one from a file."""

    camera: Annotated[str, option("front|orbit|FILE.json[:NAME]")] = "front"
    """FILE.json holds one camera {"width": px, "height": px, "K": 3x3, "world_to_camera": 4x4} (OpenCV axes, metres),
    or {"cameras": [one for each frame]}, or {"cameras": {NAME: camera}} as a capture's capture.json."""
    orbit_seconds: Number = 8.0
    """Duration of one orbit; negative orbits the other way."""
    distance: OptionalNumber = None
    """Metres from the motion's centre to the camera. Default: the least that shows all of it."""
    elevation: Number = ELEVATION
    """Degrees above the horizon."""
    fov: Number = FIELD_OF_VIEW
    """Vertical field of view in degrees."""

    def __post_init__(self) -> None:
        limits = {"orbit_seconds": (-1e6, 1e6), "distance": (1e-3, 1e4), "elevation": (-89, 89), "fov": (1, 170)}
        refuse_outside(self, limits)
        check_option(self.orbit_seconds != 0, "--orbit-seconds", "not 0", 0)
        if self.camera != "orbit":
            refuse_changed(self, ["orbit_seconds"], "needs --camera orbit")
        if self.camera not in OWN_CAMERAS:
            refuse_changed(self, ["distance", "elevation", "fov"], "the camera's file has its pose")


@dataclass(frozen=True)
class _Lighting:
    """The light, the probe of --hdr or the learned one, and the background."""

    hdr_up: ProbeUp = "y"
    """Up axis of the probe's file."""
    hdr_yaw: Number = 0.0
    """Degrees by which the light is rotated about the vertical axis, from +X towards +Z."""
    hdr_turn: Annotated[float | None, option("SECONDS")] = None
    """Duration of one rotation of the light, from --hdr-yaw on; negative rotates the other way. Default: none."""
    exposure: Number = 0.0
    """Stops by which the light is made brighter."""
    albedo_gain: Annotated[str, option(GAIN)] = "1"
    """Factors on the albedo, linear: corrects colours that training put into the light."""
    tone: Annotated[Tone, option("srgb|neutral")] = "srgb"
    """Tone curve of 8-bit frames: sRGB's alone, which clips above 1, or Khronos PBR Neutral, which compresses
    highlights. An .exr stays linear, a background of one COLOUR as it is."""
    background: Annotated[str, option("none|hdr|COLOUR")] = "none"
    """none is transparent; hdr is the light itself; a COLOUR is #rgb, #rrggbb or a name such as red (sRGB), or r,g,b
    (linear radiance)."""
    ground: Annotated[str, option("none|auto|METRES")] = "none"
    """Height of a ground that catches the shadow; auto finds it under the feet. On a background the shadow darkens
    it; without one it is black in the alpha."""

    ground_albedo: Annotated[str | None, option("R,G,B")] = None
    """Linear albedo of the ground, 0 to 1, or one number: what the ground reflects lights the body, in place of the
    probe's lower half."""

    def __post_init__(self) -> None:
        if self.ground not in ("none", "auto"):
            check_option(abs(self.ground_height) <= 1e4, "--ground", "none, auto or metres", self.ground)
        if self.ground_albedo is not None:
            check_option(self.ground != "none", "--ground-albedo", "--ground", "none")
            _ = self.albedo
        refuse_outside(self, {"hdr_yaw": (-1e6, 1e6), "hdr_turn": (-1e6, 1e6), "exposure": (-30, 30)})
        check_option(self.hdr_turn != 0, "--hdr-turn", "not 0", 0)
        parse_gain(self.albedo_gain)

    @property
    def albedo(self) -> tuple[float, float, float] | None:
        """The ground's, where given."""
        if self.ground_albedo is None:
            return None
        try:
            values = [float(word) for word in self.ground_albedo.split(",")]
        except ValueError:
            values = []
        known = len(values) in (1, 3) and all(0 <= value <= 1 for value in values)
        check_option(known, "--ground-albedo", "r,g,b or one number, 0 to 1", self.ground_albedo)
        red, green, blue = values if len(values) == 3 else 3 * values
        return red, green, blue

    @property
    def ground_height(self) -> float:
        """The height given for the ground, m; infinite where none is."""
        try:
            return float(self.ground)
        except ValueError:
            return math.inf


@dataclass(frozen=True)
class _Rendering:
    """Speed against fidelity."""

    shade: Annotated[str, option("ao|table|table+sun|lights:K|brute")] = "table+sun"
    """Shading, fastest first: ao, table, table+sun (the only one with hard shadows of the sun), K of 1 to 8192
    directional lights, brute (every texel of the probe, shadows as soft as they were learned)."""
    cull: Annotated[float | None, option("COSINE")] = None
    """Leave out Gaussians that face away: those whose normal has less than this cosine to the view; -1 renders all.
    Default: what rnd-export found to be invisible, which saves 10 to 20 % of a frame."""
    raster: Annotated[Literal["auto", "gl", "cpu"], option()] = "auto"
    """Rasteriser: auto takes OpenGL on a graphics card and the CPU otherwise."""
    threads: OptionalCount = None
    """CPU threads. Default: all."""
    supersample: Annotated[int, option("N")] = 1
    """Samples along a pixel's side, 1 to 4, averaged in linear light: 2 takes four times as long."""
    shutter: Annotated[float, option("DEGREES")] = 0.0
    """Motion blur by a shutter that is open for so much of a frame, 360 for all of it; film has 180. A camera from a
    file stands still meanwhile."""
    shutter_samples: Annotated[int, option("N")] = 8
    """Moments at which an open shutter is sampled, 2 to 64."""

    def __post_init__(self) -> None:
        check_cull(self.cull)
        refuse_outside(self, {"supersample": (1, 4), "shutter": (0, 360), "shutter_samples": (2, 64)})
        if not self.shutter:
            refuse_changed(self, ["shutter_samples"], "needs --shutter")


@dataclass(frozen=True)
class PlayOptions:
    """Animate, relight and splat an avatar to frames and clips, with no GPU and no display needed.

    rnd-play avatar.onnx --motion walk.npz --hdr sky.exr --out out/
    """

    avatar: Annotated[tyro.conf.Positional[Path | None], option("AVATAR.onnx|SCENE.toml")] = None
    """The avatar, a file of rnd-export; or several, with motions and positions, in a scene file: docs/formats.md."""
    motion: OptionalFile = None
    """Body poses over time: .npz of AMASS, SMPL, Kimodo or SLAHMR, .pkl of AIST++, WHAM, 4D-Humans or SAM 3D Body, .pt
    of GVHMR or GEM-X, .npy of HumanML3D, Motion-X or TRAM, .bvh, .glb, .vrma, .amc with its .asf, and what
    docs/formats.md lists."""
    hdr: OptionalFile = None
    """Light probe, lat-long EXR or HDR. Default: the light of the avatar's capture."""
    out: OptionalFolder = None
    """Folder for frames/, frames_exr/, aov/, play.mp4, play.webp and play.json. One that holds frames of anything but
    this run is refused."""
    size: OptionalSize = None
    """Size of a frame in pixels; also 720p, 1080p. Default: 512, or the camera file's own."""
    fps: OptionalNumber = None
    """Frames per second. Default: the motion's."""
    frames: Annotated[str | None, option("START:END")] = None
    """Frames to render, END excluded, either may be missing. Pixels are those of the whole run; processes with
    different parts may share a folder. Default: all."""
    format: Annotated[str | None, option("LIST")] = None
    """Some of png,exr,mp4,webp,webm,mov. webp, webm (VP9) and mov (ProRes 4444) are clips too, transparent where a png
    is. Default: png, and mp4 where PyAV is installed."""
    aov: Annotated[str, option("LIST")] = ""
    """Also write some of albedo,normal,roughness,visibility,depth, of the split light diffuse,specular,shadow, of
    motion (pixels to the next frame), and of parts (Cryptomatte by joint). Normals are in the camera's OpenCV axes."""
    half: Flag = False
    """Store colours of an .exr as half floats."""
    colorspace: Annotated[Literal["rec709", "acescg"], option()] = "rec709"
    """Primaries of the colours of an .exr, all linear."""
    on: On = None
    """Render parts of the run on N processes of this machine, or on the workers of a Dask scheduler (extra [dask])."""
    skip_existing: Flag = False
    """Leave frames that are there already; of a clip, those of a stopped run with --on."""
    doctor: Flag = False
    """Print renderer, providers, threads and versions, and what to install for what is missing."""
    reading: MotionGroup = field(default_factory=MotionOptions)
    view: Annotated[_Camera, *group("camera")] = field(default_factory=_Camera)
    lighting: Annotated[_Lighting, *group("light")] = field(default_factory=_Lighting)
    rendering: Annotated[_Rendering, *group("rendering")] = field(default_factory=_Rendering)

    def __post_init__(self) -> None:
        refuse_outside(self, {"fps": (1e-3, 1000)})
        if "exr" not in (self.format or ""):
            refuse_changed(self, ["half", "colorspace"], "only of --format exr")
        sampled = self.rendering.supersample > 1 or self.rendering.shutter > 0
        check_option(not (self.aov and sampled), "--aov", "no --supersample and no --shutter", self.aov)
        if self.hdr is None:
            refuse_changed(self.lighting, ["hdr_up"], "needs --hdr")

    def settings(self) -> dict[str, Any]:
        """All options in one mapping: name → value."""
        groups = {"reading", "view", "lighting", "rendering"}
        flat = {name: value for name, value in vars(self).items() if name not in groups}
        return flat | {name: value for each in sorted(groups) for name, value in vars(getattr(self, each)).items()}


def parse_frames(text: str | None, count: int) -> range:
    """``10:50``, ``:50`` or ``10:`` out of ``count`` frames."""
    match = re.fullmatch(r"(\d{0,9}):(\d{0,9})", text if text is not None else ":")
    start, end = (int(match[1] or 0), int(match[2] or count)) if match else (0, 0)
    if not 0 <= start < end <= count:
        raise InputError(flag("frames"), expected=f"START:END within 0:{count}, START before END", got=text)
    return range(start, end)
