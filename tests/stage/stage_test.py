"""The light stage: its physics against our own sum, its files against the capture format, parts against the whole."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.paths import ASSETS

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")

from rnd_runtime.capture.body import Body  # noqa: E402
from rnd_runtime.capture.capture import load_capture  # noqa: E402
from rnd_runtime.core.camera import Camera  # noqa: E402
from rnd_runtime.core.errors import InputError  # noqa: E402
from rnd_runtime.core.files import write_json  # noqa: E402
from rnd_runtime.core.gaussians import Gaussians  # noqa: E402
from rnd_runtime.core.images import read_image, srgb_to_linear, write_image  # noqa: E402
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle  # noqa: E402
from rnd_runtime.motion.motion import Motion, save_motion  # noqa: E402
from rnd_runtime.motion.skeleton import bone_transforms  # noqa: E402
from rnd_runtime.shading.light import Light, texel_directions  # noqa: E402
from rnd_runtime.shading.reference import shade_reference  # noqa: E402

mi.set_variant("scalar_rgb")

from rnd_bench.stability.processes import environment  # noqa: E402
from rnd_stage import cli, variants  # noqa: E402
from rnd_stage.film import estimates, film, lights, manifest, plan  # noqa: E402
from rnd_stage.film.cameras import ring_cameras  # noqa: E402
from rnd_stage.film.dances import dance  # noqa: E402
from rnd_stage.people import subjects  # noqa: E402
from rnd_stage.people.cloth import SKIN_GAP, Cloth, Drape  # noqa: E402
from rnd_stage.people.dressing import Wearer  # noqa: E402
from rnd_stage.render import RenderSet, Surface  # noqa: E402

ENERGY = 0.01  # relative; what is left is Fresnel's exact term against Schlick's, 7 % of the gloss under a white sky
SAME_SURFACE = 1e-6  # m: SuperLU gives the skinning weights of two processes apart by 2e-9
RECIPE = plan.Recipe(
    subject=0, frames=5, cameras=2, size=64, samples=9, lights=("red",), relight_cameras=1, step=0.018
)  # coarse: seconds, not minutes


@pytest.fixture(scope="module")
def production(tmp_path_factory) -> film.Production:
    """Twenty frames of the dance, five of which are filmed."""
    folder, body = tmp_path_factory.mktemp("recipe"), Body.load(ASSETS / "body.npz")
    whole = dance(body.skeleton)
    part = replace(whole, rotations=whole.rotations[60:80], translations=whole.translations[60:80])
    save_motion(folder / "part.npz", part)
    return film.prepare(replace(RECIPE, motion=str(folder / "part.npz")), folder, body)


@pytest.fixture(scope="module")
def filmed(production, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    film.film(production, folder, on_image=lambda name: None)
    assert manifest.finish(production, folder, "scalar_rgb", None)
    return folder


def ball(rings: int = 48) -> Surface:
    """A unit ball with true normals."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    index = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    points = points.reshape(-1, 3)
    return Surface(points, points, faces, np.tile([0.6, 0.5, 0.4], (len(points), 1)), np.full(len(points), 0.5))


@pytest.mark.parametrize("name", ["white", "split", "rainbow"])
def test_a_convex_body_has_the_energy_of_our_own_sum(name: str) -> None:
    light = next(light for light in lights.stage_lights() if light.name == name)
    eye = [0.0, 0, 40.0]  # far away: a pixel's rays are parallel, so its point follows from its place
    camera = Camera.look_at(eye, [0.0, 0, 0], width=64, height=64, fov_y=2 * np.arctan(1.0 / 40))
    theirs = RenderSet(ball()).radiance(camera, light.radiance, samples=36, seed=1)
    line = (np.arange(64) + 0.5) / 32 - 1
    x, y = np.meshgrid(line, -line)
    inside = x**2 + y**2 < 0.9
    points = np.stack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))], -1)[inside]
    count = len(points)
    seen = np.zeros((count, 16))
    seen[:, 0] = np.sqrt(4 * np.pi)
    gaussians = Gaussians(
        points,
        np.zeros((count, 6)),
        np.ones(count),
        points,
        np.tile([0.6, 0.5, 0.4], (count, 1)),
        np.full(count, 0.5),
        seen,
        np.eye(3),
    )
    ours = shade_reference(gaussians, Light(light.radiance), eye, texels=(64, 128))
    assert ours.mean() == pytest.approx(theirs[inside].mean(), rel=ENERGY)
    np.testing.assert_allclose(ours.mean(0), theirs[inside].mean(0), rtol=1.5 * ENERGY)


