"""LU factors of a sparse matrix and entries of its inverse, compiled: columns in their order, rows chosen as pivots.

``F`` is L + U by columns, with rows numbered in the order of the pivots and ascending: U above the ``diagonal`` and on
it, L, whose diagonal is 1, below. Its pattern is closed under elimination, zeros by cancellation included, so that
another matrix of the same pattern is eliminated in the same places.
"""

from __future__ import annotations

import numpy as np

from dsse_core.code_cache import compiled


@compiled
def fill_tableau(gather, above, below, data, row, column, scale):
    """The entries of ``[[diag(above), H], [H', diag(below)]]`` in the order ``gather``, H scaled on both sides.

    ``data``, ``row``, ``column``: the entries of H. ``gather`` is negative where an entry is 0.
    """
    n_meas, n = len(above), len(scale)
    scaled, found = np.empty(len(data)), np.empty(len(gather))
    for e in range(len(data)):
        scaled[e] = data[e] * scale[row[e]] * scale[n_meas + column[e]]
    for k in range(len(gather)):
        g = gather[k]
        if g < 0:
            found[k] = 0.0
        elif g >= n:
            found[k] = scaled[g - n]
        else:
            found[k] = above[g] if g < n_meas else below[g - n_meas]
    return found


@compiled
def eliminate(indptr, indices, data, threshold):
    """F of the matrix (n, n) by columns, and the number of each row's pivot, -1 for rows left of a singular matrix.

    The pivot of column k is at row k where that is at least ``threshold`` of the largest, else at the first row that
    is: rows near in the order of elimination share most columns, so that exchanging them fills in little. Each column
    is solved for with the columns before it; a search from its entries finds those that have a part in it (J. R.
    Gilbert and T. Peierls, SIAM J. Sci. Stat. Comput. 9 (1988) 862).
    """
    n = len(indptr) - 1
    number, rows, values = (
        np.full(n, -1),
        np.empty(4 * len(indices) + n, dtype=np.int64),
        np.empty(4 * len(indices) + n),
    )
    first, pivots = np.zeros(n + 1, dtype=np.int64), np.zeros(n + 1, dtype=np.int64)
    x, seen = np.zeros(n), np.full(n, -1)
    reached, path, at = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    count = 0
    for k in range(n):
        top = n
        for e in range(indptr[k], indptr[k + 1]):
            if seen[indices[e]] != k:
                top = _reach(indices[e], k, number, first, pivots, rows, seen, reached, path, at, top)
            x[indices[e]] = data[e]
        if count + n - top > len(rows):
            rows, values = _longer(rows, 2 * len(rows) + n), _longer(values, 2 * len(rows) + n)
        for e in range(top, n):
            c = number[reached[e]]
            if c >= 0:
                u = x[reached[e]]
                for p in range(pivots[c] + 1, first[c + 1]):
                    x[rows[p]] -= values[p] * u
                rows[count], values[count] = reached[e], u
                count += 1
        pivot = _choose_pivot(k, x, seen, number, reached, top, threshold)
        if pivot < 0:
            break
        number[pivot], pivots[k] = k, count
        rows[count], values[count] = pivot, x[pivot]
        count += 1
        for e in range(top, n):
            r = reached[e]
            if number[r] < 0:
                rows[count], values[count] = r, x[r] / x[pivot]
                count += 1
        for e in range(top, n):
            x[reached[e]] = 0.0
        first[k + 1] = count
    return first, rows[:count], values[:count], number


@compiled
def _reach(row, k, number, first, pivots, rows, seen, reached, path, at, top):
    """Adds to ``reached``, before ``top``, the rows that ``row`` leads to through the columns of L, in their order."""
    depth, path[0], at[0], seen[row] = 0, row, 0, k
    while depth >= 0:
        c, deeper = number[path[depth]], False
        if c >= 0:
            for p in range(pivots[c] + 1 + at[depth], first[c + 1]):
                if seen[rows[p]] != k:
                    at[depth] = p - pivots[c]
                    depth += 1
                    path[depth], at[depth], seen[rows[p]], deeper = rows[p], 0, k, True
                    break
        if not deeper:
            top -= 1
            reached[top] = path[depth]
            depth -= 1
    return top


