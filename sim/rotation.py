"""The rotation nearest to a 3 x 3 matrix, for every matrix: inverted, flat, collapsed and tiny ones too."""

import taichi as ti
import taichi.math as tm

# Below this share of the largest entry cubed, the best rotation is not unique to float32 and is left as it is.
UNIQUE = 1e-3


@ti.func
def nearest_rotation(matrix):
    """Proper rotation R (det R = +1) that maximises trace(R^T matrix), the solution of Eq. 8.

    R = U V^T of the singular value decomposition in which U and V are rotations and the smallest singular
    value carries the sign of the determinant (Kabsch 1976). The entries are divided by the largest one first,
    because Taichi's SVD loses all digits of matrices with small entries. No matrix, no rotation: the identity.
    """
    largest = 0.0
    for i, j in ti.static(ti.ndrange(3, 3)):
        largest = ti.max(largest, ti.abs(matrix[i, j]))
    rotation = ti.Matrix.identity(ti.f32, 3)
    if largest > 0.0:
        scaled = matrix / largest
        u, _, v = ti.svd(scaled, ti.f32)
        rotation = newton_step(u @ v.transpose(), scaled)
    return rotation


@ti.func
def newton_step(rotation, matrix):
    """One step of Newton's method for the maximum of trace(R^T matrix), where that is unique.

    With S = R^T matrix, the turn w solves (tr(S) I - sym(S)) w = axial(S - S^T) (Kugelstadt 2018); it
    brings the decomposition's error of 1e-4 at worst to float32's.
    """
    s = rotation.transpose() @ matrix
    hessian = (s[0, 0] + s[1, 1] + s[2, 2]) * ti.Matrix.identity(ti.f32, 3) - (s + s.transpose()) / 2
    turned = rotation
    if hessian.determinant() > UNIQUE:
        gradient = tm.vec3(s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1])
        turned = rotation @ small_rotation(hessian.inverse() @ gradient)
    return turned


@ti.func
def small_rotation(turn):
    """Rotation by about a small turn [radians], exactly orthogonal: of the quaternion (1, turn / 2)."""
    v = turn / 2
    n = 1.0 + v.norm_sqr()
    cross = tm.mat3(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
    return ti.Matrix.identity(ti.f32, 3) + 2.0 / n * (cross + cross @ cross)
