"""One run of ``rnd-play``: from options to files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rnd_runtime import __version__
from rnd_runtime.avatar.avatar import Encoded
from rnd_runtime.avatar.networks import Networks
from rnd_runtime.cli.command import finish, log, warn
from rnd_runtime.cli.jobs import check_on
from rnd_runtime.cli.lock import folder_lock
from rnd_runtime.cli.progress import track
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError, refuse_changed
from rnd_runtime.core.files import is_folder, output_folder, write_json
from rnd_runtime.core.kernels import COMPILING, kernels_are_cold
from rnd_runtime.core.threads import set_threads
from rnd_runtime.ground.bounce import reflected_share
from rnd_runtime.ground.shadow import Plane
from rnd_runtime.ground.standing import UP
from rnd_runtime.motion.motion import Motion, motion_inputs
from rnd_runtime.motion.planting import feet_slide
from rnd_runtime.playback.aov import GIVEN, parse_aovs
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.playback.framing import CameraOptions, CameraPath, Framing, front_path, orbit_path
from rnd_runtime.playback.scene import SceneRenderer, frame_people, ground_under
from rnd_runtime.shading.light import light_notes
from rnd_viewer.inputs.background import Backdrop, Background
from rnd_viewer.inputs.cameras import file_path, split_camera
from rnd_viewer.inputs.cast import load_people
from rnd_viewer.inputs.lights import chosen_light
from rnd_viewer.inputs.options import OWN_CAMERAS, PlayOptions, parse_frames
from rnd_viewer.inputs.scenes import PersonRecord, is_scene, read_scene

from .exr import ExrWriter
from .given import GivenFeatures
from .parts import in_parts
from .pipeline import run
from .run_folder import common_settings, is_of_a_run, mark_of, part_name, refuse_others, settings_of
from .sampling import Sampling
from .timing import StageTimes, show_times
from .video import CLIPS, clip_notes
from .writers import frame_writer, is_written, join_clips, parse_formats, tone_map_for

FRAME = "frame to frame"
LATENCY = "pose to pixels"
_DEFAULT_SIZE = 512, None


def play(options: PlayOptions, ahead: Future[Networks] | None = None) -> int:
    """Render the run that ``options`` describe into ``options.out`` and print a summary.

    Args:
        ahead: the avatar's networks, where they are being loaded already.

    Raises:
        InputError: for whatever cannot be used; what was finished before stays.
    """
    if options.on is not None:
        check_on(options.on)
    playing = _Run.of(options, ahead)
    for note in playing.notes:
        warn(note)
    with _claimed(playing.mark):
        seconds = playing.render() if options.on is None else playing.render_on_workers()
        if not playing.in_view:
            playing.notes.append("nothing of the avatar is in view in any of these frames")
            warn(playing.notes[-1])
        playing.report(seconds)
    return 0


def render_part(options: PlayOptions) -> tuple[bool, dict[str, list[float]]]:
    """Render the frames of a part of a run with ``--on``: whether anything is in view, and the stages' times."""
    part = _Run.of(options, None)
    with _claimed(part.mark):
        part.render()
    return part.in_view, part.times.seconds


class _Pending(NamedTuple):
    """Everybody's poses at each moment of a frame; ``asked`` is when their encoding began, in seconds."""

    asked: float
    moments: list[list[Encoded]]