@compiled
def _choose_pivot(k, x, seen, number, reached, top, threshold):
    """The row of the pivot of column ``k``; -1 where all entries left are 0."""
    largest, chosen = 0.0, -1
    for e in range(top, len(x)):
        if number[reached[e]] < 0:
            largest = max(largest, abs(x[reached[e]]))
    if not largest > 0.0:
        return -1
    if seen[k] == k and number[k] < 0 and abs(x[k]) >= threshold * largest:
        return k
    for e in range(top, len(x)):
        r = reached[e]
        if number[r] < 0 and abs(x[r]) >= threshold * largest and (chosen < 0 or r < chosen):
            chosen = r
    return chosen


@compiled
def _longer(given, size):
    longer = np.empty(size, dtype=given.dtype)
    longer[: len(given)] = given
    return longer


@compiled
def sort_rows(first, rows, values, number):
    """F with the rows of each column numbered as their pivots, ascending: rows, values, and places of diagonals."""
    n = len(number)
    of_row = np.zeros(n + 1, dtype=np.int64)
    for p in range(len(rows)):
        of_row[number[rows[p]] + 1] += 1
    for r in range(n):
        of_row[r + 1] += of_row[r]
    columns, place, end = np.empty(len(rows), dtype=np.int64), np.empty(len(rows), dtype=np.int64), of_row.copy()
    for c in range(n):
        for p in range(first[c], first[c + 1]):
            r = number[rows[p]]
            columns[end[r]], place[end[r]] = c, p
            end[r] += 1
    sorted_rows, sorted_values, diagonal = (
        np.empty(len(rows), dtype=np.int32),
        np.empty(len(rows)),
        np.empty_like(number),
    )
    end = first.copy()
    for r in range(n):
        for p in range(of_row[r], of_row[r + 1]):
            c = columns[p]
            sorted_rows[end[c]], sorted_values[end[c]] = r, values[place[p]]
            if r == c:
                diagonal[c] = end[c]
            end[c] += 1
    return sorted_rows, sorted_values, diagonal


@compiled
def eliminate_again(first, rows, diagonal, number, indptr, indices, data, least):
    """The values of F of another matrix of the same pattern with the same pivots, and the number of columns done.

    Elimination ends at the first pivot that is not above ``least`` times the largest entry left below it.
    """
    n = len(number)
    values, x = np.empty(len(rows)), np.zeros(n)
    for k in range(n):
        for e in range(indptr[k], indptr[k + 1]):
            x[number[indices[e]]] = data[e]
        for p in range(first[k], diagonal[k]):
            c = rows[p]
            u = x[c]
            values[p], x[c] = u, 0.0
            if u != 0.0:
                for q in range(diagonal[c] + 1, first[c + 1]):
                    x[rows[q]] -= values[q] * u
        pivot, largest = x[k], 0.0
        values[diagonal[k]], x[k] = pivot, 0.0
        inverse = 1.0 / pivot
        for p in range(diagonal[k] + 1, first[k + 1]):
            largest = max(largest, abs(x[rows[p]]))
            values[p], x[rows[p]] = x[rows[p]] * inverse, 0.0
        if not abs(pivot) > least * largest:
            return values, k
    return values, n


@compiled
def substitute(first, rows, diagonal, number, values, b):
    """The solutions of right-hand sides ``b`` (n, n_right)."""
    n, n_right = b.shape
    found, x = np.empty((n, n_right)), np.empty(n)
    for c in range(n_right):
        for k in range(n):
            x[number[k]] = b[k, c]
        for k in range(n):
            y = x[k]
            if y != 0.0:
                for p in range(diagonal[k] + 1, first[k + 1]):
                    x[rows[p]] -= values[p] * y
        for k in range(n - 1, -1, -1):
            y = x[k] / values[diagonal[k]]
            x[k] = y
            if y != 0.0:
                for p in range(first[k], diagonal[k]):
                    x[rows[p]] -= values[p] * y
        for k in range(n):
            found[k, c] = x[k]
    return found


