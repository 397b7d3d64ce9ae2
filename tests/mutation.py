"""Mutation testing: small changes of the core, and whether its quick tests notice.

    python -m tests.mutation --sample 500 --json docs/results/mutations.json

Each mutant changes one operator, constant, condition or statement of one file, in a copy of the
repository. A warm parent process, which has imported everything but the package itself, forks a
child for each, which runs the test files listed for the mutant's file until one fails. A mutant
survives if all pass. A seeded sample is drawn in proportion to the files' numbers of mutants; the
same command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tqdm import tqdm

ROOT = Path(__file__).resolve().parent.parent
TESTS: dict[str, tuple[str, ...]] = {
    "arguments": ("test_arguments",),
    "cells": ("test_gradient", "test_mesh", "test_cells", "test_tetrahedra"),
    "constraints": ("test_constraints", "test_poisson"),
    "distortion": ("test_distortion",),
    "factor": ("test_factor",),
    "gradient": ("test_gradient", "test_poisson"),
    "linear_map": ("test_linear_map",),
    "mesh": ("test_mesh", "test_arguments"),
    "parameterization": ("test_parameterization",),
    "poisson": ("test_poisson", "test_constraints", "test_arguments"),
    "restriction": ("test_restriction",),
    "sampling": ("test_sampling",),
    "spectral": ("test_spectral",),
    "topology": ("test_mesh",),
    "transforms": ("test_linear_map", "test_transforms"),
}

COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}


# ------------------------------------------------------- mutants


def mutants(source: str) -> Iterator[tuple[int, str, str]]:
    """Line, description and source of each mutant."""
    tree = ast.parse(source)
    for node in list(_code(tree)):
        for description, change, undo in _changes(node):
            change()
            yield node.lineno, description, ast.unparse(tree)
            undo()


def _code(node: ast.AST) -> Iterator[Any]:
    """What runs: no annotations, no documentation, no messages."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, (ast.JoinedStr, ast.ImportFrom)):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue
            if hasattr(child, "lineno"):
                yield child
            yield from _code(child)


def _changes(node: Any) -> Iterator[tuple[str, Any, Any]]:
    def swap(owner: Any, field: str, new: Any) -> tuple[Any, Any]:
        old = getattr(owner, field)
        return (lambda: setattr(owner, field, new), lambda: setattr(owner, field, old))

    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        new = COMPARISONS[type(node.ops[0])]()
        yield f"{_short(node)} with {type(new).__name__}", *swap(node, "ops", [new])
    elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in ARITHMETIC:
        new_op = ARITHMETIC[type(node.op)]()
        yield f"{_short(node)} with {type(new_op).__name__}", *swap(node, "op", new_op)
    elif isinstance(node, ast.BoolOp):
        new_op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield f"{_short(node)} with {type(new_op).__name__}", *swap(node, "op", new_op)
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant):
        twice = ast.UnaryOp(node.op, node.operand)
        yield f"{_short(node)} without {type(node.op).__name__}", *swap(node, "operand", twice)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"not {node.value}", *swap(node, "value", not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} + 1", *swap(node, "value", node.value + 1)
    elif isinstance(node, (ast.If, ast.IfExp)):
        for value in (True, False):
            yield f"if {value} for {_short(node.test)}", *swap(node, "test", ast.Constant(value))
    elif isinstance(node, ast.Expr):  # a call for its effect
        yield f"without {_short(node)}", *swap(node, "value", ast.Constant(None))
    elif (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and not (node.args or node.keywords)
    ):  # x.contiguous() and the like
        yield f"{_short(node)} without the call", *swap(node, "func", _identity(node.func))


def _identity(method: ast.Attribute) -> ast.Lambda:
    """(lambda: x) for x.method, so that x.method() becomes x."""
    return ast.Lambda(ast.arguments([], [], None, [], [], None, []), method.value)


def _short(node: ast.AST) -> str:
    text = ast.unparse(node).splitlines()[0]
    return text if len(text) < 80 else text[:77] + "..."


# ------------------------------------------------------- runs


def survives(copy: Path, tests: list[str], timeout: float) -> str:
    """'survived', 'killed' or 'hung', in a child of this process."""
    child = os.fork()
    if child == 0:
        _run_tests(copy, tests)
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return "survived" if status == 0 else "killed"
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "hung"


def _run_tests(copy: Path, tests: list[str]) -> None:
    import pytest

    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    os.chdir(copy)
    sys.path[:] = [str(copy), *(p for p in sys.path if Path(p or ".").resolve() != ROOT)]
    for name in [n for n in sys.modules if n.split(".")[0] in ("diffpoisson", "tests")]:
        del sys.modules[name]
    sys.dont_write_bytecode = True  # a stale file of the last mutant might have its time stamp
    arguments = ["-x", "-q", "-p", "no:cacheprovider", "-W", "ignore", *tests]
    code = 1
    try:
        code = int(pytest.main(arguments))
    finally:
        os._exit(min(code, 1))


def _warm_up() -> None:
    """Import what takes time, but nothing of the package."""
    import beartype  # noqa: F401
    import cholespy  # noqa: F401
    import hypothesis.extra.numpy  # noqa: F401
    import igl  # noqa: F401
    import jaxtyping  # noqa: F401
    import scipy.sparse.linalg  # noqa: F401
    import torch
    import torch.func
    import trimesh  # noqa: F401

    torch.set_num_threads(1)
    os.environ["CI"] = "1"  # derandomised examples


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--files", nargs="*", default=sorted(TESTS))
    parser.add_argument("--timeout", type=float, default=120)
    parser.add_argument("--budget", type=float, default=float("inf"), help="seconds")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    _warm_up()

    sources = {name: (ROOT / "diffpoisson" / f"{name}.py").read_text() for name in arguments.files}
    population = [(name, *mutant) for name, source in sources.items() for mutant in mutants(source)]
    random.Random(arguments.seed).shuffle(population)
    totals = {name: sum(m[0] == name for m in population) for name in sources}
    done: list[dict[str, Any]] = []
    if arguments.json and arguments.json.exists():
        earlier = json.loads(arguments.json.read_text())
        done, totals = earlier["mutants"], earlier["population"] | totals
    known = {(r["file"], r["line"], r["change"]) for r in done}
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        for part in ("diffpoisson", "njf_models", "tests", "examples"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        tests = {
            name: [f"tests/{t}.py" for t in TESTS[name] if (ROOT / "tests" / f"{t}.py").exists()]
            for name in sources
        }
        for files in sorted({tuple(t) for t in tests.values()}):
            began = time.monotonic()
            outcome = survives(copy, list(files), 600)
            print(f"unchanged: {outcome}, {time.monotonic() - began:.0f} s, {' '.join(files)}")
            if outcome != "survived":
                sys.exit("the tests must pass on the code as it is")
        for name, line, change, source in tqdm(population[: arguments.sample]):
            if (name, line, change) in known or time.monotonic() - start > arguments.budget:
                continue
            path = copy / "diffpoisson" / f"{name}.py"
            path.write_text(source)
            outcome = survives(copy, tests[name], arguments.timeout)
            path.write_text(sources[name])
            done.append({"file": name, "line": line, "change": change, "outcome": outcome})
            if arguments.json:
                arguments.json.parent.mkdir(parents=True, exist_ok=True)
                report = {"population": totals, "mutants": done}
                arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    for record in done:
        if record["outcome"] == "survived":
            print(f"{record['file']}.py:{record['line']}: {record['change']}")


if __name__ == "__main__":
    main()
