"""Schedule of a training: stages, learning rates and cost."""

from __future__ import annotations

from dataclasses import dataclass

from rnd_trainer.config import TrainConfig

UNSEEN_COST = 1 / 8
"""cost of a step without an image relative to one with an image (25 of 200 ms)"""
POSE_FITS = (0.3, 0.55, 0.8)
"""shares of the steps before which all poses are fitted to the avatar"""


@dataclass(frozen=True)
class Schedule:
    """Schedule of ``config``."""

    config: TrainConfig

    @property
    def first_stage(self) -> int:
        """Steps of the first stage."""
        if self.config.light == "none":
            return self.config.steps
        return round(self.config.stage1_fraction * self.config.steps)

    @property
    def total(self) -> int:
        """Steps of all stages; ``config.steps`` have an image."""
        unseen = self.config.unseen_fraction if self.config.model.dynamic_skinning else 0
        return self.config.steps + round(unseen * self.config.steps)

    def stage(self, step: int) -> int:
        """1: geometry with plain colours, 2: albedo and light, 3: skinning in unseen poses."""
        if step >= self.config.steps:
            return 3
        return 1 if step < self.first_stage else 2

    def decay(self, step: int) -> float:
        """Factor on the learning rates: exponential with a final cooling; in the third stage from 1 to 0.1."""
        config, steps = self.config, self.config.steps
        if step >= steps:
            return float(0.1 ** ((step - steps) / (self.total - steps)))
        done, cooling = step / steps, config.cooling_fraction
        cooled = max(0.0, done - (1 - cooling)) / cooling if cooling > 0 else 0.0
        return float(config.rate_final**done * config.rate_cooled**cooled)

    def refines(self, step: int) -> bool:
        """Whether ``step`` corrects body poses."""
        return step >= self.config.refine_after * self.config.steps

    def fits_poses(self, step: int) -> bool:
        """Whether all poses of a film are fitted to the avatar before ``step``."""
        return step in [round(share * self.config.steps) for share in POSE_FITS]

    def cost(self, steps: int) -> float:
        """Cost of the first ``steps`` in steps with an image, the unit of progress."""
        with_image = min(steps, self.config.steps)
        return with_image + UNSEEN_COST * (steps - with_image)
