"""Linear algebra of small matrices in kernels: four-wide vectors, rotations, symmetric 3 x 3 systems.

Four-wide vectors carry three numbers and a fourth: compilers use a processor's vector units only where no
entry is left out.
"""

import taichi as ti
import taichi.math as tm

# Below this determinant, relative to trace(S) cubed, the best rotation is not unique in float32 and Newton's
# step is not taken.
LEAST_DETERMINANT = 1e-3
# The error of Newton's method is the cube of its last step [rad]: below float32's rounding.
LAST_STEP_RAD = 0.01
MOST_NEWTON_STEPS = 3
SQUARINGS = 20


@ti.func
def four(vector):
    """A 3-vector with 0 as the fourth entry."""
    return tm.vec4(vector.x, vector.y, vector.z, 0.0)


@ti.func
def row(matrix, k: ti.template()):
    """Row k of a matrix with four columns."""
    return tm.vec4(matrix[k, 0], matrix[k, 1], matrix[k, 2], matrix[k, 3])


@ti.func
def cross(a, b):
    """Cross product of the first three entries."""
    return tm.vec4(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x, 0.0)


@ti.func
def nearest_rotation(matrix):
    """Proper rotation R (det R = +1) that maximises trace(R^T matrix), for every matrix: also inverted, flat
    or tiny (Eq. 8).

    Its quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix (Horn 1987). The
    entries are first divided by the largest, so that tiny matrices keep their digits. The zero matrix gives
    the identity.
    """
    largest = 0.0
    for i, j in ti.static(ti.ndrange(3, 3)):
        largest = ti.max(largest, ti.abs(matrix[i, j]))
    rotation = ti.Matrix.identity(ti.f32, 3)
    if largest > 0.0:
        scaled = matrix / largest
        rotation = rotation_of(largest_eigenvector(horn_matrix(scaled)))
        step, unique = newton_step(rotation, scaled)
        if unique:
            rotation = rotation @ small_rotation(step)
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
    """Eigenvector (4,), not of unit length, of the largest eigenvalue of a symmetric matrix (4, 4): power
    method by squaring.

    Where the two largest eigenvalues differ by less than 2^-SQUARINGS, any vector of their plane is as good
    in float32.
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
    """Rotation matrix of a quaternion (w, x, y, z) of any length."""
    v = tm.vec3(q[1], q[2], q[3])
    cross = cross_matrix(v)
    return ti.Matrix.identity(ti.f32, 3) + 2.0 / q.norm_sqr() * (q[0] * cross + cross @ cross)


@ti.func
def rotation_near(guess, matrix):
    """The same as ``nearest_rotation``, from a guess: takes a fifth of the time where the guess is close."""
    rotation, converged, steps_left = guess, False, MOST_NEWTON_STEPS
    while steps_left > 0:
        step, unique = newton_step(rotation, matrix)
        steps_left -= 1
        if unique:
            rotation = rotation @ small_rotation(step)
            converged = step.norm_sqr() < LAST_STEP_RAD**2
        if converged or not unique:
            steps_left = 0
    if not converged:
        rotation = nearest_rotation(matrix)
    return rotation


@ti.func
def newton_step(rotation, matrix):
    """Rotation vector [rad] of one Newton step to the maximum of trace(R^T matrix), and whether that maximum
    is unique.

    With S = R^T matrix, the step w solves (tr(S) I - sym(S)) w = axial(S - S^T) (Kugelstadt et al. 2018).
    Where that matrix is positive definite there is one maximum.
    """
    s = rotation.transpose() @ matrix
    size = s[0, 0] + s[1, 1] + s[2, 2]
    xx, yy, zz = size - s[0, 0], size - s[1, 1], size - s[2, 2]
    xy, xz, yz = -(s[0, 1] + s[1, 0]) / 2, -(s[0, 2] + s[2, 0]) / 2, -(s[1, 2] + s[2, 1]) / 2
    a, b, c = tm.vec3(xx, xy, xz), tm.vec3(xy, yy, yz), tm.vec3(xz, yz, zz)
    bc = b.cross(c)
    determinant = a.dot(bc)
    unique = xx > 0.0 and xx * yy - xy * xy > 0.0 and determinant > LEAST_DETERMINANT * size**3
    g = tm.vec3(s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1])
    step = tm.vec3(bc.dot(g), c.cross(a).dot(g), a.cross(b).dot(g)) / (determinant if unique else 1.0)
    return step, unique


@ti.func
def small_rotation(vector):
    """Rotation of the quaternion (1, vector / 2): exactly orthogonal, and nearly that of a small rotation
    vector [rad].
    """
    return rotation_of(tm.vec4(1.0, vector / 2))


@ti.func
def rotation_by(vector):
    """Rotation matrix of a rotation vector [rad] (Rodrigues)."""
    angle = vector.norm()
    axis = vector / ti.max(angle, 1e-12)
    cross = cross_matrix(axis)
    return tm.eye(3) + ti.sin(angle) * cross + (1.0 - ti.cos(angle)) * (cross @ cross)


@ti.func
def axial(matrix):
    """The sum of u x v where a matrix is the sum of v u^T."""
    return tm.vec3(matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1])


@ti.func
def cross_matrix(a):
    """The matrix M with M b = a x b."""
    return tm.mat3(0.0, -a.z, a.y, a.z, 0.0, -a.x, -a.y, a.x, 0.0)


@ti.func
def inverse_of(matrix):
    """Inverse of a positive definite 3 x 3 matrix, scaled by its trace: its determinant may overflow
    float32.
    """
    unit = 1.0 / matrix.trace()
    return unit * (unit * matrix).inverse()


@ti.func
def solve(matrix, right, least):
    """Solution of a symmetric 3 x 3 system with eigenvalues of ``least`` or more, by its LDL^T factors.

    In exact arithmetic no pivot is below ``least``; rounding can make one so, where a node is torn far away.
    """
    d0 = matrix[0, 0]
    l10, l20 = matrix[1, 0] / d0, matrix[2, 0] / d0
    d1 = ti.max(matrix[1, 1] - l10 * matrix[1, 0], least)
    l21 = (matrix[2, 1] - l20 * matrix[1, 0]) / d1
    d2 = ti.max(matrix[2, 2] - l20 * matrix[2, 0] - l21 * l21 * d1, least)
    y1 = right.y - l10 * right.x
    y2 = right.z - l20 * right.x - l21 * y1
    z = y2 / d2
    y = y1 / d1 - l21 * z
    return tm.vec3(right.x / d0 - l10 * y - l20 * z, y, z)
