"""Rows L1–L10 and L15: suns, broken and black maps, orientation, resizing, rotation, furnace, normals, probes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from rnd_bench.scenes.lights import SUN_RADIUS, sun_and_sky, sun_disc
from rnd_bench.scenes.psnr import Floats, decibels
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, above, at_least, at_most, below, holds, result
from rnd_bench.stability.processes import play, run_commands
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.shading.brdf import F0, LARGEST_ALBEDO, ROUGHNESS_RANGE, specular
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import REC709_LUMINANCE, Light, Up, downsize, texel_directions, texel_solid_angles
from rnd_runtime.shading.reference import shade_reference
from rnd_runtime.shading.sh import SH_COUNT
from rnd_runtime.shading.shader import Shader

from .captures import flipped_normals

HALF_MAX = 65504.0  # the largest half float; a brighter texel is infinity in a half EXR
SUNS = (1e5, 1e6, HALF_MAX)
FIREFLY = 4.0  # times the brightest neighbour
GRAZING = 0.1  # largest n·v of a grazing view
ELEVATIONS = (-90.0, -60.0, -10.0, 0.0, 20.0, 45.0, 75.0, 88.0, 90.0)


def ball(count: int = 2000) -> Gaussians:
    """A white, rough, unshadowed unit ball."""
    k = np.arange(count) + 0.5
    y, azimuth = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - y * y)
    normals = np.stack([ring * np.cos(azimuth), y, ring * np.sin(azimuth)], -1)
    visibility = np.zeros((count, SH_COUNT))
    visibility[:, 0] = np.sqrt(4 * np.pi)
    size = 4 * np.pi / count
    covariances = np.tile(size / 4 * np.array([1, 0, 0, 1, 0, 1.0]), (count, 1))
    opaque, white, rough = np.full(count, 0.99), np.ones((count, 3)), np.full(count, 0.99)
    arrays = (normals, covariances, opaque, normals, white, rough, visibility, np.eye(3))
    return Gaussians(*(np.ascontiguousarray(a, np.float32) for a in arrays))


def bright_suns(subject: Subject) -> Result:
    """L1: suns of radiance 1e5, 1e6 and the largest half float, at several elevations."""
    white = ball()
    worst, plain, flies = 0.0, 0.0, 0.0
    for radiance in SUNS:
        for elevation in (40.0,) if subject.small else (5.0, 40.0, 85.0):
            way = _towards(elevation, 0.2)
            way /= np.linalg.norm(way)
            disc = sun_disc(256, way, radiance)
            light = Light((disc * np.ones(3)).astype(np.float32))
            facing = int(np.argmax(white.normals @ way))
            cosine = float(white.normals[facing] @ way)
            expected = np.pi * np.sin(SUN_RADIUS) ** 2 * radiance * cosine / np.pi
            whiter = replace(white, albedo=1 + white.albedo)
            shader, eye = Shader(light, "table+sun"), 20.0 * way
            lit = shader.shade(whiter, eye) - shader.shade(white, eye)  # without the specular part
            worst = float(np.maximum(worst, abs(float(lit[facing, 1]) / expected - 1)))  # keeps NaN
            plain = max(plain, _bilinear_error(disc, 2 * np.pi * (1 - np.cos(SUN_RADIUS)) * radiance))
        sky = sun_and_sky(128, radiance=radiance)
        posed = subject.avatar.pose(subject.walk(0.3), 0.2)
        flies = max(flies, _fireflies(subject.radiance(posed, shader=Shader(sky, "table+sun"))))
    baseline = "bilinear downsizing to 32×64", 100 * plain
    return result(
        below("energy of the sun on a facing surface, error", 100 * worst, 1, "%", baseline=baseline),
        at_most("fireflies: pixels over four times their brightest neighbour", flies, 0),
    )


def _towards(elevation: float, z: float) -> Floats:
    """Direction [3], not normalised, at ``elevation`` degrees in the plane of x and y, with ``z`` beside it."""
    return np.array([np.cos(np.radians(elevation)), np.sin(np.radians(elevation)), z])


def _bilinear_error(disc: Floats, energy: float) -> float:
    """Relative error of the energy of a light [H, W, 1] resized bilinearly to 32×64."""
    small = cv2.resize(disc[..., 0].astype(np.float32), (64, 32), interpolation=cv2.INTER_LINEAR)
    return abs(float((small * texel_solid_angles(32, 64)).sum()) / energy - 1)


def _fireflies(image: np.ndarray) -> float:
    luminance = np.where(image[..., 3] > 0.9, image[..., 1], 0).astype(np.float32)
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    around = cv2.dilate(luminance, ring)
    covered = cv2.erode((image[..., 3] > 0.9).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return float((covered & (luminance > FIREFLY * np.maximum(around, 1e-6))).sum())


def dark_maps(subject: Subject) -> Result:
    """L2: rnd-play with a black map and with one of 1e-6."""
    wrong, runs, levels = [], [], {"black": 0.0, "faint": 1e-6}
    for name, level in levels.items():
        file = subject.work / f"{name}.exr"
        write_image(file, np.full((16, 32, 3), level, np.float32))
        options = ("--hdr", file, "--size", 32, "--frames", "0:1", "--format", "png")
        runs.append(play(subject.avatar_file, subject.still_file, subject.work / f"out_{name}", *options))
    for (name, level), done in zip(levels.items(), run_commands(subject.work, runs)):
        if done.code != 0 or f"{level:.3g}" not in done.errors or "dark" not in done.errors:
            wrong.append(f"{name}: {done}")
        shade = Shader(load_light(subject.work / f"{name}.exr"), "table+sun")
        if not np.isfinite(subject.radiance(subject.rest, shader=shade)).all():
            wrong.append(f"{name}: not finite")
    return result(holds("maps without a warning that names their maximum", wrong))


def broken_texels(subject: Subject) -> Result:
    """L3: a NaN, an infinite and a negative texel."""
    clean = subject.light.radiance
    truth = subject.image(subject.rest)
    wrong, worst = [], np.inf
    for name, value in (("NaN", np.nan), ("infinite", np.inf), ("negative", -5.0)):
        broken = clean.copy()
        broken[20, 31], broken[90, 5, 1] = value, value
        file = subject.work / f"broken_{name}.exr"
        write_image(file, broken)
        light = load_light(file)
        if light.repaired != 2:
            wrong.append(f"{name}: {light.repaired} reported for 2")
        image = subject.image(subject.rest, shader=Shader(light, "table+sun"))
        if not np.isfinite(image).all():
            wrong.append(f"{name}: not finite")
        worst = float(np.minimum(worst, decibels(image, truth)))  # keeps NaN
    return result(holds("texels not repaired or not counted", wrong), above("PSNR to the clean map", worst, 45, "dB"))


def orientation(subject: Subject) -> Result:
    """L4: a lit spot on each axis, for all three up axes."""
    white = ball()
    # rotations from the file's world to ours
    ways: dict[Up, Floats] = {
        "y": np.eye(3),
        "z": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]),
        "-y": np.diag([1, -1, -1.0]),
    }
    worst = 1.0
    directions = texel_directions(32, 64)
    for up, to_world in ways.items():
        for axis in (*np.eye(3), *-np.eye(3)):
            spot = (directions @ axis > np.cos(0.2)).astype(np.float32)
            radiance = 50 * np.repeat(spot[..., None], 3, axis=2)
            for mode in ("table", "table+sun", "brute"):
                lit = Shader(Light(radiance, up=up), mode).shade(white, [0, 0, 0])[:, 1]
                brightest = (lit[:, None] * white.normals).sum(0)
                brightest = brightest / np.linalg.norm(brightest)
                worst = float(np.minimum(worst, brightest @ (to_world @ axis)))
    return result(above("cosine between the lit side and the axis, worst of 54", worst, 0.99))


def resizing(subject: Subject) -> Result:
    """L5: a sun at elevations up to the poles, resized from 256×512 to 32×64 and to odd sizes."""
    worst, plain = 0.0, 0.0
    for elevation in ELEVATIONS:
        source = sun_disc(256, _towards(elevation, 0.1), 1e4)
        energy = float((source[..., 0] * texel_solid_angles(256, 512)).sum())
        for height, width in ((32, 64), (17, 34), (100, 200)):
            small = downsize(source * np.ones(3), height, width)[..., 0]
            worst = float(np.maximum(worst, abs((small * texel_solid_angles(height, width)).sum() / energy - 1)))
        plain = max(plain, _bilinear_error(source, energy))
    baseline = "bilinear", 100 * plain
    return result(below("energy of a sun after resizing, error", 100 * worst, 0.1, "%", baseline=baseline))


def turning_light(subject: Subject) -> Result:
    """L7: the light rotated by 360° in steps of 0.5°."""
    posed = subject.avatar.pose(subject.walk(0.3), 0.2)
    camera = subject.camera()
    angles = np.radians(0.5 * np.arange(subject.few(180, 720)))
    frames = (subject.image(posed, camera, subject.shader.with_yaw(angle)) for angle in angles)
    changes = [float(np.abs(now - before).mean()) for before, now in pairwise(frames)]
    ratio = max(changes) / float(np.median(changes))
    return result(below("frame difference, largest over median", ratio, 3, "×"))


def white_furnace(subject: Subject) -> Result:
    """L8: reflectance under uniform white light, roughness 0…1, albedo 0 and 1."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cosines = (nodes + 1) / 2
    hemispherical, facing = [], []
    for roughness in np.linspace(0, 1, subject.few(6, 11)):
        at = [_specular_reflectance(float(roughness), float(cosine)) for cosine in cosines]
        hemispherical.append(float(np.sum(weights * cosines * at)))  # ∫ R(μ) 2μ dμ
        facing.append(_specular_reflectance(float(roughness), 1.0))
    finite = bool(np.isfinite([*hemispherical, *facing]).all())
    what = f"albedo 1, played as {LARGEST_ALBEDO:.3f}: reflectance, largest over roughness"
    baseline = "the formula as printed", 1 + max(hemispherical)
    return result(
        at_most(what, LARGEST_ALBEDO + max(hemispherical), 1.0, baseline=baseline),
        at_least("albedo 0: reflectance at normal incidence, smallest over roughness", min(facing), F0 * (1 - 2e-3)),
        at_most("not finite", float(not finite), 0),
    )


