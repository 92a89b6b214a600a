"""A patient's folder: a coarse ball with a tumour, and a trocar above it."""

from pathlib import Path

import numpy as np
import trimesh

R = 25.0
SCENE = """
title = "ball"
[anatomy]
organ = "organ.stl"
tumour = "tumour.stl"
[tissue]
cell_mm = 8.0
[gravity]
direction = [0.0, 0.0, -1.0]
[attachment]
at_mm = [30.0, -40.0, -5.0]  # or the ball rolls away
radius_mm = 18.0
[transducer]
probe = "drop-in"
[trocar]
at_mm = [0.0, -150.0, 200.0]
[press]
direction = [0.0, 0.0, -1.0]
lateral = [1.0, 0.0, 0.0]
warm_up_steps = 90
[[shape]]
kind = "plane"
normal = [0.0, 0.0, 1.0]
offset_mm = -5.0
"""
# The organ's middle in the patient.
MIDDLE = np.array([30.0, -40.0, 20.0])


def folder_of_ball(folder: Path) -> Path:
    """Write the patient into a folder."""
    organ = trimesh.creation.icosphere(subdivisions=3, radius=R)
    tumour = trimesh.creation.icosphere(subdivisions=3, radius=7.0).apply_translation([0, 4.0, 15.0])
    for name, mesh in (("organ", organ), ("tumour", tumour)):
        mesh.apply_translation(MIDDLE).export(folder / f"{name}.stl")
    (folder / "scene.toml").write_text(SCENE)
    return folder
