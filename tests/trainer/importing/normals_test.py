"""Normal maps in any axes are converted to OpenCV camera axes."""

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose
from onnx import TensorProto, helper

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_trainer.importing.surfaces.normals import (
    fill_holes,
    find_axes,
    normal_map,
    normal_network,
    read_normals,
    to_opencv,
)
from support.paths import SHARED

SHARED_DATA = SHARED / "data"
EIGHT_BIT = 0.01  # half a step of (n + 1)/2, twice over
SIGNS = [(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)]


def _sphere(size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Normals [H, W, 3] of a sphere in OpenCV axes, and its mask [H, W]."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2.4 - 1.2
    inside = x**2 + y**2 < 0.97
    z = -np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))
    return np.where(inside[..., None], np.stack([x, y, z], -1), 0).astype(np.float32), inside


@pytest.mark.parametrize("signs", SIGNS)
def test_axes_are_found_by_the_template(signs):
    normals, inside = _sphere()
    axes = find_axes([normals * np.float32(signs)], [normals.astype(np.float64)])
    assert axes.signs == signs
    assert_allclose(axes.agreement, 1, atol=1e-6)
    assert_allclose(to_opencv(normals * np.float32(signs), axes)[inside], normals[inside], atol=1e-6)


def test_axes_in_words():
    normals, _ = _sphere()
    sapiens = normals * np.float32([1, -1, -1])
    assert find_axes([sapiens], [normals]).name == "right, up, towards the viewer"


def test_maps_that_disagree_with_the_template_are_refused():
    normals, inside = _sphere()
    rng = np.random.default_rng(0)
    noise = rng.normal(size=normals.shape).astype(np.float32)
    noise /= np.linalg.norm(noise, axis=-1, keepdims=True)
    for wrong in (noise, np.broadcast_to(np.float32([0, 0, -1]), normals.shape)):
        with pytest.raises(InputError, match=r"cosine.*do they belong"):
            find_axes([wrong], [normals])
    with pytest.raises(InputError, match="both cover"):
        find_axes([np.where(inside[..., None], 0, 1).astype(np.float32)], [normals])


def test_swapped_axes_are_named():
    """Red and blue swapped, or rotated axes: no signs fix that, the option does."""
    normals, _ = _sphere()
    for wrong, flag in ((normals[..., ::-1], "z,y,x"), (-np.roll(normals, 1, -1), "-y,-z,-x")):
        with pytest.raises(InputError, match=rf"with --normal-axes={flag} it would be 1\.00"):
            find_axes([wrong], [normals])


def test_files(tmp_path):
    normals, inside = _sphere()
    hollow = np.where(inside[..., None], normals, np.nan)
    np.save(tmp_path / "a.npy", hollow * 0.9)
    np.save(tmp_path / "b.npy", hollow.transpose(2, 0, 1).astype(np.float16))
    for bits, dtype in ((8, np.uint8), (16, np.uint16)):
        encoded = np.where(inside[..., None], (normals + 1) / 2, 0) * np.iinfo(dtype).max
        write_image(tmp_path / f"{bits}.png", np.round(encoded).astype(dtype))
    for name, tolerance in (("a.npy", 1e-6), ("b.npy", 1e-3), ("8.png", EIGHT_BIT), ("16.png", 1e-4)):
        read = read_normals(tmp_path / name)
        assert_allclose(read, normals, atol=tolerance, err_msg=name)
        assert (read[~inside] == 0).all(), name


def test_files_of_another_kind_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 4)))
    np.save(tmp_path / "b.npy", np.array({"a": 1}), allow_pickle=True)
    for name in ("a.npy", "b.npy", "c.npy"):
        with pytest.raises(InputError, match=name):
            read_normals(tmp_path / name)


@pytest.mark.parametrize("as_image", [True, False])
def test_a_networks_input_is_the_person_on_grey(tmp_path, as_image):
    """The network gives back its image (as n in 0…1, or −1…1): the image of a normal map comes out as that map."""
    normals, inside = _sphere()
    image = np.round(255 * (normals * np.float32([1, -1, -1]) + 1) / 2).astype(np.uint8)
    image[~inside] = (10, 200, 90)
    mask = np.where(inside, 255, 0).astype(np.uint8)
    scale, shift = (1.0, 0.0) if as_image else (2.0, -1.0)
    weights = scale * np.eye(3, dtype=np.float32)
    graph = helper.make_graph(
        [helper.make_node("Conv", ["x", "w", "b"], ["y"])],
        "copy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, "h", "w_"])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [
            helper.make_tensor("w", TensorProto.FLOAT, [3, 3, 1, 1], weights.ravel()),
            helper.make_tensor("b", TensorProto.FLOAT, [3], [shift] * 3),
        ],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), tmp_path / "n.onnx")
    found = normal_map(normal_network(tmp_path / "n.onnx"), image, mask)
    axes = find_axes([found], [normals])
    assert axes.signs == (1, -1, -1)
    in_opencv = to_opencv(found, axes)
    assert (in_opencv[~inside] == 0).all()
    cosines = (in_opencv * normals).sum(-1)[inside]
    assert (
        np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean() < 1.5
    )  # 8 bits, resized up and down; edges blend in grey


def test_back_facing_normals_are_projected():
    normals, _ = _sphere()
    axes = find_axes([normals], [normals])
    away = to_opencv(np.array([[[0.6, 0, 0.8]]], np.float32), axes)
    assert_allclose(away, [[[1, 0, 0]]], atol=1e-6)


def test_holes_are_filled_from_the_nearest_pixels():
    normals, inside = _sphere()
    holed = normals.copy()
    holed[30:33, 30:33] = 0
    filled = fill_holes(holed, np.where(inside, 255, 0).astype(np.uint8))
    assert_allclose((filled * normals).sum(-1)[30:33, 30:33], 1, atol=0.01)
    assert (filled[~inside] == 0).all()


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not here; all else here is self-made")
def test_predicted_normals_agree_with_true_ones():
    capture = load_capture(SHARED_DATA / "capture")
    images = [capture.load_frame(frame) for frame in capture.split("train")[::25]]
    flipped = [image.normal * np.float32([-1, 1, -1]) for image in images]
    axes = find_axes(flipped, [image.normal_gt for image in images])
    assert axes.signs == (-1, 1, -1) and axes.agreement > 0.9
