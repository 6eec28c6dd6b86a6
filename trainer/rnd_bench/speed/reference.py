"""What a frame would be without any approximation, and how far another one is from it.

The networks of the whole avatar (float32, its only concession), skinning and posing in float64, the sum over all
2 048 texels of the light with the avatar's own visibility, and the oracle rasteriser. There is a second one for
``table+sun``, whose suns cast shadows by depth maps and not by the avatar's visibility: with the suns' texels summed
behind the same shadows, it tells the approximation from the other visibility.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_bench.scenes.avatars import content_key, sources
from rnd_bench.scenes.scenes import Scene, bench_camera
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import NODE_LOGITS, NODE_OUTPUTS, REST_OUTPUTS
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.posing import RestPose
from rnd_runtime.posing.reference import pose_reference
from rnd_runtime.posing.window import motion_window
from rnd_runtime.raster import oracle as raster_oracle
from rnd_runtime.shading.light import load_light
from rnd_runtime.shading.reference import shade_reference, shade_reference_with_suns

from .frame import COMPARED, STEP_S, TURN, Drawn

MOST_DB = 120.0  # of two equal pictures
Floats = NDArray[np.float64]


class Reference(NamedTuple):
    """radiance [K, H, W, 3] linear and means [K, N, 3] m at the frames ``COMPARED``."""

    radiance: Floats
    means: Floats


def reference(avatar_file: Path, scene: Scene, size: int, folder: Path, *, with_suns: bool = False) -> Reference:
    """The reference of a whole avatar in ``scene``; what is slow of it is kept in ``folder``, by what the files hold.

    And by the camera, the frames and the sources of the runtime: another formula is another reference. ``with_suns``
    makes it that of ``shade_reference_with_suns``.
    """
    asked = f"{bench_camera(size, scene.view).world_to_camera.tolist()} {COMPARED} {STEP_S} {TURN}"
    inputs = (avatar_file, scene.motion, scene.hdr, asked)
    stem = f"reference_{content_key(*inputs, *sources('rnd_runtime'))}{'_suns' if with_suns else ''}"
    lit = _kept(folder / f"{stem}_lit.npz", lambda: _lit(avatar_file, scene, with_suns))

    def drawn() -> dict[str, Any]:
        camera, pictures = bench_camera(size, scene.view), []
        for k in range(len(COMPARED)):
            arrays = (lit["means"][k], lit["covariances"][k], lit["opacities"], lit["radiance"][k])
            drawn = raster_oracle.rasterize(*arrays, camera)
            covered = drawn.alpha[..., None]
            pictures.append(drawn.image * covered * (3 - 2 * covered))  # as rnd_runtime.raster.outline says
        return {"radiance": np.array(pictures)}

    pictures = _kept(folder / f"{stem}_{size}.npz", drawn)
    return Reference(pictures["radiance"].astype(np.float64), lit["means"])


def errors(drawn: Drawn, truth: Reference) -> dict[str, Any]:
    """psnr_db of all compared pictures together, psnr_db_worst of one, position_mm (largest, of the same Gaussians)."""
    squares = [
        float(np.mean((_coded(ours) - _coded(theirs)) ** 2)) for ours, theirs in zip(drawn.radiance, truth.radiance)
    ]
    same = drawn.means.shape == truth.means.shape
    distances = np.linalg.norm(drawn.means - truth.means, axis=-1) if same else None
    return {
        "psnr_db": _decibel(float(np.mean(squares))),
        "psnr_db_worst": _decibel(max(squares)),
        "position_mm": None if distances is None else 1e3 * float(distances.max()),
        "position_mm_p99": None if distances is None else 1e3 * float(np.percentile(distances, 99)),
        "worst_frame": COMPARED[int(np.argmax(squares))],
    }


def posed_reference(avatar: Avatar, motion: Any, time: float) -> Gaussians:
    """The whole avatar at ``time`` seconds, everything after its networks in float64."""
    names = [*NODE_OUTPUTS, NODE_LOGITS]
    window, velocity = motion_window(motion, time, poses=avatar.window_poses, seconds=avatar.window_seconds)
    now = motion.at(np.array([time]))
    bones = skinning_bones(avatar.skeleton, now.rotations[0], now.translations[0])
    inputs = (window, velocity, bones)
    offsets, visibility, logits = avatar.run(inputs, names)
    *rest, limits = avatar.run(inputs, REST_OUTPUTS)
    posed = pose_reference(RestPose(*rest, *limits.tolist()), logits, offsets, visibility, bones)  # type: ignore[arg-type]
    static = avatar.pose(motion, time)
    means, covariances, normals, harmonics = (np.asarray(value) for value in posed)
    return replace(static, means=means, covariances=covariances, normals=normals, visibility=harmonics)  # type: ignore[arg-type]


def _lit(avatar_file: Path, scene: Scene, with_suns: bool) -> dict[str, Any]:
    shade = shade_reference_with_suns if with_suns else shade_reference
    avatar = Avatar.load(avatar_file)
    motion = load_motion(scene.motion, avatar.skeleton)
    light, eye = load_light(scene.hdr), bench_camera(64, scene.view).position
    values: dict[str, list[Any]] = {"means": [], "covariances": [], "radiance": []}
    for number in COMPARED:
        posed = posed_reference(avatar, motion, STEP_S * number)
        values["means"].append(posed.means)
        values["covariances"].append(posed.covariances)
        values["radiance"].append(shade(posed, light.turned(TURN * number), eye))
    return {name: np.array(value) for name, value in values.items()} | {"opacities": posed.opacities}


def _kept(file: Path, make: Any) -> dict[str, Any]:
    if not file.exists():
        with atomic_path(file) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **make())
    with np.load(file) as archive:
        return dict(archive)


def _coded(radiance: Any) -> Floats:
    """sRGB, not rounded."""
    return np.asarray(linear_to_srgb(np.clip(radiance, 0, 1)), np.float64)


def _decibel(square: float) -> float:
    return min(MOST_DB, float(-10 * np.log10(max(square, 1e-30))))
