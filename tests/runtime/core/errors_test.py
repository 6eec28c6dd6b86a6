"""One line that names what, expected, got, file and frame."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from rnd_runtime.core.errors import InputError, refuse_changed, refuse_outside


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (InputError("poses"), "poses"),
        (InputError("poses", expected="numbers", got="NaN"), "poses: expected numbers, got NaN"),
        (InputError("poses", got=0), "poses: got 0"),
        (InputError("poses", expected=24), "poses: expected 24"),
        (
            InputError("poses", expected="numbers", got="NaN", file=Path("a/walk.npz"), frame=17),
            "a/walk.npz: frame 17: poses: expected numbers, got NaN",
        ),
        (InputError("poses", frame=0, hint="are these degrees?"), "frame 0: poses (are these degrees?)"),
        (InputError("poses", got="two\n  lines\t"), "poses: got two lines"),
        (InputError("not found", file="two  spaces.npz"), "two  spaces.npz: not found"),
    ],
)
def test_message(error, line):
    assert str(error) == line


def test_what_a_file_wrote_neither_reaches_the_terminal_raw_nor_fills_it():
    line = str(InputError("name", got="\x1b]0;pwned\x07\x1b[2J\u202ea\tb\u00a0é\udcff"))
    assert line == "name: got \\x1b]0;pwned\\x07\\x1b[2J\\u202ea\\tb\u00a0é\\udcff"
    long = str(InputError("name", got="x" * 5_000_000, file="a.npz", hint="rename it"))
    assert len(long) == 500 and long.startswith("a.npz: name") and long.endswith("(rename it)")
    assert len(str(InputError("name", got="\x1b" * 499))) == 500


def test_a_place_found_later_is_added_once():
    error = InputError("size", expected=1, got=2, hint="resize it").at(file="a.png", frame=3)
    assert str(error) == "a.png: frame 3: size: expected 1, got 2 (resize it)"
    assert str(error.at(file="b.png", frame=9)) == str(error)
    assert str(InputError("size").at(frame=0).at(frame=5)) == "frame 0: size"


@dataclass
class Options:
    size: int = 3
    name: str = "a"


def test_options_that_would_do_nothing_or_are_out_of_range_are_refused():
    refuse_changed(Options(size=4), ["name"], "no use")
    with pytest.raises(InputError, match=r"^--size: expected the default, got 4 \(no use\)$"):
        refuse_changed(Options(size=4), ["name", "size"], "no use")
    refuse_outside(Options(), {"size": (3, 3)})
    with pytest.raises(InputError, match=r"^--size: expected 0 to 2.5, got 3$"):
        refuse_outside(Options(), {"size": (0, 2.5)})
