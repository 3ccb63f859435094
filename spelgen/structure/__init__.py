"""Exact structure of an arm: zero, constant, varying entries of M, the minimal form of M(q), joints affecting V."""