def _specular_reflectance(roughness: float, cosine: float) -> float:
    """∫ specular · n·l dl for a view at ``cosine``, importance-sampled by D: 200 × 200 stratified half vectors."""
    alpha = float(np.clip(roughness, *ROUGHNESS_RANGE)) ** 2
    line = (np.arange(200) + 0.5) / 200
    u, azimuth = np.meshgrid(line, np.pi * line)  # half the azimuth: all is symmetric
    cosine_h = 1 / np.sqrt(1 + alpha**2 * u / (1 - u))
    sine_h = np.sqrt(1 - cosine_h**2)
    view_dot_half = sine_h * np.cos(azimuth) * np.sqrt(1 - cosine**2) + cosine_h * cosine
    n_dot_l = 2 * view_dot_half * cosine_h - cosine
    d = alpha**2 / (np.pi * cosine_h**4 * (alpha**2 + 1 / cosine_h**2 - 1) ** 2)
    density = d * cosine_h / (4 * np.abs(view_dot_half))
    value = specular(np.float64(roughness), n_dot_l, np.float64(cosine), 2 * view_dot_half**2 - 1)
    return float(np.mean(value * np.maximum(n_dot_l, 0) / density))


def broken_normals(subject: Subject) -> Result:
    """L9: normals flipped, zero, not unit, NaN: 1 % and all of them."""
    rest, wrong = subject.rest, []
    for share in (0.01, 1.0):
        hit = np.arange(len(rest.means)) % round(1 / share) == 0
        for name, factor in (("flipped", -1.0), ("zero", 0.0), ("not unit", 7.0), ("NaN", np.nan)):
            normals = rest.normals.copy()
            normals[hit] *= np.float32(factor)
            broken = replace(rest, normals=normals)
            for mode in ("ao", "table+sun", "brute"):
                image = subject.radiance(broken, shader=Shader(subject.light, mode))
                if not np.isfinite(image).all():
                    wrong.append(f"{share:.0%} {name} by {mode}")
    return result(holds("broken normals that make an image not finite", wrong), flipped_normals(subject))


