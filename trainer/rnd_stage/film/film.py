"""Filming a recipe into a folder: shot by shot, to be continued, in shards, and the manifest when all is there."""

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
from rnd_runtime.core.images import linear_to_srgb, read_image, to_bytes, write_image
from rnd_runtime.core.npz import save_npz
from rnd_runtime.motion.motion import Motion, load_motion, motion_inputs
from rnd_stage.people.dressing import Dressed, Wearer
from rnd_stage.render import MASK_FLOOR, Set, Truth

from . import plan as plans
from .cameras import VISIBLE_HEIGHT, ring_cameras
from .dances import dance
from .estimates import estimated_mask, estimated_normals
from .lights import WHITE, StageLight, module_directions, stage_lights
from .plan import Recipe, Shot

Floats = NDArray[np.float64]

RECIPE_FILE = "stage.json"
TRUTH_SAMPLES = 16  # a truth has no noise but at edges
VISIBILITY_SAMPLES = 16
SAME_MAP = 1e-4  # relative: machines round a light's float32 texels differently
FINEST, COARSEST = 0.003, 0.007  # m between a dressed surface's vertices


@dataclass(frozen=True)
class Cost:
    """What filming took: by the clock, and on the processor, all its cores together, which no other load lengthens."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0


@dataclass
class Production:
    """A recipe with everything it names loaded: what is filmed, by which cameras, under which lights."""

    recipe: Recipe
    dressed: Dressed
    title: str
    motion: Motion
    frames: list[int]
    lights: list[StageLight]
    shots: list[Shot]

    @property
    def cameras(self):
        return ring_cameras(self.recipe.cameras, self.recipe.size)


def prepare(recipe: Recipe, folder: Path, template: Body | None = None) -> Production:
    """Load and dress what ``recipe`` names; ``template`` as in ``.dressing.dress``.

    Raises:
        InputError: a part that cannot be had, or a folder that holds another recipe's pictures.
    """
    recipe.check()
    lights = _chosen(recipe)
    for what, file in (("motion", recipe.motion), ("character", recipe.character)):
        if file is not None:
            existing_file(Path(file), what=what)
    mine = recipe_for(recipe, folder)
    _refuse_other_lights(lights, folder)
    dressed, title = _cast(recipe, template)
    motion = dance(dressed.body.skeleton)
    if recipe.motion is not None:
        motion = load_motion(recipe.motion, dressed.body.skeleton)
    motion = _on_the_spot(motion)
    frames = plans.instants(recipe, motion.frame_count)
    if len(frames) < 5:
        raise InputError("motion", expected="at least 5 frames", got=motion.frame_count, file=motion.source)
    write_json(folder / RECIPE_FILE, mine)  # now that it can be filmed
    names = [light.name for light in lights]
    shots = plans.plan(recipe, frames, list(ring_cameras(recipe.cameras, recipe.size)), names)
    return Production(recipe, dressed, title, motion, frames, lights, shots)


def film(
    production: Production, folder: Path, *, shard: tuple[int, int] = (0, 1), on_picture: Callable[[str], None]
) -> Cost:
    """Film what is missing of one shard (k, n): the instants whose number is k modulo n.

    ``on_picture`` is called with the name of each picture that is there, filmed or found.
    """
    part, parts = shard
    own = set(production.frames[part::parts])
    todo = [shot for shot in production.shots if shot.frame in own]
    missing = [shot for shot in todo if plans.missing(folder, shot, production.recipe.visibility)]
    for light in production.lights:
        if not (folder / _light_file(light.name)).exists():
            write_image(folder / _light_file(light.name), light.file_radiance)
    for shot in todo:
        if shot not in missing:
            for _, name in shot.uses:
                on_picture(shot.image(name))
    if not missing:
        return Cost()
    started, started_cpu = time.perf_counter(), time.process_time()
    wearer = Wearer(production.dressed, production.motion, sorted({shot.frame for shot in missing}))
    for frame in sorted({shot.frame for shot in missing}):
        stage = Set(wearer.surface(frame), max_depth=production.recipe.max_depth)
        save_npz(folder / f"surface/{frame:06d}.npz", {"vertices": stage.surface.vertices.astype(np.float32)})
        for shot in missing:
            if shot.frame == frame:
                _shoot(production, stage, shot, folder)
                for _, name in shot.uses:
                    on_picture(shot.image(name))
    return Cost(time.perf_counter() - started, time.process_time() - started_cpu)


def _shoot(production: Production, stage: Set, shot: Shot, folder: Path) -> None:
    """One camera at one instant: the truth, then a picture for each light."""
    recipe, camera = production.recipe, production.cameras[shot.camera]
    numbers = {light.name: k for k, light in enumerate(production.lights)}
    seed = 1000 * shot.frame + 31 * int(shot.camera[3:])
    truth = stage.truth(camera, samples=TRUTH_SAMPLES, seed=seed)
    _write_truth(folder, shot, truth, recipe)
    if recipe.visibility and shot.camera == plans.TRAIN_CAMERA:
        seen = stage.visibility(camera, module_directions(), truth.normals, samples=VISIBILITY_SAMPLES, seed=seed)
        save_npz(folder / f"visibility/{shot.place}.npz", {"visibility": to_bytes(seen)})
    for _, name in shot.uses:
        light = production.lights[numbers[name]]
        radiance = stage.radiance(
            camera, light.radiance, samples=recipe.samples, seed=seed + 7919 * (1 + numbers[name])
        )
        write_image(folder / shot.image(name), to_bytes(linear_to_srgb(np.clip(radiance, 0, 1))))


def _write_truth(folder: Path, shot: Shot, truth: Truth, recipe: Recipe) -> None:
    place, covered = shot.place, (truth.coverage >= MASK_FLOOR)[..., None]
    write_image(folder / f"masks/{place}.png", to_bytes(truth.coverage))
    write_image(folder / f"normals_gt/{place}.png", to_bytes(0.5 * (truth.normals + 1) * covered))
    write_image(folder / f"albedo/{place}.png", to_bytes(linear_to_srgb(np.clip(truth.albedo, 0, 1))))
    write_image(folder / f"roughness/{place}.png", to_bytes(truth.roughness))
    write_image(folder / f"depth/{place}.exr", truth.depth.astype(np.float32), channel_names=("Z",))
    if shot.trains:
        seed, strength = recipe.estimate_seed + 1000 * shot.frame, recipe.estimate_strength
        normals = estimated_normals(truth.normals, truth.coverage, seed, strength)
        write_image(folder / f"normals/{place}.png", to_bytes(0.5 * (normals + 1) * covered))
        mask = estimated_mask(truth.coverage, seed, strength)
        write_image(folder / f"masks_estimated/{place}.png", to_bytes(mask))


def recipe_for(recipe: Recipe, folder: Path) -> dict[str, Any]:
    """The recipe as JSON has it, with the digests of the files that it names.

    Raises ``InputError`` where ``folder`` holds another one's pictures, or such of files that were replaced.
    """
    file = output_folder(folder) / RECIPE_FILE
    mine = json.loads(json.dumps(asdict(recipe)))
    motion = [] if recipe.motion is None else map(str, motion_inputs(recipe.motion))
    named = [*motion, *recipe.hdr, *([] if recipe.character is None else [recipe.character])]
    digests = {name: sha256_of(name) for name in named}
    if file.exists():
        theirs = _recipe_in(file)
        earlier = theirs.get("sha256", {})  # older recipes have none
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
    """What the ``key`` of a recipe stands for: of files, wherever they lie, their digests; else its value.

    Lights and people are called like their files, which have to be called alike, too; a motion may have an .asf beside.
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
    if not (isinstance(recipe, dict) and isinstance(recipe.get("sha256", {}), dict)):
        raise InputError("not a recipe", expected="an object as rnd-stage writes it", file=file)
    return recipe