def test_cloth_is_seen_from_its_inside() -> None:
    """A sheet from behind: lit as from before, and its truth is that of the side that is seen."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces, matt = np.array([[0, 1, 2], [0, 2, 3]]), np.full(4, 0.9)
    sheet = Surface(corners, np.tile([0.0, 0, 1], (4, 1)), faces, np.full((4, 3), 0.5), matt)
    stage, sky = RenderSet(sheet), np.ones((16, 32, 3))
    pixels = []
    for z in (4.0, -4.0):
        camera = Camera.look_at([0.0, 0.5, z], [0.0, 0, 0], width=16, height=16, fov_y=0.4)
        pixels.append(stage.radiance(camera, sky, samples=16, seed=0).mean())
        truth = stage.truth(camera, samples=4, seed=0)
        assert (truth.normals[..., 2] < -0.95).all()
        towards = camera.world_to_camera[:3, :3].T @ [0, 0, -1]
        lit = stage.visibility(camera, np.array([towards, -towards]), truth.normals, samples=4, seed=0)
        assert lit[0].min() > 0.95 and lit[1].max() == 0
    assert pixels[1] == pytest.approx(pixels[0], rel=0.02) and pixels[0] > 0.4


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


def test_the_truth_beside_a_picture_is_true(filmed: Path) -> None:
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


def test_a_diffuse_estimate_explains_the_pictures(filmed: Path) -> None:
    """Albedo × irradiance × visibility, from disk alone, is the picture up to gloss and interreflection."""
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
        picture = srgb_to_linear(images.image_srgb[covered])
        assert 0.75 < predicted.mean() / picture.mean() < 1.05
        assert np.corrcoef(predicted.ravel(), picture.ravel())[0, 1] > 0.95


def test_two_processes_make_the_whole(filmed: Path, production, tmp_path: Path) -> None:
    """Side by side in one folder, through the command; whoever ends last writes the capture."""
    recipe = production.recipe
    command = [
        sys.executable,
        "-c",
        "from rnd_stage.cli import main; main()",
        str(tmp_path),
        "--variant",
        "scalar_rgb",
        "--motion",
        recipe.motion,
        "--frames",
        str(recipe.frames),
        "--cameras",
        str(recipe.cameras),
        "--size",
        str(recipe.size),
        "--samples",
        str(recipe.samples),
        "--lights",
        *recipe.lights,
        "--relight-cameras",
        str(recipe.relight_cameras),
        "--step",
        str(recipe.step),
    ]
    shards = [
        subprocess.Popen([*command, "--shard", f"{k}/2"], env=environment(), stderr=subprocess.PIPE) for k in range(2)
    ]
    said = [shard.communicate(timeout=300)[1].decode() for shard in shards]
    assert [shard.returncode for shard in shards] == [0, 0], said
    assert load_capture(tmp_path).frames
    pictures = [path for path in filmed.rglob("*") if path.suffix in (".png", ".exr")]
    assert len(pictures) > 40
    for path in pictures:
        assert path.read_bytes() == (tmp_path / path.relative_to(filmed)).read_bytes(), path
    for path in (filmed / "surface").iterdir():
        vertices = np.load(tmp_path / "surface" / path.name)["vertices"]
        np.testing.assert_allclose(vertices, np.load(path)["vertices"], atol=SAME_SURFACE)


def test_what_is_there_is_not_filmed_again(filmed: Path, production) -> None:
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


def test_who_filmed_a_capture_stays_where_nothing_was_filmed_since(filmed, production, tmp_path, monkeypatch) -> None:
    shutil.copytree(filmed, tmp_path / "again")
    folder, told = tmp_path / "again", ("capture.json", "README.md")
    assert manifest.finish(production, folder, "scalar_rgb", 1.25)
    before = {name: (folder / name).read_bytes() for name in told}
    monkeypatch.setattr(manifest, "machine", lambda: "another one")
    (folder / "contact.png").unlink()
    assert manifest.finish(production, folder, "llvm_ad_rgb", None)
    assert {name: (folder / name).read_bytes() for name in told} == before
    assert (folder / "contact.png").exists() and b"1.25 s of processor time" in before["README.md"]
    (folder / "README.md").unlink()
    assert manifest.finish(production, folder, "llvm_ad_rgb", None)
    assert "another one" in (folder / "README.md").read_text()
    assert (folder / "capture.json").read_bytes() == before["capture.json"]
    assert manifest.finish(production, folder, "llvm_ad_rgb", 0.5)
    assert json.loads((folder / "capture.json").read_text())["engine"]["variant"] == "llvm_ad_rgb"


def test_a_readmes_command_can_be_pasted(production) -> None:
    production = replace(production, recipe=replace(production.recipe, motion="my walk.npz", hdr=("a'b.exr",)))
    words = shlex.split(manifest._readme(production, "scalar_rgb", None).split("rnd-stage OUT")[1].split("\n")[0])
    assert words[words.index("--motion") + 1] == "my walk.npz" and words[words.index("--hdr") + 1] == "a'b.exr"
    assert words[words.index("--lights") + 1] == "red" and "--no-visibility" not in words


def test_a_recipes_files_may_lie_elsewhere_and_not_say_something_else(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "more").mkdir()
    for name in ("walk.npz", "more/dance.npz"):
        shutil.copy(ASSETS / "walk.npz", tmp_path / name)
    for name in ("sky.exr", "more/sky.exr", "more/dawn.exr"):
        write_image(tmp_path / name, np.ones((8, 16, 3), np.float32))
    for name in ("run.amc", "more/run.amc", "run.asf", "more/run.asf"):
        (tmp_path / name).write_text("the same")
    recipe = replace(RECIPE, motion="walk.npz", hdr=("sky.exr",))
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
    recipe, out = replace(RECIPE, motion="run.amc"), tmp_path / "out"
    write_json(out / film.RECIPE_FILE, film.recipe_for(recipe, out))
    film.recipe_for(replace(recipe, motion="more/run.amc"), out)
    (tmp_path / "more/run.asf").write_text("another")
    with pytest.raises(InputError, match=r"the same motion \(or"):
        film.recipe_for(replace(recipe, motion="more/run.amc"), out)


def test_another_recipe_is_refused_and_one_that_cannot_be_filmed_leaves_nothing(tmp_path: Path) -> None:
    template = Body.load(ASSETS / "body.npz")
    (tmp_path / "broken.npz").write_bytes(b"no motion")
    with pytest.raises(InputError, match="broken"):
        film.prepare(replace(RECIPE, motion=str(tmp_path / "broken.npz")), tmp_path / "out", template)
    assert not (tmp_path / "out" / film.RECIPE_FILE).exists()
    film.prepare(RECIPE, tmp_path / "out", template)
    film.prepare(RECIPE, tmp_path / "out", template)
    assert json.loads((tmp_path / "out" / film.RECIPE_FILE).read_text())["samples"] == 9
    with pytest.raises(InputError, match="samples"):
        film.prepare(replace(RECIPE, samples=10), tmp_path / "out", template)


def test_a_replaced_file_is_refused(tmp_path: Path) -> None:
    """By its digest, or, where an older recipe has none, by the map of its light that pictures were lit by."""
    sky, out, texels = tmp_path / "sky.exr", tmp_path / "out", np.ones((8, 16, 3), np.float32)
    shutil.copy(ASSETS / "walk.npz", tmp_path / "walk.npz")
    recipe = replace(RECIPE, motion=str(tmp_path / "walk.npz"), hdr=(str(sky),))
    write_image(sky, texels)
    write_json(out / film.RECIPE_FILE, film.recipe_for(recipe, out))
    write_image(out / "lights/sky.exr", texels)
    written = film.recipe_for(recipe, out)
    film._refuse_other_lights(film._chosen(recipe), out)
    texels[:2] = 9
    write_image(sky, texels)
    shutil.copy(ASSETS / "avatar.onnx", tmp_path / "walk.npz")
    with pytest.raises(InputError, match=r"stage.json: .*content of \S*walk.npz, content of \S*sky.exr \(or"):
        film.prepare(recipe, out)
    del written["sha256"]
    write_json(out / film.RECIPE_FILE, written)
    with pytest.raises(InputError, match=r"lights/sky.exr: holds another light"):
        film.prepare(recipe, out)
    assert json.loads((out / film.RECIPE_FILE).read_text()) == written


@pytest.mark.parametrize("text", ["[]", "3", '{"sha256": 1}', "{"])
def test_a_recipe_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / film.RECIPE_FILE).write_text(text)
    with pytest.raises(InputError, match=r"stage.json: not a recipe"):
        film.recipe_for(RECIPE, tmp_path)


@pytest.mark.parametrize("change", [{"frames": 4}, {"cameras": 0}, {"size": 8}, {"max_depth": 1}, {"step": 0.5}])
def test_impossible_recipes_are_refused(change: dict) -> None:
    with pytest.raises(InputError):
        replace(RECIPE, **change).check()


def test_the_captures_name_is_printed_as_it_is(production, monkeypatch, capsys) -> None:
    monkeypatch.setattr(film, "prepare", lambda recipe, out: production)
    monkeypatch.setattr(manifest, "finish", lambda *_: True)
    monkeypatch.setattr(cli, "_film_with_progress", lambda *_: None)
    cli._stage(cli.StageOptions(Path("out[x]"), variant="scalar_rgb"))
    assert "out[x]/capture.json: " in capsys.readouterr().err


@pytest.mark.parametrize("text", ["1", "2/2", "a/b", "-1/2", "1/0", f"1/{'9' * 5000}"])
def test_bad_shards_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="--shard"):
        cli.parse_shard(text)
    assert cli.parse_shard("1/3") == (1, 3)


def test_unknown_lights_are_refused() -> None:
    with pytest.raises(InputError, match="--lights"):
        film._chosen(replace(RECIPE, lights=("mauve",)))


def test_there_are_nineteen_modules_eight_colours_and_a_white_light() -> None:
    assert lights.module_directions().shape == (19, 3)
    made = lights.stage_lights()
    assert made[0].name == "white" and len(made) == 9
    directions = texel_directions(64, 128).reshape(-1, 3)
    nearest = (directions @ lights.module_directions().T).argmax(0)
    white = made[0].file_radiance.reshape(-1, 3)
    assert (white[nearest] > 0.9).all()  # a peak of one at every module
    for light in made:
        mean = Light(light.radiance).mean_radiance
        assert mean.max() == pytest.approx(lights.EXPOSURE, rel=1e-5)
    colours = np.array([Light(light.radiance).mean_radiance for light in made])
    apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1) + np.eye(9)
    patterns = np.array([light.radiance.ravel() / light.radiance.max() for light in made])
    assert apart.min() > 0.02 and np.abs(np.corrcoef(patterns) - np.eye(9)).max() < 0.99


def test_cameras_stand_on_three_rings_and_see_the_whole_person() -> None:
    cameras = ring_cameras(30, 128)
    assert len(cameras) == 30
    heights = {round(float(camera.position[1]), 3) for camera in cameras.values()}
    assert len(heights) == 3
    assert abs(cameras["cam00"].position[0]) < 1e-9 and cameras["cam00"].position[2] > 4
    places = np.array([camera.position for camera in cameras.values()])
    assert min(np.linalg.norm(a - b) for i, a in enumerate(places) for b in places[:i]) > 0.3
    for camera in cameras.values():
        for point in ([0, 0, 0], [0, 1.8, 0], [0.6, 1.8, 0], [-0.6, 1.8, 0.2]):
            pixel = camera.K @ (camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3])
            assert (pixel[:2] / pixel[2] > 0).all() and (pixel[:2] / pixel[2] < 128).all()
    assert len(ring_cameras(1, 16)) == 1


def test_estimates_are_the_truth_at_strength_zero_and_the_same_for_a_seed(production) -> None:
    rng = np.random.default_rng(0)
    normals = np.zeros((64, 64, 3))
    normals[..., 2] = -1
    coverage = np.zeros((64, 64))
    coverage[16:48, 20:44] = 1
    np.testing.assert_allclose(
        estimates.estimated_normals(normals, coverage, 1, 0.0)[coverage > 0], normals[coverage > 0], atol=1e-6
    )
    np.testing.assert_array_equal(estimates.estimated_mask(coverage, 1, 0.0), coverage)
    motion = production.motion
    still = estimates.estimated_motion(motion, 1, 0.0)
    np.testing.assert_allclose(still.rotations, motion.rotations, atol=1e-12)
    a, b, c = (estimates.estimated_normals(normals, coverage, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.05
    angle = np.degrees(np.arccos(np.clip(-a[coverage > 0][:, 2], -1, 1)))
    assert 3 < angle.mean() < 20
    mask = estimates.estimated_mask(np.kron(coverage, np.ones((8, 8))), 1)
    truth = np.kron(coverage, np.ones((8, 8))) > 0.5
    iou = ((mask > 0.5) & truth).sum() / ((mask > 0.5) | truth).sum()
    assert 0.9 < iou < 0.995
    drift = estimates.estimated_motion(motion, 1).translations - motion.translations
    assert 0.002 < drift.std() < 0.04
    assert not np.array_equal(drift, rng.normal(size=drift.shape))


def test_people_differ() -> None:
    people = [subjects.subject(seed) for seed in range(6)]
    assert len({person.title for person in people}) == 6
    assert len({person.palette.top.kind for person in people[:4]}) == 4
    points = Body.load(ASSETS / "body.npz").vertices
    shapes = np.array([person.shape.warp(points) for person in people])
    assert np.ptp(shapes[:4, :, 1].max(axis=1)) > 0.05  # heights
    assert subjects.subject(17) == subjects.subject(17) != subjects.subject(18)
    with pytest.raises(InputError, match="--subject"):
        subjects.subject(-1)


def sheet() -> tuple[np.ndarray, np.ndarray, np.ndarray, Drape]:
    """A square of cloth, 20 cm wide, lying 2 cm above the plane that carries it."""
    x, z = np.meshgrid(np.arange(-0.1, 0.1, 0.008), np.arange(-0.1, 0.1, 0.008))
    points = np.stack([x.ravel(), np.full(x.size, 0.02), z.ravel()], axis=1)
    count = len(points)
    drape = Drape(
        np.full(count, 0.05),
        np.full(count, 0.02),
        np.full(count, 0.04),
        np.ones(count, np.int64),
        np.zeros(count, bool),
    )
    return points, np.tile([0.0, 1, 0], (count, 1)), np.ones((count, 1)), drape


def moving(positions: np.ndarray) -> np.ndarray:
    bones = np.zeros((len(positions), 1, 3, 4), np.float32)
    bones[:, :, :, :3] = np.eye(3)
    bones[:, 0, :, 3] = positions
    return bones


def test_cloth_remembers_and_stays_out_of_the_body() -> None:
    from rnd_stage.people.cloth import Capsules

    points, normals, weights, drape = sheet()
    none = Capsules(np.zeros(0, np.int64), np.zeros((0, 2, 3)), np.zeros(0))
    cloth = Cloth(points, normals, weights, drape, none)
    still, swung = np.zeros((30, 3)), np.zeros((30, 3))
    swung[:, 0] = 0.3 * np.sin(np.arange(30) / 29 * 2 * np.pi)  # ends where the other stands
    a = cloth.simulate(moving(still), 30.0, [29])[29]
    b = cloth.simulate(moving(swung), 30.0, [29])[29]
    assert np.linalg.norm(a - b, axis=1).max() > 0.003  # the same pose, another history
    for moved in (a, b):
        assert (moved[:, 1] > -(0.02 - SKIN_GAP) - 1e-6).all()
        assert (np.linalg.norm(moved, axis=1) < 0.05 + 1e-9).all()
    np.testing.assert_array_equal(b, cloth.simulate(moving(swung), 30.0, [29])[29])
    assert a[:, 1].mean() < -0.005  # it sags onto what is below


def test_a_leg_that_comes_through_a_skirt_lifts_it_and_does_not_tear_it() -> None:
    """A leg rises faster than cloth falls aside: its axis is above the sheet, which still ends up over the leg."""
    from rnd_stage.people.cloth import Capsules

    points, normals, weights, drape = sheet()
    weights = np.concatenate([weights, 0 * weights], axis=1)
    drape = replace(drape, radius=np.full(len(points), 0.2), hangs=np.ones(len(points), bool))
    leg = Capsules(np.array([1]), np.array([[[0.003, -0.2, -0.3], [0.003, -0.2, 0.3]]]), np.array([0.05]))
    bones = np.concatenate([moving(np.zeros((20, 3)))] * 2, axis=1)
    bones[:, 1, 1, 3] = np.clip(np.arange(20) / 4, 0, 1) * 0.23  # to 1 cm above the sheet
    cloth = Cloth(points, normals, weights, drape, leg)
    moved = cloth.rest + cloth.simulate(bones, 30.0, [19])[19]
    over = np.abs(cloth.rest[:, 0]) < 0.03
    assert (moved[over, 1] > 0.05).all()
    pairs, lengths, _ = cloth.springs
    near = lengths < 0.019
    stretch = np.linalg.norm(moved[pairs[:, 0]] - moved[pairs[:, 1]], axis=1)[near] / lengths[near]
    assert stretch.max() < 2.5


def test_clothes_fold_with_the_pose(production) -> None:
    """The filmed shirt is off its skinned place, differently in different frames, and never far."""
    wearer = Wearer(production.dressed, production.motion, production.frames[:3])
    moves = [wearer._moves[frame] for frame in production.frames[:3]]
    for move in moves:
        assert 0.001 < np.linalg.norm(move, axis=1).mean() < 0.03
    assert np.linalg.norm(moves[0] - moves[2], axis=1).mean() > 0.001


def test_the_template_is_the_unclothed_body(production) -> None:
    """The capture's template, posed, lies inside the filmed surface: its clothes stand off, they do not sink in."""
    from scipy.spatial import cKDTree

    body, frame = production.dressed.body, production.frames[0]
    bones = bone_transforms(body.skeleton, production.motion.rotations[frame], production.motion.translations[frame])
    blend = np.tensordot(body.skinning_weights, bones, axes=1)
    posed = np.einsum("vij,vj->vi", blend[:, :, :3], body.vertices) + blend[:, :, 3]
    wearer = Wearer(production.dressed, production.motion, [frame])
    surface = wearer.surface(frame)
    _, nearest = cKDTree(surface.vertices).query(posed)
    outside = np.sum((posed - surface.vertices[nearest]) * surface.normals[nearest], axis=1)
    assert np.quantile(outside, 0.95) < 0.006  # m; an 18 mm mesh cuts off fingers, nose and toes


