"""Which part of the vessels is artery and which vein: as labelled, and neither where no label says it."""

import numpy as np

from rehearsal.vessel_kinds import unlabelled_in_words, vessel_kinds
from scenes.anatomy import Grid

# Voxels of 2 mm, the first at (10, 0, 0) mm: an artery and a vein, side by side along z.
INDEX_FROM_MM = np.array([[0.5, 0, 0, -5.0], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1.0]])


def labels() -> Grid:
    voxels = np.zeros((8, 4, 5), np.float32)
    voxels[2:4, 1:3], voxels[4:6, 1:3] = 5, 7
    return Grid(voxels, INDEX_FROM_MM)


def test_each_point_has_the_kind_of_its_vessel():
    # On the outer walls of both, a voxel's half beyond the labelled centres.
    points = np.array([[13.0, 3.0, 4.0], [21.0, 3.0, 4.0], [15.0, 1.0, 0.0], [19.0, 5.0, 8.0]])
    kinds = vessel_kinds(points, labels(), {1: "kidney", 5: "artery", 7: "vein"})
    assert kinds.tolist() == ["artery", "vein", "artery", "vein"]


def test_a_vessel_is_neither_where_no_label_says_which():
    points = np.array([[13.0, 3.0, 4.0], [21.0, 3.0, 4.0]])
    assert vessel_kinds(points, labels(), {5: "vessel", 7: "vessel"}).tolist() == ["vessel", "vessel"]
    assert vessel_kinds(points, None, {}).tolist() == ["vessel", "vessel"]


def test_the_window_names_what_no_label_says():
    assert "not labelled" in unlabelled_in_words(None)
    assert "violet" in unlabelled_in_words(np.array(["artery", "vessel"]))
    assert unlabelled_in_words(np.array(["artery", "vein"])) == ""
