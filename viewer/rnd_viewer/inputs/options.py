"""The options of ``rnd-play``, and those that it shares; each comment is the option's help."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rnd_runtime.core.errors import InputError, check_cull, check_option, flag, refuse_changed, refuse_outside
from rnd_runtime.motion.edit import EDIT_LIMITS, MotionEdits, edit_motion
from rnd_runtime.motion.readers.arrays import FPS_LIMITS
from rnd_runtime.playback.framing import ELEVATION, FIELD_OF_VIEW
from rnd_runtime.shading.light import Up

if TYPE_CHECKING:
    from rnd_runtime.motion.motion import Motion
    from rnd_runtime.motion.skeleton import Skeleton

_EDITS = tuple(edit.name for edit in fields(MotionEdits))  # each of them an option of the same name
OWN_CAMERAS = ("front", "orbit")
LARGEST_SIDE = 16384  # pixels: GL's usual limit, and a typo beyond it would fill the memory


# Help without "{None}|PATH" and "(default: None)": the text says what happens when an option is left out.
def option(metavar: str) -> Any:
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """How a motion's file is read, and what is done to the motion before it is played."""

    motion_up: Literal["auto", "y", "z"] = "auto"
    """Which axis points up in the motion's file."""
    motion_fps: Annotated[float | None, option("FLOAT")] = None
    """Frames per second of the motion's recording, whatever its file says. Default: the file's, else what its
    program records: 60 for an .npz, 30 for WHAM and its like, 120 for an .amc."""
    joint_map: Annotated[Path | None, option("FILE")] = None
    """TOML or JSON file with the avatar's joints and what the motion calls them, for names we do not know."""
    smooth: Annotated[float | None, option("HZ")] = None
    """Take jitter out of the motion: a One-Euro filter of this cutoff, 1 to 5; lower is smoother."""
    speed: float = 1.0
    """How many times as fast the motion is played."""
    in_place: tyro.conf.FlagCreatePairsOff[bool] = False
    """Hold the motion's root over the place where it begins."""
    loop: tyro.conf.FlagCreatePairsOff[bool] = False
    """Blend the motion's end into its beginning, so that the clip can be repeated."""

    @property
    def edits(self) -> MotionEdits:
        """What is done to the motion once it is read."""
        return MotionEdits(**{name: getattr(self, name) for name in _EDITS})

    def read_motion(self, path: Path, skeleton: Skeleton) -> Motion:
        """The motion in ``path`` for ``skeleton``, edited.

        Raises:
            InputError: for whatever cannot be used.
        """
        from rnd_runtime.motion.motion import load_motion  # loads numba, which run_command prepares for

        motion = load_motion(path, skeleton, up=self.motion_up, fps=self.motion_fps, joint_map=self.joint_map)
        return edit_motion(motion, self.edits)

    def refuse_unread(self, why: str, *, edited: bool = False) -> None:
        """Refuse what is said of a motion's file where none is given, and ``why``; edits too unless one is ``edited``.

        Raises:
            InputError: for an option that would do nothing.
        """
        names = (field.name for field in fields(MotionOptions))
        refuse_changed(self, (name for name in names if not (edited and name in _EDITS)), why)

    def __post_init__(self) -> None:
        refuse_outside(self, {"motion_fps": FPS_LIMITS, **EDIT_LIMITS})


