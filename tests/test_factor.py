"""The Cholesky factor against dense inverses, and the traps of the library it wraps."""

from __future__ import annotations

import copy
import ctypes
import gc
import pickle
import platform
import re
import resource
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hypothesis import given
from hypothesis import strategies as st

from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import SparseMatrix
from diffpoisson.linear_map import BlockDiagonal, Product
from tests import meshes
from tests.checks import assert_near


def spd(n: int = 6, seed: int = 0) -> sp.csr_matrix:
    """A random sparse, symmetric positive definite matrix."""
    B = sp.random(n, n, density=0.4, format="csr", rng=np.random.default_rng(seed))
    return (B @ B.T + sp.eye(n)).tocsr()


def columns(n: int = 6, k: int = 3) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(1).standard_normal((n, k)))


@given(st.integers(1, 30), meshes.seeds, st.integers(-12, 12))
def test_against_a_dense_inverse(n, seed, exponent):
    A = spd(n, seed) * 10.0**exponent
    expected = np.linalg.inv(A.toarray()) @ columns(n).numpy()
    assert_near(CholeskyFactor(A).multiply(columns(n)), expected, 1e-12)


@pytest.mark.parametrize("form", ["csr", "csc", "coo", "lil", "dok"])
def test_any_sparse_format_is_left_as_it_was(form):
    A = spd().asformat(form)
    before = A.toarray()
    factor = CholeskyFactor(A)
    factor.multiply(columns())
    assert (A.toarray() == before).all()
    assert_near(factor.multiply(columns()), np.linalg.inv(before) @ columns().numpy(), 1e-13)


def test_later_edits_of_the_matrix_do_not_matter():
    """Not even in a copy, which factorises again."""
    A = spd()
    factor = CholeskyFactor(A)
    expected = factor.multiply(columns())
    A.data[:] = np.nan
    assert torch.equal(factor.multiply(columns()), expected)
    assert torch.equal(copy.deepcopy(factor).multiply(columns()), expected)


def test_duplicate_and_unsorted_entries_are_summed():
    A = spd(4).tocoo()
    csr = sp.csr_matrix((np.r_[1.0, 1, 3], np.r_[0, 0, 1], np.r_[0, 2, 3]))  # not canonical
    solved = CholeskyFactor(csr).multiply(torch.ones(2, 1, dtype=torch.float64))
    assert_near(solved, np.array([[1 / 2], [1 / 3]]), 1e-15)
    twice = sp.coo_matrix(
        (np.r_[A.data, A.data][::-1] / 2, (np.r_[A.row, A.row][::-1], np.r_[A.col, A.col][::-1]))
    )
    expected = np.linalg.inv(A.toarray()) @ columns(4).numpy()
    assert_near(CholeskyFactor(twice).multiply(columns(4)), expected, 1e-13)
    # stored zeros are entries too
    A.data[A.row != A.col] = 0
    expected = columns(4).numpy() / A.diagonal()[:, None]
    assert_near(CholeskyFactor(A).multiply(columns(4)), expected, 1e-13)


def test_a_factor_may_go_unused():
    """Releasing cholespy's work space, where there is none, would crash the interpreter."""
    CholeskyFactor(spd())
    assert CholeskyFactor(spd()).multiply(columns(6, 0)).shape == (6, 0)  # as good as unused


def test_a_factor_may_be_collected_inside_a_transform():
    """Garbage goes at any time; its clean-up must not meet the transform's own tensors."""
    factors = [CholeskyFactor(spd())]
    factors[0].multiply(columns())

    def collect(x: torch.Tensor) -> torch.Tensor:
        factors.clear()
        gc.collect()  # pytest fails the test for an error in the clean-up
        return x

    torch.func.jvp(collect, (torch.ones(3),), (torch.ones(3),))


