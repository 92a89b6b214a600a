"""Files and folders that are there whole or not at all."""

from pathlib import Path

import pytest

from scenes.atomic_files import atomic_write


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
