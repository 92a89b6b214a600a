"""Sparse linear systems: direct solves in an order of elimination that leaves little fill."""

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching
from scipy.sparse.linalg import splu

LEAF_NODES = 100


def solved(matrix: csc_matrix, right: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Solution x of matrix x = right, shape (n,), for the unknowns of an order; all others are zero.

    Args:
        matrix: of symmetric structure, shape (n, n).
        right: shape (n,).
        order: unknowns, the first to be eliminated first.

    Raises:
        RuntimeError: the matrix is singular.
    """
    # The order is made for little fill: pivots stay on the diagonal unless they vanish.
    factor = splu(
        matrix[order][:, order].tocsc(),
        permc_spec="NATURAL",
        diag_pivot_thresh=1e-3,
        options=dict(SymmetricMode=True),
    )
    solution = np.zeros(len(right))
    solution[order] = factor.solve(right[order])
    if not np.isfinite(solution).all():
        raise RuntimeError("the system is singular")
    return solution


def dissected(places: np.ndarray, nodes_of: np.ndarray) -> np.ndarray:
    """Order of elimination with little fill: nested dissection (George 1973) by the nodes' places.

    Each half of the nodes is cut from the other by the least set of nodes that touches every edge between
    them (Koenig's theorem, by a maximum matching); that set comes last.

    Args:
        places: nodes [mm], shape (nodes, 3).
        nodes_of: nodes of each element, shape (elements, nodes of one).

    Returns:
        All nodes, the first to be eliminated first, shape (nodes,).
    """
    size = nodes_of.shape[1]
    rows, columns = np.repeat(nodes_of, size, axis=1).ravel(), np.tile(nodes_of, size).ravel()
    joined = csr_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(places),) * 2)

    def ordered(nodes: np.ndarray) -> list[np.ndarray]:
        if len(nodes) <= LEAF_NODES:
            return [nodes]
        along = places[nodes, np.ptp(places[nodes], axis=0).argmax()]
        low = along <= np.median(along)
        if low.all():
            return [nodes]
        left, right = nodes[low], nodes[~low]
        cut_left, cut_right = _least_cover(joined[left][:, right].tocsr())
        cut = np.concatenate([left[cut_left], right[cut_right]])
        return [*ordered(left[~cut_left]), *ordered(right[~cut_right]), cut]

    return np.concatenate(ordered(np.arange(len(places))))


def _least_cover(edges: csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a least vertex cover of a bipartite graph, as masks."""
    column_of = maximum_bipartite_matching(edges, perm_type="column")
    row_of = np.full(edges.shape[1], -1)
    row_of[column_of[column_of >= 0]] = np.flatnonzero(column_of >= 0)
    joined = np.diff(edges.indptr) > 0
    seen_rows, seen_columns = joined & (column_of < 0), np.zeros(edges.shape[1], bool)
    front = np.flatnonzero(seen_rows)
    while len(front):
        columns = np.unique(edges[front].indices)
        columns = columns[~seen_columns[columns]]
        seen_columns[columns] = True
        # Every column met is matched, or the matching would not be maximum.
        front = row_of[columns]
        front = front[~seen_rows[front]]
        seen_rows[front] = True
    return joined & ~seen_rows, seen_columns
