"""A tiny bead experiment as files: a ball in a bowl under a probe, with made-up measurements; and the two
as a patient.
"""

import json
from pathlib import Path

import numpy as np
import tomli_w
import trimesh

from scenes.anatomy import LoadedAnatomy
from scenes.scene import PAPER, Press, Scene, load_scene

RADIUS = 12.0
DEPTHS = (0.0, 2.0, 4.0)


def bowl() -> trimesh.Trimesh:
    """A ring of triangles swept round: a block whose top holds a ball of 12 mm with 0.2 mm to spare."""
    angles = np.radians(np.linspace(-90, -20, 12))
    inside = (RADIUS + 0.2) * np.column_stack([np.cos(angles), np.sin(angles)])
    outline = np.concatenate([inside, [(20.0, inside[-1, 1]), (20.0, -20.0), (0.0, -20.0)]])
    outline[0, 0] = 0.0
    mesh = trimesh.creation.revolve(outline[::-1], sections=32)
    assert mesh.is_watertight and mesh.volume > 0
    return mesh


def values() -> dict:
    """What ``case.toml`` holds, to be changed by a test."""
    stages = [
        dict(index=k, indentation_mm=depth, position=[0.0, 0.0, RADIUS + 5.0 - depth])
        for k, depth in enumerate(DEPTHS)
    ]
    return dict(
        name="ball",
        format_version=1,
        units=dict(length="mm", acceleration="m/s^2", pressure="kPa", density="kg/m^3", force="N"),
        gravity=dict(g=9.81, direction=[0.0, 0.0, -1.0]),
        material=dict(young_kPa=15.0, poisson=0.45, density=1050.0, scanner="a laboratory's own key"),
        contact=dict(friction_coefficient=0.35),
        probe=dict(
            shape="cuboid",
            size_mm=[16.0, 8.0, 10.0],
            edge_radius_mm=1.0,
            press_direction=[0.0, 0.0, -1.0],
            rotation=np.eye(3).tolist(),
        ),
        stage=stages,
    )


def beads() -> np.ndarray:
    """Stress-free and measured places (stages + 1, n, 3) [mm]: pressed, the upper half moves down and
    outward.
    """
    random = np.random.default_rng(3)
    rest = random.uniform(-6, 6, (12, 3))
    sunk = rest - [0, 0, 0.2]
    share = np.array(DEPTHS)[:, None, None] / 12
    way = np.stack([rest[:, 0] / 6, rest[:, 1] / 6, -1 - rest[:, 2] / 6], axis=1)
    return np.concatenate([rest[None], sunk + share * way])


def write_case(folder: Path, case: dict | None = None, places: np.ndarray | None = None) -> Path:
    """Write the experiment to a folder, which is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.icosphere(subdivisions=3, radius=RADIUS).export(folder / "kidney.stl")
    bowl().export(folder / "support.stl")
    (folder / "case.toml").write_text(tomli_w.dumps(values() if case is None else case), "utf-8")
    places = beads() if places is None else places
    names = [f"{axis}{k}" for k in ("", *range(len(places) - 1)) for axis in "xyz"]
    rows = places.transpose(1, 0, 2).reshape(places.shape[1], -1)
    lines = [",".join(["id", *names])]
    lines += [",".join([str(i), *(json.dumps(float(v)) for v in row)]) for i, row in enumerate(rows)]
    (folder / "beads.csv").write_text("\n".join(lines) + "\n", "utf-8")
    return folder


def small_anatomy() -> LoadedAnatomy:
    """The ball in its bowl, on the back as patients are."""
    mould = bowl()
    mould.vertices = mould.vertices[:, [0, 2, 1]] * [1, -1, 1]
    mould.fix_normals()
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    return LoadedAnatomy(ball, None, None, (mould,))


def briefly(warm_up_steps: int) -> Scene:
    """The paper's scene, whose tissue is given so many steps to settle."""
    return load_scene(PAPER).model_copy(update={"press": Press(warm_up_steps=warm_up_steps)})
