import numpy as np
import pytest

from rnd_runtime.shading.sh import SH_COUNT, SH_DEGREES, sh_basis, sh_columns, sh_rotation, sphere_quadrature

ROUNDING = 1e-10  # float64 sums of some hundred terms of order one stay four decades below


def random_directions(count, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def random_rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def test_orthonormal_by_an_independent_quadrature():
    # midpoints in azimuth and Gauss–Legendre in cos θ, far past the degree needed, built without our helper
    z, weights = np.polynomial.legendre.leggauss(20)
    azimuth = np.arange(40) * np.pi / 20
    radius = np.sqrt(1 - z**2)
    directions = np.stack(
        [radius[:, None] * np.cos(azimuth), radius[:, None] * np.sin(azimuth), np.broadcast_to(z[:, None], (20, 40))],
        -1,
    )
    basis = sh_basis(directions)
    gram = np.einsum("zai,zaj,z->ij", basis, basis, weights) * np.pi / 20
    np.testing.assert_allclose(gram, np.eye(SH_COUNT), atol=ROUNDING)


def test_signs_and_constants_are_those_of_3dgs():
    x, y, z = direction = random_directions(1)[0]
    xx, yy, zz = x * x, y * y, z * z
    published = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    np.testing.assert_allclose(sh_basis(direction), published, atol=1e-14)


def test_quadrature_weights_cover_the_sphere():
    directions, weights = sphere_quadrature(4)
    assert directions.shape == (32, 3)
    np.testing.assert_allclose(weights.sum(), 4 * np.pi)
    np.testing.assert_allclose(weights @ directions**2, np.full(3, 4 * np.pi / 3))


@pytest.mark.parametrize("seed", range(5))
def test_rotated_coefficients_follow_the_directions(seed):
    rotation, directions = random_rotation(seed), random_directions(200, seed + 10)
    coefficients = np.random.default_rng(seed + 20).normal(size=(7, SH_COUNT))
    matrix = sh_rotation(rotation)
    turned = coefficients @ matrix.T
    np.testing.assert_allclose(
        sh_basis(directions @ rotation.T) @ turned.T, sh_basis(directions) @ coefficients.T, atol=ROUNDING
    )
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(SH_COUNT), atol=ROUNDING)
    assert (matrix[SH_DEGREES[:, None] != SH_DEGREES] == 0).all()


def test_rotations_compose_and_the_identity_stays():
    a, b = random_rotation(1), random_rotation(2)
    np.testing.assert_allclose(sh_rotation(a @ b), sh_rotation(a) @ sh_rotation(b), atol=ROUNDING)
    np.testing.assert_allclose(sh_rotation(np.eye(3)), np.eye(SH_COUNT), atol=ROUNDING)


def test_the_same_columns_serve_torch():
    torch = pytest.importorskip("torch")
    directions = random_directions(50)
    columns = sh_columns(*torch.from_numpy(directions).unbind(-1))
    np.testing.assert_allclose(torch.stack(columns, -1).numpy(), sh_basis(directions), atol=1e-14)


def test_precision_follows_the_input():
    assert sh_basis(random_directions(4).astype(np.float32)).dtype == np.float32
