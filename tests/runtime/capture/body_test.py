"""Bodies as files."""

import numpy as np

from rnd_runtime.capture.body import Body
from support.paths import ASSETS


def test_a_body_without_a_licence_is_read(tmp_path):
    """None in the file, or a list of none."""
    with np.load(ASSETS / "body.npz") as archive:
        arrays = dict(archive)
    for change in ({}, {"license": np.array([], "U1")}):
        np.savez(tmp_path / "body.npz", **{k: v for k, v in arrays.items() if k != "license"} | change)
        body = Body.load(tmp_path / "body.npz")
        assert body.license == "unknown" and len(body.vertices) == len(arrays["vertices"])