@dataclass(frozen=True, kw_only=True)
class LitOptions(MotionOptions):
    """Those of a command that lights what moves by probes, which its ``hdr`` names."""

    hdr_up: Up = "y"
    """Which axis points up in the probe's file."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not vars(self)["hdr"]:
            refuse_changed(self, ["hdr_up"], "needs --hdr")


@dataclass(frozen=True)
class PlayOptions(LitOptions):
    """Animate, relight and splat an avatar, with no GPU and no display needed.

    rnd-play avatar.onnx --motion walk.npz --hdr sky.exr --out out/
    """

    avatar: Annotated[tyro.conf.Positional[Path | None], option("AVATAR.onnx")] = None
    """The avatar, a file that rnd-export wrote."""
    motion: Annotated[Path | None, option("FILE")] = None
    """Body poses over time: .npz of AMASS, SMPL or EasyMocap (or its folder), .pkl of AIST++, WHAM or 4D-Humans, .pt of
    GVHMR, .npy of MDM, .bvh, or .amc with its .asf beside it."""
    hdr: Annotated[Path | None, option("FILE")] = None
    """Light probe, lat-long EXR or HDR. Default: the light the avatar was captured under."""
    out: Annotated[Path | None, option("FOLDER")] = None
    """Folder for frames/, frames_exr/, aov/, play.mp4, play.webp and play.json."""

    size: Annotated[str | None, option("N|WxH")] = None
    """Picture size: N or WIDTHxHEIGHT pixels. Default: 512, or the camera file's own size."""
    fps: Annotated[float | None, option("FLOAT")] = None
    """Frames per second. Default: the motion's."""
    frames: Annotated[str | None, option("START:END")] = None
    """Frames to render, END excluded, either may be missing; same pixels as in the whole run, and processes with
    different parts may share a folder. Default: all."""
    format: Annotated[str | None, option("LIST")] = None
    """Some of png,exr,mp4,webp; webp moves too, and is transparent where png is. Default: png, and mp4 where PyAV is
    installed."""

    camera: str = "front"
    """front, orbit, FILE.json or FILE.json:NAME. The first two frame the whole motion."""
    orbit_seconds: float = 8.0
    """Time of one turn of --camera orbit, in seconds; negative turns the other way."""
    distance: Annotated[float | None, option("FLOAT")] = None
    """Metres from the middle of the motion to the camera. Default: the least that shows all."""
    elevation: float = ELEVATION
    """Degrees by which the camera stands above the horizon."""
    fov: float = FIELD_OF_VIEW
    """Vertical field of view in degrees."""

    hdr_yaw: float = 0.0
    """Turn the light about the vertical axis, in degrees; positive from +X towards +Z."""
    hdr_turn: Annotated[float | None, option("SECONDS")] = None
    """Time in which the light turns once, from --hdr-yaw on; negative turns the other way. Default: it stands still."""
    exposure: float = 0.0
    """Stops by which the light is made brighter."""
    background: str = "none"
    """none (transparent), hdr, #rrggbb (sRGB) or r,g,b (linear radiance)."""
    shade: str = "table+sun"
    """Shading: ao (fastest), table, table+sun (the only one with hard sun shadows), lights:K of 1 to 8192
    lights, brute (every texel of the map, shadows as soft as the avatar learned them)."""
    cull: Annotated[float | None, option("COSINE")] = None
    """Leave out what faces away: Gaussians whose normal has less than this cosine to the view; -1 draws all. Default:
    what rnd-export found not to show, which saves a tenth to a fifth of a frame."""

    aov: Annotated[str, option("LIST")] = ""
    """Also write some of albedo,normal,roughness,visibility,depth. Normals in the camera's OpenCV axes."""
    raster: Literal["auto", "gl", "cpu"] = "auto"
    """Rasteriser: auto takes GL on a graphics card and the CPU kernel otherwise."""

    threads: Annotated[int | None, option("INT")] = None
    """CPU threads. Default: all."""
    fps_floor: Annotated[float | None, option("FLOAT")] = None
    """Frames per second to hold by shading less often, then at a lower resolution, rather than by dropping frames:
    what is given up depends on the machine, so two runs may differ."""
    pipeline: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Encode the next frame and write the last while one is drawn; --no-pipeline does one after the other."""
    doctor: Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help_behavior_hint="")] = False
    """Print renderer, providers, threads, versions and what to install for what is missing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        limits = {
            "fps": (1e-3, 1000),
            "fps_floor": (1e-3, 1000),
            "orbit_seconds": (-1e6, 1e6),
            "distance": (1e-3, 1e4),
            "elevation": (-89, 89),
            "fov": (1, 170),
            "hdr_yaw": (-1e6, 1e6),
            "hdr_turn": (-1e6, 1e6),
            "exposure": (-30, 30),
        }
        refuse_outside(self, limits)
        check_cull(self.cull)
        for name in ("orbit_seconds", "hdr_turn"):
            check_option(getattr(self, name) != 0, flag(name), "not 0", 0)
        if self.camera != "orbit":
            refuse_changed(self, ["orbit_seconds"], "needs --camera orbit")
        if self.camera not in OWN_CAMERAS:
            refuse_changed(self, ["distance", "elevation", "fov"], "the camera's file says where it stands")
        if self.fps_floor is not None and self.aov:
            hint = "AOVs are drawn at full quality"
            raise InputError("--fps-floor", expected="no --aov beside it", got=self.aov, hint=hint)


def parse_size(text: str | None) -> tuple[int, int | None] | None:
    """``512`` → (512, None); ``640x480`` → (640, 480); None stays None."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,6})(?:x(\d{1,6}))?", text)
    sides = [int(side) for side in match.groups() if side] if match else [0]
    if not all(1 <= side <= LARGEST_SIDE for side in sides):
        raise InputError("--size", expected=f"N or WxH, 1 to {LARGEST_SIDE}", got=text)
    return sides[0], sides[1] if len(sides) > 1 else None


def parse_frames(text: str | None, count: int) -> range:
    """``10:50``, ``:50`` or ``10:`` out of ``count`` frames."""
    match = re.fullmatch(r"(\d{0,9}):(\d{0,9})", text if text is not None else ":")
    start, end = (int(match[1] or 0), int(match[2] or count)) if match else (0, 0)
    if not 0 <= start < end <= count:
        raise InputError("--frames", expected=f"START:END within 0:{count}, START before END", got=text)
    return range(start, end)
