"""Constants under torch's transforms: computed outside of them, and told from what they wrap.

Inside `torch.func.grad` and its like every new tensor belongs to the transform, and under
`torch.inference_mode` none may enter a graph later. A constant that is computed at its first use,
wherever that happens to be, and kept must belong to neither. With `linear_map.py`, the only file
that uses private torch APIs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Generic, TypeVar, overload

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import get_proxy_mode

T = TypeVar("T")


@contextmanager
def outside_transforms() -> Iterator[None]:
    """Run the block as if no transform, gradient or inference mode were active."""
    with (
        torch._C._DisableFuncTorch(),
        torch.inference_mode(False),
        torch.no_grad(),
        forward_ad._set_fwd_grad_enabled(False),
    ):
        yield


def without_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Autocast off, which would round geometry to half precision behind the caller's back."""
    if torch.amp.is_autocast_available(device.type):
        return torch.autocast(device.type, enabled=False)
    return nullcontext()  # on the meta device


class constant_property(Generic[T]):  # noqa: N801  (a decorator, like functools.cached_property)
    """A property that is computed at its first use, outside of any transform, and kept."""

    def __init__(self, func: Callable[[Any], T]) -> None:
        self.func = func
        self.__doc__ = func.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> constant_property[T]: ...
    @overload
    def __get__(self, instance: object, owner: type) -> T: ...
    def __get__(self, instance: object | None, owner: type) -> constant_property[T] | T:
        if instance is None:
            return self
        with outside_transforms():
            value = self.func(instance)
        # The instance's dictionary takes precedence over this descriptor from now on.
        return instance.__dict__.setdefault(self.name, value)


def is_transformed(value: Tensor) -> bool:
    """Whether a tensor belongs to a running `torch.func` transform."""
    return bool(torch._C._functorch.is_functorch_wrapped_tensor(value))


def is_tracing() -> bool:
    """Whether operations are being recorded, so that values are not known: compile, linearize."""
    return torch.compiler.is_compiling() or get_proxy_mode() is not None


def concrete(value: Tensor) -> Tensor | None:
    """The values of a tensor under whatever transforms; None while compiling, or under vmap."""
    if is_tracing():
        return None
    while is_transformed(value):
        if torch._C._functorch.is_batchedtensor(value):
            return None
        value = torch._C._functorch.get_unwrapped(value)
    return value.detach()


def is_constant(value: Tensor) -> bool:
    """Whether no derivative or batch can come with a tensor, by whatever transform."""
    if value.requires_grad or is_transformed(value):
        return False
    return forward_ad.unpack_dual(value).tangent is None


def require_equal(value: Tensor, expected: Tensor, message: str) -> None:
    """Raise unless a tensor, under whatever transforms, has the expected values.

    Raises:
        ValueError: other values, or a batch of them under vmap. Traced, where values are not
            known while tracing, a RuntimeError with the same message when it runs.
    """
    if is_tracing():
        torch._assert_async((value.detach() == expected).all(), message)
        return
    known = concrete(value)
    if known is None:
        raise ValueError(f"{message} (vmap gives one for each element of the batch)")
    if not torch.equal(known, expected):
        raise ValueError(message)
