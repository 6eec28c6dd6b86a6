"""What is filmed: the recipe of a capture, its splits, its pictures and the files they become."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rnd_runtime.capture.format import TRAIN_SHARE, Frame, Split
from rnd_runtime.core.errors import InputError, flag, refuse_changed

from .lights import WHITE

TRAIN_CAMERA = "cam00"


def check_step(step: float | None) -> None:
    """Refuse metres between vertices of which no person is made."""
    if step is not None and not 1e-3 <= step <= 0.03:
        raise InputError("--step", expected="0.001 to 0.03 m", got=step)


@dataclass(frozen=True)
class Recipe:
    """All that decides the pictures; a part of a capture can be rendered by whoever has it."""

    subject: int = 0
    """seed of the person: 0 to 3 are composed by hand, others drawn at random"""
    character: str | None = None
    """a rigged, textured character instead: .npz, .glb or .gltf"""
    motion: str | None = None
    """a motion file; without one, the person dances"""
    frames: int = 60
    """instants, evenly spread over the motion"""
    cameras: int = 30
    """on three rings"""
    size: int = 512
    """pixels, square"""
    samples: int = 64
    """paths a pixel"""
    max_depth: int = 5
    """of a path; 2 is direct light alone"""
    lights: tuple[str, ...] = ()
    """names of the relighting lights; none named: all eight"""
    hdr: tuple[str, ...] = ()
    """HDR files to relight with as well"""
    held_out_every: int = 1
    """held-out views, poses and relit pictures take every n-th of their instants"""
    relight_cameras: int = 4
    """cameras of the relit pictures, spread over all"""
    step: float | None = None
    """metres between the vertices of a coded person; by default seven tenths of a pixel"""
    visibility: bool = True
    """write the train camera's visibility towards the nineteen modules"""
    estimate_seed: int = 0
    """of the estimates beside the truth"""
    estimate_strength: float = 1.0
    """0 is the truth, 1 what good estimators give"""

    def check(self) -> None:
        """Refuse what cannot be filmed."""
        for name, least in (
            ("frames", 5),
            ("cameras", 1),
            ("size", 16),
            ("samples", 1),
            ("max_depth", 2),
            ("held_out_every", 1),
            ("relight_cameras", 1),
            ("estimate_seed", 0),
        ):
            if getattr(self, name) < least:
                raise InputError(flag(name), expected=f"at least {least}", got=getattr(self, name))
        if self.character is not None:
            refuse_changed(self, ["subject", "step"], "--character has its own")
        check_step(self.step)
        if not 0 <= self.estimate_strength <= 10:
            raise InputError("--estimate-strength", expected="0 to 10", got=self.estimate_strength)


@dataclass(frozen=True)
class BenchmarkOptions:
    """Sizes of the benchmark: by default two cores take some forty minutes for all of it, the half of it trainings."""

    subjects: int = 4
    """people, by their seeds from 0 on"""
    seeds: int = 3
    """trainings of the first of them with every method; of the others one"""
    size: int = 256
    """pixels, square"""
    samples: int = 64
    """paths a pixel"""
    frames: int = 40
    """instants, four fifths of which train"""
    cameras: int = 5
    """one of which trains"""
    held_out_every: int = 6
    """held-out instants: every n-th"""
    relight_cameras: int = 2
    """cameras of the relit pictures"""
    steps: int = 800
    """of every training"""
    gaussians: int = 6_000
    """of every avatar"""

    def check(self) -> None:
        """Refuse what cannot be filmed or trained."""
        for name, least in (("subjects", 1), ("seeds", 1), ("steps", 1), ("gaussians", 64)):
            if getattr(self, name) < least:
                raise InputError(flag(name), expected=f"at least {least}", got=getattr(self, name))
        self.recipe(0).check()

    def recipe(self, subject: int) -> Recipe:
        """What is filmed of one subject."""
        return Recipe(
            subject=subject,
            frames=self.frames,
            cameras=self.cameras,
            size=self.size,
            samples=self.samples,
            held_out_every=self.held_out_every,
            relight_cameras=self.relight_cameras,
            visibility=False,
        )