@dataclass(eq=False)
class _Run:
    """A run with everything loaded.

    Attributes:
        mark: of the folder.
        scene: the people, one where an avatar is played; rendered by ``renderer``.
        frames: those that this process renders, out of ``count``; frame k shows the scene at k / ``fps`` seconds.
        notes: of the inputs' readers and of the run.
        in_view: whether a frame has shown anything of the avatar yet.
    """

    options: PlayOptions
    mark: Path
    formats: tuple[str, ...]
    aovs: tuple[str, ...]
    renderer: FrameRenderer
    scene: SceneRenderer
    backdrop: Backdrop
    fps: float
    frames: range
    count: int
    framing: Framing
    camera_at: CameraPath
    notes: list[str]
    times: StageTimes
    in_view: bool = False

    @classmethod
    def of(cls, options: PlayOptions, ahead: Future[Networks] | None) -> _Run:
        """Check the options, the cheap ones first, and load what they name."""
        cast, out = _required(options)
        lighting, rendering = options.lighting, options.rendering
        background, aovs, formats = (
            Background.parse(lighting.background),
            parse_aovs(options.aov),
            parse_formats(options.format),
        )
        if options.skip_existing and options.on is None and {*formats} & {*CLIPS}:
            hint = "a clip is made from its first frame on; with --on its frames are kept"
            raise InputError("--skip-existing", expected="--format png,exr", got=",".join(formats), hint=hint)
        set_threads(rendering.threads)
        times = StageTimes()
        with times.stage("load"):
            people = load_people(cast, options.reading, lighting.albedo_gain, rendering.threads, ahead=ahead)
            avatar, motions = people[0].avatar, list(dict.fromkeys(person.motion for person in people))
            if "parts" in aovs and len({person.avatar.skeleton.names for person in people}) > 1:
                raise InputError("--aov parts", expected="avatars with the same joints", got="different ones")
            light = chosen_light(
                avatar, options.hdr, up=lighting.hdr_up, yaw=lighting.hdr_yaw, exposure=lighting.exposure
            )
            fps = options.fps or motions[0].fps
            count = max(person.frames_at(fps) for person in people)
            frames = parse_frames(options.frames, count)
            framing = frame_people(people)
            camera_at = _camera_path(options, framing, frames)
            inputs = _inputs(options, cast)
            for path in inputs:
                if is_of_a_run(path, out):
                    raise InputError("cannot be an input: runs write such files into --out", file=path)
            mark = mark_of(out, common_settings(options), inputs)
            with _claimed(mark):
                pass  # before what takes long
            if kernels_are_cold():
                log(COMPILING)
            renderer = FrameRenderer(
                avatar, light, shade=rendering.shade, raster=rendering.raster, cull=rendering.cull, tone=lighting.tone
            )
            scene = SceneRenderer(people, renderer, cull=rendering.cull)
            if lighting.ground == "auto":
                renderer.ground = ground_under(people)
            elif lighting.ground != "none":
                renderer.ground = Plane(UP, lighting.ground_height)
            if renderer.ground and (slide := feet_slide(motions[0], avatar.skeleton)) is not None:
                log(f"feet on the ground slide by {1e3 * slide:.0f} mm/s on average")
            if renderer.ground and lighting.albedo:
                how = avatar, motions[0], light, renderer.ground
                renderer.reflect(reflected_share(*how, lighting.albedo))
        return cls(
            options=options,
            mark=mark,
            formats=formats,
            aovs=aovs,
            renderer=renderer,
            scene=scene,
            backdrop=Backdrop(background),
            fps=fps,
            frames=frames,
            count=count,
            framing=framing,
            camera_at=camera_at,
            notes=[*_motion_notes(motions, fps), *light_notes(light), *clip_notes(formats, fps)],
            times=times,
        )

    @property
    def out(self) -> Path:
        return self.mark.parent

    @property
    def name(self) -> str:
        """Of the clips and the report."""
        return part_name("play", self.frames, self.count)

    @cached_property
    def sampling(self) -> Sampling:
        rendering = self.options.rendering
        return Sampling(rendering.supersample, rendering.shutter, rendering.shutter_samples)

    @cached_property
    def _given(self) -> list[GivenFeatures]:
        how = self.fps, self.count, self.camera_at, self.aovs
        return [GivenFeatures(person, *how) for person in self.scene.people]

    @cached_property
    def _levels(self) -> list[list[int]]:
        """Of detail, for each frame and person: from the first frame on, so that parts of a run agree."""
        levels: list[list[int]] = self.scene.levels(self.frames.stop, self.fps, self.camera_at).tolist()
        return levels

    def camera(self, number: int) -> Camera:
        return self.camera_at(number, number / self.fps)

    def render(self) -> float:
        """Write every frame into the folder, with ``--on`` clips ``to_join``; seconds that it took."""

        def begin(number: int) -> None:
            self.mark.touch()  # not before: a run that fails at once leaves the folder as it was

        exr = ExrWriter(self.fps, self.options.half, self.options.colorspace, parts=self.renderer.avatar.skeleton.names)
        clips = frame_writer(
            self.out,
            self.formats,
            name=self.name,
            fps=self.fps,
            times=self.times,
            begin=begin,
            exr=exr,
            to_join=self.options.on is not None,
        )
        frames = self._missing(self.frames)
        self.in_view = len(frames) < len(self.frames)
        with self.renderer, clips as write:
            started = before = perf_counter()

            def put(number: int, rendered: tuple[RenderedFrame, Camera]) -> None:
                write(number, rendered[0], _reach(self.framing, rendered[1]), rendered[1])

            for _ in track("rendering", run(frames, self._encode, self._draw, put), len(frames)):
                now = perf_counter()
                self.times.add(FRAME, now - before)
                before = now
        return perf_counter() - started

    def render_on_workers(self) -> float:
        """As ``render``, in parts on the workers of ``--on``."""
        self.renderer.close()
        started = perf_counter()
        done = in_parts(render_part, self.options, self.formats, self.frames, self._missing)
        self.in_view = not done or any(in_view for in_view, _ in done)
        for _, times in done:
            self.times.extend(times)
        join_clips(self.out, self.formats, self.frames, name=self.name, fps=self.fps)
        return perf_counter() - started

    def _missing(self, frames: range) -> Sequence[int]:
        """Those of ``frames`` to render: all, or with ``--skip-existing`` those without files."""
        if not self.options.skip_existing:
            return frames
        return [number for number in frames if not is_written(self.out, self.formats, self.aovs, number)]

    def _encode(self, number: int) -> _Pending:
        asked = perf_counter()
        with self.times.stage("encoders"):
            levels = None if {*GIVEN} & {*self.aovs} else self._levels[number]
            moments = [self.scene.encode((number + offset) / self.fps, levels) for offset in self.sampling.offsets]
            return _Pending(asked, moments)

    def _draw(self, number: int, pending: _Pending) -> tuple[RenderedFrame, Camera]:
        camera, moments = self.camera(number), zip(self.sampling.offsets, pending.moments)
        frame = self.sampling.mean(self._sample(number, offset, encoded) for offset, encoded in moments)
        for stage, seconds in frame.stage_seconds.items():
            self.times.add(stage, seconds)
        self.in_view = self.in_view or bool(frame.alpha.any())
        if number == 0 and not self.in_view:
            raise _out_of_view(self.framing, camera, number)
        with self.times.stage("tonemap"):
            tone_map_for(self.formats, frame)
        self.times.add(LATENCY, perf_counter() - pending.asked)
        return frame, camera

    def _sample(self, number: int, offset: float, encoded: list[Encoded]) -> RenderedFrame:
        """Frame ``number``, ``offset`` frames later, before its samples are averaged."""
        lighting, time_s = self.options.lighting, (number + offset) / self.fps
        camera = self.sampling.fine(self.camera_at(number, time_s))
        if lighting.hdr_turn:
            self.renderer.turn(math.radians(lighting.hdr_yaw) + math.tau * time_s / lighting.hdr_turn)
        given = [of.of(number, body, camera) for of, body in zip(self._given, encoded)]
        frame = self.scene.draw(encoded, camera, aovs=self.aovs, srgb=False, given=given)
        started = perf_counter()
        frame = self.backdrop.behind(frame, camera, self.renderer.light)
        return replace(frame, stage_seconds={**frame.stage_seconds, "background": perf_counter() - started})

    def report(self, seconds: float) -> None:
        """Write play.json and print the summary of a run of so many seconds."""
        camera, light, raster = self.camera(self.frames.stop - 1), self.renderer.light, self.renderer.draws_with
        summary = self.times.summary()
        report = {
            "version": __version__,
            "settings": settings_of(self.options),
            "frames": [self.frames.start, self.frames.stop],
            "fps": self.fps,
            "size": [camera.width, camera.height],
            "raster": raster,
            "cull": self.renderer.cull,
            "light": {"maximum": light.maximum, "repaired_texels": light.repaired},
            "notes": self.notes,
            "times": summary,
        }
        write_json(self.out / f"{self.name}.json", report)
        show_times(summary)
        rate = len(self.frames) / seconds
        made = f"{len(self.frames)} frames of {camera.width}x{camera.height}, {rate:.1f} frames/s"
        finish(self.out, f"{made} ({raster}, {self.options.rendering.shade})")


