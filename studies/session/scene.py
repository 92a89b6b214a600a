"""The scene of a recorded session: the patient from the scene's own files, all else as it was recorded."""

from scenes.scene import Scene
from studies.session.file import Header


def scene_of_log(header: Header, scene: Scene) -> Scene:
    """The patient of a scene, with all else as it was recorded. Raises ValidationError."""
    values = scene.model_dump(mode="json", exclude_unset=True)
    for name, section in header.scene.items():
        if name == "transducer":
            own = values.get(name, {}).get("probe")
            section = {key: value for key, value in section.items() if key != "probe"} | (
                {"probe": own} if own else {}
            )
        if name not in ("anatomy", "shape", "title"):
            values[name] = section
    return Scene.model_validate(values)
