"""Reading avatar.onnx: the honest file, and the refusals."""

from __future__ import annotations

import msgspec
import numpy as np
import onnx
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import METADATA_KEY, encode_light
from rnd_runtime.core.errors import InputError
from rnd_runtime.shading.brdf import LARGEST_ALBEDO
from support.tiny import body, motion


def _changed(path, target, change):
    model = onnx.load(path)
    change(model)
    onnx.save_model(model, str(target))
    return target


def _metadata(model, **changes) -> None:
    entry = next(prop for prop in model.metadata_props if prop.key == METADATA_KEY)
    entry.value = msgspec.json.encode({**msgspec.json.decode(entry.value), **changes}).decode()


def test_an_avatar_poses_itself(tiny_avatar) -> None:
    avatar = Avatar.load(tiny_avatar, threads=1)
    gaussians = avatar.pose(motion(body()), 0.1)
    assert gaussians.means.shape == (800, 3) and gaussians.covariances.shape == (800, 6)
    assert np.isfinite(gaussians.means).all()
    assert np.abs(np.linalg.norm(gaussians.normals, axis=1) - 1).max() < 1e-4
    assert avatar.trained_light.shape == (32, 64, 3)
    assert avatar.skeleton.names == body().skeleton.names


def test_threads_do_not_change_a_frame(tiny_avatar) -> None:
    one, two = (Avatar.load(tiny_avatar, threads=n).pose(motion(body()), 0.1) for n in (1, 2))
    assert np.abs(one.means - two.means).max() < 1e-6
    assert np.abs(one.visibility - two.visibility).max() < 1e-5


def test_a_level_evaluates_the_same_networks_at_fewer_nodes(tiny_avatar) -> None:
    avatar = Avatar.load(tiny_avatar)
    level = avatar.level(1)
    assert level is not None and avatar.level(1) is level and avatar.level(0) is avatar
    assert (level.gaussians, level.nodes) == (avatar.gaussians, -(-avatar.nodes // 4))
    every, some = (each.encode(motion(body()), 0.1).values for each in (avatar, level))
    for whole, part in zip(every, some, strict=True):
        np.testing.assert_allclose(part, whole[::4], atol=1e-5)
    shift = level.pose(motion(body()), 0.1).means - avatar.pose(motion(body()), 0.1).means
    assert 0 < np.sqrt((shift**2).mean()) < 2e-3  # m


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"schema": "rnd-avatar/2"}, "schema: expected rnd-avatar/1, got rnd-avatar/2"),
        ({"surprise": 1}, "unknown field `surprise`"),
        ({"gaussians": "many"}, "Expected `int`"),
        ({"variant": {"encoder": "sparse"}}, "Invalid enum value 'sparse'"),
        ({"variant": {"precision": "int4"}}, "Invalid enum value 'int4'"),
        ({"variant": {"shape": 1}}, "unknown field `shape`"),
        ({"gaussians": 801}, "graph outputs: expected"),
        ({"window_poses": 6}, "graph inputs: expected"),
        ({"trained_light": "AAAA"}, "trained_light: expected float32 of shape"),
        ({"trained_light": "?"}, "trained_light: expected float32 of shape"),
        ({"trained_light": encode_light(np.full((32, 64, 3), np.nan))}, "trained_light: expected finite"),
        ({"trained_light": encode_light(np.full((32, 64, 3), -1.0))}, "trained_light: expected finite"),
        ({"window_seconds": 0.0}, "Expected `float` > 0.0"),
        ({"spacing_m": -0.01}, "Expected `float` > 0.0"),
        ({"window_poses": 0}, "Expected `int` >= 1"),
    ],
)
def test_metadata_we_do_not_know_is_refused(tiny_avatar, tmp_path, changes, line) -> None:
    path = _changed(tiny_avatar, tmp_path / "odd.onnx", lambda model: _metadata(model, **changes))
    with pytest.raises(InputError) as caught:
        Avatar.load(path)
    assert line in str(caught.value) and "odd.onnx" in str(caught.value)


def test_a_foreign_model_is_refused(tiny_avatar, tmp_path) -> None:
    path = _changed(tiny_avatar, tmp_path / "foreign.onnx", lambda model: model.ClearField("metadata_props"))
    with pytest.raises(InputError, match="not an RnD avatar"):
        Avatar.load(path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_file_cut_short_is_refused(tiny_avatar, tmp_path, share) -> None:
    whole = tiny_avatar.read_bytes()
    path = tmp_path / "cut.onnx"
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"cut\.onnx: not a"):
        Avatar.load(path)


def test_an_albedo_that_would_give_back_more_than_it_gets_is_capped(tiny_avatar, tmp_path) -> None:
    def whiten(model) -> None:
        tensor = next(t for t in model.graph.initializer if t.name == "rest/albedo")
        albedo = onnx.numpy_helper.to_array(tensor).copy()
        albedo[0] = [1.0, 0.95, 0.5]
        tensor.CopyFrom(onnx.numpy_helper.from_array(albedo, tensor.name))

    white = _changed(tiny_avatar, tmp_path / "white.onnx", whiten)
    played, given = (Avatar.load(file).pose(motion(body()), 0.1).albedo for file in (white, tiny_avatar))
    assert played[0] == pytest.approx([LARGEST_ALBEDO, LARGEST_ALBEDO, 0.5])
    assert np.array_equal(played[1:], given[1:])  # none that was trained is


