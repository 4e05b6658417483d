"""Definitions of messages are read from the user's files, and goals are checked against them."""

from __future__ import annotations

from typing import Any

import pytest

from petrobot.services.adapters.ros2.messages import Field, faults, read

NAVIGATE = """\
#goal definition
geometry_msgs/PoseStamped pose
string behavior_tree   # which tree
---
#result definition
{result}
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
int16 number_of_recoveries
float32 distance_remaining
"""
HUMBLE, JAZZY = "std_msgs/Empty result", "uint16 NONE=0\nuint16 error_code\nstring error_msg"
SHAPES = """\
uint8 KIND=3
int8[] any
float64[3] three
string<=5[<=2] few "no"
bool flag true
byte raw
uint8[] blob
string<=3 name
float32 share
Point[] points
"""


def test_a_result_differs_between_distributions() -> None:
    name = "nav2_msgs/action/NavigateToPose"
    humble = read(name, NAVIGATE.format(result=HUMBLE), "humble.action")
    jazzy = read(name, NAVIGATE.format(result=JAZZY), "jazzy.action")
    assert list(humble[f"{name}.Result"]) == ["result"]
    assert list(jazzy[f"{name}.Result"]) == ["error_code", "error_msg"]
    assert humble[f"{name}.Goal"]["pose"] == Field("geometry_msgs/msg/PoseStamped")


@pytest.mark.parametrize(
    ("value", "wrong"),
    [
        ({}, ""),
        ({"any": [1, -128], "three": [1, 2.0, 3], "few": ["a"], "flag": True, "raw": 255}, ""),
        ({"blob": "AAEC", "points": [{"x": 1}]}, ""),
        ({"ani": []}, "did you mean 'any'?"),
        ({"any": [128]}, "any.0: expected int8, found '128'"),
        ({"any": [True]}, "any.0: expected int8"),
        ({"any": 3}, "any: expected a list of int8"),
        ({"three": [1, 2]}, "three: expected exactly 3 values, found 2"),
        ({"few": ["a", "b", "c"]}, "few: expected at most 2 values, found 3"),
        ({"few": ["abcde", "äöüß"]}, "few.1: expected at most 5 bytes, found 'äöüß'"),
        ({"name": "abcd"}, "name: expected at most 3 bytes"),
        ({"share": 1e39}, "share: expected float32, found '1e+39'"),
        ({"share": float("nan"), "name": "abc"}, ""),
        ({"flag": 1}, "flag: expected bool"),
        ({"points": [{"x": "far"}]}, "points.0.x: expected float64, found 'far'"),
        ({"points": [3]}, "points.0: expected a table (shapes/msg/Point)"),
        ({"KIND": 3}, "has no such field"),
    ],
)
def test_values_are_checked_against_their_definition(value: dict[str, Any], wrong: str) -> None:
    known = read("shapes/msg/Shapes", SHAPES, "Shapes.msg")
    known |= read("shapes/msg/Point", "float64 x\nfloat64 y", "Point.msg")
    found = faults(value, "shapes/msg/Shapes", known)
    assert len(found) == bool(wrong) and wrong in "".join(found)
    assert faults(value, "unknown/msg/Other", known) == []


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        ("Shapes", "", "expected a type such as"),
        ("shapes/msg/Shapes", "int32 a\nint32", "Shapes:2: expected `type name`"),
        ("shapes/action/Shapes", "int32 a\n---\n", "expected 3 parts"),
        ("shapes/srv/Shapes", "int32 a", "expected 2 parts"),
    ],
)
def test_a_broken_file_is_refused(name: str, text: str, wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        read(name, text, "Shapes")
