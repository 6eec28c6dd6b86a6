"""USD: the rigged surface as UsdSkel with its motion, and splats as ParticleField3DGaussianSplat with time samples.

Metres, Y up; one time code is one frame. Source: OpenUSD 26.03, schemas UsdSkel and UsdVol.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.cli.extras import install_hint, need_packages
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.images import write_image
from rnd_runtime.core.rotations import matrix_to_quaternion
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton

from .mesh_files import strongest_joints
from .splats import Splats
from .surface import JOINTS, Surface
from .texture import Textures, Unwrapped

_REACH = 3.0  # standard deviations within a splat's extent


def load_usd() -> ModuleType:
    """``pxr``. Raises ``InputError`` where usd-core is missing or too old for splats."""
    need_packages("usd", "pxr", what="usd needs")
    import pxr
    from pxr import UsdVol

    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise InputError("usd", expected="usd-core 26.3 or later", got="an older one", hint=install_hint("usd"))
    return pxr


def write_rigged_usd(
    path: Path, surface: Surface, charts: Unwrapped, textures: Textures, skeleton: Skeleton, motion: Motion
) -> None:
    """A .usdz of the surface in its rest pose, its skeleton, and ``motion`` as the skeleton's animation."""
    load_usd()
    from pxr import Sdf, UsdGeom, UsdShade, UsdSkel, UsdUtils, Vt

    with temporary_folder() as folder:
        stage = _stage(folder / "avatar.usdc", motion.frame_count + motion.closed, motion.fps)
        root = UsdSkel.Root.Define(stage, "/avatar")
        stage.SetDefaultPrim(root.GetPrim())
        names = _joint_paths(skeleton)
        mesh = UsdGeom.Mesh.Define(stage, "/avatar/mesh")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(surface.vertices.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.faces), 3, np.int32)))
        corners = np.ascontiguousarray(charts.original[charts.faces].ravel(), np.int32)
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(surface.normals.astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
        uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
        uv.Set(Vt.Vec2fArray.FromNumpy(charts.uv.astype(np.float32)))
        uv.SetIndices(Vt.IntArray.FromNumpy(charts.faces.ravel()))
        binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        joints, weights = strongest_joints(surface.weights)
        binding.CreateJointIndicesPrimvar(False, JOINTS).Set(Vt.IntArray.FromNumpy(joints.astype(np.int32).ravel()))
        binding.CreateJointWeightsPrimvar(False, JOINTS).Set(Vt.FloatArray.FromNumpy(weights.ravel()))
        bones = UsdSkel.Skeleton.Define(stage, "/avatar/skeleton")
        bones.CreateJointsAttr(names)
        bones.CreateBindTransformsAttr(_translations(skeleton.rest_joints))
        parents = skeleton.rest_joints[np.maximum(skeleton.parents, 0)] * (skeleton.parents >= 0)[:, None]
        offsets = skeleton.rest_joints - parents
        bones.CreateRestTransformsAttr(_translations(offsets))
        animation = UsdSkel.Animation.Define(stage, "/avatar/skeleton/motion")
        animation.CreateJointsAttr(names)
        animation.CreateScalesAttr(Vt.Vec3hArray(len(skeleton), (1, 1, 1)))
        quaternions = matrix_to_quaternion(motion.rotations)
        for frame in range(motion.frame_count + motion.closed):
            source = frame % motion.frame_count
            moved = offsets.copy()
            moved[0] += motion.translations[source]
            animation.CreateRotationsAttr().Set(_quaternions(quaternions[source]), frame)
            animation.CreateTranslationsAttr().Set(Vt.Vec3fArray.FromNumpy(moved.astype(np.float32)), frame)
        UsdSkel.BindingAPI.Apply(bones.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
        binding.CreateSkeletonRel().SetTargets([bones.GetPath()])
        material = _material(stage, folder, textures)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
        stage.GetRootLayer().Save()
        with atomic_path(path) as temporary:
            temporary.unlink()  # the packager wants a new name
            if not UsdUtils.CreateNewUsdzPackage(str(folder / "avatar.usdc"), str(temporary)):
                raise InputError("usd package cannot be written", file=path)


def write_splat_usd(path: Path, samples: Sequence[Splats], frames: range, fps: float) -> None:
    """A .usdc of one splat prim whose ``samples`` are at the time codes ``frames``.

    Colours are stored as 3DGS stores them: coefficients interleaved by Gaussian, the lowest degree first.
    """
    load_usd()
    from pxr import UsdVol, Vt

    degree = max((d for s in samples for d in range(1, 4) if s.sh[:, d**2 : (d + 1) ** 2].any()), default=0)
    count = (degree + 1) ** 2
    with atomic_path(path) as temporary:
        temporary.unlink()  # USD wants a new name
        stage = _stage(temporary, len(samples), fps, first=frames.start)
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/avatar")
        stage.SetDefaultPrim(field.GetPrim())
        prim = field.GetPrim()
        prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(degree)
        if len({len(splats.means) for splats in samples}) > 1:
            raise InputError("usd", expected="as many finite Gaussians in every frame", got="others", file=path)
        for code, splats in zip(frames, samples):
            reach = _REACH * splats.scales.max(axis=1, keepdims=True)
            extent = np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)])
            values = {
                "positions": Vt.Vec3fArray.FromNumpy(splats.means.astype(np.float32)),
                "orientations": _quaternions(splats.quaternions),
                "scales": Vt.Vec3fArray.FromNumpy(splats.scales.astype(np.float32)),
                "opacities": Vt.FloatArray.FromNumpy(splats.opacities.astype(np.float32)),
                "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(
                    np.ascontiguousarray(splats.sh[:, :count].reshape(-1, 3), np.float32)
                ),
                "extent": Vt.Vec3fArray.FromNumpy(extent.astype(np.float32)),
            }
            for name, value in values.items():
                prim.GetAttribute(name).Set(value, code)
        stage.GetRootLayer().Save()


