"""Requests of a page to ``rnd-view``."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import Tone

from .options import SIZES

Output = Literal["lit", "light", "albedo", "normal", "roughness", "visibility"]
MAX_CLIP_FRAMES = 3600

_Side = Annotated[int, Meta(ge=SIZES[0], le=SIZES[1])]
_Angle = Annotated[float, Meta(ge=-1e4, le=1e4)]
_Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]


class ViewState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All parameters of a frame.

    Attributes:
        time: s into the motion. width, height: px.
        azimuth, elevation: rad, of the camera around ``target`` [3] m, ``distance`` m away.
        fov: vertical field of view, rad.
        truth: index of an image of the capture, which then decides camera, pose and light (no yaw, no exposure);
            None for none of them.
        light: index among the scene's lights. yaw: rad. exposure: stops.
        output: the lit frame, the light alone (on a body of one colour), or one of its materials.
        background: as ``rnd-play --background``, ``none`` being black.
        tone: as ``rnd-play --tone``, of the lit frame and of the light.
        ground: draw the body's shadow on the ground under its feet, over a background that is not black.
        gaussians: how many to render; fewer are enlarged.
        encoding: of the pixels in the answer.
    """

    time: float
    width: _Side
    height: _Side
    azimuth: _Angle
    elevation: _Angle
    distance: Annotated[float, Meta(gt=0, le=1e4)]
    target: tuple[_Metres, _Metres, _Metres]
    fov: Annotated[float, Meta(gt=0.01, lt=3.0)]
    light: Annotated[int, Meta(ge=0)] = 0
    yaw: _Angle = 0.0
    exposure: Annotated[float, Meta(ge=-30, le=30)] = 0.0
    shade: str = "table+sun"
    output: Output = "lit"
    background: str = "none"
    tone: Tone = "srgb"
    ground: bool = False
    gaussians: Annotated[int, Meta(ge=1)] | None = None
    truth: Annotated[int, Meta(ge=0)] | None = None
    encoding: Literal["raw", "jpeg"] = "raw"

    def camera(self) -> Camera:
        """The camera on its orbit."""
        flat = np.cos(self.elevation)
        direction = np.array([flat * np.sin(self.azimuth), np.sin(self.elevation), flat * np.cos(self.azimuth)])
        target = np.array(self.target)
        return Camera.look_at(
            target + self.distance * direction, target, width=self.width, height=self.height, fov_y=self.fov
        )


class RenderRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="render", tag_field="ask"):
    """One frame, answered with its ``number``; a ``live`` one may be smaller, to hold ``--fps-floor``."""

    number: int
    state: ViewState
    live: bool = False


class ClipRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="clip", tag_field="ask"):
    """The whole motion as an mp4 in the view of ``state``; ``turn``: rad by which the camera orbits."""

    state: ViewState
    fps: Annotated[float, Meta(ge=1, le=240)]
    turn: _Angle = 0.0


class TruthRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="truth", tag_field="ask"):
    """The capture's image ``index`` as in its file."""

    index: Annotated[int, Meta(ge=0)]


Request = RenderRequest | ClipRequest | TruthRequest
_decoder = msgspec.json.Decoder(Request)


def parse_request(message: str | bytes) -> Request:
    """Decode one message of a page, or raise InputError."""
    try:
        return _decoder.decode(message)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError("request", got=str(error)) from error