@pytest.mark.parametrize("index", [10**4, -1])
def test_a_node_that_is_not_there_is_refused(tiny_avatar, tmp_path, index) -> None:
    """The compiled kernel would read whatever lies there."""

    def point_outside(model) -> None:
        tensor = next(t for t in model.graph.initializer if t.name == "rest/neighbours_packed")
        neighbours = onnx.numpy_helper.to_array(tensor).astype(np.int32)
        neighbours[3, 1] = index
        tensor.CopyFrom(onnx.numpy_helper.from_array(neighbours, tensor.name))

    file = _changed(tiny_avatar, tmp_path / "outside.onnx", point_outside)
    with pytest.raises(InputError, match=rf"outside.onnx: neighbours: expected .* nodes, from 0, got .*{index}"):
        Avatar.load(file)


@pytest.mark.parametrize(
    ("name", "shape", "said"),
    [
        ("node_offsets", [], r"expected \[M, 6\], got \[\]"),
        ("node_offsets", [0, 6], r"expected \[M, 6\], got \[0, 6\]"),
        ("node_visibility", [200, 20], r"expected \[200, 1 to 16\], got \[200, 20\]"),
        ("node_visibility", [200], r"expected \[200, 1 to 16\], got \[200\]"),
        ("neighbour_weights", [800], r"expected \[800, K\], got \[800\]"),
        ("posing_limits", [2], r"expected \[3\], got \[2\]"),
    ],
)
def test_a_posing_array_of_another_shape_is_named_alone(tiny_avatar, tmp_path, name, shape, said) -> None:
    def reshape(model) -> None:
        output = next(value for value in model.graph.output if value.name == name)
        del output.type.tensor_type.shape.dim[:]
        for size in shape:
            output.type.tensor_type.shape.dim.add().dim_value = size

    with pytest.raises(InputError, match=rf"other\.onnx: {name}: {said}$"):
        Avatar.load(_changed(tiny_avatar, tmp_path / "other.onnx", reshape))


@pytest.mark.parametrize("parent", [10**30, 2**32])
def test_a_parent_that_no_joint_is_is_refused(tiny_avatar, tmp_path, parent) -> None:
    skeleton = msgspec.json.decode(
        next(prop.value for prop in onnx.load(tiny_avatar).metadata_props if prop.key == METADATA_KEY)
    )["skeleton"]
    skeleton["parents"][3] = parent
    with pytest.raises(InputError, match=r"odd\.onnx: (skeleton parents: expected|.*Integer value out of range)"):
        Avatar.load(_changed(tiny_avatar, tmp_path / "odd.onnx", lambda m: _metadata(m, skeleton=skeleton)))


def test_a_graph_that_cannot_be_evaluated_is_named(tiny_avatar, tmp_path) -> None:
    """onnxruntime looks at indices when it comes to them: at constants as the file is read, at others in a frame."""

    def point_outside(model, name: str) -> None:
        graph = model.graph
        graph.initializer.append(onnx.numpy_helper.from_array(np.array([10**6]), "outside"))
        place = next(index for index, node in enumerate(graph.node) if name in node.output)
        node = graph.node[place]
        node.output[list(node.output).index(name)] = "before"
        make = onnx.helper.make_node
        graph.node.insert(place + 1, make("Gather", ["before", "outside"], ["lost"], axis=0))
        graph.node.insert(place + 2, make("ReduceSum", ["lost"], ["sum"], keepdims=0))
        graph.node.insert(place + 3, make("Add", ["before", "sum"], [name]))

    said = r"\.onnx: graph cannot be evaluated: got .*indices"
    file = _changed(tiny_avatar, tmp_path / "constant.onnx", lambda model: point_outside(model, "albedo"))
    with pytest.raises(InputError, match="constant" + said):
        Avatar.load(file)
    file = _changed(tiny_avatar, tmp_path / "frame.onnx", lambda model: point_outside(model, "node_offsets"))
    avatar = Avatar.load(file)
    with pytest.raises(InputError, match="frame" + said):
        avatar.pose(motion(body()), 0.1)


def test_external_data_is_not_followed(tiny_avatar, tmp_path) -> None:
    secret = tmp_path / "secret.bin"
    secret.write_bytes(b"\0" * 4 * 800)

    def point_outside(model) -> None:
        tensor = next(t for t in model.graph.initializer if t.name == "rest/opacities")
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        entry = tensor.external_data.add()
        entry.key, entry.value = "location", "../secret.bin"

    folder = tmp_path / "in"
    folder.mkdir()
    path = folder / "outside.onnx"
    model = onnx.load(tiny_avatar)
    point_outside(model)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(InputError):
        Avatar.load(path)