def grazing(subject: Subject) -> Result:
    """L10: the specular term at silhouettes against the sum over a map that resolves the lobe.

    At roughness 0.1 the lobe is 1° wide: against 2048 rows of texels, 256 err by up to 11 %, 512 by 3 %, 1024 by < 1 %.
    """
    worst: dict[float, float] = {}
    finite = True
    for roughness, rows in ((0.1, subject.few(512, 1024)), (0.3, 256), (0.6, 256), (0.9, 256)):
        count = 3000
        # black in red, with the whole specular term
        blue, rough = np.full((count, 3), (0, 0, F0), np.float32), np.full(count, roughness, np.float32)
        dark = replace(ball(count), albedo=blue, roughness=rough)
        for way in ((0.0, 0.0, 1.0), (0.7, 0.3, -0.6)):
            eye = 60.0 * np.array(way)
            view = eye - dark.means
            cosine = (dark.normals * view).sum(1) / np.linalg.norm(view, axis=1)
            part = dark.only((cosine > 0) & (cosine < GRAZING))
            ours = Shader(subject.light, "table+sun").shade(part, eye)
            exact = shade_reference(part, subject.light, eye, texels=(rows, 2 * rows))
            finite &= bool(np.isfinite(ours).all())
            worst[roughness] = float(np.maximum(worst.get(roughness, 0.0), ours[:, 0].mean() / exact[:, 0].mean() - 1))
    others = max(excess for roughness, excess in worst.items() if roughness > 0.1)
    return result(
        at_most("specular over the reference at silhouettes, roughness 0.3 to 0.9, worst view", 100 * others, 10, "%"),
        at_most("the same at roughness 0.1", 100 * worst[0.1], 10, "%"),
        at_most("not finite", float(not finite), 0),
    )


