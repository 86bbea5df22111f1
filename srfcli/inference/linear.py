"""Covariances from information matrices that may be nearly singular."""

from __future__ import annotations

import numpy as np

from srfcli.numerics.collocation import Array


def inverse(information: Array) -> Array:
    """Return the inverse, after scaling; a direction that nothing determines gets an enormous variance, not a failure."""
    d = np.maximum(np.sqrt(np.diag(information)), 1e-8)  # of scaled parameters: nothing that matters is so flat
    values, vectors = np.linalg.eigh(information / np.outer(d, d))
    inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T
    return np.asarray(inverse / np.outer(d, d))


def root(covariance: Array) -> Array:
    """Return the principal directions of a covariance, one standard deviation long each, as columns."""
    d = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(d, d))
    return np.asarray((d[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0)))
