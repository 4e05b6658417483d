"""Texts that are not TOML: line, key, what was found, remedy."""

from __future__ import annotations

import pytest

from petrobot.services.host.toml_text import TomlError, key_lines, line_of, read_toml


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('a = 1\nb = "x', ":2: not valid TOML: the quote in column 5 is not closed; close it"),
        ("a = { b = 1,", ":1: not valid TOML: the brace in column 5 is not closed in its line; "),
        ("[t]\na = True", ":2: not valid TOML: True is Python; write true or false"),
        ("a = [1, word]", ':1: not valid TOML: word is a text without quotes; write "word"'),
        ("[t]\na = 1\n[u]\n[t]", ":4: t: already written in line 1; drop one of the two"),
        ("[t]\na = 1\nb = 2\na = 3", ":4: t.a: already written in line 2; drop one of the two"),
        (
            "a 1",
            ":1: not valid TOML: Expected '=' after a key in a key/value pair in column 3; see",
        ),
        ("[t", ":1: not valid TOML: Expected ']' at the end of a table declaration"),
        (b"a = 1\nb = '\xff'", ":2: file: is not UTF-8; save it as UTF-8"),
        (f"a = 1\nb = [{'1_0' * 3000}]", ":2: a number: needs more than 64 bits; write a smaller"),
        ("[t]\na = [1, { b = -9223372036854775809 }]", ":2: t.a.b: needs more than 64 bits; write"),
        ("a = " + "[" * 100_000, ": not valid TOML: nested too deeply; flatten it"),
    ],
)
def test_a_fault_is_told_with_its_line_and_a_remedy(text: str | bytes, said: str) -> None:
    with pytest.raises(TomlError) as caught:
        read_toml(text, "x.toml")
    assert str(caught.value).startswith(f"x.toml{said}"), caught.value


def test_a_byte_order_mark_is_no_fault() -> None:
    assert read_toml("\ufeffa = 1", "x") == read_toml(b"\xef\xbb\xbfa = 1", "x") == {"a": 1}


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("a", 1),
        ("t", 2),
        ("t.b", 3),
        ("t.c", 2),
        ("t.b.deep", 3),
        ("links.vision/arm", 5),
        ("places", 6),
        ("places.free.kind", 7),
        ("none", 1),
    ],
)
def test_the_line_of_a_key_or_of_what_is_around_it(key: str, line: int) -> None:
    """A table without a line of its own has that of the first one in it."""
    text = """a = 1
[t]  # a table
b = { deep = 1 }
[links]
"vision/arm" = 0.1
[places.free]
kind = "control"
"""
    assert line_of(key, key_lines(text)) == line
