"""People made by code: four designed by hand, and random ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rnd_runtime.core.errors import InputError

from .fabrics import Fabric
from .garments import Cut, Garments
from .paint import Palette
from .shapes import Shape


@dataclass(frozen=True)
class PersonDesign:
    """A person: body shape, clothes, materials."""

    title: str
    shape: Shape
    garments: Garments
    palette: Palette


def subject(seed: int) -> PersonDesign:
    """The person of a seed: 0 to 3 are designed by hand, others random."""
    if seed < 0:
        raise InputError("--subject", expected="0 or more", got=seed)
    chosen = (_lumberjack, _flowers, _knitwear, _summer)
    return chosen[seed]() if seed < len(chosen) else _sampled(seed)


def _lumberjack() -> PersonDesign:
    return PersonDesign(
        "a broad man in a plaid shirt, jeans and trainers",
        Shape(height=1.02, shoulders=1.06, waist=1.08, hips=1.02, limbs=1.08, belly=0.022),
        Garments(loose=0.013, hang=0.016, hem=0.885, collar="shirt", leg=(0.010, 0.014, 0.026)),
        Palette(
            Fabric("plaid", (0.42, 0.045, 0.035), (0.035, 0.035, 0.045), (0.68, 0.60, 0.38)),
            Fabric("denim", (0.055, 0.095, 0.21), (0.30, 0.40, 0.56), THREAD_WHITE),
            beard=0.9,
            hair=(0.075, 0.040, 0.022),
            shoe=(0.30, 0.31, 0.33),
            buttons=True,
            seed=1,
        ),
    )


def _flowers() -> PersonDesign:
    return PersonDesign(
        "a woman in a printed dress with long hair and ankle boots",
        Shape(height=0.95, shoulders=0.89, waist=0.88, hips=1.05, limbs=0.88, bust=0.026),
        Garments(
            loose=0.009,
            hang=0.004,
            hem=0.50,
            sleeve=0.42,
            cuff=0.016,
            collar="v",
            cut="shorts",
            leg_hem=0.60,
            leg=(0.004, 0.004, 0.004),
            flare=0.13,
            shoe=0.15,
            hair="long",
        ),
        Palette(
            Fabric("print", (0.045, 0.085, 0.19), (0.72, 0.36, 0.30), (0.74, 0.66, 0.42), scale=1.15),
            Fabric("plain", (0.05, 0.05, 0.06), (0.08, 0.08, 0.09), (0.1, 0.1, 0.1)),
            skin=(0.62, 0.40, 0.30),
            hair=(0.23, 0.105, 0.045),
            shoe=(0.17, 0.075, 0.035),
            sole=(0.06, 0.045, 0.035),
            lips=(0.50, 0.12, 0.13),
            seed=2,
        ),
    )


def _knitwear() -> PersonDesign:
    return PersonDesign(
        "a slim man in a cable-knit sweater, wide cords, boots and a woollen cap",
        Shape(height=1.04, shoulders=0.96, waist=0.92, hips=0.95, limbs=0.92),
        Garments(
            loose=0.019,
            hang=0.015,
            hem=0.90,
            cuff=0.009,
            collar="turtle",
            leg=(0.014, 0.022, 0.042),
            shoe=0.17,
            hair="cap",
        ),
        Palette(
            Fabric("knit", (0.66, 0.58, 0.43), (0.74, 0.67, 0.52), (0.7, 0.6, 0.4)),
            Fabric("plain", (0.17, 0.115, 0.055), (0.26, 0.18, 0.09), (0.2, 0.1, 0.1)),
            skin=(0.23, 0.115, 0.070),
            hair=(0.035, 0.031, 0.030),
            shoe=(0.36, 0.13, 0.045),
            sole=(0.05, 0.045, 0.04),
            lips=(0.22, 0.085, 0.075),
            beard=0.5,
            seed=3,
        ),
    )


def _summer() -> PersonDesign:
    return PersonDesign(
        "a woman in a striped hooded top, a pleated skirt and canvas shoes, her hair in a bun",
        Shape(height=0.98, shoulders=0.94, waist=1.0, hips=1.10, limbs=1.0, bust=0.030, belly=0.008),
        Garments(
            loose=0.016,
            hang=0.010,
            hem=0.93,
            cuff=0.010,
            collar="hood",
            cut="skirt",
            leg_hem=0.58,
            flare=0.085,
            hair="bun",
        ),
        Palette(
            Fabric("stripes", (0.62, 0.63, 0.60), (0.02, 0.20, 0.23), (0.70, 0.42, 0.06)),
            Fabric("dots", (0.34, 0.06, 0.10), (0.70, 0.62, 0.50), (0.72, 0.45, 0.10)),
            skin=(0.40, 0.22, 0.14),
            hair=(0.045, 0.032, 0.028),
            shoe=(0.62, 0.60, 0.55),
            sole=(0.74, 0.73, 0.70),
            lips=(0.36, 0.10, 0.10),
            seed=4,
        ),
    )


THREAD_WHITE = (0.7, 0.68, 0.62)

_GROUNDS = (
    (0.42, 0.05, 0.04),
    (0.05, 0.09, 0.22),
    (0.06, 0.20, 0.14),
    (0.62, 0.55, 0.40),
    (0.35, 0.07, 0.20),
    (0.60, 0.38, 0.06),
    (0.10, 0.10, 0.11),
    (0.30, 0.36, 0.40),
)
_ACCENTS = ((0.72, 0.66, 0.50), (0.70, 0.42, 0.08), (0.06, 0.28, 0.32), (0.66, 0.30, 0.26), (0.04, 0.04, 0.05))
_SKINS = ((0.62, 0.40, 0.30), (0.50, 0.295, 0.205), (0.40, 0.22, 0.14), (0.23, 0.115, 0.070), (0.14, 0.070, 0.045))
_HAIRS = ((0.035, 0.031, 0.030), (0.060, 0.038, 0.025), (0.23, 0.105, 0.045), (0.45, 0.30, 0.13), (0.30, 0.29, 0.28))


def _sampled(seed: int) -> PersonDesign:
    rng = np.random.default_rng(seed)

    def pick(options):
        return options[rng.integers(len(options))]

    def fabric(kinds) -> Fabric:
        second, accent = (_ACCENTS[i] for i in rng.choice(len(_ACCENTS), 2, replace=False))
        return Fabric(pick(kinds), pick(_GROUNDS), second, accent, scale=float(rng.uniform(0.8, 1.3)))

    woman = bool(rng.random() < 0.5)
    girth = rng.uniform(0.9, 1.12)
    shape = Shape(
        height=float(rng.uniform(0.92, 1.0) if woman else rng.uniform(0.97, 1.06)),
        shoulders=float(girth**0.5 * (0.91 if woman else 1.02)),
        waist=float(girth * (0.92 if woman else 1.0)),
        hips=float(girth**0.7 * (1.07 if woman else 0.98)),
        limbs=float(girth**0.8 * (0.92 if woman else 1.0)),
        belly=float(max(0.0, girth - 1.0) * 0.25),
        bust=0.026 if woman else 0.0,
    )
    dress = woman and rng.random() < 0.35
    cut: Cut = (
        "shorts"
        if dress
        else pick(("trousers", "trousers", "shorts", "skirt") if woman else ("trousers", "trousers", "shorts"))
    )
    leg_hem = {"trousers": 0.052, "shorts": float(rng.uniform(0.5, 0.62)), "skirt": float(rng.uniform(0.45, 0.62))}[cut]
    garments = Garments(
        loose=float(rng.uniform(0.008, 0.018)),
        hang=float(rng.uniform(0.004, 0.016)),
        hem=float(rng.uniform(0.48, 0.62) if dress else rng.uniform(0.88, 0.93)),
        sleeve=float(pick((0.36, 0.44, 0.672, 0.672))),
        collar=pick(("v", "crew")) if dress else pick(("crew", "shirt", "turtle", "hood", "v")),
        cut=cut,
        leg_hem=leg_hem,
        flare=float(rng.uniform(0.06, 0.14)),
        shoe=float(pick((0.092, 0.092, 0.16))),
        hair=pick(("long", "bob", "bun", "cap")) if woman else pick(("short", "short", "cap")),
    )
    palette = Palette(
        fabric(("print", "dots", "stripes", "plaid") if dress else ("plaid", "knit", "stripes", "print", "plain")),
        Fabric("denim", (0.055, 0.095, 0.21), (0.30, 0.40, 0.56), THREAD_WHITE)
        if cut != "skirt" and rng.random() < 0.5
        else fabric(("plain", "dots") if cut == "skirt" else ("plain",)),
        skin=pick(_SKINS),
        hair=pick(_HAIRS),
        shoe=pick(_GROUNDS),
        beard=0.0 if woman else float(rng.uniform(0, 1)),
        buttons=garments.collar == "shirt",
        seed=int(seed),
    )
    return PersonDesign(f"random person {seed}", shape, garments, palette)