def _stage(path: Path, frames: int, fps: float, first: int = 0) -> Any:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(first)
    stage.SetEndTimeCode(first + frames - 1)
    return stage


def _joint_paths(skeleton: Skeleton) -> list[str]:
    """``pelvis/left_hip/left_knee`` of each joint, which UsdSkel takes for its tree."""
    from pxr import Tf

    paths: list[str] = []
    for name, parent in zip(skeleton.names, skeleton.parents):
        own = Tf.MakeValidIdentifier(name)
        paths.append(own if parent < 0 else f"{paths[parent]}/{own}")
    return paths


def _translations(points: NDArray[np.float64]) -> Any:
    from pxr import Vt

    matrices = np.tile(np.eye(4), (len(points), 1, 1))
    matrices[:, 3, :3] = points  # row vectors
    return Vt.Matrix4dArray.FromNumpy(matrices)


def _quaternions(wxyz: NDArray[np.float64]) -> Any:
    from pxr import Gf, Vt

    return Vt.QuatfArray([Gf.Quatf(w, x, y, z) for w, x, y, z in wxyz.tolist()])


def _material(stage: Any, folder: Path, textures: Textures) -> Any:
    """UsdPreviewSurface with the textures, which are written into ``folder``."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, "/avatar/material")
    shader = UsdShade.Shader.Define(stage, "/avatar/material/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    reader = UsdShade.Shader.Define(stage, "/avatar/material/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    st = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    kinds = Sdf.ValueTypeNames
    inputs = {  # texture: image, coding, and output → input of the surface
        "albedo": (textures.albedo, "sRGB", [("rgb", kinds.Float3, "diffuseColor", kinds.Color3f)]),
        "normal": (textures.normal, "raw", [("rgb", kinds.Float3, "normal", kinds.Normal3f)]),
        "packed": (
            textures.material,
            "raw",
            [("g", kinds.Float, "roughness", kinds.Float), ("r", kinds.Float, "occlusion", kinds.Float)],
        ),
    }
    for name, (image, coding, links) in inputs.items():
        write_image(folder / f"{name}.png", np.ascontiguousarray(image))
        texture = UsdShade.Shader.Define(stage, f"/avatar/material/{name}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(f"./{name}.png")
        texture.CreateInput("sourceColorSpace", kinds.Token).Set(coding)
        texture.CreateInput("st", kinds.Float2).ConnectToSource(st)
        if name == "normal":
            texture.CreateInput("scale", kinds.Float4).Set((2, 2, 2, 1))
            texture.CreateInput("bias", kinds.Float4).Set((-1, -1, -1, 0))
        for output, kind, name_in, kind_in in links:
            shader.CreateInput(name_in, kind_in).ConnectToSource(texture.CreateOutput(output, kind))
    return material
