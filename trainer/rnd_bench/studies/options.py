"""The options of the studies."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from rnd_runtime.cli.command import Count, Flag, Number, OptionalCount, OptionalFile, option
from rnd_runtime.cli.jobs import On
from rnd_runtime.core.errors import check_option, flag
from rnd_stage.film.plan import Recipe
from rnd_stage.materials import Material
from rnd_stage.variants import Variant


@dataclass(frozen=True)
class Trainings:
    """Train and score the variants of a study."""

    run: Annotated[Path, tyro.conf.Positional, option("RUN")]
    """folder for the trainings; done runs are not done again"""
    capture: Annotated[Path, tyro.conf.Positional, option("CAPTURE")]
    """folder with capture.json"""
    json: OptionalFile = None
    """write summary and rows here"""
    variants: Annotated[tuple[str, ...], option("NAME ...")] = ()
    """names of the variants to train, such as "static skinning"; by default all"""
    preset: Literal["quick", "standard", "full"] = "quick"
    """as of rnd-train"""
    steps: OptionalCount = None
    """instead of the preset's"""
    gaussians: OptionalCount = None
    """instead of the preset's"""
    image_scale: Number = 1.0
    """as of rnd-train"""
    seeds: Count = 3
    """0 to SEEDS − 1"""
    hold_out: Flag = False
    """score on every fifth training frame, held out, instead of the test splits: to choose by"""
    shade: Annotated[str, option("MODE")] = "table+sun"
    """as of rnd-eval"""
    motion: Annotated[str | None, option("FILE")] = None
    """another motion file of the capture to train and score with"""
    perceptual_weights: OptionalFile = None
    """as of rnd-train; adds the LPIPS column"""
    consistency_weights: OptionalFile = None
    """as of rnd-train"""
    on: On = None
    """train on N processes of this machine, or on the workers of a Dask scheduler (extra [dask])"""


@dataclass(frozen=True)
class Ablations(Trainings):
    """The paper's ablations: dynamic skinning, L_gc, encoders, window lengths, light, visibility.

    rnd-bench study ablations runs/ablations assets/capture --seeds 1
    """


@dataclass(frozen=True)
class Causes(Trainings):
    """What limits quality: light, normals, poses, number of Gaussians.

    rnd-bench study causes runs/causes CAPTURE
    """


@dataclass(frozen=True)
class Lengths(Trainings):
    """An eighth to five times the steps.

    rnd-bench study lengths runs/lengths assets/capture
    """


@dataclass(frozen=True)
class PeopleSizes:
    """Sizes of the study: rendering a person takes two cores 6 minutes by default, a training 3."""

    subjects: Count = 4
    """people"""
    first: Count = 0
    """seed of the first; 0 to 3 were developed with, those from 100 on are looked at once, for a table"""
    hdr: Annotated[tuple[str, ...], option("FILE ...")] = ()
    """lights of places: each person is filmed under the next of them and relit under the others"""
    seeds: Count = 3
    """trainings of each of them with every method"""
    size: Count = 256
    """pixels, square"""
    samples: Count = 64
    """paths a pixel"""
    material: Material = "layered"
    """as of rnd-stage"""
    frames: Count = 40
    """instants, four fifths of which train"""
    cameras: Count = 5
    """one of which trains"""
    held_out_every: Count = 6
    """held-out instants: every n-th"""
    relight_cameras: Count = 2
    """cameras of the relit images"""
    steps: Count = 800
    """of every training"""
    gaussians: Count = 6_000
    """of every avatar"""

    def check(self) -> None:
        """Refuse what cannot be rendered or trained."""
        for name, least in (("subjects", 1), ("seeds", 1), ("steps", 1), ("gaussians", 64)):
            check_option(getattr(self, name) >= least, flag(name), f"at least {least}", getattr(self, name))
        self.recipe(0).check()

    def recipe(self, subject: int) -> Recipe:
        """What is rendered of one subject."""
        names = ("frames", "cameras", "size", "samples", "material", "held_out_every", "relight_cameras", "hdr")
        own: dict[str, Any] = {name: getattr(self, name) for name in names}
        if self.hdr:
            places = [Path(file).stem for file in self.hdr]
            own |= {"train_lights": (places[subject % len(places)],), "lights": tuple(places)}
        return Recipe(subject=subject, visibility=False, **own)

    @property
    def seeds_of_people(self) -> range:
        """Seeds of all people."""
        return range(self.first, self.first + self.subjects)


@dataclass(frozen=True)
class People:
    """Render people on the light stage, train on one camera's images, score the rest; resumes.

    rnd-bench study people out/people --json out/people.json
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for captures and trainings"""
    json: OptionalFile = None
    """write summary, cost and rows here"""
    sheet: OptionalFile = None
    """write a PNG of every subject: truth and the first of the methods, albedo, another light, both light maps"""
    methods: Annotated[tuple[str, ...], option("NAME ...")] = ("ours", "static skinning", "LBS, plain colour")
    """variants to train, such as "true light\""""
    perceptual_weights: OptionalFile = None
    """adds LPIPS to the metrics and to the training, as in rnd-train"""
    judge_weights: OptionalFile = None
    """another network for the metrics, which no training saw"""
    sizes: Annotated[PeopleSizes, tyro.conf.arg(name="")] = field(default_factory=PeopleSizes)
    variant: Variant = "auto"
    """Mitsuba's back end"""


@dataclass(frozen=True)
class Agreement:
    """Our renderer with true attributes of a ball and of a person against Mitsuba, under every light of the stage.

    rnd-bench study agreement out/agreement.json
    """

    json: Annotated[Path, tyro.conf.Positional, option("FILE")]
    """write the rows here"""
    subject: Count = 0
    """seed of the person"""
    frame: Count = 40
    """of the dance"""
    size: Count = 256
    """pixels, square"""
    samples: Count = 128
    """Mitsuba's paths a pixel; their noise is in every row"""
    material: Material = "layered"
    """as of rnd-stage"""
    lights: Annotated[tuple[str, ...], option("NAME ...")] = ()
    """names of the lights; by default white and all eight coloured ones"""
    sheet: OptionalFile = None
    """write ours, Mitsuba's direct light, four times their difference and interreflection, a row for each light"""
    step: Number = 0.006
    """metres between the person's vertices, and Gaussians"""
    variant: Variant = "auto"
    """Mitsuba's back end"""
