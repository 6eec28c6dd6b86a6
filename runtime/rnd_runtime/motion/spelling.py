"""Spellings of joint names: prefixes and suffixes that say nothing, and sides."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_SHARED = 0.8  # of the joints have what says nothing
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_NUMBER = re.compile(r"(?<=.)_\d+$")
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_MIDDLE = ("c", "m", "mid", "center")
_SEPARATORS = str.maketrans("", "", "_-. |")


def plain(name: str) -> str:
    """``name`` without namespace, separators and capitals."""
    return name.rsplit(":", 1)[-1].translate(_SEPARATORS).lower()


def sided(name: str) -> str:
    """``plain`` with the one word of a side in front: "left|upleg" of "LeftUpLeg", "l_upleg" and "UpLeg.L".

    Without the word of the middle: "hips" of "C_Hips".
    """
    words = [word.lower() for word in _WORDS.findall(name.rsplit(":", 1)[-1])]
    sides = [word for word in words if word in _SIDES]
    if len(sides) != 1:
        return "".join(word for word in words if word not in _MIDDLE) if not sides else plain(name)
    words.remove(sides[0])
    return f"{_SIDES[sides[0]]}|{''.join(words)}"


def keys(names: Sequence[str]) -> list[dict[str, int]]:
    """Index in ``names`` by key: as spelled, then without what most share, then with sides apart."""
    bare = _without_shared([name.rsplit(":", 1)[-1] for name in names])
    spelled = [[plain(name) for name in names], [plain(name) for name in bare], [sided(name) for name in bare]]
    return [{key: index for index, key in reversed(list(enumerate(one))) if key} for one in spelled]


def _without_shared(names: list[str]) -> list[str]:
    """``names`` without the prefix and the suffix that most of them share, such as each one's "_" and number."""
    numbered = [_NUMBER.sub("", name) for name in names]
    if sum(map(str.__ne__, names, numbered)) >= _SHARED * len(names):
        names = numbered
    prefix = _common(names)
    names = [name.removeprefix(prefix) or name for name in names]
    suffix = _common([name[::-1] for name in names])[::-1]
    if not suffix or suffix[0].isalnum():  # no word of its own, such as "_JNT"
        return names
    return [name.removesuffix(suffix) or name for name in names]


def _common(names: Iterable[str]) -> str:
    """The longest prefix of most of ``names``."""
    names, prefix = list(names), ""
    while names:
        following = [name[len(prefix)] for name in names if name.startswith(prefix) and len(name) > len(prefix)]
        if not following:
            break
        best = max(set(following), key=following.count)
        if following.count(best) < _SHARED * len(names):
            break
        prefix += best
    return prefix
