"""The embedded patient, coarse and with small images, for tests of sessions."""

from dataclasses import replace

import numpy as np

from rehearsal.case import case_of
from rehearsal.configuration import probe_of
from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import Grid, LoadedAnatomy, load_anatomy
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import EMBEDDED, load_scene, with_options


def thinned(grid: Grid) -> Grid:
    """Every other voxel each way."""
    half = np.diag([0.5, 0.5, 0.5, 1.0])
    return Grid(np.ascontiguousarray(grid.voxels[::2, ::2, ::2]), half @ grid.index_from_mm)


def coarse_patient() -> tuple[Rehearsal, LoadedAnatomy]:
    """Its rehearsal on elements of 8 mm, with images of 32 x 32 pixels of few scanlines, and its anatomy;
    Taichi must be started.
    """
    scene = with_options(load_scene(EMBEDDED), {"tissue.cell_mm": 8.0, "image.mode": "b-mode"})
    short = dict(press=scene.press.model_copy(update={"warm_up_steps": 20}))
    small = dict(image=scene.image.model_copy(update={"pixels": 32}))
    whole = load_anatomy(scene, phantom_folder())
    anatomy = replace(whole, ct=thinned(whole.ct), labels=thinned(whole.labels))
    few = dict(number_of_scanlines=64, number_of_samples_per_scanline=160)
    probe = probe_of(scene).model_copy(update=few)
    return Rehearsal(case_of(scene.model_copy(update=short | small), anatomy, probe), anatomy), anatomy
