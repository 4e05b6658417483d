"""The latch of the emergency stop: what is stored, what holds if it cannot be read or written, and
how a node uses it."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import pytest

from petrobot.services.host.emergency_latch import ALL, STATE, Latch, LatchError, latch_of, uptime
from petrobot.services.node.emergency_stops import LOOK, NEVER, EmergencyStops

DEVICES = ("arm", "camera", "gripper")


def stop(stops: EmergencyStops, devices: Iterable[str]) -> str:
    """Stop these devices; return what `done` received, at once."""
    why: list[str] = []
    stops.stop(list(devices), why.append)
    return why[0]


def clear(stops: EmergencyStops, devices: Sequence[str]) -> str:
    """Clear these devices; return what `done` received, at once."""
    why: list[str] = []
    stops.clear(devices, why.append)
    return why[0]


def latch(folder: Path) -> Latch:
    """A latch with two folders for its file."""
    return Latch("motion", [folder / "first", folder / "second"])


def test_stopped_devices_stay_stopped_until_they_are_cleared(tmp_path: Path) -> None:
    """Another process reads the same; stops are added; clearing some leaves the others."""
    assert latch(tmp_path).stopped() == frozenset()
    assert latch(tmp_path).stop(["arm"]) == tmp_path / "first" / "motion.stopped"
    latch(tmp_path).stop(["camera"])
    assert latch(tmp_path).stopped() == {"arm", "camera"}
    latch(tmp_path).clear(["arm"], DEVICES)
    assert latch(tmp_path).stopped() == {"camera"}
    latch(tmp_path).clear(DEVICES, DEVICES)
    assert latch(tmp_path).stopped() == frozenset() and not list(tmp_path.rglob("*.stopped*"))


def test_all_means_every_device_even_after_one_is_cleared(tmp_path: Path) -> None:
    latch(tmp_path).stop([ALL])
    latch(tmp_path).clear(["arm"], DEVICES)
    assert latch(tmp_path).stopped() == {"camera", "gripper"}


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"\xff\xfe\x00", None], ids=["empty", "blank", "no text", "a folder"]
)
def test_a_damaged_latch_stops_everything(tmp_path: Path, content: bytes | None) -> None:
    """A file that a power cut or a user has damaged is not a permission to move."""
    path = latch(tmp_path).paths[1]
    path.parent.mkdir()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    assert latch(tmp_path).stopped() == {ALL}
    stops = EmergencyStops(DEVICES, latch(tmp_path))
    assert stops.at_start() == list(DEVICES)


def test_a_process_without_free_descriptors_stops_nothing_without_a_latch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As under a flood of connections: that is no emergency stop."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("io.open", refuse)
    assert latch(tmp_path).stopped() == frozenset()
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "motion.stopped").touch()
    assert latch(tmp_path).stopped() == {ALL}, "in doubt it is stopped"


def test_the_second_folder_is_used_if_the_first_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "motion.stopped").mkdir()  # nothing can replace it
    assert Latch("motion", [tmp_path / "none" / ".." / "second"]).stop(["arm"])
    assert latch(tmp_path).stop(["arm"]) == tmp_path / "second" / "motion.stopped"


def test_a_stop_that_cannot_be_stored_is_reported_and_still_holds(tmp_path: Path) -> None:
    """It holds until the node ends; a clear that fails clears nothing, in memory or on disk."""
    (tmp_path / "file").write_text("")
    nowhere = Latch("motion", [tmp_path / "file" / "folder"])
    with pytest.raises(LatchError, match="Not a directory"):
        nowhere.stop(["arm"])
    stops = EmergencyStops(DEVICES, nowhere)
    assert "NOT STORED" in stop(stops, ["arm"]) and "arm" in stops
    stuck = latch(tmp_path)
    stuck.paths[0].mkdir(parents=True)
    stops = EmergencyStops(DEVICES, stuck)
    stops.at_start()
    assert (
        "remove this file by hand once the cell is safe" in clear(stops, ["arm"]) and "arm" in stops
    )


def test_a_stop_whose_file_is_gone_or_never_was_is_stored_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the next process of the node would move what this one holds stopped."""

    def no_room(path: Path, content: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    one = latch(tmp_path)
    stops = EmergencyStops(DEVICES, one)
    stop(stops, ["arm"])
    for folder in tmp_path.iterdir():
        shutil.rmtree(folder)
    assert one.stopped() == frozenset()
    assert stops.look(1.0) == ([], []) and latch(tmp_path).stopped() == {"arm"}
    assert clear(stops, ["arm"]) == "" and stops.look(2.0) == ([], [])
    assert one.stopped() == frozenset() and one.cleared.number == 1
    with monkeypatch.context() as full:
        full.setattr("petrobot.services.host.emergency_latch.write_whole", no_room)
        assert "the node tries again" in stop(stops, ["arm"])
        assert stops.look(3.0) == ([], []) and one.stopped() == frozenset()
    assert stops.look(4.0) == ([], []) and one.stopped() == {"arm"}


def test_a_node_that_cannot_store_a_latch_starts_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It cannot know whether it was stopped: where no file can be written, a missing file proves
    nothing."""
    monkeypatch.setattr("petrobot.services.host.emergency_latch._writable", lambda folder: False)
    stops = EmergencyStops(DEVICES, latch(tmp_path))
    assert stops.at_start() == list(DEVICES)
    assert clear(stops, DEVICES) == "" and stops.names == (), (
        "an operator may say so for this life of it"
    )


def test_a_latch_of_another_process_is_seen_at_the_next_check(tmp_path: Path) -> None:
    """Each device is returned once to be stopped; a lock-step cell never reads the latch."""
    stops = EmergencyStops(DEVICES, latch(tmp_path))
    assert stops.at_start() == [] and stops.due == LOOK
    latch(tmp_path).stop([ALL])
    assert stops.look(1.0) == (list(DEVICES), []) and stops.due == 1.0 + LOOK
    assert stops.look(2.0) == ([], [])
    assert EmergencyStops(DEVICES).due == NEVER


def test_the_folders_of_the_latch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside services.toml, else in the user's folder; only in the folder of the environment
    variable, if it is set."""
    monkeypatch.delenv(STATE, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    beside, own = latch_of(tmp_path / "services.toml", "motion").paths
    monkeypatch.setattr(f"{Latch.__module__}.INSTALLED", tmp_path.resolve())
    installed = latch_of(tmp_path / "services.toml", "motion").paths
    assert installed == (own, beside), "nothing is written into an installed package"
    assert beside == tmp_path.resolve() / ".petrobot" / "motion.stopped"
    assert own.is_relative_to(tmp_path / "state" / "petrobot") and own.name == "motion.stopped"
    monkeypatch.setenv(STATE, str(tmp_path / "given"))
    assert latch_of(tmp_path / "services.toml", "motion").paths == (
        tmp_path / "given" / "motion.stopped",
    )


def test_cleared_stops_are_counted_and_the_count_stays(tmp_path: Path) -> None:
    """In memory and on disk alike: whoever clears a stop, its node knows how many there were, even
    if it was frozen or is another process. Where nothing was stopped, nothing is counted."""
    stops = EmergencyStops(DEVICES, latch(tmp_path))
    assert clear(stops, DEVICES) == "" and stops.cleared == 0
    stop(stops, ["arm"])
    assert clear(stops, ["arm"]) == "" and clear(stops, ["arm"]) == "" and stops.cleared == 1
    latch(tmp_path).stop([ALL])
    latch(tmp_path).clear(DEVICES, DEVICES)
    assert stops.look(1.0) == ([], list(DEVICES)) and stops.cleared == 2
    assert EmergencyStops(DEVICES, latch(tmp_path)).cleared == 2
    assert [path.name for path in tmp_path.rglob("*.*")] == ["motion.cleared"]


def test_a_stop_that_another_process_has_cleared_is_cleared(tmp_path: Path) -> None:
    """Also one that only the processes of the devices have seen, but none of another device, none
    that was given while it was being cleared, and none whose file is only gone."""
    stops, other = EmergencyStops(DEVICES, latch(tmp_path)), latch(tmp_path)
    stop(stops, DEVICES)
    other.clear(["arm"], DEVICES)
    assert stops.look(1.0) == ([], ["arm"]) and [*stops.names] == ["camera", "gripper"]
    other.clear(DEVICES, DEVICES)
    assert stops.look(2.0)[1] == ["camera", "gripper"] and [*stops.names] == []
    other.stop([ALL])
    other.clear(DEVICES, DEVICES)
    assert stops.look(3.0) == ([], list(DEVICES)) and stops.look(4.0) == ([], [])
    other.stop([ALL])
    counted = other.paths[0].with_suffix(".cleared")
    # As far as the other process has come:
    counted.write_text("\n".join(["5", "1.0", *(f"{device} 5" for device in DEVICES), ""]))
    assert other.cleared == (5, 1.0, dict.fromkeys(DEVICES, 5))
    stop(stops, DEVICES)
    for path in other.paths:
        path.unlink(missing_ok=True)
    assert stops.look(5.0) == ([], []) and [*stops.names] == [*DEVICES]
    counted.unlink()
    assert stops.look(6.0) == ([], []) and [*stops.names] == [*DEVICES]


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("2\n1.5\n", (2, 1.5)),
        ("2\n", (2, 0.0)),
        (f"2\n{1e12}\n", (2, 0.0)),
        ("?", (0, 0.0)),
        ("2\n1.5\narm", (0, 0.0)),
        ("2\n1.5\narm x\n", (0, 0.0)),
    ],
    ids=["now", "without a time", "before the last boot", "unreadable", "cut off", "damaged"],
)
def test_when_the_last_stop_was_cleared(
    tmp_path: Path, text: str, known: tuple[int, float]
) -> None:
    """What is not known counts as long ago, but not before this host was booted."""
    one = latch(tmp_path)
    one.stop([ALL])
    one.clear(DEVICES, DEVICES)
    path = one.paths[0].with_suffix(".cleared")
    assert one.cleared.number == 1 and 0.0 <= uptime() - one.cleared.at < 60.0
    path.write_text(text)
    assert one.cleared == (*known, {})


