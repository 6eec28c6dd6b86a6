"""Several avatars in one image: they occlude one another and cast sun shadows on one another.

All are posed in the frame of the first one's root and kept in common arrays, body after body. Each is shaded by itself,
with its neighbours as casters of shadows. One sort by depth puts all of them in order; bodies of few pixels are
splatted on finer grids, which ``far.depth_groups`` puts in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera, Floats
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians, Raster
from rnd_runtime.ground.several import remaining_of_several
from rnd_runtime.ground.shadow import GroundLight, Plane, footprint
from rnd_runtime.ground.standing import ground_of
from rnd_runtime.motion.motion import Motion
from rnd_runtime.raster.in_view import visible_to
from rnd_runtime.raster.oracle import NEAR
from rnd_runtime.raster.tone import tone_map
from rnd_runtime.shading.shader import SHADOW_RESOLUTION, Shader, shadow_radii
from rnd_runtime.shading.shadow import axes_towards, directional_visibility

from .aov import aov_layers
from .far import MARGIN, MIN_PIXELS_PER_METRE, Extent, depth_groups, extent
from .frame import FrameRenderer, RenderedFrame, features_of, in_root_frame, splat
from .framing import CameraPath, Framing, frame_motion

_PART_OF_A_FRAME = 1e-4  # tolerance of rounded times
LEVEL_SPACING, NODE_SPACING = 1.3, 48.0
"""px, spacings of the Gaussians and of the nodes up to which a coarser level is taken: neighbouring levels then differ
by 1/255 at most, as root mean square over the body's box (``rnd-bench scenes``)"""
HYSTERESIS = 1.15
"""factor on the distance between taking a coarser level and giving it back"""
SIDE_BY_SIDE = 0.6
"""m between people across the view at which none hides another"""
_TURNS = np.radians([0, 10, -10, 20, -20, 30, -30, 40, -40]).tolist()
MAX_SHADOW_RESOLUTION = 4096
"""texels along a depth map of several bodies: 20 m as fine as for one"""


@dataclass(frozen=True, eq=False)
class Person:
    """An avatar in a scene.

    Attributes:
        motion: mapped to its skeleton; begins at ``start`` s of the scene.
        place: [4, 4] the motion's world → the scene's, rigid, m.
    """

    avatar: Avatar
    motion: Motion
    start: float = 0.0
    place: Floats = field(default_factory=lambda: np.eye(4))

    def frames_at(self, fps: float) -> int:
        """Number of the scene's frames until the motion ends."""
        return max(self.motion.frames_at(fps) + math.ceil(self.start * fps - _PART_OF_A_FRAME), 1)

    def positions(self, times_s: Floats) -> Floats:
        """Its root [T, 3] m in the scene."""
        moved = self.motion.at(times_s - self.start).translations + self.avatar.skeleton.rest_joints[0]
        return np.asarray(moved @ self.place[:3, :3].T + self.place[:3, 3])

    def encode(self, time_s: float, level: int = 0) -> Encoded:
        """Its pose at ``time_s`` of the scene, at a level of detail."""
        avatar = self.avatar.level(level)
        assert avatar is not None
        encoded = avatar.encode(self.motion, time_s - self.start)
        return encoded._replace(root=self.place @ encoded.root)


def place_at(x: float, z: float, heading: float) -> Floats:
    """A ``Person.place``: origin at (x, 0, z) m, turned by ``heading`` rad to the left; π/2 turns +Z to +X."""
    placed = np.eye(4)
    cosine, sine = np.cos(heading), np.sin(heading)
    placed[0, [0, 2, 3]], placed[2, [0, 2, 3]] = (cosine, sine, x), (-sine, cosine, z)
    return placed


def frame_people(people: Sequence[Person]) -> Framing:
    """The ``Framing`` of all motions; it faces as the first person does, or turned so that people are side by side."""
    framings = [frame_motion(person.avatar.skeleton, person.motion) for person in people]
    places = [person.place for person in people]
    joints = np.concatenate([each.joints @ at[:3, :3].T + at[:3, 3] for each, at in zip(framings, places)])
    facing = framings[0].facing + float(np.arctan2(places[0][0, 2], places[0][2, 2]))
    middles = np.array([at[:3, :3] @ each.centre + at[:3, 3] for each, at in zip(framings, places)])
    facing += max(_TURNS, key=lambda turn: (_least_gap(middles, facing + turn), -abs(turn)))
    padding = max(each.padding for each in framings)
    return Framing(joints, (joints.min(axis=0) + joints.max(axis=0)) / 2, padding, facing)


