"""Our renderer with true attributes against Mitsuba, in small: what ``rnd-stage agreement`` measures in full."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")

from rnd_runtime.body import Body  # noqa: E402
from rnd_runtime.camera import Camera  # noqa: E402
from rnd_runtime.errors import InputError  # noqa: E402
from rnd_runtime.images import read_image  # noqa: E402
from rnd_runtime.light import downsize, texel_directions, texel_solid_angles  # noqa: E402
from rnd_runtime.sh import sh_basis, sphere_quadrature  # noqa: E402
from rnd_runtime.shadow import directional_visibility  # noqa: E402

mi.set_variant("scalar_rgb")

from rnd_trainer.stage import cli, dressing  # noqa: E402
from rnd_trainer.stage.agreement import (  # noqa: E402
    AgreementOptions,
    ball,
    compare,
    fitted_visibility,
    true_gaussians,
)
from rnd_trainer.stage.cameras import ring_cameras  # noqa: E402
from rnd_trainer.stage.lights import stage_lights  # noqa: E402
from rnd_trainer.stage.render import Set  # noqa: E402

ASSETS = Path(__file__).parent.parent / "assets"
SIZE = 64  # pixels


@pytest.fixture(scope="module")
def compared():
    matt = replace(ball(rings=64), roughness=np.full(2 * 64 * 64, 0.8))
    camera = ring_cameras(1, SIZE)["cam00"]
    options = AgreementOptions(size=SIZE, samples=64, lights=("white", "red"))
    return {result.row["light"]: result for result in compare("ball", matt, camera, options)}


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
        next(
            compare("ball", ball(rings=8), ring_cameras(1, 16)["cam00"], AgreementOptions(lights=("mauve",)))
        )


def test_a_picture_too_small_for_the_body_is_refused() -> None:
    thin = ball(radius=0.05, rings=8)
    with pytest.raises(InputError, match="--size"):
        next(compare("ball", thin, ring_cameras(1, 16)["cam00"], AgreementOptions(size=16, samples=2)))


def test_rim_light_differs_by_the_formula_for_fresnel_and_masking() -> None:
    """Where light grazes, Schlick's term and joint masking keep less; summed with Mitsuba's, the gap is gone."""
    light = next(light for light in stage_lights() if light.name == "rim")
    colour, roughness = np.array([0.5, 0.4, 0.3]), 0.4
    surface = ball(rings=96)
    count = len(surface.vertices)
    surface = replace(
        surface,
        vertices=surface.normals,
        colour=np.tile(colour, (count, 1)),
        roughness=np.full(count, roughness),
    )
    eye = np.array([0.0, 0, 40])  # far: a pixel's place is its point's
    camera = Camera.look_at(eye.tolist(), [0.0, 0, 0], width=SIZE, height=SIZE, fov_y=2 * np.arctan(1 / 40))
    theirs = Set(surface, max_depth=2).radiance(camera, light.radiance, samples=64, seed=0)
    line = (np.arange(SIZE) + 0.5) / (SIZE / 2) - 1
    x, y = np.meshgrid(line, -line)
    inside = x**2 + y**2 < 0.9
    inside[::2] = False  # half the rows will do
    points = np.stack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))], -1)[inside]
    texels = downsize(light.radiance.astype(np.float32), 32, 64)
    flux = (texels * texel_solid_angles(32, 64)[..., None]).reshape(-1, 3)
    towards = texel_directions(32, 64).reshape(-1, 3)
    schlick, exact = (
        _shaded(points, eye, towards, flux, colour, roughness**2, term) for term in (_schlick, _exact)
    )
    truth = theirs[inside].sum()
    assert exact.sum() == pytest.approx(truth, rel=0.01)
    assert schlick.sum() < 0.97 * truth


def _shaded(points, eye, towards, flux, colour, alpha, gloss):
    view = eye - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    n_l = np.maximum(points @ towards.T, 0)
    n_v = np.maximum(np.sum(points * view, axis=1), 1e-4)[:, None]
    half = towards + view[:, None]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    n_h, v_h = np.einsum("ijk,ik->ij", half, points), np.einsum("ijk,ik->ij", half, view)
    d = alpha**2 / (np.pi * (1 - n_h**2 * (1 - alpha**2)) ** 2)
    safe = np.maximum(n_l, 1e-4)
    shine = d * gloss(safe, n_v, v_h, alpha) / (4 * safe * n_v)
    return (n_l * shine) @ flux + colour / np.pi * (n_l @ flux)


def _lambda(cosine, alpha):
    return (np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)) - 1) / 2


def _schlick(n_l, n_v, v_h, alpha):
    """Ours: :mod:`rnd_runtime.brdf`."""
    return (0.04 + 0.96 * (1 - v_h) ** 5) / (1 + _lambda(n_l, alpha) + _lambda(n_v, alpha))


def _exact(n_l, n_v, v_h, alpha):
    """Mitsuba's: Fresnel's equations for an index of 1.5, separable masking."""
    inner = np.sqrt(1.5**2 - 1 + v_h**2)
    across = (v_h - inner) / (v_h + inner)
    along = (1.5**2 * v_h - inner) / (1.5**2 * v_h + inner)
    fresnel = 0.5 * (across**2 + along**2)
    return fresnel / ((1 + _lambda(n_l, alpha)) * (1 + _lambda(n_v, alpha)))


def test_fitted_visibility_keeps_the_light_that_arrives() -> None:
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


def test_the_command_writes_rows_and_a_picture(monkeypatch, tmp_path: Path) -> None:
    template, made = Body.load(ASSETS / "body.npz"), dressing.dress
    monkeypatch.setattr(dressing, "dress", lambda who, step: made(who, 0.02, template))
    options = cli.Agreement(
        tmp_path / "rows.json", frame=1, size=64, samples=4, lights=("white", "rim"),
        picture=tmp_path / "sheet.png", variant="scalar_rgb",
    )  # fmt: skip
    cli._agreement(options)
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["body"], row["light"]) for row in rows] == [
        ("ball", "white"), ("ball", "rim"), ("person", "white"), ("person", "rim"),
    ]  # fmt: skip
    for row in rows:
        assert row["machine"] and row["variant"] == "scalar_rgb"
        assert (row["size"], row["samples"]) == (64, 4) and row["gaussians"] > 1000
        assert 10 < row["brute"]["psnr_inside"] < 60
    assert read_image(tmp_path / "sheet.png").shape == (2 * 64, 8 * 64, 3)
