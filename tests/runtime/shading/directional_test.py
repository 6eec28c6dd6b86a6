import numpy as np
import pytest

from rnd_runtime.shading.directional import extract_directional
from rnd_runtime.shading.light import Light, texel_directions
from support.sun_scenes import beside_a_lamp, direction_of, energy, sky, with_sun

ENERGY = 1e-6  # relative; the sky is kept in float32, the sun takes what its rounding leaves
SUN_ENERGY = 1e-2  # FAILURES L1
HALF_TEXEL = 0.0123  # radians, of a map of 128 rows


PLACES = {
    "midday": (1.0, 0.4),
    "seam": (0.5, np.pi - 1e-3),
    "corner": (-0.2, -np.pi + 0.02),
    "zenith": (np.pi / 2, 0.0),
    "nearly zenith": (np.radians(88.5), 2.0),
    "nadir": (-np.pi / 2, 0.0),
}


@pytest.mark.parametrize("peak", [1e4, 1e5, 1e6])
@pytest.mark.parametrize("place", PLACES)
def test_a_sun_is_found_whole_and_where_it_is(place, peak):
    direction = direction_of(*PLACES[place])
    radiance, sun_energy = with_sun(sky(), direction, peak)
    light = Light(radiance)
    rest, suns = extract_directional(light)
    assert len(suns) == 1
    np.testing.assert_allclose(suns[0].irradiance, sun_energy, rtol=SUN_ENERGY)
    assert np.linalg.norm(suns[0].direction - direction) < HALF_TEXEL
    assert np.isclose(np.linalg.norm(suns[0].direction), 1)
    assert rest.radiance.max() < 3  # nothing of it is left behind
    assert (rest.radiance <= light.radiance).all()  # what is darker than the background stays dark
    np.testing.assert_allclose(energy(rest.radiance) + suns[0].irradiance, energy(light.radiance), rtol=ENERGY)


def test_the_spread_is_that_of_the_disc():
    radiance, _ = with_sun(sky(256), direction_of(0.6, 1.0), 1e5, radius=3)
    (sun,) = extract_directional(Light(radiance))[1]
    np.testing.assert_allclose(sun.spread, np.radians(3) / np.sqrt(2), rtol=0.02)


def test_two_suns_and_no_third():
    radiance = sky()
    for elevation, azimuth, peak in [(0.7, 1.0, 3e4), (0.3, -2.0, 5e4), (-0.5, 0.0, 2e4)]:
        radiance, _ = with_sun(radiance, direction_of(elevation, azimuth), peak)
    light = Light(radiance)
    rest, suns = extract_directional(light)
    np.testing.assert_allclose(suns[0].direction, direction_of(0.3, -2.0), atol=HALF_TEXEL)  # strongest first
    np.testing.assert_allclose(suns[1].direction, direction_of(0.7, 1.0), atol=HALF_TEXEL)
    total = energy(rest.radiance) + suns[0].irradiance + suns[1].irradiance
    np.testing.assert_allclose(total, energy(light.radiance), rtol=ENERGY)
    assert rest.radiance.max() > 1e4  # the third stays in the map


@pytest.mark.parametrize("kind", ["overcast", "black", "constant", "window", "faint lamp", "lamp and panes"])
def test_where_there_is_no_sun_none_is_found(kind):
    radiance = sky()
    directions = texel_directions(*radiance.shape[:2])
    if kind == "black":
        radiance = 0 * radiance
    elif kind == "constant":
        radiance = np.ones_like(radiance)
    elif kind == "window":  # 50° wide
        radiance = np.where((directions[..., 0] > np.cos(np.radians(25)))[..., None], 100.0, radiance)
    elif kind == "faint lamp":
        radiance, _ = with_sun(radiance, direction_of(0.5, 0.5), 500)
    elif kind == "lamp and panes":  # of 10° each, brighter from one to the next
        azimuth, height = np.degrees(np.arctan2(directions[..., 2], directions[..., 0])), directions[..., 1]
        pane = (np.abs(azimuth) < 50) & (np.abs(height) < np.sin(np.radians(15))) & (azimuth % 10 > 2)
        radiance = np.where(pane[..., None], 20.0 + 0.2 * azimuth[..., None], radiance)
        radiance, _ = with_sun(radiance, direction_of(1.0, 3.0), 500)
    light = Light(radiance)
    rest, suns = extract_directional(light)
    assert suns == ()
    np.testing.assert_array_equal(rest.radiance, light.radiance)


def test_large_and_tiny_maps():
    radiance, sun_energy = with_sun(sky(600), direction_of(0.5, 0.5), 1e5)
    rest, suns = extract_directional(Light(radiance))
    assert rest.radiance.shape == (512, 1024, 3)
    np.testing.assert_allclose(suns[0].irradiance, sun_energy, rtol=SUN_ENERGY)
    spot = np.ones((4, 8, 3))
    spot[1, 3] = 1e6
    rest, suns = extract_directional(Light(spot))
    assert suns == ()  # a texel of 45° is no sun


def test_a_brighter_lamp_too_weak_for_a_sun_hides_none():
    radiance, sun_energy = beside_a_lamp()
    light = Light(radiance)
    brightest = texel_directions(*radiance.shape[:2]).reshape(-1, 3)[light.radiance[..., 1].argmax()]
    assert brightest @ direction_of(0.2, -2.0) > np.cos(np.radians(1))
    rest, suns = extract_directional(light)
    assert len(suns) == 1
    np.testing.assert_allclose(suns[0].direction, direction_of(0.7, 1.0), atol=HALF_TEXEL)
    np.testing.assert_allclose(suns[0].irradiance, sun_energy, rtol=SUN_ENERGY)
    assert rest.radiance.max() == light.radiance.max()  # the lamp stays in the map
