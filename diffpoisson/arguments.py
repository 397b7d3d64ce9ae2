"""What operations require of their arguments before anything is computed with them.

Shapes are checked by each operation, whose message shows them; here is what they have in common.
"""

from __future__ import annotations

import math
import numbers
import operator
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

DTYPES = (torch.float32, torch.float64)


def require_tensor(
    operation: str, name: str, value: object, device: torch.device | None = None
) -> None:
    """Raise unless a value is a dense tensor of real floating-point numbers, on a device if given.

    Raises:
        TypeError: not a tensor, or one of another kind of numbers or layout.
        ValueError: on another device.
    """
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{operation}: {name} must be a torch tensor, got {type(value).__name__}; convert it "
            "with torch.as_tensor"
        )
    if not value.is_floating_point():
        raise TypeError(f"{operation}: {name} must have a real floating dtype, got {value.dtype}")
    if value.layout != torch.strided:
        raise TypeError(f"{operation}: {name} must be dense, got {value.layout}")
    if device is not None and value.device != device:
        raise ValueError(f"{operation}: {name} is on {value.device}, the mesh on {device}")


def require_single_or_double(operation: str, name: str, value: Tensor) -> None:
    """Raise TypeError for narrower floating dtypes, which the kernels do not have."""
    if value.dtype not in DTYPES:
        raise TypeError(
            f"{operation}: {name} must be float32 or float64, got {value.dtype}; convert it"
        )


def as_tensor(value: object, device: torch.device | None = None) -> Tensor:
    """`torch.as_tensor`, also of arrays that torch cannot share: read-only, or flipped views."""
    return torch.as_tensor(value.copy() if isinstance(value, np.ndarray) else value, device=device)


def to_tensor(operation: str, name: str, value: object, device: torch.device) -> Tensor:
    """A tensor on a device of anything numeric and real.

    Raises:
        TypeError: not numeric, complex, or without values.
    """
    try:
        # Through NumPy, where Python's numbers keep their 64 bits; torch would round to float32.
        tensor = as_tensor(value if isinstance(value, Tensor) else np.array(value), device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{operation}: {name} must be numeric: {error}") from error
    if tensor.is_complex() or tensor.layout != torch.strided:
        raise TypeError(
            f"{operation}: {name} must be dense and real, got {tensor.layout} {tensor.dtype}"
        )
    return tensor


def require_instances(operation: str, values: object, kind: type) -> None:
    """Raise TypeError unless values are a sequence of instances of a class."""
    if not isinstance(values, Sequence):
        raise TypeError(
            f"{operation}: expected a list of {kind.__name__}, got {type(values).__name__}"
        )
    for i, value in enumerate(values):
        if not isinstance(value, kind):
            raise TypeError(
                f"{operation}: expected a list of {kind.__name__}, but entry {i} is of type "
                f"{type(value).__name__}"
            )


def require_integer(operation: str, name: str, value: object, least: int | None = None) -> None:
    """Raise unless a value is an integer, and not below the least if that is given.

    Raises:
        TypeError: not an integer.
        ValueError: too small.
    """
    try:
        count = operator.index(value)  # type: ignore[arg-type]
        if isinstance(value, bool):
            raise TypeError
    except TypeError:
        raise TypeError(
            f"{operation}: {name} must be an integer, got {type(value).__name__}"
        ) from None
    if least is not None and count < least:
        raise ValueError(f"{operation}: {name} must be at least {least}, got {count}")


def require_number(operation: str, name: str, value: object) -> None:
    """Raise unless a value is a finite real number that is not negative.

    Raises:
        TypeError: not a real number.
        ValueError: negative or not finite.
    """
    if not isinstance(value, numbers.Real):
        raise TypeError(f"{operation}: {name} must be a number, got {type(value).__name__}")
    if not 0 <= float(value) < math.inf:
        raise ValueError(f"{operation}: {name} must be finite and not negative, got {value}")