def _least_gap(places: Floats, facing: float) -> float:
    """Least distance m, at most ``SIDE_BY_SIDE``, of two of ``places`` [N, 3] across a view from ``facing``."""
    across = np.sort(places @ [np.cos(facing), 0, -np.sin(facing)])
    return min(float(np.diff(across).min(initial=np.inf)), SIDE_BY_SIDE)


def ground_under(people: Sequence[Person]) -> Plane:
    """The lowest horizontal plane under the feet of anybody."""
    stands = {(id(each.avatar), id(each.motion)): (each.avatar, each.motion) for each in people}
    return min((ground_of(*pair) for pair in stands.values()), key=lambda plane: plane.offset)


def greatest_sizes(avatar: Avatar, smallest: float = 0.0) -> Floats:
    """Pixels per metre [L], falling, up to which each level of detail is taken; to the first below ``smallest``."""
    sizes = [np.inf]
    while sizes[-1] >= smallest and (level := avatar.detail(len(sizes))) is not None:
        whole = level.gaussians == avatar.gaussians
        size = NODE_SPACING / level.node_spacing if whole else LEVEL_SPACING / level.spacing
        sizes.append(min(size, sizes[-1]))
    return np.array(sizes)


def chosen_levels(pixels_per_metre: Floats, greatest: Floats) -> NDArray[np.intp]:
    """Level [F] of a body in F consecutive frames, by its size; ``greatest`` [L] as of ``greatest_sizes``.

    The coarsest that may be taken; a coarser one than before only ``HYSTERESIS`` later.
    """
    sizes = pixels_per_metre / greatest[1:, None]  # [L − 1, F]
    coarsest, lagging = ((sizes * factor <= 1).sum(axis=0) for factor in (1.0, HYSTERESIS))
    levels: NDArray[np.intp] = coarsest.copy()
    for frame in range(1, len(levels)):
        levels[frame] = np.clip(levels[frame - 1], lagging[frame], coarsest[frame])
    return levels


