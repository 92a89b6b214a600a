"""A reference solution: the bead experiment on the embedded patient, by nonlinear finite elements.

It shares no code with the simulator on purpose: quadratic tetrahedra and Newton's
method in float64 (scikit-fem, SciPy) on a mesh that Mmg makes. Lengths are mm, stresses kPa, forces mN
(1 kPa mm^2 = 1 mN), until the files, which have N.
"""
