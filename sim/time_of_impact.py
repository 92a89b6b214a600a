"""How far a point can go before it meets a shape, so that nothing fast passes through what it should lie on."""

import taichi as ti

from sim.shapes import FAR

# A way ends this deep in a shape [mm], so that a body can slide along one; thinner shapes stop nothing fast.
DEEP_MM = 1.0
# Each stride is as long as the room there is: few, but for ways along a surface.
STRIDES = 32
LEAST_STRIDE_MM = 0.01


@ti.data_oriented
class TimeOfImpact:
    """Ways among the shapes that do not move, by sphere tracing (Hart 1996); where there are none all ways are free."""

    def __init__(self, shapes: list) -> None:
        self.shapes = [shape for shape in shapes if not shape.moves]

    @ti.func
    def share(self, start, way, free: float):
        """Share of a way [mm] from a start that can be gone until a shape is met; 1 of ways no longer than ``free`` [mm]."""
        length = way.norm()
        share = 1.0
        if length > free:
            gone = 0.0
            for _ in range(STRIDES):
                if gone < length:
                    stride = self.room(start + gone / length * way) + DEEP_MM
                    gone += stride if stride > LEAST_STRIDE_MM else 0.0
            share = ti.min(1.0, ti.max(gone, free) / length)
        return share

    @ti.func
    def room(self, p):
        """A ball of this radius [mm] around p meets no shape."""
        room = FAR
        for s in ti.static(range(len(self.shapes))):
            room = ti.min(room, self.shapes[s].room(p))
        return room
