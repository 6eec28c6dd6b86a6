"""The recipe of a capture, its splits, images and files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from rnd_runtime.capture.format import TRAIN_SHARE, Frame, Split
from rnd_runtime.cli.command import Count, Number, OptionalNumber, option
from rnd_runtime.core.errors import check_option, flag, refuse_changed
from rnd_stage.materials import Material

from .lights import WHITE

TRAIN_CAMERA = "cam00"


def check_step(step: float | None) -> None:
    """Refuse distances between vertices outside 1 mm to 3 cm."""
    check_option(step is None or 1e-3 <= step <= 0.03, "--step", "0.001 to 0.03 m", step)


@dataclass(frozen=True)
class Recipe:
    """All that determines the images."""

    subject: Count = 0
    """seed of the person: 0 to 3 are composed by hand, others are random"""
    character: Annotated[str | None, option("FILE")] = None
    """a rigged, textured character instead: .npz, .glb or .gltf"""
    motion: Annotated[str | None, option("FILE")] = None
    """a motion file; without one, the person dances"""
    frames: Count = 60
    """instants, evenly spread over the motion"""
    cameras: Count = 30
    """on three rings"""
    size: Count = 512
    """pixels, square"""
    samples: Count = 64
    """paths a pixel"""
    max_depth: Count = 5
    """of a path; 2 is direct light alone"""
    material: Material = "layered"
    """the player's own formula, or Mitsuba's principled material"""
    train_lights: Annotated[tuple[str, ...], option("NAME ...")] = (WHITE,)
    """names of the lights trained under; of several, instants take turns"""
    lights: Annotated[tuple[str, ...], option("NAME ...")] = ()
    """names of the relighting lights; by default all eight"""
    hdr: Annotated[tuple[str, ...], option("FILE ...")] = ()
    """HDR files to relight with as well"""
    held_out_every: Count = 1
    """held-out views, poses and relit images take every n-th of their instants"""
    relight_cameras: Count = 4
    """cameras of the relit images, spread over all"""
    step: OptionalNumber = None
    """metres between the vertices of a coded person; by default seven tenths of a pixel"""
    visibility: bool = True
    """write the train camera's visibility towards the nineteen modules"""
    estimate_seed: Count = 0
    """of the estimates beside the truth"""
    estimate_strength: Number = 1.0
    """0 is the truth, 1 what good estimators give"""

    def check(self) -> None:
        """Refuse what cannot be rendered."""
        limits = {"frames": 5, "cameras": 1, "size": 16, "samples": 1, "max_depth": 2, "held_out_every": 1}
        for name, least in {**limits, "relight_cameras": 1, "estimate_seed": 0}.items():
            check_option(getattr(self, name) >= least, flag(name), f"at least {least}", getattr(self, name))
        if self.character is not None:
            refuse_changed(self, ["subject", "step"], "--character has its own")
        check_step(self.step)
        check_option(len(self.train_lights) > 0, "--train-lights", "one name at least", "none")
        check_option(0 <= self.estimate_strength <= 10, "--estimate-strength", "0 to 10", self.estimate_strength)


@dataclass(frozen=True)
class View:
    """One camera at one frame of the motion, under one or more lights, each for a split."""

    camera: str
    frame: int
    uses: tuple[tuple[Split, str], ...]

    @property
    def name(self) -> str:
        return f"{self.camera}_{self.frame:06d}"

    @property
    def trains(self) -> bool:
        return any(split == "train" for split, _ in self.uses)

    def image(self, light: str) -> str:
        """The image's path in the capture."""
        return f"images/{light}/{self.name}.png"

    def truth_files(self, visibility: bool) -> list[str]:
        """All files but the images."""
        files = [f"{kind}/{self.name}.png" for kind in ("masks", "normals_gt", "albedo", "roughness")]
        files.append(f"depth/{self.name}.exr")
        if self.trains:
            files += [f"normals/{self.name}.png", f"masks_estimated/{self.name}.png"]
        if visibility and self.camera == TRAIN_CAMERA:
            files.append(f"visibility/{self.name}.npz")
        return files

    def records(self, *, estimated: bool) -> Iterator[Frame]:
        """The frames of capture.json; with ``estimated`` masks of the train split."""
        for split, light in self.uses:
            exact = f"normals_gt/{self.name}.png"
            train = split == "train"
            yield Frame(
                image=self.image(light),
                mask=f"{'masks_estimated' if train and estimated else 'masks'}/{self.name}.png",
                camera=self.camera,
                frame=self.frame,
                split=split,
                normal=f"normals/{self.name}.png" if train else exact,
                normal_gt=exact,
                albedo=f"albedo/{self.name}.png",
                light=light,
            )


def instants(recipe: Recipe, frame_count: int) -> list[int]:
    """Evenly spaced indices into the motion, at most all."""
    count = min(recipe.frames, frame_count)
    return [int(i) for i in np.unique(np.round(np.linspace(0, frame_count - 1, count)).astype(int))]


def plan(recipe: Recipe, frames: list[int], cameras: list[str], lights: list[str]) -> list[View]:
    """Every view, by instants.

    As in the paper, the first four fifths of one camera's frames under the training lights train. These instants from
    all other cameras are the novel views; the last fifth from every camera are the novel poses, and from some cameras
    under the other lights the relit images.
    """
    split_at = max(1, int(TRAIN_SHARE * len(frames)))
    spread = np.linspace(0, len(cameras), min(recipe.relight_cameras, len(cameras)), endpoint=False)
    relit = {cameras[int(k)] for k in spread}
    others = [light for light in lights if light not in recipe.train_lights]
    views = []
    for number, frame in enumerate(frames):
        own = recipe.train_lights[number % len(recipe.train_lights)]
        training = number < split_at
        held_out = (number if training else number - split_at) % recipe.held_out_every == 0
        for camera in cameras:
            uses: list[tuple[Split, str]] = []
            if training and camera == TRAIN_CAMERA:
                uses.append(("train", own))
            elif training and held_out:
                uses.append(("novel_view", own))
            elif not training and held_out:
                uses.append(("novel_pose", own))
                uses += [("relight", light) for light in others if camera in relit]
            if uses:
                views.append(View(camera, frame, tuple(uses)))
    return views


def image_count(views: list[View]) -> int:
    return sum(len(view.uses) for view in views)


def missing(folder: Path, view: View, visibility: bool) -> bool:
    """Whether any file of ``view`` is missing."""
    names = [*view.truth_files(visibility), *(view.image(light) for _, light in view.uses)]
    return not all((folder / name).exists() for name in names)
