"""Formats, conventions and kernels of RnD-Avatar; plays an avatar without torch.

Conventions, stated once and tested in ``tests/conventions_test.py``:

* **World**: metres, Y up, right-handed. At rest a person faces +Z.
* **Cameras**: OpenCV. +X right, +Y down, +Z forward; ``world_to_camera`` is 4×4; the centre of the top left
  pixel lies at (0.5, 0.5); principal points may be off-centre.
* **Rotations**: axis-angle in radians in files, matrices inside; quaternions are wxyz.
* **Posing**: ``G_k = G_parent(k) · [R_k | rest_k − rest_parent]``; the root turns about its rest position and
  is then translated.
* **Radiance** is linear Rec.709. Images are premultiplied by alpha. One function (``images.linear_to_srgb``)
  makes sRGB of it, one (``images.to_bytes``) rounds to 8 bit.
* **Light probes**: lat-long 2:1, linear; ``u = 0.5 + atan2(z, x) / 2π``, ``v = acos(y) / π``: the image's centre
  is +X, to its right +Z, its top +Y.
* **Covariances** are stored as their upper triangle (xx, xy, xz, yy, yz, zz) in m².
"""

import os

from rnd_runtime.core.kernel_cache import keep_kernels_by_source

# Idle threads of GNU OpenMP spin for milliseconds unless told not to before it is loaded (with torch, or with the first
# kernel). On two cores at load 8 one forward and backward pass of the rasteriser then took 350 ms instead of 26. But a
# thread that sleeps at once takes up to half a millisecond to wake on a virtual machine, at each of a frame's nine
# kernels. So they spin for about 0.1 ms: a frame of 30 000 Gaussians takes 19.5 ms instead of 24, and beside two busy
# processes 33 instead of 35 to 52 (a spin of 0.4 ms: 46 to 51).
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "5000")
keep_kernels_by_source()

__version__ = "0.1.0"
