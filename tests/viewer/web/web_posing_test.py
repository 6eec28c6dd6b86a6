"""The page for static hosts poses as the compiled pass does."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.posing.rest import RestPose
from rnd_runtime.posing.skinning import PosedArrays
from support.paths import ROOT
from support.posing_scenes import page_arrays, posing_scene

NODE = shutil.which("node")
ROUND_OFF = 3e-5  # of the largest value: the page computes in float64, the pass in float32

pytestmark = pytest.mark.skipif(NODE is None, reason="needs Node.js")

_POSE = """
import { readFileSync, writeFileSync } from "node:fs";
const [source, folder] = process.argv.slice(1);
const { RestPose } = await import(source + "/posing/posing.js");
const { names, integers } = JSON.parse(readFileSync(folder + "/names.json"));
const [count, ...arrays] = names.map((name) => {
    const { buffer, byteOffset, byteLength } = readFileSync(`${folder}/${name}`);
    const bytes = buffer.slice(byteOffset, byteOffset + byteLength);
    return integers.includes(name) ? new Int32Array(bytes) : new Float32Array(bytes);
});
const bones = arrays.pop();
new RestPose(count[0], arrays.slice(0, 8)).pose(arrays.slice(8), bones)
    .forEach((values, k) => writeFileSync(`${folder}/posed${k}`, values));
"""


def _page(folder: Path, rest: RestPose, logits: Any, *fields: Any) -> PosedArrays:
    """What the page's code makes of it, in Node.js."""
    assert NODE is not None
    *nodes, bones = fields
    count = len(rest.points)
    arrays = {
        "count": np.int32([count]),
        **page_arrays(rest),
        "offsets": nodes[0],
        "visibility": nodes[1],
        **({} if logits is None else {"logits": logits}),
        "bones": bones,
    }
    for name, values in arrays.items():
        (folder / name).write_bytes(np.ascontiguousarray(values).tobytes())
    (folder / "names.json").write_text(json.dumps({"names": list(arrays), "integers": ["count", "neighbours"]}))
    source = (ROOT / "viewer/web/src").as_uri()
    subprocess.run([NODE, "--input-type=module", "--eval", _POSE, source, str(folder)], check=True, timeout=60)
    made = (np.fromfile(folder / f"posed{k}", np.float32).reshape(count, -1) for k in range(4))
    return PosedArrays(*made)


def _assert_close(ours: PosedArrays, theirs: PosedArrays) -> None:
    for a, b in zip(ours, theirs):
        assert_allclose(a, b, rtol=0, atol=ROUND_OFF * np.nanmax(np.abs(b)))


@pytest.mark.parametrize(("joints", "coefficients"), [(24, 16), (2, 1), (55, 9)])
def test_it_poses_as_the_compiled_pass(tmp_path, joints, coefficients):
    rest, inputs = posing_scene(joints, harmonics=coefficients)
    _assert_close(_page(tmp_path, rest, *inputs), rest.pose(*inputs))


def test_without_logits_the_template_decides(tmp_path):
    rest, (_, *inputs) = posing_scene(24)
    _assert_close(_page(tmp_path, rest, None, *inputs), rest.pose(None, *inputs))


def test_what_is_not_finite_stays_with_its_gaussians(tmp_path):
    rest, (logits, offsets, *others) = posing_scene(24)
    rest.points[3, 1], rest.factors[7, 2], rest.normals[11, 0] = np.nan, np.inf, np.nan
    logits[5, 2], offsets[9, 4] = np.nan, np.inf
    expected = rest.pose(logits, offsets, *others)
    assert 0 < np.isnan(expected.means).any(axis=1).mean() < 0.5
    got = _page(tmp_path, rest, logits, offsets, *others)
    assert (np.isfinite(got.means) == np.isfinite(expected.means)).all()
