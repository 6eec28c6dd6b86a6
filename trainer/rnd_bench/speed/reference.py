"""Reference frames without approximations, and the error of others against them.

Networks in float32, skinning and posing in float64, the sum over all 2 048 texels of the light with the avatar's own
visibility, the oracle rasteriser. A second reference for ``table+sun`` applies its shadow maps to the suns' texels.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rnd_bench.scenes.avatars import content_key, sources
from rnd_bench.scenes.psnr import Floats, decibels_of, srgb
from rnd_bench.scenes.scenes import BenchScene, bench_camera
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import NODE_LOGITS, NODE_OUTPUTS, REST_OUTPUTS
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.far import fine_view
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.reference import pose_reference
from rnd_runtime.posing.rest import RestPose
from rnd_runtime.posing.window import motion_window
from rnd_runtime.raster import oracle as raster_oracle
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.reference import shade_reference, shade_reference_with_directional

from .frame import COMPARED, STEP_S, STEP_YAW, Measured

MAX_DB = 120.0  # of equal images


class Reference(NamedTuple):
    """radiance [K, H, W, 3] linear and means [K, N, 3] m at the frames ``COMPARED``."""

    radiance: Floats
    means: Floats


def reference(avatar_file: Path, scene: BenchScene, size: int, folder: Path, *, with_suns: bool = False) -> Reference:
    """The reference of a full avatar in ``scene``, ``with_suns`` that for ``table+sun``; stored in ``folder``."""
    asked = f"{bench_camera(size, scene.view).world_to_camera.tolist()} {COMPARED} {STEP_S} {STEP_YAW}"
    inputs = (avatar_file, scene.motion, scene.hdr, asked)
    stem = f"reference_{content_key(*inputs, *sources('rnd_runtime'))}{'_suns' if with_suns else ''}"
    lit = _stored(folder / f"{stem}_lit.npz", lambda: _lit(avatar_file, scene, with_suns))

    def rendered() -> dict[str, Any]:
        camera, frames = bench_camera(size, scene.view), []
        for k in range(len(COMPARED)):
            arrays = (lit["means"][k], lit["covariances"][k], lit["opacities"], lit["radiance"][k])
            fine = fine_view(camera, lit["joints"][k])
            raster = raster_oracle.rasterize(*arrays, camera if fine is None else fine.camera)
            covered = raster.alpha[..., None]
            sharp = replace(raster, image=raster.image * covered * (3 - 2 * covered))
            frames.append((sharp if fine is None else fine.averaged(sharp)).image)
        return {"radiance": np.array(frames)}

    frames = _stored(folder / f"{stem}_{size}.npz", rendered)
    return Reference(frames["radiance"].astype(np.float64), lit["means"])


def errors(found: Measured, truth: Reference) -> dict[str, Any]:
    """PSNR of all compared frames and of the worst one, and position errors where the Gaussians are the same."""
    squares = [float(np.mean((srgb(ours) - srgb(theirs)) ** 2)) for ours, theirs in zip(found.radiance, truth.radiance)]
    same = found.means.shape == truth.means.shape
    distances = np.linalg.norm(found.means - truth.means, axis=-1) if same else None
    return {
        "psnr_db": min(MAX_DB, decibels_of(float(np.mean(squares)))),
        "psnr_db_worst": min(MAX_DB, decibels_of(max(squares))),
        "position_mm": None if distances is None else 1e3 * float(distances.max()),
        "position_mm_p99": None if distances is None else 1e3 * float(np.percentile(distances, 99)),
        "worst_frame": COMPARED[int(np.argmax(squares))],
    }


def posed_reference(avatar: Avatar, motion: Any, time: float) -> Gaussians:
    """The full avatar at ``time`` seconds, everything after its networks in float64."""
    names = [*NODE_OUTPUTS, NODE_LOGITS]
    window, velocity = motion_window(motion, time, poses=avatar.window_poses, seconds=avatar.window_seconds)
    now = motion.at(np.array([time]))
    bones = skinning_bones(avatar.skeleton, now.rotations[0], now.translations[0])
    inputs = (window, velocity, bones)
    offsets, visibility, logits = avatar.run(inputs, names)
    *rest, limits = avatar.run(inputs, REST_OUTPUTS)
    posed = pose_reference(RestPose(*rest, *limits.tolist()), logits, offsets, visibility, bones)  # type: ignore[arg-type]
    static = avatar.pose(motion, time)
    means, covariances, normals, seen = (np.asarray(value) for value in posed)
    return replace(static, means=means, covariances=covariances, normals=normals, visibility=seen)  # type: ignore[arg-type]


def _lit(avatar_file: Path, scene: BenchScene, with_suns: bool) -> dict[str, Any]:
    shade = shade_reference_with_directional if with_suns else shade_reference
    avatar = Avatar.load(avatar_file)
    motion = load_motion(scene.motion, avatar.skeleton)
    light, eye = load_light(scene.hdr), bench_camera(64, scene.view).position
    values: dict[str, list[Any]] = {"means": [], "covariances": [], "radiance": [], "joints": []}
    for number in COMPARED:
        posed = posed_reference(avatar, motion, STEP_S * number)
        values["means"].append(posed.means)
        values["covariances"].append(posed.covariances)
        bones = avatar.encode(motion, STEP_S * number).in_world().bones
        values["joints"].append(bones[:, :, :3] @ avatar.skeleton.rest_joints[:, :, None] @ np.ones(1) + bones[:, :, 3])
        values["radiance"].append(shade(posed, light.with_yaw(STEP_YAW * number), eye))
    return {name: np.array(value) for name, value in values.items()} | {"opacities": posed.opacities}


def _stored(file: Path, make: Any) -> dict[str, Any]:
    if not file.exists():
        with atomic_path(file) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **make())
    with np.load(file) as archive:
        return dict(archive)
