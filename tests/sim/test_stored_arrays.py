"""Arrays that are read from files are those that were computed."""

import numpy as np
import pytest
import trimesh

from sim import lattice, stored_arrays
from sim.stored_arrays import stored

CALLS: list[tuple] = []


def computed(*arguments: object) -> tuple[np.ndarray, ...]:
    """Two arrays that tell whether they were computed now."""
    CALLS.append(arguments)
    return np.arange(6.0).reshape(2, 3).T, np.array([len(arguments)], np.int32)


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    CALLS.clear()
    monkeypatch.setattr(stored_arrays, "FOLDER", tmp_path / "arrays")
    return tmp_path / "arrays"


def test_what_is_read_has_the_bits_of_what_was_computed(folder):
    first, again = stored(computed, 3.5, "organ"), stored(computed, 3.5, "organ")
    assert len(CALLS) == 1
    for one, other in zip(first, again, strict=True):
        assert one.dtype == other.dtype and np.array_equal(one, other) and other.flags["C_CONTIGUOUS"]
    # No name but a hash, and nobody else may read it.
    (file,) = folder.iterdir()
    assert len(file.stem) == 32 and file.suffix == ".npz"


@pytest.mark.parametrize(
    "other", [(3.6, "organ"), (3.5, "Organ"), (3.5, "organ", None), (np.float64(3.5), "organ")]
)
def test_another_input_is_computed(other):
    stored(computed, 3.5, "organ")
    stored(computed, *other)
    assert len(CALLS) == 2


@pytest.mark.parametrize("name", ["scenes/surfaces.py", "ultrasound/probes/linear.toml"])
def test_another_source_or_table_anywhere_is_computed_again(monkeypatch, tmp_path, name):
    file = tmp_path / name
    file.parent.mkdir(parents=True)
    monkeypatch.setattr(stored_arrays, "SOURCES", (tmp_path / "scenes", tmp_path / "ultrasound"))
    for count, text in ((1, "a = 1"), (1, "a = 1"), (2, "a = 2")):
        file.write_text(text)
        stored_arrays._sources.cache_clear()
        stored(computed, 3.5)
        assert len(CALLS) == count


def test_every_source_that_a_computation_may_call_counts():
    files = {file.name for folder in stored_arrays.SOURCES for file in folder.rglob("*")}
    assert {"surfaces.py", "acoustics.py", "tissue_map.py", "pressed_organ.py", "blood_flow.toml"} <= files


def test_surfaces_and_arrays_count_by_their_values():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
    stored(computed, ball)
    stored(computed, ball.copy())
    assert len(CALLS) == 1
    stored(computed, ball.copy().apply_scale(1.001))
    stored(computed, np.arange(4.0))
    stored(computed, np.arange(4.0, dtype=np.float32))
    stored(computed, np.arange(4.0), backend="cuda")
    assert len(CALLS) == 5
    with pytest.raises(TypeError, match="list: expected an array, a surface, a number or a text"):
        stored(computed, [1, 2])


def test_what_would_displace_all_others_is_not_stored(folder, monkeypatch):
    stored(computed, "organ")
    monkeypatch.setattr(stored_arrays, "MOST_BYTES", 80)
    stored(computed, "larger")
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("damage", [b"", b"no array", None])
def test_a_damaged_file_is_computed_anew(folder, damage):
    stored(computed, 1)
    (file,) = folder.iterdir()
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2] if damage is None else damage)
    assert np.array_equal(stored(computed, 1)[1], [1]) and len(CALLS) == 2
    stored(computed, 1)
    assert len(CALLS) == 2 and file.read_bytes() != damage


def test_a_folder_that_cannot_be_written_is_no_error(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setattr(stored_arrays, "FOLDER", tmp_path / "file" / "arrays")
    assert len(stored(computed, 1)) == 2
    monkeypatch.setattr(stored_arrays, "FOLDER", None)
    assert len(stored(computed, 1)) == 2 and len(CALLS) == 2


def test_the_files_used_least_recently_are_removed(folder, monkeypatch):
    stored(computed, 1)
    (file,) = folder.iterdir()
    monkeypatch.setattr(stored_arrays, "MOST_BYTES", 3 * file.stat().st_size)
    for number in range(2, 8):
        stored(computed, number)
    assert len(list(folder.iterdir())) == 3
    CALLS.clear()
    stored(computed, 7)
    assert CALLS == []


def test_a_lattice_is_the_same_computed_and_read(ball):
    first, again = lattice.fill_with_cells(ball, 4.0), lattice.fill_with_cells(ball, 4.0)
    for name, values in vars(first).items():
        assert np.array_equal(values, getattr(again, name)), name
    assert first is not again and len(first.cells) > 50
