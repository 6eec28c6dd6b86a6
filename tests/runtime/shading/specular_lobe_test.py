import numpy as np
import pytest

from rnd_runtime.shading.brdf import ROUGHNESS_RANGE, specular
from rnd_runtime.shading.specular_lobe import (
    LOBE_WIDTHS,
    attenuation,
    lobe_moments,
    lobe_table,
    make_table,
    mean_cosine,
    width_of_mean,
)


def moments_by_brute_force(roughness, cosine, count=800):
    """Energy and first moment of specular · max(n·l, 0) on a plain grid of the hemisphere."""
    z, azimuth = (np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count * np.pi
    z, azimuth = np.meshgrid(z, azimuth)
    x = np.sqrt(1 - z**2) * np.cos(azimuth)
    l_dot_v = x * np.sqrt(1 - cosine**2) + z * cosine
    weight = specular(np.float64(roughness), z, np.float64(cosine), l_dot_v) * z * 2 * np.pi / count**2
    return weight.sum(), -(weight * x).sum() / weight.sum(), (weight * z).sum() / weight.sum()


@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.3, 0.1, -0.3])
@pytest.mark.parametrize("roughness", [0.35, 0.6, 0.95])
def test_moments_agree_with_brute_force(roughness, cosine):
    measured = np.array([column[0] for column in lobe_moments(roughness, np.array([cosine]))])
    exact = moments_by_brute_force(roughness, cosine)
    # seen from the front the table errs by half a percent; from behind, where only tails show, by three
    np.testing.assert_allclose(measured, exact, atol=0.005 if cosine > 0 else 0.03, rtol=0.02)


@pytest.mark.parametrize("width", [1e-3, 0.02, 0.5, 2.0])
def test_attenuation_is_the_mean_of_legendre_polynomials(width):
    nodes, weights = np.polynomial.legendre.leggauss(100)
    low, high = np.log(width), np.log(width + 2)
    away = np.exp(low + (nodes + 1) / 2 * (high - low))  # a − x, in whose logarithm all is smooth
    x, weights = 1 + width - away, weights / away
    polynomials = [x, (3 * x**2 - 1) / 2, (5 * x**3 - 3 * x) / 2]
    exact = [weights @ p / weights.sum() for p in polynomials]
    np.testing.assert_allclose(attenuation(np.float64(width)), exact, rtol=1e-6)
    np.testing.assert_allclose(width_of_mean(mean_cosine(np.float64(width))), width, rtol=1e-4)


def test_the_table_holds_valid_lobes():
    table = lobe_table().astype(float)
    np.testing.assert_allclose(table, make_table(), rtol=0, atol=1e-6)  # another machine's logarithms
    assert np.isfinite(table).all()
    assert ((table[..., 0] > 0) & (table[..., 0] <= 1)).all()
    np.testing.assert_allclose(np.hypot(table[..., 1], table[..., 2]), 1, atol=1e-6)
    assert (table[..., 2] > 0).all()  # no lobe points below the horizon
    assert ((table[..., 3] >= 0) & (table[..., 3] < len(LOBE_WIDTHS) - 1)).all()  # the widest map is wide enough
    assert (np.diff(table[..., 4:], axis=-1) <= 0).all()  # higher degrees are left less


def test_a_mirror_reflects_at_the_mirrored_direction():
    energy, tangent, normal = (column[0] for column in lobe_moments(ROUGHNESS_RANGE[0], np.array([0.6])))
    np.testing.assert_allclose([tangent, normal], [0.8, 0.6], atol=0.005)
    np.testing.assert_allclose(energy, 0.04 + 0.96 * 0.4**5, rtol=0.02)  # Schlick at v·h = 0.6
