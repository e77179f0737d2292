"""Where one cell's numbers stand while a kernel works on it.

The scratch is a flat array of rows of eight doubles, one lane a Gauss point. Row r of lane g is
w[8 r + g]; a 3 x 3 matrix takes nine rows, row by row; the pairs of stretches are (0,1), (1,2), (2,0).
"""

DEFORMATION = 0  # F, 9
U = 9  # left rotation, 9
V = 18  # right rotation, 9
STRETCH = 27  # signed singular values of F, 3
ENERGY = 30  # psi, 1
FIRST = 31  # d psi / d stretch, 3
SECOND = 34  # d^2 psi / d stretch^2: 00 11 22 01 12 20
FLIP = 40  # (psi_i - psi_j) / (s_i - s_j) of each pair, 3
TWIST = 43  # (psi_i + psi_j) / (s_i + s_j) of each pair, 3
STRESS = 46  # weight times P, 9
TEMPORARY = 55  # 9
MODES = 64  # nine 3 x 3 matrices that the tangent couples, 81
COUPLED = 145  # what the tangent makes of them, 81
TANGENT = 226  # weight times d P / d F, 81
WEIGHT = 307  # volume of each point, 1
SLOPES = 308  # shape function gradients, lanes are nodes: (8 points, 3), 24
PRODUCT = 332  # 24
FORCE = 356  # (3 components), lanes are nodes
STIFFNESS = 359  # lower (component, component) blocks, each 8 x 8 nodes, 48
ROWS = 407
