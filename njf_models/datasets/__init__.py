"""Data sets: mesh sources, the training pairs made of them, and the cache that keeps them."""

from __future__ import annotations
