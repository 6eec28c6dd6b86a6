"""--mask-net, --normal-net and --albedo-net, from the command to the capture."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.images import linear_to_srgb, read_image, srgb_to_linear, to_bytes, write_image
from rnd_trainer.checking.silhouette import mask_iou
from rnd_trainer.commands import data as data_cli
from support import layouts
from support.known_scene import FRAMES, HEIGHT, WIDTH, view_of
from support.pose_programs import write_poses

SCALE = 4
BACKGROUND = (230, 60, 30)
# mean IoU over the four frames, poses 6 cm off: with the network (measured 0.997), without it (0.77)
BY_NETWORK, WITHOUT = 0.98, 0.85
DEGREES = 0.5  # mean angle to the truth, measured 0.3: eight bits of colour, eight bits of normal


def _net(path: Path, weights: np.ndarray, bias: np.ndarray, *, after: str | None = None) -> Path:
    """One 1×1 convolution of an RGB image of any size, ``weights`` [C, 3], and a function ``after`` it."""
    nodes = [helper.make_node("Conv", ["x", "w", "b"], ["y"])]
    if after:
        nodes.append(helper.make_node(after, ["y"], ["z"]))
    graph = helper.make_graph(
        nodes,
        "pixelwise",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, "height", "width"])],
        [helper.make_tensor_value_info("z" if after else "y", TensorProto.FLOAT, None)],
        [
            helper.make_tensor("w", TensorProto.FLOAT, [len(bias), 3, 1, 1], np.float32(weights).ravel()),
            helper.make_tensor("b", TensorProto.FLOAT, [len(bias)], np.float32(bias)),
        ],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)
    return path


CAMERA = layouts.video_camera(77.0).resized(SCALE * WIDTH, SCALE * HEIGHT)


@pytest.fixture
def run(tmp_path, capsys) -> Callable[..., tuple[int, str, Path]]:
    """``rnd-data import`` of frames whose colours encode the normals as Sapiens has them (right, up, to the viewer)."""
    for k in range(FRAMES):
        view = view_of(CAMERA, k)
        person = to_bytes(0.2 + 0.35 * (view.normals @ layouts.FLIP + 1))
        image = np.where(view.mask[..., None], person, np.array(BACKGROUND)).astype(np.uint8)
        write_image(tmp_path / "frames" / f"{k:05d}.png", image)
        write_image(tmp_path / "masks" / f"{k:05d}.png", (255 * view.mask).astype(np.uint8))
    body = layouts.body_file(tmp_path)

    def command(shift: float, *options: object) -> tuple[int, str, Path]:
        out = tmp_path / f"capture{len(list(tmp_path.glob('capture*')))}"
        trans = layouts.camera_world().trans + np.array([shift, 0, 0])
        lens = [CAMERA.K[0, 0], CAMERA.K[1, 1], CAMERA.K[0, 2], CAMERA.K[1, 2]]
        words = ["import", tmp_path / "frames", out, "--body", body, "--poses", write_poses(tmp_path, trans=trans)]
        with pytest.raises(SystemExit) as ended:
            data_cli.main([str(word) for word in (*words, "--intrinsics", *lens, *options)])
        return int(ended.value.code or 0), "".join(capsys.readouterr()), out

    return command


def _mean_iou(out: Path) -> float:
    capture = load_capture(out)
    found = [(capture.load_frame(frame).mask > 0.5, view_of(CAMERA, frame.frame).mask) for frame in capture.frames]
    return float(np.mean([mask_iou(mask, truth) for mask, truth in found]))


def test_masks_of_a_network_reach_the_capture(tmp_path, run) -> None:
    """The person is bluer than the wall; the poses are off, so that the template alone is not enough."""
    net = _net(tmp_path / "bluer.onnx", np.array([[0, 0, 30.0]]), np.array([-30 * 0.35]), after="Sigmoid")
    _, printed, out = run(0.06, "--mask-net", net)
    assert f"{FRAMES} masks made by a network: rough" in printed
    with_it = _mean_iou(out)
    _, printed, out = run(0.06)
    assert "masks made from the template" in printed
    assert with_it > BY_NETWORK and _mean_iou(out) < WITHOUT


def test_normals_of_a_network_reach_the_capture(tmp_path, run) -> None:
    """The network inverts the images' colour coding; the template finds that its y and z are flipped."""
    net = _net(tmp_path / "normals.onnx", np.eye(3) / 0.35, np.full(3, -0.2 / 0.35 - 1))
    code, printed, out = run(0.0, "--masks", tmp_path / "masks", "--normal-net", net)
    assert code == 0 and "normals point right, up, towards the viewer" in printed, printed
    capture = load_capture(out)
    angles = []
    for frame in capture.frames:
        normals, truth = capture.load_frame(frame).normal, view_of(CAMERA, frame.frame)
        assert (normals[~truth.mask] == 0).all() and (np.abs(normals[truth.mask]).max(-1) > 0).all()
        angles.append(np.degrees(np.arccos(np.clip((normals * truth.normals).sum(-1)[truth.mask], -1, 1))))
    assert np.mean(np.concatenate(angles)) < DEGREES