def _refuse_other_lights(lights: list[StageLight], folder: Path) -> None:
    """Raise ``InputError`` where ``folder`` holds a map that is not its light's: pictures were lit by it."""
    for light in lights:
        file = folder / _light_file(light.name)
        if file.exists():
            theirs = read_image(file)
            same = theirs.shape == light.file_radiance.shape
            if not (same and np.allclose(theirs, light.file_radiance, rtol=SAME_MAP, atol=0)):
                raise InputError(
                    "holds another light", expected="its map as it is now", file=file, hint="or another OUT"
                )


def _cast(recipe: Recipe, template: Body | None) -> tuple[Dressed, str]:
    if recipe.character is not None:
        from rnd_stage.people.characters import load_character

        return load_character(Path(recipe.character)), Path(recipe.character).stem
    from rnd_stage.people.dressing import dress
    from rnd_stage.people.subjects import subject

    person = subject(recipe.subject)
    step = float(np.clip(0.7 * VISIBLE_HEIGHT / recipe.size, FINEST, COARSEST)) if recipe.step is None else recipe.step
    return dress(person, step, template), person.title


def _on_the_spot(motion: Motion) -> Motion:
    """The motion about the middle of the stage."""
    middle = np.median(motion.translations, axis=0) * [1, 0, 1]
    return replace(motion, translations=motion.translations - middle)


def _chosen(recipe: Recipe) -> list[StageLight]:
    lights = stage_lights(tuple(Path(name) for name in recipe.hdr))
    names = [light.name for light in lights]
    unknown = [name for name in recipe.lights if name not in names]
    if unknown:
        raise InputError("--lights", expected=", ".join(names), got=", ".join(unknown))
    given = {Path(name).stem for name in recipe.hdr}
    wanted = {WHITE, *given, *(recipe.lights or names)}
    return [light for light in lights if light.name in wanted]


def _light_file(name: str) -> str:
    return f"lights/{name}.exr"