# ------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("matrix", "message"),
    {
        "rectangular": (sp.eye(3, 4), "expected a square matrix, got shape (3, 4)"),
        "nan": (sp.diags([1.0, np.nan]), "entries that are not finite"),
        "inf": (sp.diags([1.0, np.inf]), "entries that are not finite"),
        "infinite sum": (
            sp.csr_matrix((np.r_[1e308, 1e308, 1], np.r_[0, 0, 1], np.r_[0, 2, 3])),
            "entries that are not finite",
        ),
        "negative": (-sp.eye(3), "not positive definite"),
        "indefinite": (sp.csr_matrix([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        "zero": (sp.csr_matrix((2, 2)), "not positive definite"),
    }.values(),
)
def test_refused(matrix, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        CholeskyFactor(matrix)


@pytest.mark.parametrize("shape", [(5, 3), (7, 3), (6,), (0, 3)])
def test_wrong_row_count_raises(shape, unchecked):
    """cholespy would read past the end of the array."""
    message = f"CholeskyFactor: expected x of shape (6, k), got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        CholeskyFactor(spd()).multiply(torch.zeros(shape, dtype=torch.float64))


def test_wrong_device_raises(unchecked):
    with pytest.raises(ValueError, match="x is on meta, the factor on cpu"):
        CholeskyFactor(spd()).multiply(torch.zeros(6, 1, dtype=torch.float64, device="meta"))


# ------------------------------------------------------- right-hand sides


def test_strides_dtypes_and_widths():
    factor, inverse = CholeskyFactor(spd()), np.linalg.inv(spd().toarray())
    wide = columns(6, 300)
    assert_near(factor.multiply(wide), inverse @ wide.numpy(), 1e-13)
    views = {
        "transposed": columns(3, 6).T,
        "every other": columns(6, 8)[:, ::2],
        "reversed rows": columns().flip(0),
        "expanded": columns(6, 1).expand(6, 4),
        "one column": columns(6, 1),
    }
    for b in views.values():
        before = b.clone()
        assert_near(factor.multiply(b), inverse @ b.numpy(), 1e-13)
        assert torch.equal(b, before)
    single = factor.multiply(columns().float())
    assert single.dtype == torch.float32
    assert_near(single, inverse @ columns().float().double().numpy(), 1e-7)
    assert factor.multiply(columns(6, 0)).shape == (6, 0)


def test_right_hand_side_that_is_not_finite_is_not_hidden():
    b = columns()
    b[2, 1] = torch.nan
    x = CholeskyFactor(spd()).multiply(b)
    assert x[:, 1].isnan().any()
    assert x[:, [0, 2]].isfinite().all()


# ------------------------------------------------------- copies and blocks


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f))])
def test_copies(clone):
    factor = CholeskyFactor(spd())
    twin = clone(factor)
    del factor
    assert_near(twin.multiply(columns()), np.linalg.inv(spd().toarray()) @ columns().numpy(), 1e-13)
    assert twin.shape == (6, 6)


def test_is_its_own_transpose():
    factor = CholeskyFactor(spd())
    assert factor.transposed() is factor


def test_block_diagonal():
    A = sp.random(3, 5, density=0.7, format="csr", rng=np.random.default_rng(2))
    blocks = [CholeskyFactor(spd()), SparseMatrix(A, torch.device("cpu"))]
    dense = np.zeros((9, 11))
    dense[:6, :6], dense[6:, 6:] = np.linalg.inv(spd().toarray()), A.toarray()
    matrix = BlockDiagonal(blocks)
    assert matrix.shape == (9, 11)
    assert_near(matrix.multiply(columns(11)), dense @ columns(11).numpy(), 1e-13)
    assert matrix.transposed().shape == (11, 9)
    assert_near(matrix.transposed().multiply(columns(9)), dense.T @ columns(9).numpy(), 1e-13)


def test_block_diagonal_in_planes():
    """Rows that come in two planes hold those of all blocks, then those of all again."""
    A, B = (
        sp.random(2 * m, n, density=0.7, format="csr", rng=np.random.default_rng(m))
        for m, n in ((3, 5), (2, 4))
    )
    upper = sp.block_diag([A[:3], B[:2]]).toarray()
    lower = sp.block_diag([A[3:], B[2:]]).toarray()
    dense = np.concatenate([upper, lower])
    matrix = BlockDiagonal([SparseMatrix(M, torch.device("cpu")) for M in (A, B)], (2, 1))
    assert_near(matrix.multiply(columns(9)), dense @ columns(9).numpy(), 1e-13)
    assert_near(matrix.transposed().multiply(columns(10)), dense.T @ columns(10).numpy(), 1e-13)


def test_product():
    A = sp.random(6, 5, density=0.7, format="csr", rng=np.random.default_rng(3))
    matrix = Product([CholeskyFactor(spd()), SparseMatrix(A, torch.device("cpu"))])
    dense = np.linalg.inv(spd().toarray()) @ A.toarray()
    assert matrix.shape == (6, 5)
    assert matrix.transposed().shape == (5, 6)
    assert_near(matrix.multiply(columns(5)), dense @ columns(5).numpy(), 1e-13)
    assert_near(matrix.transposed().multiply(columns(6)), dense.T @ columns(6).numpy(), 1e-13)
    single = matrix.multiply(columns(5).float())  # rounded once, at the end
    assert torch.equal(single, matrix.multiply(columns(5).float().double()).float())


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc for its memory")
def test_work_space_is_released():
    """cholespy itself leaks 8 bytes per row and column of the last right-hand side."""

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    # One column, the width of the smallest work space.
    A, b = sp.eye(50_000, format="csr"), torch.ones(50_000, 1, dtype=torch.float64)

    def use(times: int) -> int:
        for _ in range(times):
            CholeskyFactor(A).multiply(b)
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # memory that is free, but not yet given back
        return resident()

    growth = -use(3) + use(20)
    assert growth < 6 * b.numel() * b.element_size()  # 20 would be leaked