def test_an_llvm_that_does_not_work_is_not_used(monkeypatch, tmp_path: Path) -> None:
    broken = tmp_path / "libLLVM-99.so"
    broken.write_bytes(b"no library")
    monkeypatch.setenv(variants.LIBRARY_VARIABLE, str(broken))
    assert not variants._renders(str(broken))
    monkeypatch.setattr(variants, "_renders", lambda library: False)
    assert variants.use_variant("auto") == "scalar_rgb"
    with pytest.raises(InputError, match="LLVM"):
        variants.use_variant("llvm_ad_rgb")


def test_the_first_working_llvm_is_chosen(monkeypatch) -> None:
    monkeypatch.setattr(variants, "_candidates", lambda: iter(["old", "good", "other"]))
    monkeypatch.setattr(variants, "_renders", lambda library: library != "old")
    assert variants.working_llvm() == "good"


def test_a_turned_light_turns_the_picture() -> None:
    """The footlight shines from below: the ball's lower half is brighter; the red light from the person's left (+X)."""
    camera = Camera.look_at([0.0, 0, 6], [0.0, 0, 0], width=16, height=16, fov_y=0.35)
    stage = RenderSet(ball(16))
    by_name = {light.name: light for light in lights.stage_lights()}
    foot = stage.radiance(camera, by_name["footlight"].radiance, samples=16, seed=0)[..., 0]
    assert foot[9:].mean() > 2 * foot[:7].mean()
    red = stage.radiance(camera, by_name["red"].radiance, samples=16, seed=0)[..., 0]
    assert red[:, 9:].mean() > 1.3 * red[:, :7].mean()  # seen from +Z, +X is right
    turned = axis_angle_to_matrix([0.0, np.pi, 0.0])
    behind = Camera.look_at((turned @ [0, 0, 6]).tolist(), [0.0, 0, 0], width=16, height=16, fov_y=0.35)
    red = stage.radiance(behind, by_name["red"].radiance, samples=16, seed=0)[..., 0]
    assert red[:, :7].mean() > 1.3 * red[:, 9:].mean()


def test_the_benchmark_trains_scores_and_does_nothing_twice(filmed: Path, tmp_path: Path, monkeypatch) -> None:
    from rnd_bench.studies import stage_people as benchmark

    monkeypatch.setattr(benchmark, "METHODS", ("ours",))
    (tmp_path / "subject0").symlink_to(filmed)
    cost = {"pictures": 11, "seconds": 22.0, "cpu_seconds": 33.0, "variant": "scalar_rgb"}
    (filmed / benchmark.COST_FILE).write_text(json.dumps(cost))
    options = plan.BenchmarkOptions(subjects=1, seeds=1, steps=4, gaussians=400)
    result = benchmark.run_benchmark(options, tmp_path, perceptual=None, on_run=lambda *told: None)
    assert {row["split"] for row in result["rows"]} >= {"novel_view", "novel_pose", "relight"}
    assert all(row["subject"] == 0 and row["method"] == "ours" for row in result["rows"])
    assert result["cost"]["seconds_per_picture"] == pytest.approx(2.0)
    assert result["cost"]["cpu_seconds_per_image"] == pytest.approx(3.0)
    again = benchmark.run_benchmark(options, tmp_path, perceptual=None, on_run=lambda *told: None)
    assert again["rows"] == result["rows"]
