"""The states of the machine as signs at the edge of the 3D view."""

from collections.abc import Iterable

from render.viewer import Sign

MEANINGS = {
    "Recording": "The images and the poses of the probe are recorded as a tracked sweep: {sweep} ends it.",
    "Replay": "A recorded session is shown: with {take_over} mouse and keys control the probe from here on.",
    "Longer steps": (
        "This machine is too slow for as many steps a second as are set: they are longer. The tissue comes "
        "to the same rest."
    ),
    "Reduced iterations": (
        "The steps have fewer iterations than are set, to keep up with the clock: the tissue comes to rest "
        "more slowly."
    ),
    "Cutting": "The cut along the score is computed: it takes one to three seconds.",
    "Planning": "A plan is searched while you continue: {next_plan} stops it.",
}


def machine_signs(states: Iterable[str]) -> tuple[Sign, ...]:
    """Signs of some states, each of which begins with a name of ``MEANINGS``; of an empty one none.

    ``{action}`` in a meaning stands for the key of an action.
    """
    return tuple(Sign(state, _meaning(state), state.startswith("Recording")) for state in states if state)


def _meaning(state: str) -> str:
    return next(meaning for name, meaning in MEANINGS.items() if state.startswith(name))
