"""Layout of the scratch array that element kernels work in.

The scratch holds the values of one cell at eight Gauss points, one SIMD lane per point. It is a flat array of
rows of eight doubles: row r of lane g is w[8 r + g]. The constants are row offsets; the comments give the content
and the number of rows. A 3 x 3 matrix takes nine rows, row by row. Pairs of stretches are (0, 1), (1, 2), (2, 0).
psi_i is d psi / d s_i. Flip and twist are the modes of Smith, De Goes and Kim, Analytic Eigensystems for
Isotropic Distortion Energies (2019).
"""

DEFORMATION = 0  # deformation gradient F, 9
U = 9  # left rotation of F = U diag(s) V^T, 9
V = 18  # right rotation, 9
STRETCH = 27  # stretches s: signed singular values of F, 3
ENERGY = 30  # energy density psi, 1
FIRST = 31  # psi_i, 3
SECOND = 34  # d^2 psi / ds_i ds_j: 00 11 22 01 12 20, 6
FLIP = 40  # stiffness of the flip mode of each pair, (psi_i - psi_j) / (s_i - s_j), 3
TWIST = 43  # stiffness of the twist mode of each pair, (psi_i + psi_j) / (s_i + s_j), 3
STRESS = 46  # weight times first Piola-Kirchhoff stress P, 9
TEMPORARY = 55  # intermediate values of one function, 9
MODES = 64  # nine 3 x 3 matrices: three stretch modes, then two matrices of each pair, 81
COUPLED = 145  # the local tangent applied to the modes, 81
TANGENT = 226  # weight times d P / d F, 81
WEIGHT = 307  # volume of each point [m^3], 1
SHAPE_GRADIENTS = 308  # of (8 points, 3 components), 24; here the SIMD lanes are nodes
PRODUCT = 332  # tangent times shape function gradients, (8 points, 3 components), 24; the SIMD lanes are nodes
FORCE = 356  # nodal forces by component, 3; the SIMD lanes are nodes
STIFFNESS = 359  # (component i, component k <= i) blocks of 8 x 8 nodes, 48
ROWS = 407  # rows in all