class SceneRenderer:
    """Renders N people with the light, the rasteriser and the ground of ``renderer``, which is of the first avatar.

    Of one person it renders the frames of ``renderer``. ``cull`` is as of that, for everybody.

    Raises:
        InputError: the graph of one of several avatars poses by itself.
    """

    def __init__(self, people: Sequence[Person], renderer: FrameRenderer, *, cull: float | None = None) -> None:
        self.people, self.renderer = people, renderer
        self._cull = cull
        if len(people) > 1 and not all(person.avatar.posed_outside for person in people):
            raise InputError("avatar of a scene", expected="a file of rnd-export", got="a graph that poses")
        self._arrays: dict[str, NDArray[Any]] = {}

    def levels(self, count: int, fps: float, camera_at: CameraPath, *, start: float = 0.0) -> NDArray[np.intp]:
        """Level of detail [F, N] of each person in ``count`` frames from ``start`` s on.

        A lone one that needs all its Gaussians has the finest, which is drawn on the renderer's device at once.
        """
        levels = np.zeros((count, len(self.people)), np.intp)
        times_s = start + np.arange(count) / fps
        cameras = [camera_at(frame, time_s) for frame, time_s in enumerate(times_s.tolist())]
        axes = np.array([[*camera.world_to_camera[2], max(camera.K[0, 0], camera.K[1, 1])] for camera in cameras])
        for number, person in enumerate(self.people):
            depths = (person.positions(times_s) * axes[:, :3]).sum(axis=1) + axes[:, 3] - MARGIN
            sizes = np.divide(axes[:, 4], depths, out=np.full(len(depths), np.inf), where=depths > NEAR)
            smallest, avatar = float(sizes.min()), person.avatar
            if len(self.people) > 1 or smallest < LEVEL_SPACING / avatar.spacing:
                levels[:, number] = chosen_levels(sizes, greatest_sizes(avatar, smallest))
        if len(self.people) == 1 and levels.any():
            made = [avatar.detail(number) for number in range(int(levels.max()) + 1)]
            levels[np.array([level is None or level.gaussians == avatar.gaussians for level in made])[levels]] = 0
        return levels

    def encode(self, time_s: float, levels: Sequence[int] | None = None) -> list[Encoded]:
        """Everybody's pose, for ``draw``, at ``levels`` of detail; the finest by default, which ``given`` ones need."""
        return [person.encode(time_s, level) for person, level in zip(self.people, levels or [0] * len(self.people))]

    def draw(
        self,
        bodies: Sequence[Encoded],
        camera: Camera,
        *,
        aovs: Sequence[str] = (),
        srgb: bool = True,
        given: Sequence[Mapping[str, Floats32]] | None = None,
        change: Callable[[Gaussians], Gaussians] | None = None,
        ground_light: GroundLight | None = None,
    ) -> RenderedFrame:
        """Render what is encoded.

        Args:
            aovs, srgb: as of ``FrameRenderer.draw``. given: the same of each person, for all of its Gaussians.
            change: what is shown in place of a body's Gaussians, where nothing is ``given``; the ground's shadow stays.
            ground_light: the renderer's by default.
        """
        given = given or [{}] * len(bodies)
        if len(bodies) == 1 and bodies[0].avatar is self.renderer.avatar and change is None:
            return self.renderer.draw(bodies[0], camera, aovs=aovs, srgb=srgb, given=given[0])
        seconds, started = {}, perf_counter()
        frame = bodies[0].root
        moved = [body.in_frame(frame) for body in bodies]
        posed = [body.avatar.posed(body) for body in moved]
        shown = posed if change is None else [change(gaussians) for gaussians in posed]
        joints = [body.avatar.joints(body) for body in moved]
        seconds["posing"], started = perf_counter() - started, perf_counter()
        shader, view = in_root_frame(frame, self.renderer.shader, camera)
        details = [person.avatar.spacing / body.avatar.spacing for person, body in zip(self.people, bodies)]
        culls = [body.avatar.advice.cull if self._cull is None else self._cull for body in bodies]
        visible = [visible_to(gaussians, view, cull) for gaussians, cull in zip(shown, culls)]
        sunlit = self._sunlit(shown, joints, shader, visible, details)
        features = [
            features_of(gaussians, shader, view, seen, aovs=aovs, lit=True, given=own, sunlit=reached)
            for gaussians, seen, own, reached in zip(shown, visible, given, sunlit)
        ]
        seconds["shading"] = perf_counter() - started
        # pixels finer than the distances between its Gaussians would show no more of a body
        least = [min(1 / body.avatar.spacing, MIN_PIXELS_PER_METRE) for body in bodies]
        extents = [extent(view, points, size) for points, size in zip(joints, least)]
        raster = self._splatted(shown, extents, visible, features, view, "depth" in aovs)
        for stage, spent in raster.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + spent
        layers = aov_layers(aovs, raster, 3, given[0])
        radiance, started = raster.image[..., :3], perf_counter()
        image_srgb = tone_map(radiance, raster.alpha, tone=self.renderer.tone) if srgb else None
        seconds["tone map"] = perf_counter() - started
        ground = None
        if self.renderer.ground is not None:
            started = perf_counter()
            plane, light = self.renderer.ground, ground_light or self.renderer.ground_light(self.renderer.ground)
            ground = self._lit_ground(posed, joints, frame, view, plane, light)
            seconds["ground"] = perf_counter() - started
        return RenderedFrame(
            radiance, raster.alpha, layers, seconds, ground=ground, srgb_on_black=image_srgb, tone=self.renderer.tone
        )

    def _sunlit(
        self,
        posed: Sequence[Gaussians],
        joints: Sequence[NDArray[np.float64]],
        shader: Shader,
        receivers: Sequence[NDArray[np.bool_]],
        details: Sequence[float],
    ) -> list[Floats32]:
        """``Shader.sunlit`` of each body past all of them; those whose shadows may meet share a map.

        The maps of coarser levels are coarser too: ``details`` are the whole avatars' spacings over those shown.
        """
        directions = shader.directional_arrays().directions
        sunlit = [np.zeros((len(gaussians.means), len(directions)), np.float32) for gaussians in posed]
        low, high = (np.array([side(points, axis=0) for points in joints]) for side in (np.min, np.max))
        centres, sizes = (low + high) / 2, np.linalg.norm(high - low, axis=1)
        reach = sizes / 2 + MARGIN
        for light, direction in enumerate(directions):
            across = centres @ axes_towards(direction)[:2].T
            apart = np.linalg.norm(across[:, None] - across, axis=-1)
            for bodies in _connected(apart < reach[:, None] + reach):
                points, normals, radii, seen = (
                    self._together(name, parts)
                    for name, parts in (
                        ("means", [posed[i].means for i in bodies]),
                        ("normals", [posed[i].normals for i in bodies]),
                        ("radii", [shadow_radii(posed[i]) for i in bodies]),
                        ("visible", [receivers[i] for i in bodies]),
                    )
                )
                wider = 1 + np.ptp(across[bodies], axis=0).max() / sizes[bodies].max()
                detail = max(details[i] for i in bodies)
                resolution = min(round(SHADOW_RESOLUTION * wider * detail), MAX_SHADOW_RESOLUTION)
                reached = directional_visibility(
                    points, normals, direction[None], radii=radii, resolution=resolution, receivers=seen
                )
                for body, rows in zip(bodies, np.split(reached, np.cumsum([len(sunlit[i]) for i in bodies[:-1]]))):
                    sunlit[body][:, light] = rows[:, 0]
        return sunlit

    def _splatted(
        self,
        posed: Sequence[Gaussians],
        extents: Sequence[Extent],
        visible: Sequence[NDArray[np.bool_]],
        features: Sequence[Floats32],
        camera: Camera,
        depth: bool,
    ) -> Raster:
        """Everybody, groups of ``far.depth_groups`` composited front to back."""
        height, width = camera.height, camera.width
        seconds: dict[str, float] = {}
        result: Raster | None = None
        for bodies, part in depth_groups(extents):
            fine = part.view(camera) if part.factor > 1 else None
            arrays = [[getattr(posed[i], name) for i in bodies] for name in ("means", "covariances", "opacities")]
            means, covariances, opacities, attributes, seen = (
                self._together(name, parts)
                for name, parts in zip(
                    ("means", "covariances", "opacities", "features", "visible"),
                    [*arrays, [features[i] for i in bodies], [visible[i] for i in bodies]],
                )
            )
            geometry, grid = (means, covariances, opacities), camera if fine is None else fine.camera
            raster = splat(geometry, attributes, grid, self.renderer.rasterizer, seen, depth=depth)
            for stage, spent in raster.seconds.items():
                seconds[stage] = seconds.get(stage, 0.0) + spent
            started = perf_counter()
            if fine is None:
                result = raster
                continue
            if result is None:
                shape = height, width
                image = np.zeros((*shape, attributes.shape[1]), np.float32)
                result = Raster(image, np.zeros(shape, np.float32), np.zeros(shape, np.float32))
            open_share = 1 - result.alpha[fine.region]
            for layer, behind in zip((result.image, result.alpha, result.depth), fine.means(raster)):
                layer[fine.region] += behind * (open_share[..., None] if behind.ndim == 3 else open_share)
            seconds["compositing"] = seconds.get("compositing", 0.0) + perf_counter() - started
        assert result is not None
        return replace(result, seconds=seconds, srgb=None)

    @staticmethod
    def _lit_ground(
        posed: Sequence[Gaussians],
        joints: Sequence[Floats],
        frame: Floats,
        camera: Camera,
        ground: Plane,
        light: GroundLight,
    ) -> Floats32:
        """Share [H, W, 3] of the ground's light that everybody leaves."""
        plane, shadows = ground.in_frame(frame), []
        for gaussians, points in zip(posed, joints):
            pixel = footprint(camera, plane, plane.axes[:2] @ points[0])
            shadows.append(light.shadow(gaussians, shadow_radii(gaussians), plane, frame[:3, :3], pixel=pixel))
        return remaining_of_several([shadow for shadow in shadows if shadow is not None], light, camera)

    def _together(self, name: str, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """``parts`` one after another, in an array that is kept from frame to frame."""
        if len(parts) == 1:
            return parts[0]
        rows, first = sum(map(len, parts)), parts[0]
        kept = self._arrays.get(name)
        if kept is None or len(kept) < rows or kept.shape[1:] != first.shape[1:]:
            kept = self._arrays[name] = np.empty((rows, *first.shape[1:]), first.dtype)
        return np.concatenate(parts, out=kept[:rows])


def _connected(near: NDArray[np.bool_]) -> list[list[int]]:
    """Groups of the numbers of rows that a symmetric relation [B, B] connects."""
    groups: dict[int, list[int]] = {}
    labels = np.arange(len(near))
    while (least := np.where(near, labels, len(near)).min(axis=1)).tolist() != labels.tolist():
        labels = least
    for row, label in enumerate(labels.tolist()):
        groups.setdefault(label, []).append(row)
    return list(groups.values())
