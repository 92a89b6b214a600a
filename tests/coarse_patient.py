"""The embedded patient, coarse and with small images, for tests of sessions."""

from rehearsal.rehearsal import Rehearsal
from scenes.anatomy import LoadedAnatomy, load_anatomy
from scenes.phantom.embedded_patient import phantom_folder
from scenes.scene import EMBEDDED, load_scene, with_options


def coarse_patient() -> tuple[Rehearsal, LoadedAnatomy]:
    """Its rehearsal on elements of 8 mm, with images of 32 x 32 pixels, and its anatomy; Taichi must be started."""
    scene = with_options(load_scene(EMBEDDED), {"tissue.cell_mm": 8.0, "image.mode": "b-mode"})
    short = dict(press=scene.press.model_copy(update={"warm_up_steps": 20}))
    small = dict(image=scene.image.model_copy(update={"pixels": 32}))
    anatomy = load_anatomy(scene, phantom_folder())
    return Rehearsal(scene.model_copy(update=short | small), anatomy), anatomy