def test_albedos_of_a_network_reach_the_capture(tmp_path, run) -> None:
    """The network halves the image and lifts it by a tenth."""
    net = _net(tmp_path / "albedo.onnx", 0.5 * np.eye(3), np.full(3, 0.1))
    code, printed, out = run(0.0, "--masks", tmp_path / "masks", "--albedo-net", net)
    assert code == 0, printed
    capture = load_capture(out)
    for frame in capture.frames:
        images, person = capture.load_frame(frame), view_of(CAMERA, frame.frame).mask
        assert frame.albedo is None and images.albedo_srgb is None  # the estimate is no truth
        estimate, source = images.albedo_estimate_srgb, images.image_srgb
        assert (estimate[~person] == 0).all()
        assert np.abs(estimate - (0.5 * source + 0.1))[person].mean() < 2 / 255  # eight bits, resized up and down


def test_albedos_of_a_folder_are_premultiplied(tmp_path, run) -> None:
    for k in range(FRAMES):
        soft = (200 * (read_image(tmp_path / "masks" / f"{k:05d}.png") > 0)).astype(np.uint8)
        write_image(tmp_path / "soft" / f"{k:05d}.png", soft)
        write_image(tmp_path / "albedos" / f"{k:05d}.png", np.full((*soft.shape[:2], 3), 120 + k, np.uint8))
    code, printed, out = run(0.0, "--masks", tmp_path / "soft", "--albedos", tmp_path / "albedos")
    assert code == 0, printed
    capture = load_capture(out)
    for frame in capture.frames:
        estimate, covered = capture.load_frame(frame).albedo_estimate_srgb, view_of(CAMERA, frame.frame).mask
        expected = linear_to_srgb(srgb_to_linear((120 + frame.frame) / 255) * 200 / 255)
        assert np.abs(estimate[covered] - expected).max() < 1 / 255 and (estimate[~covered] == 0).all()


UNUSABLE = {
    "a normal network": (2 * np.eye(3), np.full(3, -1.0), "network's albedo: expected sRGB in 0 … 1, got -.* to"),
    "0 to 255": (255 * np.eye(3), np.zeros(3), "network's albedo: expected sRGB in 0 … 1, got"),
    "one channel": (np.ones((1, 3)), np.zeros(1), "network's output: expected a map of 3 channels, got"),
    "NaN": (np.eye(3), np.full(3, np.nan), "network's output: expected finite numbers, got NaN or infinity"),
}


@pytest.mark.parametrize(("weights", "bias", "words"), UNUSABLE.values(), ids=UNUSABLE)
def test_unusable_albedo_networks_are_refused_in_one_line(tmp_path, run, weights, bias, words) -> None:
    net = _net(tmp_path / "albedo.onnx", weights, bias)
    code, printed, out = run(0.0, "--masks", tmp_path / "masks", "--albedo-net", net)
    line = printed.splitlines()[-1]
    assert code == 2 and re.search(rf"albedo\.onnx: frame 0: {words}", line) and printed.count("expected") == 1, printed
    assert not (out / "capture.json").exists()
