"""Files that are written whole: after a power cut there is the old file or the new one, with its
name, folder and mode."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.services.comm.protocol.security import new_key, read_key, write_key
from petrobot.services.host.emergency_latch import Latch
from petrobot.services.host.whole_file import make_folder, write_whole
from tests.power_cut import power_cut


def test_a_written_file_survives_a_power_cut(tmp_path: Path) -> None:
    with power_cut(tmp_path) as disk:
        make_folder(tmp_path / "new" / "folder")
        write_whole(tmp_path / "new" / "folder" / "file", "old")
        assert disk.left() == {"new/folder/file": b"old"}
        write_whole(tmp_path / "new" / "folder" / "file", "new")
        assert disk.left() == {"new/folder/file": b"new"}, "nothing else either: no draft"


def test_a_power_cut_during_a_write_leaves_the_old_or_the_new_file(tmp_path: Path) -> None:
    """After a power cut at any sync, the file has the old content or the new one, never a part."""
    with power_cut(tmp_path) as disk:
        write_whole(tmp_path / "file", "old")
        images: list[dict[str, bytes]] = []
        synced = os.fsync
        with pytest.MonkeyPatch.context() as patch:

            def before(handle: int) -> None:
                images.extend(disk.left(torn) for torn in (0.0, 0.5, 1.0))
                synced(handle)

            patch.setattr(os, "fsync", before)
            write_whole(tmp_path / "file", "new")
    assert len(images) == 6 and {image["file"] for image in images} == {b"old"}


def test_a_name_that_is_not_synced_is_lost(tmp_path: Path) -> None:
    """The simulated disk really loses what a disk may lose."""
    with power_cut(tmp_path) as disk:
        draft = tmp_path / "draft"
        with draft.open("w") as file:
            file.write("kept")
            file.flush()
            os.fsync(file.fileno())
            assert disk.left() == {}, "its folder is not synced"
            make_folder(tmp_path / "other")
            assert disk.left() == {"draft": b"kept"}
            file.write(", lost")
            file.flush()
            assert disk.left() == {"draft": b"kept"} and disk.left(0.5) == {"draft": b"kept, l"}
        draft.replace(tmp_path / "renamed")
        assert disk.left() == {"draft": b"kept"}, "a rename that is not synced is undone"


def test_a_journals_folder_survives_a_power_cut(tmp_path: Path) -> None:
    with power_cut(tmp_path) as disk:
        writer = JournalWriter(tmp_path / "runs" / "one" / "run.journal", {"mission": "m"})
        writer.append("stimulus", {})
        [(name, header)] = disk.left().items()
        writer.sync()
        [(_, both)] = disk.left().items()
        writer.close()
    assert name == "runs/one/run.journal" and both.startswith(header) and len(both) > len(header)
    assert len(read_journal(tmp_path / name).records) == 1


def test_an_emergency_stop_survives_a_power_cut(tmp_path: Path) -> None:
    with power_cut(tmp_path) as disk:
        Latch("motion", [tmp_path / "state"]).stop({"arm"})
        [content] = disk.left().values()
    assert content.split() == [b"arm"]


def test_a_key_file_is_written_whole_and_only_its_owner_can_read_it(tmp_path: Path) -> None:
    path, key = tmp_path / "cell.key", new_key()
    with power_cut(tmp_path) as disk:
        write_key(path, key)
        assert disk.left() == {"cell.key": path.read_bytes()}
    assert read_key(path) == key and stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("links", [True, False], ids=["links", "a file system without links"])
def test_a_new_file_never_replaces_another(
    tmp_path: Path, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not links:

        def refuse(*given: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "file"
    write_whole(path, "first", fresh=True)
    with pytest.raises(FileExistsError, match="file"):
        write_whole(path, "second", fresh=True)
    assert path.read_text() == "first" and list(tmp_path.iterdir()) == [path]


def test_a_fresh_file_is_not_written_to_a_pipe(tmp_path: Path) -> None:
    """It would hang until someone reads the pipe, who then has the key."""
    os.mkfifo(path := tmp_path / "cell.key")
    with pytest.raises(FileExistsError, match=r"cell\.key"):
        write_whole(path, "secret", fresh=True)
    assert path.is_fifo() and [*tmp_path.iterdir()] == [path]


def test_modes_links_and_pipes_are_kept(tmp_path: Path) -> None:
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    write_whole(file, "1", mode=0o640)
    link.symlink_to(file)
    write_whole(link, "2")
    assert (
        link.is_symlink() and file.read_text() == "2" and stat.S_IMODE(file.stat().st_mode) == 0o640
    )
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    write_whole(pipe, "3")
    reader.join(30.0)
    assert read == ["3"] and pipe.is_fifo()
