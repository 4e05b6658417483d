"""Topics over DDS: byte for byte what rosbags writes, and through a real DDS domain."""

from __future__ import annotations

import random
import time
from typing import Any

import pytest

from petrobot.services.adapters.ros2 import messages as definitions
from petrobot.services.adapters.ros2.messages import Field
from tests.adapters.ros2.test_actions import Ports
from tests.waiting import Limit

pytest.importorskip("cyclonedds")
rosbags = pytest.importorskip("rosbags.typesys")
dds = pytest.importorskip("petrobot.services.adapters.ros2.dds")

TYPES = [
    "std_msgs/msg/String",
    "std_msgs/msg/Empty",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/ByteMultiArray",
    "std_msgs/msg/ColorRGBA",
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PolygonStamped",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Path",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Joy",
    "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/NavSatFix",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Range",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/JointTrajectory",
    "diagnostic_msgs/msg/DiagnosticArray",
    "unique_identifier_msgs/msg/UUID",
]


def files(store: Any, interface: str) -> dict[str, str]:
    """The .msg files of a type and of all types in it, by type."""
    first, *others = store.generate_msgdef(interface, ros_version=2)[0].split("=" * 80 + "\nMSG: ")
    found = {interface: first}
    for other in others:
        name, _, text = other.partition("\n")
        found[name.replace("/", "/msg/")] = text
    return found


def known(texts: dict[str, str]) -> definitions.Definitions:
    read = [definitions.read(name, text, name) for name, text in texts.items()]
    return {name: fields for one in read for name, fields in one.items()}


class Drawn:
    """Random messages, as plain data and as rosbags has them."""

    def __init__(self, store: Any, types: definitions.Definitions, seed: int) -> None:
        self.store, self.types, self.chance = store, types, random.Random(seed)

    def message(self, interface: str) -> tuple[dict[str, Any], Any]:
        ours, theirs = {}, {}
        for name, field in self.types[interface].items():
            ours[name], theirs[name] = self.field(field)
        if not theirs:
            theirs[dds.EMPTY] = 0
        return ours, self.store.types[interface](**theirs)

    def field(self, field: Field) -> tuple[Any, Any]:
        import numpy as np

        if not field.array:
            return self.value(field.type)
        most = 4 if field.size is None else field.size
        many = (
            most if field.size is not None and not field.bounded else self.chance.randint(0, most)
        )
        drawn = [self.value(field.type) for _ in range(many)]
        ours, theirs = [one for one, _ in drawn], [other for _, other in drawn]
        if field.type in ("string",) or "/" in field.type:
            return ours, theirs
        kind = {"byte": "uint8", "char": "uint8"}.get(field.type, field.type)
        return ours, np.array(theirs, kind)

    def value(self, kind: str) -> tuple[Any, Any]:
        if "/" in kind:
            return self.message(kind)
        if kind == "string":
            text = "".join(self.chance.choices("aé✓ \n0", k=self.chance.randint(0, 9)))
            return text, text
        if kind == "bool":
            truth = self.chance.random() < 0.5
            return truth, truth
        if kind.startswith("float"):
            number = self.chance.choice([0.0, -1.5, 2.0**-20, 1e6, 0.15625])
            return number, number
        low, high = definitions._INTEGERS[kind]
        if kind == "byte":
            high = 127  # rosbags has it with a sign
        whole = self.chance.choice([low, high, 0, 1, self.chance.randint(low, high)])
        return whole, whole


@pytest.mark.parametrize("distribution", ["ROS2_HUMBLE", "ROS2_JAZZY"])
@pytest.mark.parametrize("interface", TYPES)
def test_messages_are_the_bytes_of_rosbags(interface: str, distribution: str) -> None:
    store = rosbags.get_typestore(getattr(rosbags.Stores, distribution))
    types = known(files(store, interface))
    made = dds.Types(types)
    for seed in range(40):
        ours, theirs = Drawn(store, types, seed).message(interface)
        assert definitions.faults(ours, interface, types) == []
        wanted = bytes(store.serialize_cdr(theirs, interface))
        sample = made.make(interface, ours)
        written = sample.serialize(use_version_2=False)
        # After the header of 4 bytes; Cyclone fills up to a multiple of 4 with zeros.
        assert written[4 : len(wanted)] == wanted[4:] and not any(written[len(wanted) :]), ours
        assert dds.plain(made.of(interface).deserialize(wanted)) == ours


def test_numbers_that_are_not_finite_are_null_as_from_rosbridge() -> None:
    made = dds.Types(known({"a/msg/B": "float64 x\nfloat32[] y"}))
    sample = made.make("a/msg/B", {"x": float("nan"), "y": [1.0, float("inf")]})
    assert dds.plain(sample) == {"x": None, "y": [1.0, None]}


