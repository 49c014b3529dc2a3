"""Momentum matrices of a configuration, and the protected subspace."""
