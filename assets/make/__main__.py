"""``python -m assets.make [body] [figure] [prior] [walk] [turn] [sky] [capture] [contact]``: remakes these.

Without names it remakes all but figure and prior.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rnd_runtime.capture.body import Body
from rnd_runtime.motion.motion import save_motion
from rnd_stage.film.dances import turn_round, walk
from rnd_stage.people.template import template_body
from rnd_trainer.estimating.fitting.figure import TEMPLATE
from rnd_trainer.estimating.fitting.prior import FILE

from . import sky

ASSETS = Path(__file__).parents[1]
STEPS = ("body", "figure", "prior", "walk", "turn", "sky", "capture", "contact")


def main(steps: list[str]) -> None:
    """Run ``steps`` in the order in which one needs the other."""
    unknown = set(steps) - set(STEPS)
    if unknown:
        raise SystemExit(f"assets.make: expected {', '.join(STEPS)}, got {', '.join(sorted(unknown))}")
    steps = steps or [step for step in STEPS if step not in ("figure", "prior")]  # which need what is not in the clone
    if "body" in steps:
        template_body().save(ASSETS / "body.npz")
    body = Body.load(ASSETS / "body.npz")
    if "figure" in steps:
        from . import figure  # needs anny

        figure.make_figure(TEMPLATE)
    if "prior" in steps:
        from . import prior

        prior.make_pose_prior(FILE)
    if "walk" in steps:
        save_motion(ASSETS / "walk.npz", walk(body.skeleton))
    if "turn" in steps:
        save_motion(ASSETS / "turn.npz", turn_round())
    if "sky" in steps:
        sky.make_light(ASSETS / "sky.exr", sky.noon())
    if {"capture", "contact"} & set(steps):
        from . import capture  # needs mitsuba

        if "capture" in steps:
            capture.make_capture(ASSETS / "capture", body)
        capture.contact_sheet(ASSETS / "capture")


if __name__ == "__main__":
    main(sys.argv[1:])
