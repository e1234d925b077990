"""A file that the package writes is whole or not there, whatever stops the writer."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from go1exp.base import files

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="a device without space is a thing of Linux")


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is being written goes to a device that has no space left."""

    def on_full_device(final: Path, keep_suffix: bool) -> Path:
        partial = final.with_name(f"{final.name}.partial")
        partial.symlink_to(FULL)
        return partial

    monkeypatch.setattr(files, "_beside", on_full_device)


@needs_full
@pytest.mark.usefixtures("full_disk")
def test_a_full_disk_names_the_file_and_leaves_the_older_one(tmp_path: Path) -> None:
    path = tmp_path / "eval.json"
    path.write_text("older")
    with pytest.raises(OSError, match="No space left on device") as caught:
        files.write_text(path, "newer")
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert path.read_text() == "older"
    assert [p.name for p in tmp_path.iterdir()] == ["eval.json"]


def test_an_interrupted_writer_leaves_the_older_file_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "net.npz"
    path.write_bytes(b"older")

    def interrupted() -> None:
        with files.opened(path) as file:
            file.write(b"half of the new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_about_another_file_keeps_its_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught, files.opened(tmp_path / "copy") as file:
        file.write((tmp_path / "source").read_bytes())
    assert caught.value.filename == str(tmp_path / "source")


def test_a_missing_folder_and_a_folder_in_the_way_are_named(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "nowhere" / "file", tmp_path / "folder"):
        with pytest.raises(OSError, match=str(path)):
            files.write_text(path, "text")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_a_link_is_followed_and_a_device_is_written_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    files.write_text(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "text"
    files.write_text("/dev/null", "text")
    assert Path("/dev/null").is_char_device()


def test_the_link_to_a_pipe_is_written_although_it_leads_to_no_name() -> None:
    end, start = os.pipe()
    files.write_text(f"/dev/fd/{start}", "text")
    os.close(start)
    with os.fdopen(end) as read:
        assert read.read() == "text"


def test_two_writers_of_one_file_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with files.opened(path) as one, files.opened(path) as other:
        one.write(b"one" * 10)
        other.write(b"other")
    assert path.read_bytes() == b"one" * 10  # the last to end
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path) -> None:
    (tmp_path / f"000003.pt.1a2b3c4d{files.PARTIAL}").write_bytes(b"half")
    (tmp_path / "000002.pt").write_bytes(b"whole")
    files.remove_partial(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["000002.pt"]
