"""The lights of the training images, by name: learned probes, or the capture's own maps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import torch
from torch import Tensor

from rnd_runtime.capture.capture import Capture, Frame
from rnd_runtime.core.errors import InputError
from rnd_runtime.shading.light import Light, texel_directions
from rnd_trainer.model.checkpoint import UNKNOWN_LIGHT
from rnd_trainer.render.probe import PROBE_SHAPE, LightProbes, as_probe


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


class TrainingLights:
    """One light for each name, of learned radiance unless it is fixed.

    Args:
        names: the default light first.
        channels: of the learned probes.
        fixed: maps that replace the learned probes, or None.

    Attributes:
        probes: the learned lights, in the order of ``names``.
    """

    def __init__(self, names: tuple[str, ...], channels: int = 3, fixed: dict[str, Light] | None = None) -> None:
        self.names, self.probes = names, LightProbes(channels, len(names))
        self._fixed: Tensor | None = None
        if fixed is not None:  # resized before rotating, which keeps a sun in one texel
            maps = [fixed[name].resized(*PROBE_SHAPE).sample(texel_directions(*PROBE_SHAPE)) for name in names]
            self._fixed = torch.stack([as_probe(radiance) for radiance in maps])

    def to(self, device: torch.device) -> TrainingLights:
        """Itself, on ``device``."""
        self.probes.to(device)
        self._fixed = None if self._fixed is None else self._fixed.to(device)
        return self

    @property
    def learned(self) -> bool:
        return self._fixed is None

    def radiance(self) -> Tensor:
        """[lights, 32, 64, 3] linear."""
        return self.probes.radiance() if self._fixed is None else self._fixed

    def index(self, frame: Frame) -> int:
        """Index of the light of ``frame``."""
        return self.names.index(light_name(frame))

    def by_name(self) -> dict[str, Tensor]:
        """Radiance [32, 64, 3] of each light, without gradient."""
        return dict(zip(self.names, self.radiance().detach(), strict=True))
