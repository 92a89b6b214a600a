"""The scene of a recorded session: the patient of the user's scene, all other settings as recorded."""

from typing import Any

from rehearsal.sessions.session_file import Header
from scenes.scene import Scene

# The parts of a scene that belong to the patient's folder and may name files.
PATIENTS: dict[str, Any] = {"anatomy": True, "shape": True, "title": True, "transducer": {"probe"}}


def recorded_values(scene: Scene) -> dict[str, Any]:
    """The recorded part of a scene."""
    return scene.model_dump(mode="json", exclude=PATIENTS)


def scene_of_log(header: Header, scene: Scene) -> Scene:
    """The patient of a scene, with all other settings as recorded. Raises ValidationError."""
    values = scene.model_dump(mode="json", exclude_unset=True)
    recorded = {name: section for name, section in header.scene.items() if PATIENTS.get(name) is not True}
    if "transducer" in recorded:
        kept = {key: value for key, value in recorded["transducer"].items() if key != "probe"}
        own = values.get("transducer", {}).get("probe")
        recorded["transducer"] = kept | ({"probe": own} if own else {})
    return Scene.model_validate(values | recorded)
