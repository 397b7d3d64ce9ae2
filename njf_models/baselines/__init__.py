"""What Neural Jacobian Fields are compared with, each trained by the same module."""

from __future__ import annotations