def test_a_stop_that_cannot_be_counted_is_not_cleared(tmp_path: Path) -> None:
    latch(tmp_path).stop(["arm"])
    for folder in ("first", "second"):
        (tmp_path / folder / "motion.cleared").mkdir(parents=True)
    with pytest.raises(LatchError, match=r"motion\.cleared: Is a directory"):
        latch(tmp_path).clear(DEVICES, DEVICES)
    assert latch(tmp_path).stopped() == {"arm"}


def test_a_device_that_is_renamed_while_it_is_stopped_stays_stopped(tmp_path: Path) -> None:
    """A name that the node does not have means all its devices, until they are cleared."""
    stop(EmergencyStops(["arm", "eye"], latch(tmp_path)), ["arm"])
    renamed = EmergencyStops(["puma", "eye"], latch(tmp_path))
    assert sorted(renamed.at_start()) == ["eye", "puma"]
    assert clear(renamed, ["eye"]) == "" and renamed.names == ("puma",)
    assert latch(tmp_path).stopped() == {"puma"}, "known by its new name from now on"
    assert clear(renamed, ["puma"]) == "" and latch(tmp_path).stopped() == frozenset()
    assert EmergencyStops(["puma", "eye"], latch(tmp_path)).at_start() == []


@pytest.mark.parametrize("by", ["node", "command"])
def test_a_device_that_is_moved_to_another_node_while_it_is_stopped_stays_stopped(
    tmp_path: Path, by: str
) -> None:
    """On the same host. The command writes the file for a node that does not answer."""
    left, right = (Latch(node, [tmp_path / "first", tmp_path / "second"]) for node in ("l", "r"))
    if by == "node":
        stop(EmergencyStops(["arm", "eye"], left), ["arm", "eye"])
    else:
        left.stop([ALL, "arm", "eye"])
    moved = EmergencyStops(["arm", "grip"], right)
    assert moved.at_start() == ["arm"] and right.stopped() == {"arm"}
    assert EmergencyStops(["lamp"], Latch("lamps", [tmp_path / "first"])).at_start() == []
    assert clear(moved, ["arm"]) == "" and moved.names == ()
    assert "arm" not in left.stopped() and "eye" in left.stopped()
    assert EmergencyStops(["arm", "grip"], right).at_start() == []


