"""Task files in different formatting: without an edit nothing changes, and an edit changes nothing
else."""

from __future__ import annotations

import copy
import json
from typing import Any

from hypothesis import HealthCheck, assume, given, settings, strategies as st

from petrobot.coordinator.page.edits import edited, parse, plain

comments = st.sampled_from(["", " # why", '   # [places.p0] = "1"', "\t# tab"])
equals = st.sampled_from([" = ", "=", "  =  ", " =\t"])
numbers = st.sampled_from(["10", "1.50", "1_000", "+5", "0x10", "1e2", "-3"])
blank = st.sampled_from(["", "", "\n", "\n\n", "\n# a remark on its own\n"])
KINDS = ('"control"', "'resource'", '"""control"""')
WAYS = ("header", "header", "header", "inline", "dotted", "quoted")


def sent_back(value: Any) -> Any:
    """Return what the page sends: JSON, in which 1.0 has become 1."""
    if isinstance(value, dict):
        return {k: sent_back(v) for k, v in value.items()}
    if isinstance(value, list):
        return [sent_back(v) for v in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


@st.composite
def place(draw: st.DrawFn, name: str, way: str) -> tuple[str, str]:
    """Draw one place: (its block with a header or "", its lines under a common [places])."""
    kind, end = draw(st.sampled_from(KINDS)), draw(comments)
    eq = draw(equals)
    where = draw(st.booleans())
    if way == "inline":
        position = f", x = {draw(numbers)}, y={draw(numbers)}" if where else ""
        return "", f"{name}{eq}{{kind={kind}{position}}}{end}\n"
    if way == "dotted":
        return "", f"{name}.kind{eq}{kind}{end}\n" + (
            f"{name}.x = {draw(numbers)}\n" if where else ""
        )
    key = json.dumps(name) if way == "quoted" else name
    lines = [
        f"{draw(st.sampled_from(['', '  ']))}[ places . {key} ]{end}",
        f"kind{eq}{kind}{draw(comments)}",
    ]
    lines += [f"x{eq}{draw(numbers)}{draw(comments)}", "y = 2"] if where else []
    lines += draw(
        st.lists(
            st.sampled_from(
                ["args = { v = {var='q'}, w= [1,2 ,3] } # args", "", "# said after it"]
            ),
            max_size=2,
            unique=True,
        )
    )
    lines += [f"[places.{name}.out] {end}", "k = 'v'"] if draw(st.booleans()) else []
    return "\n".join(lines) + "\n", ""


@st.composite
def transition(draw: st.DrawFn, name: str) -> str:
    """Draw one transition with its arcs on one line or several."""
    took = draw(
        st.sampled_from(
            [
                'in = ["p0"]',
                'in = [\n  "p0", # first\n]',
                "in=['p0' , ]",
                'in = [\n\t"p0",\n\n\t"p1*2" # two\n\t]',
            ]
        )
    )
    gave = draw(st.sampled_from(["out = []", 'out = ["p0*2"]', "out = [ # none\n]"]))
    return f"[transitions.{name}]{draw(comments)}\n{took}{draw(comments)}\n{gave}\n"


@st.composite
def task_files(draw: st.DrawFn) -> str:
    """Draw a whole file: sections in any order, LF or CR LF, with or without a final line end."""
    made = [
        draw(place(f"p{i}", draw(st.sampled_from(WAYS)))) for i in range(draw(st.integers(1, 4)))
    ]
    common = "".join(lines for _, lines in made)
    text = draw(
        st.sampled_from(
            ["", "text = '''\nof\n lines'''\n", 'text = """a \\\n   b"""\n', "parameters.a = 1\n"]
        )
    )
    blocks = [block for block, _ in made if block] + ([f"[places]\n{common}"] if common else [])
    blocks += [draw(transition(f"t{i}")) for i in range(draw(st.integers(1, 3)))]
    blocks.append(f"[task]{draw(comments)}\nname{draw(equals)}'x'\nfinal = \"p0 == 1\"\n{text}")
    blocks += draw(
        st.sampled_from([[], ["[[extra]]\na = 1\n", "[[extra]]\na = 2 # two\n[extra.sub]\nb=1\n"]])
    )
    if len(blocks) < 4 or not blocks[-1].startswith("[[extra]]"):
        blocks = draw(st.permutations(blocks))
    whole = f"# top\nschema = 1{draw(comments)}\n" + "".join(
        draw(blank) + block for block in blocks
    )
    whole = whole if draw(st.booleans()) else whole.rstrip("\n")
    return whole.replace("\n", draw(st.sampled_from(["\n", "\r\n"])))


def document_of(text: str) -> dict[str, Any]:
    """Return what the page gets; texts that are not TOML are skipped."""
    try:
        return plain(parse(text))
    except ValueError:
        assume(False)
        raise


many = settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    deadline=None,
)


@many
@given(task_files())
def test_a_file_without_an_edit_is_unchanged(text: str) -> None:
    """From the file to the page and back every byte stays the same."""
    assert edited(text, sent_back(document_of(text))) == text


@many
@given(task_files(), st.data())
def test_an_edit_keeps_all_other_lines_and_comments(text: str, data: st.DataObject) -> None:
    """Moving a place, putting it into a macro place, or adding an arc or element loses no line of
    other elements and keeps line ends."""
    document = document_of(text)
    wanted = copy.deepcopy(document)
    name = data.draw(st.sampled_from(sorted(document["places"])))
    edit = data.draw(st.sampled_from(["move", "macro", "arc", "place", "transition"]))
    if edit == "move":
        wanted["places"][name] |= {"x": 777, "y": 888}
    elif edit == "macro":
        wanted["places"]["group"] = {"kind": "macro"}
        wanted["places"][name]["macro"] = "group"
    elif edit == "arc":
        wanted["transitions"]["t0"]["in"] = [*wanted["transitions"]["t0"]["in"], "p9:normal"]
    elif edit == "place":
        wanted["places"]["fresh"] = {"kind": "control", "x": 1, "y": 2}
    else:
        wanted["transitions"]["fresh"] = {"in": ["p0"], "out": [], "x": 1, "y": 2}
    result = edited(text, sent_back(wanted))
    assert sent_back(plain(parse(result))) == sent_back(wanted)
    assert ("\r\n" in text) == ("\r\n" in result) and (
        ("\r\n" not in text) or "\n" not in result.replace("\r\n", "")
    )
    assert result.count("#") >= text.count("#"), "a comment was lost"
    kept = result.splitlines()
    changed = [line for line in text.splitlines() if line.strip() and line not in kept]
    assert len(changed) <= 2, changed
    assert sent_back(plain(parse(edited(result, sent_back(document))))) == sent_back(document), (
        "undoing the edit must restore the file"
    )
