"""One run of ``rnd-play``: from options to files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rnd_runtime import __version__
from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.avatar.networks import Networks
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import is_folder, output_folder
from rnd_runtime.core.kernels import COMPILING, kernels_are_cold
from rnd_runtime.core.threads import set_threads
from rnd_runtime.motion.motion import Motion, motion_inputs
from rnd_runtime.playback.aov import parse_aovs
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.playback.framing import CameraOptions, CameraPath, Framing, frame_motion, front_path, orbit_path
from rnd_runtime.shading.light import light_notes
from rnd_viewer.inputs.background import Background
from rnd_viewer.inputs.cameras import file_path, split_camera
from rnd_viewer.inputs.console import FRAME, LATENCY, print_summary, tell, warn, with_progress
from rnd_viewer.inputs.lights import chosen_light
from rnd_viewer.inputs.options import OWN_CAMERAS, PlayOptions, parse_frames, parse_size
from rnd_viewer.view.governor import Governor

from .pipeline import run
from .player import Player
from .run_folder import claim, is_of_a_run, part_name
from .timing import StageTimes
from .video import clip_notes
from .writers import frame_writer, parse_formats, tone_map_for, write_report

DEFAULT_SIZE = 512
OWN_TO_A_PROCESS = (
    "frames",
    "threads",
    "format",
    "pipeline",
    "raster",
)  # options that do not tell one run from another
FILES = ("avatar", "motion", "hdr", "joint_map")  # a run goes by what they are, however their paths are spelt


def play(options: PlayOptions, ahead: Future[Networks] | None = None) -> int:
    """Render the run that ``options`` describe into ``options.out`` and print a summary.

    Args:
        ahead: the avatar's networks, where they are being loaded already.

    Raises:
        InputError: for whatever cannot be used; what was finished before stays.
    """
    played = _Run.of(options, ahead)
    for note in played.notes:
        warn(note)
    seconds = played.render()
    for note in played.afterthoughts():
        played.note(note)
    played.report(seconds)
    return 0


class _Turn(NamedTuple):
    """A frame that is encoded and waits to be drawn; ``asked`` is when its turn began, both in seconds."""

    asked: float
    encoding: float
    encoded: Encoded


@dataclass(eq=False)
class _Run:
    """What ``rnd-play`` was asked for, with everything loaded, and what is learnt on the way.

    Attributes:
        frames: those that this process renders, out of ``count``; frame k shows the motion at k / ``fps`` seconds.
        notes: what the inputs' readers found, and what the run itself has to say.
        qualities: of every frame that was drawn, in turn.
        in_view: whether anything of the avatar was seen yet.
    """

    options: PlayOptions
    out: Path
    formats: tuple[str, ...]
    player: Player
    motion: Motion
    fps: float
    frames: range
    count: int
    framing: Framing
    camera_at: CameraPath
    notes: list[str]
    governor: Governor | None
    scales: list[float] = field(default_factory=list)
    in_view: bool = False

    @classmethod
    def of(cls, options: PlayOptions, ahead: Future[Networks] | None) -> _Run:
        """Check the options, the cheap ones first, and load what they name."""
        avatar_file, motion_file, out = _required(options)
        background, aovs = Background.parse(options.background), parse_aovs(options.aov)
        formats, size = parse_formats(options.format), parse_size(options.size)
        set_threads(options.threads)

        times = StageTimes()
        with times.stage("load"):
            avatar = Avatar.load(avatar_file, threads=options.threads, ahead=ahead)
            motion = options.read_motion(motion_file, avatar.skeleton)
            light = chosen_light(avatar, options.hdr, up=options.hdr_up, yaw=options.hdr_yaw, exposure=options.exposure)
            if kernels_are_cold():
                tell(COMPILING)
            renderer = FrameRenderer(avatar, light, shade=options.shade, raster=options.raster, cull=options.cull)
        for path in _inputs(options):
            if is_of_a_run(path, out):
                raise InputError("cannot be an input: runs write such files into --out", file=path)
        player = Player(renderer, background, aovs, times)
        fps = options.fps or motion.fps
        count = motion.frames_at(fps)
        frames = parse_frames(options.frames, count)
        framing = frame_motion(avatar.skeleton, motion)
        return cls(
            options=options,
            out=out,
            formats=formats,
            player=player,
            motion=motion,
            fps=fps,
            frames=frames,
            count=count,
            framing=framing,
            camera_at=_camera_path(options, size, framing, frames),
            notes=[*motion.notes, *motion.loop_notes(fps), *light_notes(light), *clip_notes(formats, fps)],
            governor=Governor(options.fps_floor) if options.fps_floor else None,
        )

    @property
    def name(self) -> str:
        """Of the clips and the report."""
        return part_name("play", self.frames, self.count)

    def camera(self, number: int) -> Camera:
        return self.camera_at(number, number / self.fps)

    def render(self) -> float:
        """Leave every frame in the folder; how many seconds it took."""
        times, overlap = self.player.times, self.options.pipeline
        clips = frame_writer(self.out, self.formats, name=self.name, fps=self.fps, times=times, begin=self._begin)
        with self.player.renderer, clips as write:
            started = before = perf_counter()

            def put(number: int, drawn: tuple[RenderedFrame, Camera]) -> None:
                write(number, drawn[0], _reach(self.framing, drawn[1]))

            for _ in with_progress(self.frames, run(self.frames, self._encode, self._draw, put, overlap=overlap)):
                now = perf_counter()
                times.add(FRAME, now - before)
                before = now
        return perf_counter() - started

    def _begin(self, number: int) -> None:
        if number != self.frames.start:
            return
        # not before: what fails at once leaves the folder as it was
        if removed := claim(self.out, _common(self.options), _inputs(self.options)):
            self.note(f"{removed} files that another run had left in {self.out} were removed")

    def note(self, note: str) -> None:
        """Say ``note``, here and in the report."""
        self.notes.append(note)
        warn(note)

    def _encode(self, number: int) -> _Turn:
        asked = perf_counter()
        encoded = self.player.encode(self.motion, number / self.fps)
        return _Turn(asked, perf_counter() - asked, encoded)

    def _draw(self, number: int, turn: _Turn) -> tuple[RenderedFrame, Camera]:
        started = perf_counter()
        player, camera = self.player, self.camera(number)
        if self.options.hdr_turn:
            yaw = math.radians(self.options.hdr_yaw) + math.tau * number / self.fps / self.options.hdr_turn
            player.renderer.turn(yaw)
        self.scales.append(self.governor.scale if self.governor else 1.0)
        frame = player.draw(turn.encoded, camera, self.scales[-1])
        self.in_view = self.in_view or bool(frame.alpha.any())
        if number == 0 and not self.in_view:
            raise _out_of_view(self.framing, camera, number)
        with player.times.stage("tonemap"):
            tone_map_for(self.formats, frame)
        now = perf_counter()
        player.times.add(LATENCY, now - turn.asked)
        if self.governor:
            drawing = now - started
            longest = max(turn.encoding, drawing) if self.options.pipeline else turn.encoding + drawing
            self.governor.observe(longest)
        return frame, camera

    def afterthoughts(self) -> Iterator[str]:
        """What can be said of the frames only once they are there."""
        if lowered := sum(scale < 1 for scale in self.scales):
            share = f"{lowered} of {len(self.frames)} frames"
            yield f"{share} at less than full resolution, for {self.options.fps_floor:g} frames/s"
        if not self.in_view:
            yield "nothing of the avatar is in view in any of these frames"

    def report(self, seconds: float) -> None:
        """Write play.json and print the summary of a run of so many seconds."""
        camera, light = self.camera(self.frames.stop - 1), self.player.renderer.light
        raster, summary = self.player.renderer.draws_with, self.player.times.summary()
        report = {
            "version": __version__,
            "settings": _settings(self.options),
            "frames": [self.frames.start, self.frames.stop],
            "fps": self.fps,
            "size": [camera.width, camera.height],
            "raster": raster,
            "cull": self.player.renderer.cull,
            "light": {"maximum": light.maximum, "repaired_texels": light.repaired},
            "notes": self.notes,
            "times": summary,
        }
        write_report(self.out / f"{self.name}.json", report)
        rate = len(self.frames) / seconds
        headline = f"{len(self.frames)} frames of {camera.width}x{camera.height}, {rate:.1f} frames/s"
        print_summary(summary, headline=f"{headline} ({raster}, {self.options.shade}) in {self.out}")


def _common(options: PlayOptions) -> dict[str, object]:
    """The settings that all processes of one run share, beside its ``_inputs``."""
    camera = options.camera if options.camera in OWN_CAMERAS else split_camera(options.camera)[1]
    settings = _settings(options) | {"camera": camera}
    return {key: value for key, value in settings.items() if key not in (*OWN_TO_A_PROCESS, *FILES)}


def _settings(options: PlayOptions) -> dict[str, object]:
    """The options as JSON has them, without the folder: two runs into two folders give the same report."""
    values = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()}
    return {name: value for name, value in values.items() if name not in ("out", "doctor")}


def _required(options: PlayOptions) -> tuple[Path, Path, Path]:
    """The three files without which there is nothing to play."""
    given = {"AVATAR.onnx": options.avatar, "--motion": options.motion, "--out": options.out}
    if missing := [name for name, value in given.items() if value is None]:
        raise InputError(f"missing {', '.join(missing)}", hint="rnd-play AVATAR.onnx --motion FILE --out FOLDER")
    assert options.avatar and options.motion and options.out
    if is_folder(options.motion) and options.out.resolve() == options.motion.resolve():
        raise InputError("--out", expected="another folder than the motion's", got=options.out)
    return options.avatar, options.motion, output_folder(options.out)


def _inputs(options: PlayOptions) -> list[Path]:
    """Every file that the pictures are made from."""
    given = [options.avatar, options.hdr, options.joint_map]
    if options.motion:
        given += motion_inputs(options.motion)
    if options.camera not in OWN_CAMERAS:
        given.append(split_camera(options.camera)[0])
    return [path for path in given if path is not None]


def _camera_path(
    options: PlayOptions, size: tuple[int, int | None] | None, framing: Framing, frames: range
) -> CameraPath:
    if options.camera not in OWN_CAMERAS:
        return file_path(options.camera, size, frames)
    width, height = size or (DEFAULT_SIZE, None)
    view = CameraOptions(
        width, height or width, math.radians(options.fov), math.radians(options.elevation), options.distance
    )
    if options.camera == "orbit":
        return orbit_path(framing, view, options.orbit_seconds)
    return front_path(framing, view)


def _reach(framing: Framing, camera: Camera) -> tuple[float, float]:
    """Nearest and farthest depth in metres at which ``camera`` can see the body at any time."""
    depth = float((camera.world_to_camera @ [*framing.centre, 1.0])[2])
    return max(depth - framing.radius, 0.0), depth + framing.radius


def _out_of_view(framing: Framing, camera: Camera, number: int) -> InputError:
    centre = (camera.world_to_camera @ [*framing.centre, 1.0])[:3]
    return InputError(
        "nothing of the avatar is in view in the first frame",
        got=f"a motion about {np.round(centre, 2).tolist()} m right of, below and in front of the camera",
        frame=number,
        hint="check --camera, --distance and --motion-up",
    )
