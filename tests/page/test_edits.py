"""Editing a task file changes only the edited values: comments, order, spacing and every other byte
stay."""

from __future__ import annotations

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.coordinator.page.edits import EditError, Rename, edited, parse, plain
from tests.page.test_formatting import sent_back

SHIPPED = Path(__file__).parents[2] / "coordinator" / "tasks"
FILES = [*sorted(SHIPPED.glob("*.toml")), *sorted((Path(__file__).parent / "tasks").glob("*.toml"))]
TEXTS = {path.stem: path.read_text(encoding="utf-8") for path in FILES}

names = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
scalars = st.one_of(
    st.integers(-(2**60), 2**60),
    st.booleans(),
    st.floats(allow_nan=False, allow_infinity=False, width=32),
    st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12),
)
values = st.recursive(
    scalars, lambda v: st.lists(v, max_size=3) | st.dictionaries(names, v, max_size=3), max_leaves=6
)
blanks = st.sampled_from(["", " ", "  "])
comments = st.sampled_from(["", "  # why it is so", ' # 1 [not.a.header] = "text"'])


def through_a_browser(document: dict[str, Any]) -> dict[str, Any]:
    """Return what the page sends back: JSON, in which 1.0 has become 1."""
    sent: dict[str, Any] = sent_back(json.loads(json.dumps(document)))
    return sent


def written(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return "[ " + ", ".join(map(written, value)) + " ]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {written(v)}" for k, v in value.items()) + " }"
    return repr(value)


@st.composite
def files(draw: st.DrawFn) -> str:
    """Return a strategy for task files as people write them: comments anywhere, irregular spacing,
    tables in any order."""
    lines = ["# head", "schema=1" + draw(comments), ""]
    for group in draw(st.permutations(["places", "transitions", "events"])):
        for name in draw(st.lists(names, min_size=1, max_size=3, unique=True)):
            lines += ["# about " + name] if draw(st.booleans()) else []
            lines.append(f"[{group}.{name}]" + draw(comments))
            for key, value in draw(st.dictionaries(names, values, max_size=4)).items():
                lines.append(
                    f"{draw(blanks)}{key}{draw(blanks)}={draw(blanks)}{written(value)}{draw(comments)}"
                )
            lines += [""] * draw(st.integers(0, 2))
    return "\n".join(lines) + draw(st.sampled_from(["", "\n", "\n\n# end\n"]))


@pytest.mark.parametrize("name", TEXTS)
def test_saving_without_an_edit_changes_nothing(name: str) -> None:
    """Every shipped task, opened in the page and saved again, is byte for byte what it was."""
    text = TEXTS[name]
    assert edited(text, through_a_browser(plain(parse(text)))) == text


@settings(max_examples=40)
@given(files())
def test_saving_any_file_without_an_edit_changes_nothing(text: str) -> None:
    """The same holds for any file."""
    assert edited(text, through_a_browser(plain(parse(text)))) == text


@settings(max_examples=40)
@given(files(), st.data())
def test_one_edit_changes_one_line(text: str, data: st.DataObject) -> None:
    """A changed value changes only its own line, and its comment stays."""
    document = plain(parse(text))
    group = data.draw(
        st.sampled_from([g for g in ("places", "transitions", "events") if document.get(g)])
    )
    table = document[group][data.draw(st.sampled_from(sorted(document[group])))]
    if not table:
        return
    key = data.draw(st.sampled_from(sorted(table)))
    if isinstance(table[key], dict):
        return
    from_a_page = scalars.filter(
        lambda v: not isinstance(v, float) and (not isinstance(v, int) or abs(v) < 2**53)
    )
    table[key] = data.draw(from_a_page.filter(lambda v: v != table[key]))
    result = edited(text, through_a_browser(document))
    before, after = text.split("\n"), result.split("\n")
    assert len(before) == len(after)
    different = [(b, a) for b, a in zip(before, after, strict=True) if b != a]
    assert len(different) <= 1
    for old, new in different:
        assert old.partition("=")[0] == new.partition("=")[0]
    assert tomllib.loads(result) is not None


@settings(max_examples=40)
@given(files(), st.data())
def test_adding_and_deleting_elements_keeps_all_other_lines(text: str, data: st.DataObject) -> None:
    """The lines of the other elements stay in their order."""
    document = plain(parse(text))
    name = data.draw(names.filter(lambda n: n not in document["places"]))
    grown = copy.deepcopy(document)
    grown["places"][name] = {"kind": "control", "x": 10, "y": 20, "args": {"p": {"var": "q"}}}
    result = edited(text, grown)
    left = iter(result.split("\n"))
    assert all(line in left for line in text.split("\n") if line.strip()), (
        "a line was lost or moved"
    )
    back = plain(parse(edited(result, document)))
    assert back == document


def test_a_renamed_element_keeps_its_position_and_comments() -> None:
    """The header is renamed in place; the lines below it stay."""
    text = TEXTS["pick_and_place"]
    document = plain(parse(text))
    document["places"] = {("grab" if n == "pick" else n): p for n, p in document["places"].items()}
    result = edited(text, document, [Rename(("places",), "pick", "grab")])
    assert result == text.replace("[places.pick]", "[places.grab]")


def test_a_renamed_element_without_a_header_is_written_again() -> None:
    """Inline tables have no header to rename; the element is written again, and the document is
    correct."""
    text = "schema = 1\n[places]\na = {kind = 'control'} # first\n"
    result = edited(
        text, {"schema": 1, "places": {"b": {"kind": "control"}}}, [Rename(("places",), "a", "b")]
    )
    assert plain(parse(result)) == {"schema": 1, "places": {"b": {"kind": "control"}}}


def test_numbers_keep_their_kind() -> None:
    """An integer typed for a decimal value is written with a decimal point."""
    assert edited("a = 2.5 # s\n", {"a": 3}) == "a = 3.0 # s\n"
    assert edited("a = 2\n", {"a": 3}) == "a = 3\n"
    assert edited("a = true\n", {"a": 1}) == "a = 1\n"


def test_lists_keep_their_layout() -> None:
    """Adding an arc to a list on several lines keeps the other lines and their comments."""
    text = 'in = [\n  "a", # first\n  "b",\n]\n'
    result = edited(text, {"in": ["a", "b", "c"]})
    assert tomllib.loads(result) == {"in": ["a", "b", "c"]}
    assert '"a", # first\n' in result
    assert edited(result, {"in": ["a", "b"]}).count("# first") == 1


def test_values_that_json_cannot_hold_survive() -> None:
    """Dates, infinities and huge integers are sent to the page as text and return unchanged."""
    text = "when = 2026-01-02T03:04:05Z\nlimit = inf\nbig = 123456789012345678901\nodd = nan\n"
    assert edited(text, through_a_browser(plain(parse(text)))) == text


@pytest.mark.parametrize("text", ["a = ", "[a", "a = 1\na = 2", "[a]\n[a]"])
def test_a_file_that_is_not_toml_is_refused(text: str) -> None:
    """A file that is broken on disk is not overwritten."""
    with pytest.raises(EditError):
        edited(text, {})
