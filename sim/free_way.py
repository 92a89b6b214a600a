"""How far a point can go before it meets a shape, so that nothing fast passes through what it should lie on."""

import taichi as ti
import taichi.math as tm

# Each stride is as long as the room there is, so they are few unless the way grazes a shape.
STRIDES = 32
# A way with less room than this has met the shape [mm].
MET_MM = 0.1


@ti.data_oriented
class FreeWay:
    """Ways among the shapes that do not move, by sphere tracing (Hart 1996); where there are none all ways are free."""

    def __init__(self, shapes: list) -> None:
        self.shapes = [shape for shape in shapes if not shape.moves]

    @ti.func
    def share(self, start, way, slack: float):
        """Share of a way [mm] from a start that can be gone until a shape is met, and ``slack`` [mm] further: 1 at most."""
        length = way.norm()
        share = 1.0
        if length > slack:
            gone = 0.0
            for _ in range(STRIDES):
                if gone < length:
                    room = self.room(start + gone / length * way)
                    gone += room if room > MET_MM else 0.0
            share = ti.min(1.0, (gone + slack) / length)
        return share

    @ti.func
    def room(self, p):
        """A ball of this radius [mm] around p meets no shape."""
        room = tm.inf
        for s in ti.static(range(len(self.shapes))):
            room = ti.min(room, self.shapes[s].room(p))
        return room
