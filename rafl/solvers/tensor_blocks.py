"""Block elimination of block-tridiagonal matrices in torch tensors, for all trajectories of a batch at once."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from torch import Tensor

from rafl.fem.mesh import HexMesh
from rafl.solvers.level_sets import LevelSets
from rafl.solvers.linear import Factors

Array = NDArray[Any]

MAX_DIRECT_SIZE = 128  # of a matrix that the library factors; batches of larger ones it factors slowly on a card


class TensorBlockElimination:
    """Cholesky factors of a block-tridiagonal matrix, by block elimination from both ends to the middle.

    The blocks are the level sets of `rafl.solvers.level_sets`. The two levels that are as far from the middle form a
    group and are eliminated together, padded to the size of the larger one: an added unknown has 1 on the diagonal and
    is coupled to none. So the loop over groups is half as long as that over levels, and nothing else is a loop.

    The storage is a list of blocks of all trajectories: the inverses L^-1 of the Cholesky factors of every group, from
    the outermost inwards, last of the middle; then the couplings C L^-T of every group with the next one inward. With
    inverses a solution takes products only, which suit a graphics card better than substitution.

    Args:
        mesh: the rest shape.
        fixed: indices of the fixed nodes, (F).
        device: where the factors are.
    """

    factorisation_cost = 4.0  # 1.3 for a small batch on a card, where all calls take alike, and 15 for a large mesh

    def __init__(self, mesh: HexMesh, fixed: NDArray[np.int64], device: torch.device) -> None:
        found = LevelSets.of(mesh, fixed)
        self.device = device
        self.free_index = (3 * found.order[:, None] + np.arange(3)).ravel()
        self.count = len(self.free_index)
        sides = [side for side in (range(found.middle), range(len(found.sizes) - 1, found.middle, -1)) if len(side)]
        depth = max(map(len, sides), default=0)
        # The levels of each group, -1 where a side is shorter than the other; last the middle.
        groups = [[side[k - depth] if depth - k <= len(side) else -1 for side in sides] for k in range(depth)]
        groups.append([found.middle])
        sizes = [*found.sizes, 0]  # of no level
        self._widths = [max(sizes[level] for level in group) for group in groups]
        self._sides = len(sides)
        self._place_blocks()
        self._index_unknowns(groups, sizes)
        self._index_entries(mesh, found, groups)

    def _place_blocks(self) -> None:
        """Slices of the blocks of every group in an assembled row of numbers."""
        self._diagonals: list[slice] = []
        self._couplings: list[slice] = []
        end = 0
        for k, width in enumerate(self._widths[:-1]):
            self._diagonals.append(slice(end, end + self._sides * width**2))
            end = self._diagonals[-1].stop + self._sides * width * self._widths[k + 1]
            self._couplings.append(slice(self._diagonals[-1].stop, end))
        self._diagonals.append(slice(end, end + self._widths[-1] ** 2))
        self._size = self._diagonals[-1].stop

    def _index_unknowns(self, groups: list[list[int]], sizes: list[int]) -> None:
        """Unknowns of every row of the groups, `count` for an added one, and where the diagonal is in a row."""
        first = np.cumsum([0, *sizes[:-1]])
        unknowns, places = [], []
        for width, group, block in zip(self._widths, groups, self._diagonals, strict=True):
            for side, level in enumerate(group):
                rows = np.arange(width)
                unknowns.append(np.where(rows < sizes[level], first[level] + rows, self.count))
                places.append(block.start + side * width**2 + rows * (width + 1))
        self._unknowns = torch.from_numpy(np.concatenate(unknowns)).to(self.device)
        self._diagonal_places = torch.from_numpy(np.concatenate(places)).to(self.device)

    def _index_entries(self, mesh: HexMesh, found: LevelSets, groups: list[list[int]]) -> None:
        """Entries of the cell tangents (E * 576) that are needed, and their places in a row."""
        level_of_node = np.full(len(mesh.vertices), -1)
        row_of_node = np.zeros(len(mesh.vertices), dtype=np.int64)
        counts = np.array(found.sizes) // 3
        level_of_node[found.order] = np.repeat(np.arange(len(counts)), counts)
        row_of_node[found.order] = 3 * (np.arange(len(found.order)) - np.repeat(np.cumsum(counts) - counts, counts))
        group_of, side_of = (np.zeros(len(counts), dtype=np.int64) for _ in range(2))
        for k, group in enumerate(groups):
            for side, level in enumerate(group):
                if level >= 0:
                    group_of[level], side_of[level] = k, side
        widths = np.array([*self._widths, 0])
        diagonals = np.array([block.start for block in self._diagonals])
        couplings = np.array([*(block.start for block in self._couplings), 0])
        row, column = (np.repeat(mesh.hexes, 8, axis=1).ravel(), np.tile(mesh.hexes, (1, 8)).ravel())  # (E * 64)
        own, other = level_of_node[row], level_of_node[column]
        group = group_of[other]
        free = (own >= 0) & (other >= 0)
        inside = free & (own == other) & (row_of_node[row] >= row_of_node[column])
        inward = free & (own != other) & (group_of[own] == group + 1)
        start = np.where(
            inside,
            diagonals[group] + side_of[other] * widths[group] ** 2,
            couplings[group] + side_of[other] * widths[group + 1] * widths[group],
        )
        start = start + row_of_node[row] * widths[group] + row_of_node[column]
        kept = np.flatnonzero(inside | inward)
        cell, pair = np.divmod(kept, 64)
        entry = 576 * cell + 72 * (pair // 8) + 3 * (pair % 8)
        components = np.arange(3)
        width = widths[group][kept]
        entries = entry[:, None, None] + 24 * components[:, None] + components
        places = start[kept][:, None, None] + width[:, None, None] * components[:, None] + components
        self._entries = torch.from_numpy(entries.ravel()).to(self.device)
        self._places = torch.from_numpy(places.ravel()).to(self.device)
        unknown_of_node = np.full(len(mesh.vertices), -3)
        unknown_of_node[found.order] = 3 * np.arange(len(found.order))
        self._cell_unknowns = (unknown_of_node[mesh.hexes][..., None] + components).reshape(-1, 24)  # negative: fixed

    def allocate(self, batch: int) -> Factors:
        """Storage for the factors of a batch, empty until the first are there."""
        return Factors([], np.zeros(batch, dtype=bool))

    def _blocks(self, flat: Tensor) -> list[Tensor]:
        """Views of the diagonal blocks, then of the couplings, of each group, (R, sides, rows, columns)."""
        widths, sides = self._widths, [self._sides] * len(self._couplings) + [1]
        diagonals = zip(self._diagonals, sides, widths, widths, strict=True)
        couplings = zip(self._couplings, sides[:-1], widths[1:], widths[:-1], strict=True)
        return [flat[:, block].view(-1, *shape) for block, *shape in (*diagonals, *couplings)]

    def _assembled(self, tangents: Tensor, diagonal: Tensor) -> Tensor:
        """The lower blocks of tangents (R, E, 24, 24) plus a diagonal (R, n), (R, size)."""
        rows = len(tangents)
        values = tangents.reshape(rows, -1).index_select(1, self._entries)
        flat = values.new_zeros(rows, self._size).scatter_add_(1, self._places.expand(rows, -1), values)
        added = torch.cat([diagonal, diagonal.new_ones(rows, 1)], dim=1)  # 1 for the added unknowns
        flat[:, self._diagonal_places] += added.index_select(1, self._unknowns)
        return flat

    def factor(self, factors: Factors, rows: Array, tangents: Tensor, diagonal: Tensor) -> NDArray[np.bool_]:
        """Factor `rows` (R), in ascending order, of the batch; True where the matrix is positive definite.

        tangents: (R, E, 24, 24) [N/m]; diagonal: (R, n).
        """
        whole, batch = len(rows) == len(factors.ready), len(factors.ready)
        if whole:
            factors.storage = []  # of a large mesh there is no room for two
        blocks = self._blocks(self._assembled(tangents, diagonal))
        diagonals, couplings = blocks[: len(self._diagonals)], blocks[len(self._diagonals) :]
        infos = []
        for k, block in enumerate(diagonals):
            inverse, info = inverse_factors(block)
            infos.append(info)
            block.copy_(inverse)
            if k < len(couplings):
                coupling = couplings[k] @ inverse.mT
                couplings[k].copy_(coupling)
                square = coupling @ coupling.mT
                diagonals[k + 1] -= square if k < len(couplings) - 1 else square.sum(1, keepdim=True)
        finite = diagonals[-1].diagonal(dim1=-2, dim2=-1).sum((1, 2)).isfinite()
        definite: NDArray[np.bool_] = (finite & (torch.cat(infos, dim=1) == 0).all(1)).cpu().numpy()
        if whole:
            factors.storage = [block.contiguous() for block in blocks]
        else:
            factors.storage = factors.storage or [block.new_zeros(batch, *block.shape[1:]) for block in blocks]
            index = torch.from_numpy(rows).to(self.device)
            for own, block in zip(factors.storage, blocks, strict=True):
                own[index] = block
        factors.ready[rows] = definite
        return definite

    def solve(self, factors: Factors, rows: Array, right: Tensor) -> Tensor:
        """Solutions (R, C, n) for right-hand sides (R, C, n)."""
        blocks: list[Tensor] = factors.storage
        if len(rows) != len(factors.ready):
            index = torch.from_numpy(rows).to(self.device)
            blocks = [block[index] for block in blocks]
        diagonals, couplings = blocks[: len(self._diagonals)], blocks[len(self._diagonals) :]
        batch, columns, _ = right.shape
        padded = torch.cat([right, right.new_zeros(batch, columns, 1)], dim=2).mT.index_select(1, self._unknowns)
        parts = torch.split(padded, [block.shape[1] * block.shape[2] for block in diagonals], dim=1)
        x = [part.reshape(*block.shape[:3], columns) for part, block in zip(parts, diagonals, strict=True)]
        last = len(couplings) - 1
        for k, coupling in enumerate(couplings):
            x[k] = diagonals[k] @ x[k]
            push = coupling @ x[k]
            x[k + 1] = x[k + 1] - (push if k < last else push.sum(1, keepdim=True))
        x[-1] = diagonals[-1].mT @ (diagonals[-1] @ x[-1])
        for k in reversed(range(len(couplings))):
            x[k] = diagonals[k].mT @ (x[k] - couplings[k].mT @ x[k + 1])
        out = right.new_empty(batch, self.count + 1, columns)
        out[:, self._unknowns] = torch.cat([part.flatten(1, 2) for part in x], dim=1)
        return out[:, :-1].mT

    def solve_indefinite(self, tangents: Tensor, diagonal: Tensor, right: Tensor) -> Tensor:
        """Solutions (C, n) of one trajectory's system whose matrix is not positive definite.

        By sparse LU factors on the host. Such matrices are rare: Newton's method needs none of them, and a body rests
        where its tangent is positive definite.
        """
        unknowns = self._cell_unknowns
        row, column = np.repeat(unknowns, 24, axis=1).ravel(), np.tile(unknowns, (1, 24)).ravel()
        free = (row >= 0) & (column >= 0)
        values = tangents.reshape(-1).cpu().numpy()[free]
        matrix = coo_array((values, (row[free], column[free])), shape=(self.count, self.count))
        factor = splu((matrix + diags_array(diagonal.cpu().numpy())).tocsc())
        return torch.from_numpy(factor.solve(right.cpu().numpy().T).T).to(right)


def inverse_factors(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses of the Cholesky factors of matrices (..., m, m), and (...) numbers, 0 where one is positive definite.

    Only the lower triangles are read. Large matrices are halved, so that nearly all the work is in products:

        A = [A1, B^T; B, A2],  L = [L1, 0; C, L2],  C = B L1^-T,  L2 L2^T = A2 - C C^T,  (L^-1)_21 = -L2^-1 C L1^-1.
    """
    size = matrix.shape[-1]
    if size <= MAX_DIRECT_SIZE:
        lower, info = torch.linalg.cholesky_ex(matrix)
        identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
        return torch.linalg.solve_triangular(lower, identity, upper=False), info
    half = size // 2
    first, info = inverse_factors(matrix[..., :half, :half])
    below = matrix[..., half:, :half] @ first.mT
    second, other = inverse_factors(matrix[..., half:, half:] - below @ below.mT)
    whole = torch.zeros_like(matrix, memory_format=torch.contiguous_format)
    whole[..., :half, :half], whole[..., half:, half:] = first, second
    whole[..., half:, :half] = -second @ (below @ first)
    return whole, info.maximum(other)
