"""Labels in detail: names, notes and near misses."""

import numpy as np
import pytest
import SimpleITK as sitk
from synthetic_body import DIRECTIONS, drawn, grid_around
from test_readers_labels import KIDNEY

from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import LabelMap
from scenes.patients.readers.label_merge import merge_label_maps
from scenes.patients.readers.segment_choice import assign_tissues
from scenes.volumes.voxel_grid import VoxelGrid

GRID = VoxelGrid.of(grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6)))


def strips(*names):
    """A label map of a row of segments."""
    values = np.zeros(GRID.size[::-1], np.uint8)
    for n in range(1, len(names) + 1):
        values[2:5, 2:5, n] = n
    return LabelMap.valued(GRID, values, dict(enumerate(names, start=1)))


class TestTogether:
    def test_the_users_word_is_all_that_is(self):
        (assigned,) = assign_tissues(
            [strips("kidney_left", "old tumour", "new mass")], [], {"tumour": ["new mass"]}
        )
        assert [s.tissue for s in assigned.segments.values()] == ["kidney", None, "tumour"]

    def test_what_of_the_organ_has_a_tissue_keeps_it(self):
        (assigned,) = assign_tissues([strips("kidney_left", "mass", "x")], ["kidney_left", "mass", "x"], {})
        assert [s.tissue for s in assigned.segments.values()] == ["kidney", "tumour", "kidney"]

    @pytest.mark.parametrize(
        ("over", "under"), [("tumour", "cyst"), ("cyst", "kidney"), ("stone", "tumour"), ("vein", "kidney")]
    )
    def test_what_lies_over_what(self, over, under):
        inside = np.zeros(GRID.size[::-1], np.uint8)
        inside[2:6, 2:6, 2:6] = 1
        maps = [LabelMap.valued(GRID, inside, {1: name}) for name in (over, under)]
        for one in (merge_label_maps(maps)[0], merge_label_maps(maps[::-1])[0]):
            assert [s.name for s in one.segments.values()] == [over] and len(one.segments) == 1

    def test_many_values(self):
        values = np.zeros(GRID.size[::-1], np.int32)
        values[2:5, 2:5, 2], values[2:5, 2:5, 4] = 300, 44
        labels = LabelMap.of(GRID.image(values), {300: "kidney_left"})
        assert labels.of_tissues("kidney") == [300] and set(labels.segments) == {44, 300}
        assert (labels.values == values).all()

    @pytest.mark.parametrize("direction", DIRECTIONS)
    def test_coarse_voxels_keep_their_volume(self, direction):
        """On a finer grid, to their outer faces."""
        fine = VoxelGrid.of(grid_around((-25,) * 3, (25,) * 3, (1.0, 1.0, 1.0)))
        coarse = VoxelGrid((3, 2, 4), np.array([4.0, 6.0, 5.0]), np.full(3, 0.2), DIRECTIONS[direction])
        maps = [
            LabelMap.valued(grid, np.ones(grid.size[::-1], np.uint8), {1: name})
            for grid, name in ((fine, "kidney"), (coarse, "mass"))
        ]
        one, _ = merge_label_maps(maps)
        assert np.isin(one.values, one.of_tissues("tumour")).sum() == pytest.approx(24 * 120, rel=0.03)


class TestLabelMaps:
    @pytest.mark.parametrize(
        ("stem", "tissue", "side"),
        [
            ("kidney_right", "kidney", "right"),
            ("label_left", "kidney", "left"),
            ("r", "kidney", "right"),
            ("spleen_left", None, "left"),
            ("lung_left", None, "left"),
        ],
    )
    def test_a_name_with_a_side_alone_is_the_kidneys(self, tmp_path, stem, tissue, side):
        empty = grid_around((-33, 18, -401), (-22, 30, -385), (0.7, 0.9, 1.6))
        sitk.WriteImage(drawn(empty, (4, KIDNEY)), str(tmp_path / f"{stem}.nii.gz"))
        (one,) = open_labels(tmp_path / f"{stem}.nii.gz").maps(None)
        assert [(s.tissue, s.side) for s in one.segments.values()] == [(tissue, side)]

    def test_organs_are_read_near_the_kidneys(self, tmp_path):
        """And all that a picture shows of them: 80 mm around."""
        empty = grid_around((-20, -20, -150), (20, 20, 150), (4.0, 4.0, 5.0), DIRECTIONS["slices first"])
        middle, wide = np.zeros(3), np.array([9.0, 8.0, 11.0])
        for name, shape in {
            "kidney_left": (middle, wide),
            "aorta": (middle, np.array([9.0, 9.0, 1e4])),
        }.items():
            sitk.WriteImage(drawn(empty, (1, shape)), str(tmp_path / f"{name}.nii.gz"))
        kidney, aorta = (np.abs(one.grid.corners()[:, 2]).max() for one in open_labels(tmp_path).maps(None))
        assert kidney + 80 <= aorta <= kidney + 85
