"""An own reference: the bead experiment on the embedded patient, solved by nonlinear finite elements.

It stands apart from the simulator on purpose and shares none of its code: quadratic tetrahedra and Newton's
method in float64 (scikit-fem, SciPy) on a mesh that Mmg makes. Lengths are mm, stresses kPa, forces mN
(1 kPa mm^2 = 1 mN), until the files, which have N.
"""