TWIST = "geometry_msgs/msg/Twist"
SPEED = {"topic": "/cmd_vel", "type": TWIST, "fields": ["linear.x", "angular.z"]}


ODD = {
    "odd/msg/In": "int64 big\nuint64 huge\nfloat64[] far\nbool[3] flags",
    "odd/msg/Odd": """\
int32 X=-123
string NAME="a # b"
odd/In[] inners
In[2] two
In[<=3] most
string<=4[<=2] words
byte raw
char letter
byte[2] raws
char[] letters
uint8[16] uuid
int8[] small
float32[3] singles
builtin_interfaces/Time stamp
builtin_interfaces/Duration[] spans
std_msgs/Empty[] nothings
uint16 with_default 7
bool last
""",
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Empty": "# nothing",
}


def test_unusual_messages() -> None:
    """Nested arrays of messages, 64 bits, bytes of fixed number, texts of base64 and "now"."""
    store = rosbags.get_typestore(rosbags.Stores.EMPTY)
    for name, text in ODD.items():
        store.register(rosbags.get_types_from_msg(text, name))
    types, inner = dds.Types(known(ODD)), {"big": -(2**63), "huge": 2**64 - 1, "far": [1e308]}
    message = {
        "inners": [{**inner, "flags": [True, False, True]}] * 2,
        "most": [{"big": 2**53 + 1}],
        "words": ["äö", ""],
        "raw": 255,
        "letter": 65,
        "raws": [0, 255],
        "letters": "AP8=",
        "uuid": list(range(240, 256)),
        "small": [-128, 127],
        "singles": [float("nan"), float("-inf"), 0.5],
        "stamp": "now",
        "spans": [{"sec": -1, "nanosec": 999_999_999}] * 3,
        "nothings": [{}, {}],
        "last": True,
    }
    assert definitions.faults(message, "odd/msg/Odd", known(ODD)) == []
    sample = types.make("odd/msg/Odd", message)
    sent = bytes(sample.serialize())
    theirs = bytes(store.serialize_cdr(store.deserialize_cdr(sent, "odd/msg/Odd"), "odd/msg/Odd"))
    assert sent.rstrip(b"\0") == theirs.rstrip(b"\0")
    got = dds.plain(type(sample).deserialize(theirs))
    assert got["uuid"] == message["uuid"] and got["letters"] == [0, 255] == got["raws"]
    assert got["inners"][1]["huge"] == 2**64 - 1 and got["most"][0]["big"] == 2**53 + 1
    assert got["singles"] == [None, None, 0.5] and got["nothings"] == [{}, {}]
    assert abs(got["stamp"]["sec"] - time.time()) < 600.0
    assert definitions.unfit(got, gaps=True) == ""


def test_topics_through_a_domain() -> None:
    """Two participants: set points in one direction, an event and a value in the other."""
    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    texts = files(store, TWIST)
    config = {"definitions": {name: name for name in texts}, "domain": random.randint(1, 100)}
    here, there = Ports(texts), Ports(texts)
    told = {"topic": "/cmd_vel", "type": TWIST, "event": "moves", "when": {"linear.x": [0.1, 9.0]}}
    base = dds.Topics({**config, "setpoints": {"speed": SPEED}}, here)
    watcher = dds.Topics({**config, "subscribe": {"speed": told}}, there)
    base.command(0.0, {"drive": ["speed"]})
    limit = Limit("the set point")
    while not there.events and limit.left():
        here.point.take(0.5, -0.25)  # the first may be lost: discovery is not over
        base.step(0.0)
        watcher.step(0.0)
        time.sleep(0.01)
    assert watcher.topics["speed"]["msg"]["angular"]["z"] == -0.25
    base.stop(0.0)
    assert base.stopped()
    limit = Limit("rest")
    while watcher.topics["speed"]["msg"]["linear"]["x"] and limit.left():
        watcher.step(0.0)
        time.sleep(0.01)
    assert len(there.events) == 1
    base.close()
    watcher.close()


@pytest.mark.parametrize(
    ("texts", "interface", "wrong"),
    [
        ({}, "a/msg/B", "expected the .msg file of a/msg/B"),
        ({"a/msg/B": "C inner"}, "a/msg/B", "expected the .msg file of a/msg/C"),
        ({"a/msg/B": "wstring text"}, "a/msg/B", "a/msg/B: text is a wstring"),
    ],
)
def test_a_type_that_cannot_be_made_is_refused(
    texts: dict[str, str], interface: str, wrong: str
) -> None:
    with pytest.raises(ValueError, match=wrong):
        dds.Types(known(texts)).of(interface)
