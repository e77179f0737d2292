"""Rows of the scratch array of cells with stabilised hourglass modes, in place of those after WEIGHT for points.

The SIMD lanes are eight cells. The rows of `rafl.fem.kernel_layout` up to WEIGHT hold each cell's mean deformation
gradient and what follows from it.
Vectors and matrices of the hourglass modes are in the frame that the polar rotation R of the mean deformation gradient
carries along. [v] is the matrix of the cross product with v. A variation of F0 turns the frame by
omega = sum_j L_j R^T dF0 e_j with L_j = G^-1 [e_j], G = tr(S) I - S and S = R^T F0.
"""

COLUMNS = 7  # of the tangent: three of the deformation gradient, four hourglass vectors

POSITIONS = 308  # nodal positions (8 nodes, 3 components), 24
VECTORS = 332  # hourglass vectors Gamma, 12
ROTATION = 344  # R, 9
LOCAL = 353  # Y = R^T Gamma, 12
LOCAL_FORCE = 365  # derivative of the energy by Y, 12
INVERSE = 377  # G^-1, 9
STRETCH_TENSOR = 386  # S, 9
MOMENT = 395  # n = G^-1 sum_k Y_k x T_k, 3
TURN = 398  # omega per column of R^T dF0: L, (3, 9), 27
SWEEP = 425  # change of Y per omega: [Y_k], (12, 3), 36
DRIVEN = 461  # stiffness times sweep, minus [T_k], (12, 3), 36
CURVATURE = 497  # C = M + [S n], (3, 3), 9
MODE_STIFFNESS = 506  # derivative of the force by Y, (12, 12), 144
TENSOR = 650  # the tangent by column and component, (21, 21), 441
NODAL_PRODUCT = 1091  # tangent times nodal columns, (7, 8), 56
VELOCITY = 1171  # nodal velocities (8 nodes, 3), 24
RATE = 1195  # gradient of the velocity, 9
RATE_VECTORS = 1204  # hourglass vectors of the velocity, 12
SCRATCH = 1216  # 12
BLOCK = 1228  # one component block of the stiffness, (8, 8), 64
ENHANCED_ROWS = 1292  # rows in all