@dataclass(frozen=True)
class Shot:
    """One camera at one instant, under one or more lights, each for a split.

    ``frame`` indexes the motion.
    """

    camera: str
    frame: int
    uses: tuple[tuple[Split, str], ...]

    @property
    def place(self) -> str:
        return f"{self.camera}_{self.frame:06d}"

    @property
    def trains(self) -> bool:
        return any(split == "train" for split, _ in self.uses)

    def image(self, light: str) -> str:
        """The picture's path in the capture."""
        return f"images/{light}/{self.place}.png"

    def truth_files(self, visibility: bool) -> list[str]:
        """Everything beside the pictures themselves."""
        files = [f"{kind}/{self.place}.png" for kind in ("masks", "normals_gt", "albedo", "roughness")]
        files.append(f"depth/{self.place}.exr")
        if self.trains:
            files += [f"normals/{self.place}.png", f"masks_estimated/{self.place}.png"]
        if visibility and self.camera == TRAIN_CAMERA:
            files.append(f"visibility/{self.place}.npz")
        return files

    def records(self, *, estimated: bool) -> Iterator[Frame]:
        """The rows of capture.json; ``estimated`` ones train on the ragged mask."""
        for split, light in self.uses:
            exact = f"normals_gt/{self.place}.png"
            train = split == "train"
            yield Frame(
                image=self.image(light),
                mask=f"{'masks_estimated' if train and estimated else 'masks'}/{self.place}.png",
                camera=self.camera,
                frame=self.frame,
                split=split,
                normal=f"normals/{self.place}.png" if train else exact,
                normal_gt=exact,
                albedo=f"albedo/{self.place}.png",
                light=light,
            )


def instants(recipe: Recipe, frame_count: int) -> list[int]:
    """Indices into the motion, evenly spread; fewer than asked where the motion is shorter."""
    count = min(recipe.frames, frame_count)
    return [int(i) for i in np.unique(np.round(np.linspace(0, frame_count - 1, count)).astype(int))]


def plan(recipe: Recipe, frames: list[int], cameras: list[str], lights: list[str]) -> list[Shot]:
    """Every shot, instant by instant.

    As in the paper: the first four fifths of one camera's frames train, under white light; those instants seen from
    all other cameras are the novel views; the last fifth seen from every camera holds the novel poses. Those again,
    from some cameras and under the other lights, are relit.
    """
    split_at = max(1, int(TRAIN_SHARE * len(frames)))
    spread = np.linspace(0, len(cameras), min(recipe.relight_cameras, len(cameras)), endpoint=False)
    relit = {cameras[int(k)] for k in spread}
    others = [light for light in lights if light != WHITE]
    shots = []
    for number, frame in enumerate(frames):
        training = number < split_at
        held_out = (number if training else number - split_at) % recipe.held_out_every == 0
        for camera in cameras:
            uses: list[tuple[Split, str]] = []
            if training and camera == TRAIN_CAMERA:
                uses.append(("train", WHITE))
            elif training and held_out:
                uses.append(("novel_view", WHITE))
            elif not training and held_out:
                uses.append(("novel_pose", WHITE))
                uses += [("relight", light) for light in others if camera in relit]
            if uses:
                shots.append(Shot(camera, frame, tuple(uses)))
    return shots


def picture_count(shots: list[Shot]) -> int:
    """Path-traced pictures, the truths not counted."""
    return sum(len(shot.uses) for shot in shots)


def missing(folder: Path, shot: Shot, visibility: bool) -> bool:
    """Whether any file of ``shot`` is not there yet; files appear whole or not at all."""
    names = [*shot.truth_files(visibility), *(shot.image(light) for _, light in shot.uses)]
    return not all((folder / name).exists() for name in names)
