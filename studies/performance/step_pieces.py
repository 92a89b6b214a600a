"""Names of the pieces of a step, as ``study timing`` reports them."""

# Before the iterations of a substep, in an iteration (of shape matching or not), after them; "frames" is once a step.
BEFORE = ("tool", "predict", "begin", "find contacts", "leave contacts", "gather")
IN_ITERATION = {
    True: ("fit clusters", "average goals", "move to goals", "contacts"),
    False: ("tissue and contacts",),
}
AFTER = ("scatter", "keep out", "velocities")
CONTACTS = ("find contacts", "leave contacts", "contacts", "keep out")