@compiled
def find_rest(indptr, indices, data, b, x):
    """``b - A x`` of a symmetric A, (n,); scipy's product takes as long again for the check of its arguments."""
    rest = np.empty(len(b))
    for k in range(len(b)):
        total = b[k]
        for e in range(indptr[k], indptr[k + 1]):
            total -= data[e] * x[indices[e]]
        rest[k] = total
    return rest


@compiled
def invert(first, rows, diagonal, values):
    """Entries of the inverse Z of L U at the transposed places of F: the place of (r, c) has the entry (c, r).

    From the last pivot k to the first, ``Z_jk = -sum_i Z_ji L_ik`` and ``Z_ki = -sum_j U_kj Z_ji / U_kk`` for j and i
    after k, and ``Z_kk = (1 - sum_j U_kj Z_jk) / U_kk`` (Erisman and Tinney).
    """
    n = len(diagonal)
    of_row = np.zeros(n + 1, dtype=np.int64)
    for c in range(n):
        for p in range(first[c], diagonal[c]):
            of_row[rows[p] + 1] += 1
    for r in range(n):
        of_row[r + 1] += of_row[r]
    columns, place, end = np.empty(of_row[n], dtype=np.int64), np.empty(of_row[n], dtype=np.int64), of_row.copy()
    for c in range(n):
        for p in range(first[c], diagonal[c]):
            columns[end[rows[p]]], place[end[rows[p]]] = c, p
            end[rows[p]] += 1
    Z, lower, sums, below = np.zeros(len(values)), np.empty(n), np.empty(n), np.full(n, -1)
    for k in range(n - 1, -1, -1):
        for p in range(diagonal[k] + 1, first[k + 1]):
            r = rows[p]
            lower[r], sums[r], below[r] = values[p], 0.0, k
        inverse, own = 1.0 / values[diagonal[k]], 1.0
        for e in range(of_row[k], of_row[k + 1]):
            upper, total, p = values[place[e]], 0.0, first[columns[e] + 1] - 1
            while rows[p] > k:
                r = rows[p]
                if below[r] == k:
                    total += Z[p] * lower[r]
                    sums[r] += Z[p] * upper
                p -= 1
            Z[place[e]] = -total
            own += upper * total
        Z[diagonal[k]] = own * inverse
        for p in range(diagonal[k] + 1, first[k + 1]):
            Z[p] = -sums[rows[p]] * inverse
    return Z


@compiled
def _find_place(first, rows, number, row, column):
    r, low, high = number[row], first[column], first[column + 1]
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < r:
            low = middle + 1
        else:
            high = middle
    return low if low < first[column + 1] and rows[low] == r else -1


@compiled
def find_places(first, rows, number, at_rows, at_columns):
    """Places in F of the entries (at_rows[k], at_columns[k]) of the matrix, (k,); -1 where F has none."""
    found = np.empty(len(at_rows), dtype=np.int64)
    for k in range(len(at_rows)):
        found[k] = _find_place(first, rows, number, at_rows[k], at_columns[k])
    return found


@compiled
def check_inverse(first, rows, number, Z, indptr, indices, data):
    """The largest entry of Z A - 1 in each row, (n,), for ``invert``'s Z of a symmetric A.

    In row k only columns where A has an entry are checked, if Z has all entries that they need.
    """
    n = len(number)
    row, known, miss = np.zeros(n), np.full(n, -1), np.zeros(n)
    for k in range(n):
        for p in range(first[k], first[k + 1]):
            row[rows[p]], known[rows[p]] = Z[p], k
        for e in range(indptr[k], indptr[k + 1]):
            c = indices[e]
            total = -1.0 if c == k else 0.0
            for i in range(indptr[c], indptr[c + 1]):
                r = number[indices[i]]
                if known[r] == k:
                    total += row[r] * data[i]
                elif data[i] != 0.0:
                    total = 0.0
                    break
            if not abs(total) <= miss[k]:
                miss[k] = abs(total)
    return miss
