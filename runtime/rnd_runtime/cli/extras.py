"""Packages that an extra of ours brings: which of them are missing, and what installs them."""

from __future__ import annotations

from importlib.util import find_spec

from rnd_runtime.core.errors import InputError

_PACKAGES = {
    "PIL": "Pillow",
    "av": "PyAV",
    "cv2": "OpenCV",
    "distributed": "Dask distributed",
    "pxr": "usd-core",
    "skimage": "scikit-image",
    "yaml": "PyYAML",
}
"""names of packages that differ from their modules'"""


def install_hint(extra: str) -> str:
    """What installs ``extra``; in a clone in place, as pip otherwise replaces its packages by copies."""
    return f"pip install 'rnd-avatar[{extra}]', in a clone pip install -e \".[{extra}]\""


def need_packages(extra: str, *modules: str, what: str = "", otherwise: str = "") -> None:
    """Raise ``InputError`` with the missing ones of ``modules`` and what installs ``extra``, unless there are none.

    Args:
        modules: top-level modules of packages.
        what: what needs them, with its verb: "meshes need".
        otherwise: what else could be done, after the hint.
    """
    if missing := [_PACKAGES.get(module, module) for module in modules if find_spec(module) is None]:
        verb = "are" if len(missing) > 1 else "is"
        names = " and ".join(filter(None, [", ".join(missing[:-1]), missing[-1]]))
        line = f"{what} {names}, which {verb} not installed" if what else f"{names} {verb} not installed"
        raise InputError(line, hint=install_hint(extra) + otherwise)
