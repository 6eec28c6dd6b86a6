"""The lights of the training images, by name: learned, or known to the user."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.capture.capture import Capture, Frame
from rnd_runtime.core.errors import InputError
from rnd_runtime.shading.light import Light, texel_directions
from rnd_trainer.model.checkpoint import UNKNOWN_LIGHT
from rnd_trainer.render.probe import PROBE_SHAPE, LightProbes, as_probe

from .grey_card import GreyCard


def light_name(frame: Frame) -> str:
    """Name of the light of ``frame``."""
    return frame.light or UNKNOWN_LIGHT


def light_names(frames: Iterable[Frame]) -> tuple[str, ...]:
    """Unique names of the lights of ``frames``, the most used first."""
    return tuple(name for name, _ in Counter(light_name(frame) for frame in frames).most_common())


def capture_lights(capture: Capture, what: str = "--light capture") -> dict[str, Light]:
    """The maps of all lights of the training images, the most used first.

    Raises:
        InputError: one without a map; the message names the option ``what``.
    """
    frames = capture.split("train")
    for frame in frames:
        if not capture.has_map(frame.light):
            expected, got = "a light map of every training image", light_name(frame)
            raise InputError(what, expected=expected, got=got, file=capture.folder, frame=frame.frame)
    return {name: capture.load_light(name) for name in light_names(frames)}


@dataclass(frozen=True)
class KnownLight:
    """What the user knows of the light.

    Attributes:
        place: a map of the place, whose yaw and scale are found by the search.
        card: a grey card in an image.
    """

    place: Light | None = None
    card: GreyCard | None = None

    def check(self, names: tuple[str, ...]) -> None:
        """Raise ``InputError`` if a place is given for several lights ``names``."""
        if self.place is not None and len(names) > 1:
            raise InputError("--hdr", expected="one light in the training images", got=", ".join(names))


class TrainingLights:
    """One light for each name, learned until it is fixed.

    Args:
        names: the default light first.
        channels: of the probes.

    Attributes:
        probes: the lights, in the order of ``names``.
    """

    def __init__(self, names: tuple[str, ...], channels: int = 3) -> None:
        self.names, self.probes = names, LightProbes(channels, len(names))

    def to(self, device: torch.device) -> TrainingLights:
        """Itself, on ``device``."""
        self.probes.to(device)
        return self

    def fix(self, lights: dict[str, Light] | None = None) -> None:
        """Learn no further; with ``lights``, at their maps."""
        self.probes.raw.requires_grad_(False)
        if lights is not None:  # resized before rotating, which keeps a sun in one texel
            grid = texel_directions(*PROBE_SHAPE)
            maps = [as_probe(lights[name].resized(*PROBE_SHAPE).sample(grid)) for name in self.names]
            self.probes.start_from(torch.stack(maps), self.probes.exposure)

    def scale(self, gain: NDArray[np.float64]) -> None:
        """Multiply all lights by ``gain`` [3]."""
        scaled = self.radiance().detach() * torch.as_tensor(gain).to(self.probes.raw)
        self.probes.start_from(scaled, self.probes.exposure)

    @property
    def learned(self) -> bool:
        return self.probes.raw.requires_grad

    def radiance(self) -> Tensor:
        """[lights, 32, 64, 3] linear."""
        radiance: Tensor = self.probes.radiance()
        return radiance

    def index(self, frame: Frame) -> int:
        """Index of the light of ``frame``."""
        return self.names.index(light_name(frame))

    def by_name(self) -> dict[str, Tensor]:
        """Radiance [32, 64, 3] of each light, without gradient."""
        return dict(zip(self.names, self.radiance().detach(), strict=True))
