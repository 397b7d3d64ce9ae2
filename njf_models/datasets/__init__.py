"""Data sets: mesh sources, patches and their targets, and the store that keeps them."""

from __future__ import annotations
