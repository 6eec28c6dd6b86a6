"""EXR frames as compositors expect them.

===========================  =============================================================================
channels                     values
===========================  =============================================================================
R, G, B, A                   linear radiance, premultiplied; alpha 1 over a background
albedo, diffuse, specular,   linear, premultiplied; diffuse + specular is the radiance without a background,
shadow                       and radiance + shadow has no cast shadows
normal, roughness, …, Z      averages over the covered part of a pixel, not premultiplied
ground                       share of a plate's light that the shadow on the ground leaves, not premultiplied
CryptoPart00 … 02            Cryptomatte, always FLOAT
===========================  =============================================================================

Attributes are chromaticities, framesPerSecond, and the camera: ``worldToCamera`` and ``worldToNDC`` as OpenEXR defines
them (row vectors; camera +X right, +Y up, +Z forward; NDC from (0, 0) at the upper left to (1, 1)), and in
``rnd/K`` and ``rnd/worldToCamera`` our own OpenCV matrices, row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import Attribute, write_image
from rnd_runtime.playback import cryptomatte
from rnd_runtime.playback.aov import CHANNELS, COLOURS
from rnd_runtime.playback.frame import RenderedFrame

ColourSpace = Literal["rec709", "acescg"]
CHROMATICITIES = {  # x, y of red, green, blue and white
    "rec709": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "acescg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
}
_IN_OCIO = {"rec709": "lin_rec709", "acescg": "ACEScg"}
_NEVER_HALF = ("depth", "motion", "parts")  # metres, pixels and hashes need more than 11 bits


@dataclass(frozen=True)
class ExrWriter:
    """Writes frames of a run.

    Attributes:
        fps: frames per second. half: store colours and other layers of [0, 1] as HALF.
        space: of all colours. parts: names of the parts whose coverage is the AOV ``parts``.
    """

    fps: float
    half: bool = False
    space: ColourSpace = "rec709"
    parts: Sequence[str] = ()

    def write(self, path: Path, frame: RenderedFrame, camera: Camera) -> None:
        """Write one frame with all of its AOVs."""
        linear = frame.linear()
        layers, names, half = [self._colours(linear[..., :3]), linear[..., 3:]], ["R", "G", "B", "A"], [self.half] * 4
        if frame.ground is not None:
            layers.append(frame.ground)
            names += ["ground.R", "ground.G", "ground.B"]
            half += [self.half] * 3
        for aov, values in frame.aovs.items():
            if aov in COLOURS:
                values = self._colours(values)
            if aov == "parts":
                values = cryptomatte.layers(values, self.parts)
            layers.append(values)
            names += CHANNELS[aov]
            half += [self.half and aov not in _NEVER_HALF] * len(CHANNELS[aov])
        write_image(
            path,
            np.concatenate(layers, axis=-1, dtype=np.float32),
            channel_names=tuple(names),
            half=tuple(half),
            attributes=self._attributes(frame, camera),
        )

    def _colours(self, linear: NDArray[np.float32]) -> NDArray[np.float32]:
        return linear if self.space == "rec709" else linear @ self._matrix

    @cached_property
    def _matrix(self) -> NDArray[np.float32]:
        """[3, 3] row vectors of linear Rec.709 → the space, by OpenImageIO's own OCIO configuration."""
        basis = oiio.ImageBuf(np.eye(3, dtype=np.float32)[None])
        source, target = _IN_OCIO["rec709"], _IN_OCIO[self.space]
        converted = oiio.ImageBufAlgo.colorconvert(basis, source, target, colorconfig="ocio://default")
        assert not converted.has_error, converted.geterror()
        return np.asarray(converted.get_pixels("float"), np.float32).reshape(3, 3)

    def _attributes(self, frame: RenderedFrame, camera: Camera) -> dict[str, Attribute]:
        rate = frame_rate(self.fps)
        to_camera, to_ndc = camera_matrices(camera)
        attributes: dict[str, Attribute] = {
            "chromaticities": ("float[8]", CHROMATICITIES[self.space]),
            "FramesPerSecond": ("rational", (rate.numerator, rate.denominator)),
            "worldToCamera": ("matrix", tuple(to_camera.ravel().tolist())),
            "worldToNDC": ("matrix", tuple(to_ndc.ravel().tolist())),
            "rnd/K": ("float[9]", tuple(camera.K.ravel().tolist())),
            "rnd/worldToCamera": ("float[16]", tuple(camera.world_to_camera.ravel().tolist())),
        }
        if "parts" in frame.aovs:
            attributes |= cryptomatte.attributes(self.parts)
        return attributes


def frame_rate(fps: float) -> Fraction:
    """``fps`` as a fraction; 24000/1001 and its like where it is one of them, rounded."""
    broadcast = Fraction(1000 * round(1.001 * fps), 1001)
    return broadcast if abs(broadcast - fps) < 2e-3 else Fraction(fps).limit_denominator(1001)


def camera_matrices(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """OpenEXR's worldToCamera and worldToNDC [4, 4] for row vectors: (x, y, z, 1) M."""
    to_camera = np.diag([1.0, -1, 1, 1]) @ camera.world_to_camera
    projection = np.zeros((4, 4))
    projection[:2, :3] = camera.K[:2] / [[camera.width], [camera.height]]
    projection[2:] = [[0, 0, 1, 0], [0, 0, 1, 0]]
    return to_camera.T, (projection @ camera.world_to_camera).T
