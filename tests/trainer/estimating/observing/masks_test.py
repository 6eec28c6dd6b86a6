"""Masks by the background of a static camera, from the ragged ones of a network."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rnd_trainer.checking.silhouette import mask_iou
from rnd_trainer.estimating.observing.masks import _learn, refine_masks

HEIGHT, WIDTH, COUNT = 200, 160, 14


def textured(seed: int, mean: tuple[int, int, int], blur: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur)
    return np.clip(np.array(mean) + 25 * smooth / smooth.std(), 0, 255)


def shape(k: int) -> np.ndarray:
    """A body with an arm akimbo [H, W] 0…1, at four times the resolution: its gap shows the background."""
    big = np.zeros((4 * HEIGHT, 4 * WIDTH), np.uint8)
    x = 4 * (45 + 5 * k)
    cv2.ellipse(big, (x, 400), (70, 260), 0, 0, 360, 255, -1)
    cv2.line(big, (x + 40, 250), (x + 170, 380), 255, 30)
    cv2.line(big, (x + 170, 380), (x + 40, 520), 255, 30)
    return cv2.resize(big, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def clip(seed: int = 0, noise: float = 2.0) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Images with noise, true masks, and a network's: blurred, its gaps filled."""
    rng = np.random.default_rng(seed)
    behind, person = textured(1, (120, 130, 90)), textured(2, (150, 80, 60))
    images, truths, soft = [], [], []
    for k in range(COUNT):
        alpha = shape(k)[..., None]
        image = person * alpha + behind * (1 - alpha) + rng.normal(scale=noise, size=behind.shape)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
        truths.append((255 * alpha[..., 0]).astype(np.uint8))
        closed = cv2.morphologyEx(truths[-1], cv2.MORPH_CLOSE, np.ones((25, 25), np.uint8))
        soft.append(cv2.GaussianBlur(closed, (0, 0), 2.5))
    return images, truths, soft


def ious(masks: list[np.ndarray], truths: list[np.ndarray]) -> np.ndarray:
    return np.array([mask_iou(mask > 127, truth > 127) for mask, truth in zip(masks, truths)])


def refined(images: list[np.ndarray], soft: list[np.ndarray]) -> list[np.ndarray]:
    return [mask for _, mask in refine_masks(images.__getitem__, soft)]


def test_the_background_of_a_static_camera_sharpens_masks() -> None:
    images, truths, soft = clip()
    before, after = ious(soft, truths), ious(refined(images, soft), truths)
    assert before.mean() < 0.91
    assert after.min() > 0.92 and after.mean() > 0.965


def test_a_codecs_errors_beside_the_person_are_not_the_person() -> None:
    images, truths, soft = clip(noise=0.0)
    rng = np.random.default_rng(1)
    for image, truth in zip(images, truths):  # what stands still is coded without error
        beside = cv2.dilate(truth, np.ones((13, 13), np.uint8))[..., None] > 0
        error = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), 1.5)
        image[:] = np.clip(image + beside * 6 * error / error.std(), 0, 255)
    masks = refined(images, soft)
    over = [((mask > 127) & (truth < 1)).sum() / (truth > 127).sum() for mask, truth in zip(masks, truths)]
    assert np.mean(over) < 0.025


def test_a_moving_background_leaves_the_networks_masks_about_as_they_are() -> None:
    images, truths, soft = clip()
    moved = []
    for k, (image, truth) in enumerate(zip(images, truths)):
        elsewhere = textured(50 + k, (120, 130, 90)).astype(np.uint8)
        moved.append(np.where(truth[..., None] > 0, image, elsewhere))
    after = ious(refined(moved, soft), soft)
    assert after.min() > 0.9


def test_large_images_are_worked_on_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    from rnd_trainer.estimating.observing import masks

    monkeypatch.setattr(masks, "MAX_SIDE", 90)
    images, truths, soft = clip()
    after = refined(images, soft)
    assert after[0].shape == (HEIGHT, WIDTH)
    assert ious(after, truths).mean() > 0.92


def test_an_empty_mask_stays_empty() -> None:
    images, _, soft = clip()
    soft[3] = np.zeros_like(soft[3])
    assert refined(images, soft)[3].max() == 0


def test_a_background_is_the_median_of_the_frames_that_show_it() -> None:
    rng = np.random.default_rng(3)
    images = np.clip(rng.integers(40, 200, (1, 6, 30, 3)) + rng.normal(0, 3, (11, 6, 30, 3)), 0, 255).astype(np.uint8)
    first, hidden = rng.random((11, 6, 30)) < 0.6, rng.random((11, 6, 30)) < 0.4
    hidden[2:, 0, :5] = True
    hidden[:, 3:] = first[:, 3:]
    colour, noise = np.zeros((6, 30, 3), np.float32), np.zeros((6, 30), np.float32)
    _learn(images, first, np.ones((6, 30), bool), colour, noise)
    _learn(images, hidden, (first != hidden).any(0), colour, noise)
    seen = (~hidden).sum(0) >= 3
    shown = np.where(hidden[..., None], np.nan, images)[:, seen]
    expected = np.nanmedian(shown, axis=0)
    np.testing.assert_array_equal(colour[seen], expected)
    np.testing.assert_allclose(noise[seen], 1.48 * np.nanmedian(np.abs(shown - expected), axis=0).max(-1), rtol=1e-6)
    assert not colour[~seen].any()
