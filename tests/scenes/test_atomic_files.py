"""Files and folders that are there whole or not at all."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from errors import PatientError
from scenes.atomic_files import atomic_write, check_folder, new_folder
from scenes.volumes.volume_files import file_volume, save_image


def written(path: Path, fault: BaseException) -> None:
    """Half of a file, and then a fault."""
    with atomic_write(path) as partial:
        partial.write_text("half")
        raise fault


def made(path: Path, content: str) -> None:
    """A folder with one file."""
    with atomic_write(path) as partial:
        partial.mkdir()
        (partial / "b").write_text(content)


@pytest.mark.parametrize("fault", [OSError(28, "No space"), KeyboardInterrupt()])
def test_a_file_stays_as_it_was_where_the_new_one_cannot_be_written(tmp_path, fault):
    path = tmp_path / "a.json"
    path.write_text("before")
    with pytest.raises(type(fault)) as caught:
        written(path, fault)
    assert [each.name for each in tmp_path.iterdir()] == ["a.json"] and path.read_text() == "before"
    if isinstance(caught.value, OSError):
        assert caught.value.filename == str(path) and caught.value.strerror == "No space"


def test_a_file_takes_its_name_and_suffix_at_the_end(tmp_path):
    path = tmp_path / "a.nii.gz"
    path.write_text("before")
    with atomic_write(path) as partial:
        assert partial.name.endswith("a.nii.gz")
        partial.write_text("after")
        assert path.read_text() == "before"
    assert [each.name for each in tmp_path.iterdir()] == ["a.nii.gz"] and path.read_text() == "after"


def test_a_folder_takes_the_place_of_an_empty_one_alone(tmp_path):
    path = tmp_path / "a"
    path.mkdir()
    made(path, "first")
    with pytest.raises(OSError, match="a'$") as caught:
        made(path, "second")
    assert caught.value.filename == str(path)
    assert [each.name for each in tmp_path.iterdir()] == ["a"] and (path / "b").read_text() == "first"


@pytest.mark.parametrize("letter", ["p", "\u00e9"])
def test_a_name_may_be_as_long_as_the_file_system_allows(tmp_path, letter):
    count = 250 // len(letter.encode())
    path, folder = tmp_path / f"{letter * (count - 2)}.nii.gz"[-count:], tmp_path / (letter * count)
    with atomic_write(path) as partial:
        assert partial.name.endswith(".nii.gz") and len(os.fsencode(partial.name)) < 120
        partial.write_text("a")
    assert path.read_text() == "a"
    check_folder(folder)
    with new_folder(folder) as written_to:
        (written_to / "b").touch()
    assert {one.name for one in tmp_path.iterdir()} == {path.name, folder.name}


@pytest.mark.parametrize("below", [[], ["a"], ["a", "b"]])
def test_a_folder_whose_name_is_too_long_is_refused_before_the_work(tmp_path, below):
    for folder in (tmp_path.joinpath(*below, "p" * 256), tmp_path.joinpath("p" * 256, *below)):
        for start in (check_folder, lambda path: new_folder(path).__enter__()):
            with pytest.raises(PatientError, match=f"{folder}: cannot be made in .*too long") as caught:
                start(folder)
            assert "partial" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_run_left_of_a_long_name_is_its_own(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    one, other = (tmp_path / f"{first}-kidney-of-the-left-side-2026" for first in ("a", "b"))
    with atomic_write(one) as partial:
        partial.mkdir()
    left = tmp_path / partial.name.replace(str(os.getpid()), str(ended.pid), 1)
    one.rename(left)
    for folder, stays in ((other, True), (one, False)):
        with new_folder(folder):
            assert left.exists() == stays


def test_the_folder_that_another_run_writes_is_not_removed(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    alive, killed, old = (
        f".{writer}.partial-a" for writer in (f"{os.getpid()}-0a", f"{ended.pid}-0b", "0a1b2c3d")
    )
    for name in (alive, killed, old):
        (tmp_path / name).mkdir()
    with new_folder(tmp_path / "a") as partial:
        names = {each.name for each in tmp_path.iterdir()}
        assert names == {alive, partial.name}


@pytest.mark.parametrize("first", ["outer", "inner"])
def test_of_two_runs_into_one_folder_the_later_is_refused_in_words(tmp_path, first):
    path, expected = tmp_path / "a", "exists and is not an empty folder; choose another"
    with pytest.raises(PatientError, match=expected), new_folder(path) as outer:  # noqa: PT012
        (outer / "b").write_text("outer")
        if first == "outer":
            os.replace(outer, path)
            with new_folder(path):
                pytest.fail("began")
        with new_folder(path) as inner:
            (inner / "b").write_text("inner")
    assert (path / "b").read_text() == first and len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere names of files are Unicode")
@pytest.mark.parametrize("suffix", [".nrrd", ".nhdr", ".mha", ".mhd"])
@pytest.mark.parametrize("names", [(b"pat\xe9", "ct"), (b"plain", b"ct\xe9")])
def test_volumes_with_names_that_are_not_utf_8_are_written_and_read(tmp_path, names, suffix):
    image = sitk.GetImageFromArray(np.arange(24, dtype=np.int16).reshape(2, 3, 4))
    folder, name = map(os.fsdecode, names)
    path = tmp_path / folder / f"{name}{suffix}"
    path.parent.mkdir()
    if suffix in (".nrrd", ".mha"):
        save_image(image, path)
    else:  # the voxels are in a second file
        plain = tmp_path / f"written{suffix}"
        sitk.WriteImage(image, str(plain))
        for part in tmp_path.glob("written.*"):
            part.rename(path if part == plain else path.parent / part.name)
    assert (file_volume(path).read() == sitk.GetArrayFromImage(image)).all()
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(PatientError, match="expected"):
        file_volume(path)