def monochrome_probe(subject: Subject) -> Result:
    """L15: a coloured light as a 32×64 probe of three channels, and of one."""
    directions = texel_directions(64, 128)
    lamps = np.zeros((64, 128, 3))
    for way, colour in (((1, 0.4, 0.6), (6, 1, 0.5)), ((-1, 0.3, 0.5), (0.5, 1, 6)), ((0, 1, -0.2), (1, 4, 1))):
        lamps += np.exp(12 * (directions @ (np.array(way) / np.linalg.norm(way)) - 1))[..., None] * np.array(colour)
    light = Light((0.05 + lamps).astype(np.float32))
    grey = light.radiance @ REC709_LUMINANCE.astype(np.float32)
    one = Light(np.repeat(grey[..., None], 3, axis=2)).resized(32, 64)
    truth = subject.image(subject.rest, shader=Shader(light, "brute", texels=(64, 128)))
    ours = subject.image(subject.rest, shader=Shader(light.resized(32, 64), "brute"))
    mono = subject.image(subject.rest, shader=Shader(one, "brute"))
    baseline = "one channel", decibels(mono, truth)
    figure = above("PSNR under coloured lamps, RGB probe", decibels(ours, truth), 35, "dB", baseline=baseline)
    return result(figure, images=(to_bytes(ours), to_bytes(truth)))
