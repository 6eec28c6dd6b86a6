"""Rendering of a recipe into a folder, resumable and in shards."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file, output_folder, sha256_of, write_json
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.core.npz import save_npz
from rnd_runtime.motion.motion import Motion, load_motion, motion_inputs
from rnd_stage.people.dressing import Dressed, Wearer
from rnd_stage.render import MASK_FLOOR, RenderSet, Truth

from . import plan as plans
from .cameras import VISIBLE_HEIGHT, ring_cameras
from .dances import dance
from .estimates import estimated_mask, estimated_normals
from .lights import StageLight, module_directions, stage_lights
from .plan import Recipe, View

Floats = NDArray[np.float64]

RECIPE_FILE = "stage.json"
TRUTH_SAMPLES = 16  # ground truth has noise at edges alone
VISIBILITY_SAMPLES = 16
FINEST, COARSEST = 0.003, 0.007  # m between a dressed surface's vertices


@dataclass
class Production:
    """A recipe with all its files loaded."""

    recipe: Recipe
    dressed: Dressed
    title: str
    motion: Motion
    frames: list[int]
    lights: list[StageLight]
    views: list[View]

    @property
    def cameras(self):
        return ring_cameras(self.recipe.cameras, self.recipe.size)


def prepare(recipe: Recipe, folder: Path, template: Body | None = None) -> Production:
    """Load and dress the parts of ``recipe``; a folder with another recipe's images is refused.

    ``template`` as in ``.dressing.dress``.
    """
    recipe.check()
    lights = _chosen(recipe)
    for what, file in (("motion", recipe.motion), ("character", recipe.character)):
        if file is not None:
            existing_file(Path(file), what=what)
    mine = recipe_for(recipe, folder)
    dressed, title = _cast(recipe, template)
    motion = dance(dressed.body.skeleton)
    if recipe.motion is not None:
        motion = load_motion(recipe.motion, dressed.body.skeleton)
    middle = np.median(motion.translations, axis=0) * [1, 0, 1]
    motion = replace(motion, translations=motion.translations - middle)
    frames = plans.instants(recipe, motion.frame_count)
    if len(frames) < 5:
        raise InputError("motion", expected="at least 5 frames", got=motion.frame_count, file=motion.source)
    write_json(folder / RECIPE_FILE, mine)
    names = [light.name for light in lights]
    views = plans.plan(recipe, frames, list(ring_cameras(recipe.cameras, recipe.size)), names)
    return Production(recipe, dressed, title, motion, frames, lights, views)


def film(
    production: Production, folder: Path, *, shard: tuple[int, int] = (0, 1), on_image: Callable[[str], None]
) -> float:
    """Render the missing images of shard (k, n), the instants with number k modulo n; return the processor seconds.

    ``on_image`` is called with the name of each image, rendered or found.
    """
    part, parts = shard
    own = set(production.frames[part::parts])
    todo = [view for view in production.views if view.frame in own]
    missing = [view for view in todo if plans.missing(folder, view, production.recipe.visibility)]
    for light in production.lights:
        file = folder / f"lights/{light.name}.exr"
        if not file.exists():
            write_image(file, light.file_radiance)
    for view in todo:
        if view not in missing:
            for _, name in view.uses:
                on_image(view.image(name))
    if not missing:
        return 0.0
    recipe, started = production.recipe, time.process_time()
    wearer = Wearer(production.dressed, production.motion, sorted({view.frame for view in missing}))
    for frame in sorted({view.frame for view in missing}):
        stage = RenderSet(wearer.surface(frame), max_depth=recipe.max_depth, material=recipe.material)
        save_npz(folder / f"surface/{frame:06d}.npz", {"vertices": stage.surface.vertices.astype(np.float32)})
        for view in missing:
            if view.frame == frame:
                _render_view(production, stage, view, folder)
                for _, name in view.uses:
                    on_image(view.image(name))
    return time.process_time() - started


def _render_view(production: Production, stage: RenderSet, view: View, folder: Path) -> None:
    """Ground truth and images of one camera at one instant."""
    recipe, camera = production.recipe, production.cameras[view.camera]
    numbers = {light.name: k for k, light in enumerate(production.lights)}
    seed = 1000 * view.frame + 31 * int(view.camera[3:])
    truth = stage.truth(camera, samples=TRUTH_SAMPLES, seed=seed)
    _write_truth(folder, view, truth, recipe)
    if recipe.visibility and view.camera == plans.TRAIN_CAMERA:
        seen = stage.visibility(camera, module_directions(), truth.normals, samples=VISIBILITY_SAMPLES, seed=seed)
        save_npz(folder / f"visibility/{view.name}.npz", {"visibility": to_bytes(seen)})
    for _, name in view.uses:
        light = production.lights[numbers[name]]
        radiance = stage.radiance(
            camera, light.radiance, samples=recipe.samples, seed=seed + 7919 * (1 + numbers[name])
        )
        write_image(folder / view.image(name), to_bytes(linear_to_srgb(np.clip(radiance, 0, 1))))


def _write_truth(folder: Path, view: View, truth: Truth, recipe: Recipe) -> None:
    name, covered = view.name, (truth.coverage >= MASK_FLOOR)[..., None]
    write_image(folder / f"masks/{name}.png", to_bytes(truth.coverage))
    write_image(folder / f"normals_gt/{name}.png", to_bytes(0.5 * (truth.normals + 1) * covered))
    write_image(folder / f"albedo/{name}.png", to_bytes(linear_to_srgb(np.clip(truth.albedo, 0, 1))))
    write_image(folder / f"roughness/{name}.png", to_bytes(truth.roughness))
    write_image(folder / f"depth/{name}.exr", truth.depth.astype(np.float32), channel_names=("Z",))
    if view.trains:
        seed, strength = recipe.estimate_seed + 1000 * view.frame, recipe.estimate_strength
        normals = estimated_normals(truth.normals, truth.coverage, seed, strength)
        write_image(folder / f"normals/{name}.png", to_bytes(0.5 * (normals + 1) * covered))
        mask = estimated_mask(truth.coverage, seed, strength)
        write_image(folder / f"masks_estimated/{name}.png", to_bytes(mask))


def recipe_for(recipe: Recipe, folder: Path) -> dict[str, Any]:
    """The recipe as JSON with the digests of its files; a folder with images of another recipe or files is refused."""
    file = output_folder(folder) / RECIPE_FILE
    mine = json.loads(json.dumps(asdict(recipe)))
    motion = [] if recipe.motion is None else map(str, motion_inputs(recipe.motion))
    named = [*motion, *recipe.hdr, *([] if recipe.character is None else [recipe.character])]
    digests = {name: sha256_of(name) for name in named}
    if file.exists():
        theirs = json.loads(json.dumps(asdict(Recipe()))) | _recipe_in(file)
        earlier = theirs["sha256"]
        different = sorted(
            key
            for key in mine
            if theirs.get(key) != mine[key] and _content(theirs, key, earlier) != _content(mine, key, digests)
        )
        different += [f"content of {name}" for name in digests if earlier.get(name, digests[name]) != digests[name]]
        if different:
            raise InputError(
                "holds another recipe", expected=f"the same {', '.join(different)}", file=file, hint="or another OUT"
            )
    return mine | {"sha256": digests}


def _content(recipe: dict[str, Any], key: str, digests: dict[str, Any]) -> object:
    """The value of a recipe's ``key``; for files their digests, for lights and people also their names.

    A motion may have an .asf beside it.
    """
    value = recipe.get(key)
    known = {Path(name): digest for name, digest in digests.items()}
    files = [Path(name) for name in (value if isinstance(value, list) else [value]) if isinstance(name, str)]
    if not files or not all(file in known for file in files):
        return value
    if key != "motion":
        return [(file.stem, known[file]) for file in files]
    return [digest for file, digest in known.items() if file in files or file.suffix.lower() == ".asf"]


def _recipe_in(file: Path) -> dict[str, Any]:
    try:
        recipe = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError("not a recipe", got=str(error), file=file) from error
    if not (isinstance(recipe, dict) and isinstance(recipe.get("sha256"), dict)):
        raise InputError("not a recipe", expected="an object as rnd-stage writes it", file=file)
    return recipe


def _cast(recipe: Recipe, template: Body | None) -> tuple[Dressed, str]:
    if recipe.character is not None:
        from rnd_stage.people.characters import load_character

        return load_character(Path(recipe.character)), Path(recipe.character).stem
    from rnd_stage.people.dressing import dress
    from rnd_stage.people.subjects import subject

    person = subject(recipe.subject)
    step = float(np.clip(0.7 * VISIBLE_HEIGHT / recipe.size, FINEST, COARSEST)) if recipe.step is None else recipe.step
    return dress(person, step, template), person.title


def _chosen(recipe: Recipe) -> list[StageLight]:
    lights = stage_lights(tuple(Path(name) for name in recipe.hdr))
    names = [light.name for light in lights]
    for what, chosen in (("--lights", recipe.lights), ("--train-lights", recipe.train_lights)):
        unknown = [name for name in chosen if name not in names]
        if unknown:
            raise InputError(what, expected=", ".join(names), got=", ".join(unknown))
    given = {Path(name).stem for name in recipe.hdr}
    wanted = {*recipe.train_lights, *given, *(recipe.lights or names)}
    return [light for light in lights if light.name in wanted]
