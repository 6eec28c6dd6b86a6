"""The capture that rnd-stage writes: its splits, its truth, shards, and what it resumes or refuses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from support.paths import ASSETS

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")
mi.set_variant("scalar_rgb")

from rnd_bench.stability.processes import environment  # noqa: E402
from rnd_runtime.capture.body import Body  # noqa: E402
from rnd_runtime.capture.capture import load_capture  # noqa: E402
from rnd_runtime.capture.format import Split  # noqa: E402
from rnd_runtime.core.errors import InputError, flag  # noqa: E402
from rnd_runtime.core.files import write_json  # noqa: E402
from rnd_runtime.core.images import read_image, srgb_to_linear, write_image  # noqa: E402
from rnd_runtime.core.rotations import matrix_to_axis_angle  # noqa: E402
from rnd_runtime.motion.motion import Motion  # noqa: E402
from rnd_stage import cli  # noqa: E402
from rnd_stage.film import film, lights, manifest, plan  # noqa: E402

pytestmark = pytest.mark.slow
SAME_SURFACE = 1e-6  # m: SuperLU gives the skinning weights of two processes apart by 2e-9


def test_the_capture_is_one(filmed: Path, production) -> None:
    capture = load_capture(filmed)
    splits = {name: capture.split(name) for name in ("train", "novel_view", "novel_pose", "relight")}
    assert {name: len(frames) for name, frames in splits.items()} == {
        "train": 4,
        "novel_view": 4,
        "novel_pose": 2,
        "relight": 1,
    }
    assert {f.camera for f in splits["train"]} == {"cam00"} and {f.light for f in splits["train"]} == {"white"}
    assert {f.frame for f in splits["novel_view"]} == {f.frame for f in splits["train"]}
    assert min(f.frame for f in splits["novel_pose"]) > max(f.frame for f in splits["train"])
    assert {f.light for f in splits["relight"]} == {"red"}
    assert (filmed / "contact.png").exists() and "rnd-stage" in (filmed / "README.md").read_text()
    exact, estimated = capture.motion, load_capture(filmed / manifest.ESTIMATED).motion
    assert 0.5 < np.degrees(np.abs(matrix_to_axis_angle(_relative(exact, estimated))).mean()) < 4


def _relative(a: Motion, b: Motion) -> np.ndarray:
    return np.swapaxes(a.rotations, -1, -2) @ b.rotations


def test_the_truth_beside_an_image_is_true(filmed: Path) -> None:
    capture = load_capture(filmed)
    for frame in capture.split("train"):
        place, images = f"{frame.camera}_{frame.frame:06d}", capture.load_frame(frame)
        covered = images.mask > 0.99
        assert (images.normal_gt[covered][:, 2] < 0).mean() > 0.98
        camera = capture.cameras[frame.camera]
        vertices = np.load(filmed / f"surface/{frame.frame:06d}.npz")["vertices"]
        seen = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        depth = read_image(filmed / f"depth/{place}.exr")[..., 0]
        assert seen[:, 2].min() - 0.02 < depth[covered].min() and depth[covered].max() < seen[:, 2].max() + 0.02
        pixels = seen @ camera.K.T
        low, high = (pixels[:, :2] / pixels[:, 2:]).min(0), (pixels[:, :2] / pixels[:, 2:]).max(0)
        rows, columns = np.nonzero(images.mask > 0.5)
        np.testing.assert_allclose([columns.min(), rows.min()], low, atol=1.5)
        np.testing.assert_allclose([columns.max() + 1, rows.max() + 1], high, atol=1.5)
        visibility = np.load(filmed / f"visibility/{place}.npz")["visibility"] / 255.0
        d = lights.module_directions()
        world = images.normal_gt[covered] @ camera.world_to_camera[:3, :3]
        facing = world @ d.T > 0.5
        assert 0.7 < visibility[:, covered].T[facing].mean() < 1.0  # a body shadows itself a little
        assert visibility[:, covered].T[world @ d.T < -0.1].max() == 0.0


def test_a_diffuse_estimate_explains_the_images(filmed: Path) -> None:
    """Albedo × irradiance × visibility, from disk alone, is the image up to specular and interreflection."""
    capture = load_capture(filmed)
    d, amplitudes = lights.module_directions(), np.ones((19, 3))
    for frame in capture.split("train"):
        images = capture.load_frame(frame)
        place = f"{frame.camera}_{frame.frame:06d}"
        covered = images.mask > 0.99
        seen = np.load(filmed / f"visibility/{place}.npz")["visibility"][:, covered] / 255.0
        world = images.normal_gt[covered] @ capture.cameras[frame.camera].world_to_camera[:3, :3]
        flux = 2 * np.pi / lights.SHARPNESS * amplitudes * capture.lights["white"].scale[0]
        irradiance = (np.maximum(world @ d.T, 0) * seen.T) @ flux
        predicted = srgb_to_linear(images.albedo_srgb[covered]) * irradiance / np.pi
        image = srgb_to_linear(images.image_srgb[covered])
        assert 0.75 < predicted.mean() / image.mean() < 1.05
        assert np.corrcoef(predicted.ravel(), image.ravel())[0, 1] > 0.95


def test_two_processes_render_the_same(filmed: Path, production, tmp_path: Path) -> None:
    """Side by side in one folder, through the command; the last to end writes the capture."""
    recipe = production.recipe
    names = ("motion", "frames", "cameras", "size", "samples", "relight_cameras", "step")
    options = [word for name in names for word in (flag(name), str(getattr(recipe, name)))]
    code = "import sys; from rnd_stage.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, str(tmp_path), "--variant", "scalar_rgb", *options]
    command += ["--lights", *recipe.lights]
    shards = [
        subprocess.Popen([*command, "--shard", f"{k}/2"], env=environment(), stderr=subprocess.PIPE) for k in range(2)
    ]
    errors = [shard.communicate(timeout=300)[1].decode() for shard in shards]
    assert [shard.returncode for shard in shards] == [0, 0], errors
    assert load_capture(tmp_path).frames
    images = [path for path in filmed.rglob("*") if path.suffix in (".png", ".exr")]
    assert len(images) > 40
    for path in images:
        assert path.read_bytes() == (tmp_path / path.relative_to(filmed)).read_bytes(), path
    for path in (filmed / "surface").iterdir():
        vertices = np.load(tmp_path / "surface" / path.name)["vertices"]
        np.testing.assert_allclose(vertices, np.load(path)["vertices"], atol=SAME_SURFACE)


def test_existing_images_are_not_rendered_again(filmed: Path, production) -> None:
    lost = filmed / production.views[0].image("white")
    before = lost.read_bytes()
    times = {path: path.stat().st_mtime_ns for path in filmed.rglob("*.png")}
    lost.unlink()
    named: list[str] = []
    film.film(production, filmed, on_image=named.append)
    assert lost.read_bytes() == before
    assert len(named) == plan.image_count(production.views)
    kept = [path for path, time in times.items() if path.stat().st_mtime_ns == time]
    assert len(times) - len(kept) == len(production.views[0].truth_files(False))  # the one view's PNGs and its picture


def test_a_recipes_files_may_be_elsewhere_and_not_differ(recipe, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "more").mkdir()
    for name in ("walk.npz", "more/dance.npz"):
        shutil.copy(ASSETS / "walk.npz", tmp_path / name)
    for name in ("sky.exr", "more/sky.exr", "more/dawn.exr"):
        write_image(tmp_path / name, np.ones((8, 16, 3), np.float32))
    for name in ("run.amc", "more/run.amc", "run.asf", "more/run.asf"):
        (tmp_path / name).write_text("the same")
    small, recipe = recipe, replace(recipe, motion="walk.npz", hdr=("sky.exr",))
    write_json(tmp_path / film.RECIPE_FILE, film.recipe_for(recipe, tmp_path))
    for motion in ("./walk.npz", str(tmp_path / "walk.npz"), "more/dance.npz"):
        film.recipe_for(replace(recipe, motion=motion, hdr=("more/sky.exr",)), tmp_path)
    for change, said in (
        ({"motion": "sky.exr"}, "motion"),
        ({"motion": None}, "motion"),
        ({"hdr": ("more/dawn.exr",)}, "hdr"),  # its light would be called otherwise
        ({"hdr": ("sky.exr", "more/dawn.exr")}, "hdr"),
        ({"motion": "./walk.npz", "samples": 10}, "samples"),
    ):
        with pytest.raises(InputError, match=f"holds another recipe: expected the same {said} \\(or another OUT"):
            film.recipe_for(replace(recipe, **change), tmp_path)
    recipe, out = replace(small, motion="run.amc"), tmp_path / "out"
    write_json(out / film.RECIPE_FILE, film.recipe_for(recipe, out))
    film.recipe_for(replace(recipe, motion="more/run.amc"), out)
    (tmp_path / "more/run.asf").write_text("another")
    with pytest.raises(InputError, match=r"the same motion \(or"):
        film.recipe_for(replace(recipe, motion="more/run.amc"), out)


def test_another_recipe_is_refused_and_an_unusable_one_leaves_nothing(recipe, tmp_path: Path) -> None:
    template = Body.load(ASSETS / "body.npz")
    (tmp_path / "broken.npz").write_bytes(b"no motion")
    with pytest.raises(InputError, match="broken"):
        film.prepare(replace(recipe, motion=str(tmp_path / "broken.npz")), tmp_path / "out", template)
    assert not (tmp_path / "out" / film.RECIPE_FILE).exists()
    film.prepare(recipe, tmp_path / "out", template)
    film.prepare(recipe, tmp_path / "out", template)
    assert json.loads((tmp_path / "out" / film.RECIPE_FILE).read_text())["samples"] == 9
    with pytest.raises(InputError, match="samples"):
        film.prepare(replace(recipe, samples=10), tmp_path / "out", template)


def test_a_replaced_file_is_refused(recipe, tmp_path: Path) -> None:
    sky, out, texels = tmp_path / "sky.exr", tmp_path / "out", np.ones((8, 16, 3), np.float32)
    shutil.copy(ASSETS / "walk.npz", tmp_path / "walk.npz")
    recipe = replace(recipe, motion=str(tmp_path / "walk.npz"), hdr=(str(sky),))
    write_image(sky, texels)
    written = film.recipe_for(recipe, out)
    write_json(out / film.RECIPE_FILE, written)
    write_image(sky, 9 * texels)
    shutil.copy(ASSETS / "avatar.onnx", tmp_path / "walk.npz")
    with pytest.raises(InputError, match=r"stage.json: .*content of \S*walk.npz, content of \S*sky.exr \(or"):
        film.prepare(recipe, out)
    assert json.loads((out / film.RECIPE_FILE).read_text()) == written


@pytest.mark.parametrize("text", ["[]", "3", '{"sha256": 1}', "{"])
def test_a_recipe_that_is_none_is_refused(recipe, tmp_path: Path, text: str) -> None:
    (tmp_path / film.RECIPE_FILE).write_text(text)
    with pytest.raises(InputError, match=r"stage.json: not a recipe"):
        film.recipe_for(recipe, tmp_path)


@pytest.mark.parametrize("change", [{"frames": 4}, {"cameras": 0}, {"size": 8}, {"max_depth": 1}, {"step": 0.5}])
def test_impossible_recipes_are_refused(recipe, change: dict) -> None:
    with pytest.raises(InputError):
        replace(recipe, **change).check()


@pytest.mark.parametrize("text", ["1", "2/2", "a/b", "-1/2", "1/0", f"1/{'9' * 5000}"])
def test_bad_shards_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="--shard"):
        cli.parse_shard(text)
    assert cli.parse_shard("1/3") == (1, 3)


def test_unknown_lights_are_refused(recipe) -> None:
    with pytest.raises(InputError, match="--lights"):
        film._chosen(replace(recipe, lights=("mauve",)))
    with pytest.raises(InputError, match="--train-lights"):
        film._chosen(replace(recipe, train_lights=("mauve",)))


def test_training_lights_take_turns_and_none_of_them_relights(recipe) -> None:
    two = replace(recipe, train_lights=("red", "white"), lights=("green",))
    assert {light.name for light in film._chosen(two)} == {"red", "white", "green"}
    views = plan.plan(two, [0, 1, 2, 3, 4], ["cam00", "cam01"], ["white", "red", "green"])
    used = {split: [light for view in views for name, light in view.uses if name == split] for split in get_args(Split)}
    assert used["train"] == used["novel_view"] == ["red", "white", "red", "white"]
    assert used["novel_pose"] == ["red"] * 2 and used["relight"] == ["green"]
