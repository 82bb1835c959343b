"""Sentences as vectors: tokenizers, published weights from a folder, cached results."""
