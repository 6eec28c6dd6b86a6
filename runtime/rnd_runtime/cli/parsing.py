"""Rules by which tyro reads a command line, and what it refuses in one line."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from rnd_runtime.core.errors import InputError, flag

# What other programs call our options; the first that the command has is suggested.
_MEANT = {
    "light": ("hdr",),
    "probe": ("hdr",),
    "hdri": ("hdr",),
    "envmap": ("hdr",),
    "environment": ("hdr",),
    "resolution": ("size",),
    "res": ("size",),
    "width": ("size",),
    "height": ("size",),
    "output": ("out",),
    "o": ("out",),
    "poses": ("motion",),
    "animation": ("motion",),
    "anim": ("motion",),
    "bg": ("background",),
    "cam": ("camera",),
    "view": ("camera",),
    "framerate": ("fps",),
    "gpu": ("device", "raster"),
    "iterations": ("steps",),
    "epochs": ("steps",),
    "pictures": ("strips", "images"),
}


def refuse_unknown(taken: Sequence[str], prog: str, words: Sequence[str], unknown: Mapping[str, str]) -> None:
    """Raise ``InputError`` for an option that the command lacks, with the one that was meant where that is known.

    tyro would take the words after it for missing or superfluous arguments.
    """
    for word in words[: words.index("--")] if "--" in words else words:
        given = word.split("=")[0]
        name = given[2:].replace("_", "-")
        if not given.startswith("--") or name in (*taken, "help") or name.startswith("tyro-"):
            continue
        if name in unknown:
            raise InputError(f"unknown option {given}", hint=unknown[name])
        if meant := next((meant for meant in _MEANT.get(name, ()) if meant in taken), None):
            raise InputError(f"{given}: {prog} takes --{meant}", hint=f"see {prog} --help")
        close = "".join(f"perhaps --{meant}; " for meant in difflib.get_close_matches(name, taken, 1))
        raise InputError(f"unknown option {given}", hint=f"{close}see {prog} --help")


def names(kind: type[Any]) -> Iterator[str]:
    """The options of a dataclass and of those in it, without dashes."""
    kinds = get_type_hints(kind, include_extras=True)
    for each in fields(kind):
        inner, *notes = get_args(kinds[each.name]) if get_origin(kinds[each.name]) is Annotated else [kinds[each.name]]
        if is_dataclass(inner):
            yield from names(inner)  # type: ignore[arg-type]
            continue
        for note in notes:
            yield from (alias.lstrip("-") for alias in getattr(note, "aliases", None) or ())
        name = next((note.name for note in notes if getattr(note, "name", None)), flag(each.name)[2:])
        yield from (name, f"no-{name}") if inner is bool else (name,)


def registry() -> ConstructorRegistry:
    """Rules by which tyro takes paths (no empty ones), numbers, and what may be missing."""
    rules = ConstructorRegistry()

    @rules.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
        if len(kinds) != 1 or len(get_args(info.type)) != 2 or NoneType not in get_args(info.type):
            return None
        inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
        if not isinstance(inner, PrimitiveConstructorSpec):
            return None
        return replace(
            inner,
            is_instance=lambda value: value is None or inner.is_instance(value),
            str_from_instance=lambda value: [] if value is None else inner.str_from_instance(value),
        )

    @rules.primitive_rule
    def primitive(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        readers: dict[Any, tuple[str, Callable[[str], Any]]] = {Path: ("FILE", _path), int: ("N", _int)}
        readers[float] = ("N", _float)
        if info.type not in readers:
            return None
        metavar, read = readers[info.type]
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=metavar,
            instance_from_str=lambda words: read(words[0]),
            is_instance=lambda value: isinstance(value, info.type),
            str_from_instance=lambda value: [str(value)],
        )

    return rules


def _path(text: str) -> Path:
    if not text:  # Path("") is the current folder
        raise ValueError("expected a path, got nothing")
    return Path(text)


def _int(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"expected a whole number, got {text or 'nothing'}") from None


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"expected a number, got {text or 'nothing'}") from None


def _choices(found: re.Match[str]) -> str:
    choices = found[3].replace("'", "")
    return f"{found[2]}: expected {choices}, got {found[1] or 'nothing'}"


def refusal(page: str) -> InputError:
    """A page of tyro's (a title, what is wrong, suggestions, where to read more, ruled) as one line."""
    lines = [line.strip(" │╭╮╰╯") for line in page.splitlines()][1:]
    parts = re.split(r"^[-─]+$", "\n".join(lines), flags=re.MULTILINE)
    parts = [part.strip() for part in parts if part.strip()] or [page]
    what = " ".join(parts[0].split("\n\n")[0].split()).removesuffix(".").replace(" (required)", ";").rstrip(";")
    what = what.removeprefix("Error parsing ").replace("'options.", "'")
    what = re.sub(r"^Missing value for argument '(.*)'\. Expected.*", r"\1: expected a value, got nothing", what)
    what = re.sub(r"^[Ii]nvalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*?),?\)", _choices, what)
    meant = next((part.splitlines()[1].split()[0] for part in parts if part.startswith("Perhaps")), None)
    hint = [f"perhaps {meant.rstrip(',')}"] if meant else []
    hint += [f"see {command}" for command in re.findall(r"[\w-]+(?: \w+)* --help", parts[-1])]
    if not what[:2].isupper():  # as a metavar is
        what = what[:1].lower() + what[1:]
    return InputError(what, hint="; ".join(hint) or None)
