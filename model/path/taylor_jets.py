"""Arithmetic of truncated Taylor series (jets).

A jet holds the coefficients F^(j)(t) / j! along the first axis (Griewank, Walther 2008, 13).
"""

from math import factorial

import numpy as np

from transport.model.arrays import Array


def derivative(a: Array) -> Array:
    """Return the jet of the time derivative, one order lower."""
    # (a')_j = (j + 1) a_(j + 1)
    orders = np.arange(1, len(a), dtype=np.float64)
    return np.asarray(a[1:] * orders.reshape(-1, *[1] * (a.ndim - 1)))


def product(a: Array, b: Array) -> Array:
    """Return the jet of a product; the other axes broadcast."""
    # (a b)_k = sum_i a_i b_(k - i)
    orders = min(len(a), len(b))
    coefficients = []
    for k in range(orders):
        coefficients.append(sum(a[i] * b[k - i] for i in range(k + 1)))
    return np.array(coefficients)


def dot(a: Array, b: Array) -> Array:
    """Return the jet of the inner product over the last axis, which is kept with length 1."""
    return np.asarray(product(a, b).sum(axis=-1, keepdims=True))


def composed(outer: Array, inner: Array) -> Array:
    """Return the jet of f(g(t)).

    outer: Taylor coefficients of f at g(t), which may have further axes. inner: the jet of g.
    """
    # Horner's scheme in g - g_0: f_0 + (g - g_0) (f_1 + (g - g_0) (f_2 + ...)).
    steps = inner.reshape(*inner.shape, *[1] * (outer.ndim - inner.ndim)).copy()
    steps[0] = 0.0

    result = np.zeros((len(inner), *outer.shape[1:]), dtype=np.result_type(outer, inner))
    for coefficient in outer[len(inner) - 1 :: -1]:
        result = product(result, steps)
        result[0] += coefficient
    return result


def power(a: Array, exponent: float) -> Array:
    """Return the jet of a power of a series without zeros."""
    # Taylor coefficients of x^p at a_0: p (p - 1) .. (p - j + 1) / j! a_0^(p - j).
    coefficients = []
    factor = 1.0
    for j in range(len(a)):
        coefficients.append(factor * a[0] ** (exponent - j))
        factor *= (exponent - j) / (j + 1)
    return composed(np.array(coefficients), a)


def sine(a: Array, lead: float = 0.0) -> Array:
    """Return the jet of sin(a + lead), lead in rad."""
    # The j-th derivative of the sine leads by j quarter turns.
    coefficients = []
    for j in range(len(a)):
        coefficients.append(np.sin(a[0] + lead + j * np.pi / 2.0) / factorial(j))
    return composed(np.array(coefficients), a)
