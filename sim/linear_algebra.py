"""The rotation nearest to a 3 x 3 matrix, for every matrix: inverted, flat, collapsed and tiny ones too."""

import taichi as ti
import taichi.math as tm

# Below this share of its size cubed, the best rotation is not unique to float32 and is left as it is.
UNIQUE = 1e-3
# Newton's method errs by the cube of its last turn [rad]: by no more than float32 does.
LAST_TURN = 0.01
MOST_TURNS = 3
SQUARINGS = 20


@ti.func
def four(vector):
    """A vector of three with 0 as the fourth entry."""
    return tm.vec4(vector.x, vector.y, vector.z, 0.0)


@ti.func
def row(matrix, k: ti.template()):
    """Row k of a matrix of four columns."""
    return tm.vec4(matrix[k, 0], matrix[k, 1], matrix[k, 2], matrix[k, 3])


@ti.func
def cross(a, b):
    """Cross product of the first three entries."""
    return tm.vec4(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x, 0.0)


@ti.func
def nearest_rotation(matrix):
    """Proper rotation R (det R = +1) that maximises trace(R^T matrix), the solution of Eq. 8.

    Its quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix (Horn 1987). The entries are
    divided by the largest one first, so that those of tiny matrices keep their digits. No matrix, no rotation: the
    identity.
    """
    largest = 0.0
    for i, j in ti.static(ti.ndrange(3, 3)):
        largest = ti.max(largest, ti.abs(matrix[i, j]))
    rotation = ti.Matrix.identity(ti.f32, 3)
    if largest > 0.0:
        scaled = matrix / largest
        rotation = rotation_of(largest_eigenvector(horn_matrix(scaled)))
        turn, unique = newton_turn(rotation, scaled)
        if unique:
            rotation = rotation @ small_rotation(turn)
    return rotation


@ti.func
def horn_matrix(m):
    """Horn's matrix (4, 4): q^T N q = trace(R(q)^T m) for unit quaternions q = (w, x, y, z)."""
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    xx, yy, zz = m[0, 0], m[1, 1], m[2, 2]
    return tm.mat4(
        [xx + yy + zz, x, y, z],
        [x, xx - yy - zz, xy, xz],
        [y, xy, yy - xx - zz, yz],
        [z, xz, yz, zz - xx - yy],
    )


@ti.func
def largest_eigenvector(symmetric):
    """Eigenvector (4,), not of unit length, of the largest eigenvalue of a symmetric matrix (4, 4): the power method by squaring.

    Where two eigenvalues are nearer than 2^-SQUARINGS it is of their plane, which is as good to float32.
    """
    power = symmetric + symmetric.norm() * tm.eye(4)
    for _ in range(SQUARINGS):
        power = power @ power
        power /= power.trace()
    best, largest = tm.vec4(power[0, 0], power[1, 0], power[2, 0], power[3, 0]), power[0, 0]
    for k in ti.static(range(1, 4)):
        if power[k, k] > largest:
            best, largest = tm.vec4(power[0, k], power[1, k], power[2, k], power[3, k]), power[k, k]
    return best


@ti.func
def rotation_of(q):
    """Rotation matrix of a quaternion (w, x, y, z) that need not be of unit length."""
    v = tm.vec3(q[1], q[2], q[3])
    cross = cross_matrix(v)
    return ti.Matrix.identity(ti.f32, 3) + 2.0 / q.norm_sqr() * (q[0] * cross + cross @ cross)


@ti.func
def rotation_near(guess, matrix):
    """The same rotation, from a guess: a fifth of the time where it is close, and no slower in vain than it must be."""
    rotation, found, left = guess, False, MOST_TURNS
    while left > 0:
        turn, unique = newton_turn(rotation, matrix)
        left -= 1
        if unique:
            rotation = rotation @ small_rotation(turn)
            found = turn.norm_sqr() < LAST_TURN**2
        if found or not unique:
            left = 0
    if not found:
        rotation = nearest_rotation(matrix)
    return rotation


@ti.func
def newton_turn(rotation, matrix):
    """The turn [rad] of one step of Newton's method for the maximum of trace(R^T matrix), and whether that is unique.

    With S = R^T matrix, the turn w solves (tr(S) I - sym(S)) w = axial(S - S^T) (Kugelstadt 2018). Where that
    matrix is positive definite there is one maximum.
    """
    s = rotation.transpose() @ matrix
    size = s[0, 0] + s[1, 1] + s[2, 2]
    xx, yy, zz = size - s[0, 0], size - s[1, 1], size - s[2, 2]
    xy, xz, yz = -(s[0, 1] + s[1, 0]) / 2, -(s[0, 2] + s[2, 0]) / 2, -(s[1, 2] + s[2, 1]) / 2
    a, b, c = tm.vec3(xx, xy, xz), tm.vec3(xy, yy, yz), tm.vec3(xz, yz, zz)
    bc = b.cross(c)
    determinant = a.dot(bc)
    unique = xx > 0.0 and xx * yy - xy * xy > 0.0 and determinant > UNIQUE * size**3
    g = tm.vec3(s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1])
    turn = tm.vec3(bc.dot(g), c.cross(a).dot(g), a.cross(b).dot(g)) / (determinant if unique else 1.0)
    return turn, unique


@ti.func
def small_rotation(turn):
    """Rotation by about a small turn [rad], exactly orthogonal: of the quaternion (1, turn / 2)."""
    return rotation_of(tm.vec4(1.0, turn / 2))


@ti.func
def cross_matrix(a):
    """The matrix of a x."""
    return tm.mat3(0.0, -a.z, a.y, a.z, 0.0, -a.x, -a.y, a.x, 0.0)
