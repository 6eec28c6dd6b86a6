"""The page for static hosts merges the Gaussians of far bodies as the runtime does."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.playback.scene import chosen_levels, greatest_sizes
from support.paths import ASSETS, ROOT
from support.posing_scenes import page_arrays

NODE = shutil.which("node")
SIZES = (150.0, 90.0, 60.0)  # pixels per metre; of the whole avatar, and of two levels
ROUND_OFF = 2e-5  # of single precision, after up to a hundred merges

pytestmark = pytest.mark.skipif(NODE is None, reason="needs Node.js")

_LEVELS = """
import { readFileSync, writeFileSync } from "node:fs";
const [source, folder] = process.argv.slice(1);
const { Levels } = await import(source + "/posing/levels.js");
const { names, about, sizes } = JSON.parse(readFileSync(folder + "/about.json"));
const surface = { count: about.count };
for (const name of names) {
    const { buffer, byteOffset, byteLength } = readFileSync(`${folder}/${name}`);
    const bytes = buffer.slice(byteOffset, byteOffset + byteLength);
    surface[name] = name === "neighbours" ? new Int32Array(bytes) : new Float32Array(bytes);
}
const levels = new Levels(surface, about);
const made = sizes.map((size) => {
    const level = levels.at(size, 60);
    if (!level) return null;
    const { rest, opacities, albedo, roughness, spacing, cull, ofItsNodes } = level;
    const arrays = { ...rest, opacities, albedo, roughness };
    for (const name of names.filter((each) => each !== "limits"))
        writeFileSync(`${folder}/${size}_${name}`, arrays[name]);
    const nodes = ofItsNodes(Float32Array.from({ length: about.nodes }, (_, k) => k)).length;
    return { count: opacities.length, spacing, cull, nodes };
});
console.log(JSON.stringify(made));
"""


def test_levels_are_the_runtimes(tmp_path):
    avatar = Avatar.load(ASSETS / "avatar.onnx", threads=1)
    rest = avatar._rest
    arrays = {
        **page_arrays(rest),
        "opacities": avatar._opacities,
        "albedo": avatar._albedo,
        "roughness": avatar._roughness,
    }
    for name, values in arrays.items():
        (tmp_path / name).write_bytes(np.ascontiguousarray(values).tobytes())
    about = {"count": avatar.gaussians, "spacing": avatar.spacing, "nodes": avatar.nodes, "fewer": True, "cull": -2}
    text = json.dumps({"names": list(arrays), "about": about, "sizes": SIZES})
    (tmp_path / "about.json").write_text(text)
    command = [NODE, "--input-type=module", "--eval", _LEVELS, (ROOT / "viewer/web/src").as_uri(), str(tmp_path)]
    made = json.loads(subprocess.run(command, check=True, timeout=60, capture_output=True, text=True).stdout)
    whole, *merged = SIZES
    assert made[0] is None and whole * avatar.spacing > 1
    for size, theirs in zip(merged, made[1:]):
        level = avatar.level(int(chosen_levels(np.array([size]), greatest_sizes(avatar, size))[0]))
        assert theirs["count"] == level.gaussians < avatar.gaussians
        assert (theirs["cull"], theirs["nodes"]) == (level.advice.cull, level.nodes)
        assert theirs["spacing"] == pytest.approx(level.spacing)
        _assert_same(level, tmp_path, f"{size:g}")


def _assert_same(level, folder, prefix):
    def read(name, kind):
        return np.fromfile(folder / f"{prefix}_{name}", kind)

    rest = level._rest
    ours = {
        "points": rest.points,
        "normals": rest.normals,
        "limbs": rest.limbs,
        "template": rest.log_template,
        "opacities": level._opacities,
        "albedo": level._albedo,
        "roughness": level._roughness,
    }
    for name, values in ours.items():
        np.testing.assert_allclose(read(name, np.float32).reshape(values.shape), values, atol=ROUND_OFF, err_msg=name)
    ours_of_nodes = _at_nodes(rest.neighbours, rest.neighbour_weights, level.nodes)
    neighbours = read("neighbours", np.int32).reshape(level.gaussians, -1)
    theirs_of_nodes = _at_nodes(neighbours, read("weights", np.float32).reshape(neighbours.shape), level.nodes)
    np.testing.assert_allclose(theirs_of_nodes, ours_of_nodes, atol=ROUND_OFF)
    ours_squared, theirs_squared = (_covariances(factors) for factors in (rest.factors, read("factors", np.float32)))
    np.testing.assert_allclose(theirs_squared, ours_squared, atol=ROUND_OFF * np.abs(ours_squared).max())


def _at_nodes(neighbours, weights, nodes):
    """Weights [N, M]: the order of a Gaussian's neighbours is of no importance."""
    dense = np.zeros((len(neighbours), nodes))
    np.put_along_axis(dense, neighbours, weights, 1)
    return dense


def _covariances(factors):
    square = factors.reshape(-1, 3, 3).astype(np.float64)
    return square @ square.transpose(0, 2, 1)
