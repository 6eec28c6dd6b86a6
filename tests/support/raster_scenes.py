"""Random scenes for the tests of the rasterisers."""

import numpy as np

from rnd_runtime.core.camera import Camera


def random_scene(seed, n=150, channels=3, *, spread=0.5, size=0.06):
    """N Gaussians around the origin, float32: means, covariances, opacities, features."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(n, 3, 3)) * rng.uniform(0.1, 1, (n, 3, 1)) * size
    upper = (axes @ axes.transpose(0, 2, 1))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    arrays = (rng.normal(size=(n, 3)) * spread, upper, rng.uniform(0, 1, n), rng.uniform(0, 1, (n, channels)))
    return tuple(np.ascontiguousarray(array, np.float32) for array in arrays)


def off_centre_camera(width, height, eye=(0.4, 0.3, -2.5)):
    """A view of the origin with unequal focal lengths and the principal point off the centre."""
    view = Camera.look_at(list(eye), [0.1, 0.0, 0.2], width=width, height=height, fov_y=0.7)
    K = np.array([[0.9 * max(width, height), 0, 0.4 * width], [0, max(width, height), 0.6 * height], [0, 0, 1]])
    return Camera(width, height, K, view.world_to_camera)
