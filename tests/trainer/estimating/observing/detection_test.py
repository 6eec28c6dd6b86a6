"""Finding people: a network that sees one of two in the whole image."""

import cv2
import numpy as np

from rnd_trainer.estimating.observing.detection import SIDE, Detector
from rnd_trainer.estimating.observing.regions import Region


class OneOfMany:
    """Sees the largest of the whole white squares in its input, as the middle of hips at its centre."""

    anchors = Detector(None)._anchors

    def run(self, names: object, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        white = inputs["image"][0, ..., 0] > 0.5
        _, _, stats, centres = cv2.connectedComponentsWithStats(white.astype(np.uint8))
        left, top, width, height = stats[1:, :4].T
        whole = (left > 0) & (top > 0) & (left + width < SIDE) & (top + height < SIDE)
        boxes = np.zeros((1, len(self.anchors), 12), np.float32)
        scores = np.full((1, len(self.anchors), 1), -9, np.float32)
        if whole.any():
            chosen = int((height * whole).argmax())
            hips = (centres[1 + chosen] + 0.5) / SIDE
            best = int(np.abs(self.anchors - hips).sum(1).argmin())
            boxes[0, best, 4:6] = SIDE * (hips - self.anchors[best])
            boxes[0, best, 6:8] = boxes[0, best, 4:6] - [0, height[chosen] / 2]
            scores[0, best] = 4
        return [boxes, scores]


def test_a_second_person_whom_the_whole_image_does_not_show_is_found_in_its_parts() -> None:
    image = np.zeros((400, 900, 3), np.uint8)
    image[150:250, 100:200] = 255
    image[160:240, 720:800] = 255
    found = Detector(OneOfMany())(image)
    assert sorted(round(one.region.x, -1) for one in found) == [150, 760]


def test_regions_of_neighbours_overlap_and_are_two_people() -> None:
    """Of Pose2Sim's two people, in pixels; and of one person seen twice."""
    man, woman, her_legs = Region(483, 781, 1014), Region(169, 1099, 1148), Region(228, 1183, 778)
    assert man.overlap(woman) > 0.3
    assert not man.same_person(woman)
    assert woman.same_person(her_legs) and her_legs.same_person(woman)