@contextmanager
def _claimed(mark: Path) -> Iterator[None]:
    """Hold the folder of ``mark``, together with other parts of its run; refuse one with files of another run."""
    with folder_lock(mark.parent, "rnd-play", shared_by=mark.name):
        refuse_others(mark)
        yield


def _motion_notes(motions: Sequence[Motion], fps: float) -> list[str]:
    return list(dict.fromkeys(note for motion in motions for note in (*motion.notes, *motion.loop_notes(fps))))


def _required(options: PlayOptions) -> tuple[list[PersonRecord], Path]:
    """The people, and the folder."""
    given = {"AVATAR.onnx or SCENE.toml": options.avatar, "--motion": options.motion, "--out": options.out}
    if options.avatar and is_scene(options.avatar):
        refuse_changed(options, ["motion"], "the scene has its motions")
        del given["--motion"]
    if missing := [name for name, value in given.items() if value is None]:
        raise InputError(f"missing {', '.join(missing)}", hint="rnd-play AVATAR.onnx --motion FILE --out FOLDER")
    assert options.avatar and options.out
    cast = [PersonRecord(options.avatar, options.motion)] if options.motion else read_scene(options.avatar)
    for motion in {person.motion for person in cast}:
        if is_folder(motion) and options.out.resolve() == motion.resolve():
            raise InputError("--out", expected="another folder than the motion's", got=options.out)
    return cast, output_folder(options.out)


def _inputs(options: PlayOptions, cast: Sequence[PersonRecord]) -> list[Path]:
    """Every file that the frames depend on."""
    given = [options.avatar, options.hdr, options.reading.joint_map]
    for motion in dict.fromkeys(person.motion for person in cast):
        given += motion_inputs(motion)
    given += [file for file in dict.fromkeys(person.avatar for person in cast) if file != options.avatar]
    if options.view.camera not in OWN_CAMERAS:
        given.append(split_camera(options.view.camera)[0])
    return [path for path in given if path is not None]


def _camera_path(options: PlayOptions, framing: Framing, frames: range) -> CameraPath:
    view = options.view
    if view.camera not in OWN_CAMERAS:
        return file_path(view.camera, options.size, frames)
    width, height = options.size or _DEFAULT_SIZE
    camera = CameraOptions(width, height or width, math.radians(view.fov), math.radians(view.elevation), view.distance)
    return orbit_path(framing, camera, view.orbit_seconds) if view.camera == "orbit" else front_path(framing, camera)


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
