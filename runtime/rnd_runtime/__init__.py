"""Formats, conventions and kernels of RnD-Avatar; plays an avatar without torch.

::

    import rnd_runtime as rnd

    avatar = rnd.load_avatar("avatar.onnx")
    motion = rnd.load_motion("walk.npz", avatar.skeleton)
    light = rnd.load_light("sky.exr")
    camera = rnd.framing_camera(avatar, motion, width=512, height=512)
    image = rnd.render(avatar, motion, light, camera, time=0.5)  # [512, 512, 4] uint8, straight alpha

Importing the package changes nothing for the process and loads nothing; names are loaded when they are used.

Conventions:

* **World**: metres, Y up, right-handed. At rest a person faces +Z.
* **Cameras**: OpenCV. +X right, +Y down, +Z forward; ``world_to_camera`` is 4×4; the centre of the top left
  pixel is at (0.5, 0.5); principal points may be off-centre.
* **Rotations**: axis-angle in radians in files, matrices inside; quaternions are wxyz.
* **Posing**: ``G_k = G_parent(k) · [R_k | rest_k − rest_parent]``; the root rotates about its rest position and
  is then translated.
* **Radiance** is linear Rec.709. Images are premultiplied by alpha. One function (``images.linear_to_srgb``)
  converts to sRGB, one (``images.to_bytes``) rounds to 8 bit.
* **Light probes**: lat-long 2:1, linear; ``u = 0.5 + atan2(z, x) / 2π``, ``v = acos(y) / π``: the image's centre
  is +X, to its right +Z, its top +Y.
* **Covariances** are stored as their upper triangle (xx, xy, xz, yy, yz, zz) in m².
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .facade import Camera, framing_camera, load_avatar, load_light, load_motion, render

__all__ = ["Camera", "framing_camera", "load_avatar", "load_light", "load_motion", "render"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import facade

    return getattr(facade, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
