"""Regression of parameters on many statistics, of which most may say nothing.

Sparse Bayesian regression in which every statistic has its own prior variance, found by
maximising the evidence (MacKay 1994, "automatic relevance determination"; Tipping 2001). Where a
parameter depends on the statistics in a curved way, products of the linear predictions are added
and treated the same. Statistics that are not correlated with any parameter are left out first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sliplab.storage.streams import F64, I64

MOST = 120
"""Statistics that one parameter is regressed on, those most correlated with it."""
ROUNDS = 12
"""Of the re-estimation of variances: more change predictions by less than they err."""
_LEAST_NOISE = 1e-6
"""Smallest share of a parameter's variance that is treated as noise, so that copies of an exact
statistic leave a matrix that can be inverted."""
_SKILLED = 0.1
"""Share of variance explained from which on a prediction is used for others' curvature."""


@dataclass(frozen=True)
class Regression:
    """Predicts p parameters, each within -1..1, from c statistics of unit spread.

    Attributes:
        weights: (c, p). constant: (p,). Of the linear prediction.
        skilled: parameters whose linear predictions make products, indices.
        product_weights: of `_products`, (f, p). product_constant: (p,).
    """

    weights: F64
    constant: F64
    skilled: I64
    product_weights: F64
    product_constant: F64

    def __call__(self, x: F64) -> F64:
        """Return predictions (n, p) for statistics (n, c)."""
        linear = self._linear(x)
        curved = _products(linear[:, self.skilled]) @ self.product_weights
        result: F64 = np.clip(linear + curved + self.product_constant, -1.0, 1.0)
        return result

    def _linear(self, x: F64) -> F64:
        result: F64 = np.clip(x @ self.weights + self.constant, -1.0, 1.0)
        return result


def regression(x: F64, y: F64) -> Regression:
    """Return the regression of parameters on statistics.

    Args:
        x: statistics, (n, c), each of about unit spread, finite.
        y: parameters, (n, p), within -1..1.
    """
    weights = np.zeros((x.shape[1], y.shape[1]))
    constant = y.mean(axis=0)
    # a statistic may be symmetric about the prior's middle, so squares count as well
    telling = _related(x, np.column_stack([y, (y - constant) ** 2])).any(axis=1)
    if telling.any():
        weights[telling], constant = sparse_weights(x[:, telling], y)
    linear = np.clip(x @ weights + constant, -1.0, 1.0)
    residual = y - linear
    skilled = np.flatnonzero(residual.var(axis=0) < (1.0 - _SKILLED) * y.var(axis=0))
    products = _products(linear[:, skilled])
    product_weights = np.zeros((products.shape[1], y.shape[1]))
    product_constant = np.zeros(y.shape[1])
    curved = _related(products, residual[:, skilled]).any(axis=1)
    if curved.any():
        found, offset = sparse_weights(products[:, curved], residual[:, skilled])
        product_weights[np.ix_(curved, skilled)] = found
        product_constant[skilled] = offset
    return Regression(weights, constant, skilled, product_weights, product_constant)


def sparse_weights(x: F64, y: F64) -> tuple[F64, F64]:
    """Return weights (c, p) and constants (p,) of linear regressions of y (n, p) on x (n, c)."""
    n, p = y.shape
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    x_scale, y_scale = _scales(x), _scales(y)
    xs, ys = (x - x_mean) / x_scale, (y - y_mean) / y_scale
    cross = (xs.T @ ys).T
    most = min(MOST, x.shape[1], n // 3)
    chosen = np.argsort(-np.abs(cross), axis=1, kind="stable")[:, :most]
    gram = (xs.T @ xs)[chosen[:, :, None], chosen[:, None, :]]
    cross = np.take_along_axis(cross, chosen, axis=1)
    square = (ys**2).sum(axis=0)
    precision = np.full((p, most), float(most))
    noise = np.full(p, 0.5)
    diagonal = np.arange(most)
    for _ in range(ROUNDS):
        matrix = gram / noise[:, None, None]
        matrix[:, diagonal, diagonal] += precision
        covariance = np.linalg.inv(matrix)
        found = np.einsum("pij,pj->pi", covariance, cross) / noise[:, None]
        # how far the data determine each weight, 0..1
        determined = np.clip(1.0 - precision * covariance[:, diagonal, diagonal], 1e-9, 1.0)
        precision = np.clip(determined / np.maximum(found**2, 1e-18), 1e-2, 1e8)
        left = square - 2.0 * (found * cross).sum(axis=1)
        left += np.einsum("pi,pij,pj->p", found, gram, found)
        noise = left / np.maximum(n - determined.sum(axis=1), 1.0)
        noise = np.maximum(noise, _LEAST_NOISE)
    weights = np.zeros((x.shape[1], p))
    np.put_along_axis(weights, chosen.T, found.T, axis=0)
    weights *= y_scale / x_scale[:, None]
    return weights, y_mean - x_mean @ weights


def _products(u: F64) -> F64:
    """Return all products of two columns and the cubes of each, (n, m (m + 3) / 2)."""
    i, j = np.triu_indices(u.shape[1])
    return np.column_stack([u[:, i] * u[:, j], u**3])


def _related(x: F64, y: F64) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return which columns of x are correlated with which of y, (c, p).

    The bound is what the largest of c p correlations of unrelated columns reaches.
    """
    n = len(x)
    xs, ys = (x - x.mean(axis=0)) / _scales(x), (y - y.mean(axis=0)) / _scales(y)
    bound = np.sqrt(2.0 * np.log(max(x.shape[1] * y.shape[1], 2)) / n)
    related: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = np.abs(xs.T @ ys) / n > bound
    return related


def _scales(a: F64) -> F64:
    """Return standard deviations, 1 for a constant column."""
    spread = a.std(axis=0)
    return np.where(spread > 1e-12, spread, 1.0)
