"""Our renderer with true attributes against Mitsuba, in small: what ``rnd-bench study agreement`` measures in full."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.paths import ASSETS

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")

from rnd_runtime.capture.body import Body  # noqa: E402
from rnd_runtime.core.errors import InputError  # noqa: E402
from rnd_runtime.core.images import read_image  # noqa: E402
from rnd_runtime.shading.sh import sh_basis, sphere_quadrature  # noqa: E402
from rnd_runtime.shading.shadow import directional_visibility  # noqa: E402

mi.set_variant("scalar_rgb")

from rnd_bench.cli import main  # noqa: E402
from rnd_bench.studies.agreement import ball, compare, fitted_visibility, true_gaussians  # noqa: E402
from rnd_stage.film.cameras import ring_cameras  # noqa: E402
from rnd_stage.people import dressing  # noqa: E402

pytestmark = pytest.mark.slow
SIZE = 64  # pixels


@pytest.fixture(scope="module")
def compared():
    rough = replace(ball(rings=64), roughness=np.full(2 * 64 * 64, 0.8))
    camera = ring_cameras(1, SIZE)["cam00"]
    return {result.row["light"]: result for result in compare("ball", rough, camera, 64, ("white", "red"))}


@pytest.mark.parametrize("mode", ["brute", "table+sun"])
def test_a_convex_body_has_mitsubas_energy(compared, mode: str) -> None:
    for light, result in compared.items():
        assert result.row[mode]["energy"] == pytest.approx(1, abs=0.01), light
        assert 30 < result.row[mode]["psnr_inside"] < result.row["noise_psnr"] + 3, light


def test_a_convex_body_has_no_interreflection(compared) -> None:
    for result in compared.values():
        assert abs(result.row["interreflection_energy"]) < 0.005
        # only noise is between the two
        assert result.row["interreflection_psnr"] == pytest.approx(result.row["noise_psnr"] - 3, abs=1.5)


def test_the_strip_shows_the_difference(compared) -> None:
    strip = compared["white"].strip()
    assert strip.shape == (SIZE, 4 * SIZE, 3)
    ours, direct, difference, full = np.split(strip, 4, axis=1)
    np.testing.assert_allclose(difference, np.clip(4 * np.abs(ours - direct), 0, 1), atol=1e-12)
    assert np.abs(full - direct).mean() < 0.01 < ours.mean()


def test_an_unknown_light_is_refused() -> None:
    with pytest.raises(InputError, match="--lights"):
        next(compare("ball", ball(rings=8), ring_cameras(1, 16)["cam00"], 2, ("mauve",)))


def test_an_image_too_small_for_the_body_is_refused() -> None:
    thin = ball(radius=0.05, rings=8)
    with pytest.raises(InputError, match="--size"):
        next(compare("ball", thin, ring_cameras(1, 16)["cam00"], 2))


def test_fitted_visibility_preserves_irradiance() -> None:
    """Of two balls that shade each other, the irradiance under a white sky is that of traced shadows."""
    one = true_gaussians(ball(rings=40))
    points = np.concatenate([one.means, one.means + np.float32([1.05, 0, 0])]).astype(np.float64)
    normals = np.concatenate([one.normals, one.normals]).astype(np.float64)
    radius = 0.05
    fitted = fitted_visibility(points, normals, radius)
    directions, areas = sphere_quadrature(20)
    weight = np.maximum(normals @ directions.T, 0) * areas / np.pi
    traced = directional_visibility(points, normals, directions, radii=radius, resolution=384)
    arriving = np.sum(weight * traced, axis=1)
    kept = np.sum(weight * (fitted @ sh_basis(directions).T), axis=1)
    assert arriving.min() < 0.7  # they do shade each other
    assert np.sqrt(np.mean((kept - arriving) ** 2)) < 0.012
    assert abs(np.mean(kept - arriving)) < 0.001


def test_the_command_writes_rows_and_a_sheet(monkeypatch, tmp_path: Path) -> None:
    template, made = Body.load(ASSETS / "body.npz"), dressing.dress
    monkeypatch.setattr(dressing, "dress", lambda who, step: made(who, 0.02, template))
    out, sheet = tmp_path / "rows.json", tmp_path / "sheet.png"
    options = ["--frame", "1", "--size", "64", "--samples", "4", "--variant", "scalar_rgb", "--lights", "white", "rim"]
    assert main(["study", "agreement", str(out), "--sheet", str(sheet), *options]) == 0
    rows = json.loads(out.read_text())
    bodies = [(row["body"], row["light"]) for row in rows]
    assert bodies == [(body, light) for body in ("ball", "person") for light in ("white", "rim")]
    for row in rows:
        assert row["machine"] and row["variant"] == "scalar_rgb"
        assert (row["size"], row["samples"]) == (64, 4) and row["gaussians"] > 1000
        assert 10 < row["brute"]["psnr_inside"] < 60
    assert read_image(sheet).shape == (2 * 64, 8 * 64, 3)