class SlowDisk:
    """Writes when a test says so, as a thread of the node would, and reports it later still."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Callable[[], str], Callable[[str], None]]] = []

    def write(self, write: Callable[[], str], done: Callable[[str], None]) -> None:
        self.waiting.append((write, done))

    def go_on(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Write the oldest; do `meanwhile` before this is reported."""
        write, done = self.waiting.pop(0)
        why = write()
        meanwhile()
        done(why)


def test_a_stop_acts_before_it_is_written_and_is_acknowledged_after(tmp_path: Path) -> None:
    """On a slow disk, in order with the clearing before it, which it outlives; a look meanwhile
    takes no file for the work of another process, but obeys a new stop."""
    disk, said = SlowDisk(), list[str]()
    stops = EmergencyStops(DEVICES, latch(tmp_path), disk.write)
    stops.stop(["arm", "camera"], said.append)
    assert [*stops.names] == ["arm", "camera"] and not said and not latch(tmp_path).stopped()
    latch(tmp_path).stop(["gripper"])
    assert stops.look(1.0) == (["gripper"], []) and len(disk.waiting) == 1
    disk.go_on(lambda: stops.look(2.0))
    assert said == [""] and latch(tmp_path).stopped() == set(DEVICES)

    stops.clear(DEVICES, said.append)
    assert [*stops.names] == [*DEVICES] and latch(tmp_path).stopped() == set(DEVICES)
    stops.stop(["arm"], said.append)
    disk.go_on(lambda: stops.look(3.0))
    assert [*stops.names] == ["arm"] and stops.cleared == 1 and not latch(tmp_path).stopped()
    assert stops.look(4.0) == ([], []) and len(disk.waiting) == 1
    disk.go_on()
    assert latch(tmp_path).stopped() == {"arm"} and said == ["", "", ""]
    assert stops.look(5.0) == ([], []) and "arm" in stops and not disk.waiting


def test_a_repeated_stop_is_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An operator's command repeats its order until the devices stand still. What another process
    has replaced is written again."""
    written = list[object]()
    monkeypatch.setattr("os.fsync", written.append)
    stops = EmergencyStops(DEVICES, latch(tmp_path))
    assert [stop(stops, DEVICES) for _ in range(3)] == ["", "", ""]
    once = len(written)
    latch(tmp_path).paths[0].unlink()
    assert stop(stops, DEVICES) == "" and len(written) > once
    assert latch(tmp_path).stopped() == set(DEVICES)
    twice = len(written)
    assert stop(stops, ["arm"]) == "" and len(written) == twice
