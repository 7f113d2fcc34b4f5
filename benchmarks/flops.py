"""Floating-point operations of dense algorithms; an addition and a multiplication count as two.

"Nominal" counts are of symmetric results computed in full.  Computing one half is enough, so that a
nominal share of the peak can be up to two.
"""

from __future__ import annotations


def product(m: int, n: int, k: int) -> int:
    """(m, k) times (k, n): mn inner products of length k."""
    return 2 * m * n * k


def symmetric_product(n: int, k: int) -> int:
    """A'A for A (k, n), one triangle: n^2 / 2 inner products of length k."""
    return n * n * k


def cholesky(n: int) -> int:
    """Column j updates a triangle of side n - j with (n - j)^2 operations; the sum is n^3 / 3."""
    return n**3 // 3


def solve(n: int, k: int) -> int:
    """Two triangular solves with k right-hand sides, each n^2 / 2 multiply-adds per side."""
    return 2 * n * n * k


def inverse(n: int) -> int:
    """A^-1 from A: cholesky n^3 / 3, inverse of the factor n^3 / 3, its square n^3 / 3."""
    return n**3


def newton(n: int, r: int) -> int:
    """Hessian of n samples and r features, then its Cholesky factor; the rest is of lower order."""
    return symmetric_product(r + 1, n) + cholesky(r + 1)


def embedding_loss(m: int, r: int) -> int:
    """C^-1; C^-1 F and a e', (m, m) by r each; and M, a product of two (m, m) matrices."""
    return inverse(m) + 2 * product(m, r, m) + product(m, m, m)


def policy_loss(m: int) -> int:
    """C^-1, and M, a product of two (m, m) matrices; one action makes the rest negligible."""
    return inverse(m) + product(m, m, m)
