"""Mutation testing: small changes of the core, and whether its quick tests notice.

    python -m tests.mutation --json docs/results/mutations.json

Each mutant changes one operator, constant, condition or statement of one file. The tests are
collected once, and run once to see which executes which line. Then a child process is forked for
each mutant: it exchanges the code of the changed functions, and runs the tests that execute the
changed line, first the fastest on each path through the file, until one fails. A mutant survives if
all pass, or if none fails in `--seconds` of tests. What runs at import (defaults, class bodies,
constants) can't be exchanged: such mutants are written to a copy of the repository, and the tests
collected anew. The same command goes on where it was interrupted; mutants of a function that has
changed since are forgotten. `--again` runs the survivors again, after tests were added, but for
those that `mutation_verdicts.toml` argues away.
"""

from __future__ import annotations

import argparse
import ast
import builtins
import gc
import hashlib
import importlib
import json
import os
import pickle
import shutil
import signal
import sys
import tempfile
import time
import tomllib
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, NamedTuple

import pytest
from tqdm import tqdm

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted(p.stem for p in (ROOT / "diffpoisson").glob("[!_]*.py") if p.stem != "testing")
# These start processes, which do not see the exchanged code, read files that the copy lacks, or
# take minutes.
LEFT_OUT = (
    "test_architecture",
    "test_benchmarks",
    "test_distribution",
    "test_docs",
    "test_examples",
    "test_faults",
    "test_fuzz",
    "test_main",
    "test_mutation",
    "test_public_api",
    "test_robustness",
)
VERDICTS = Path(__file__).parent / "mutation_verdicts.toml"
MOVES = ("cpu", "numpy")  # without them nothing changes where all tensors live on the CPU
UNEXPECTED = 99
PROBE = "_probe_of_the_mutation_tests"

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


Key = tuple[str, str, int]


@dataclass(frozen=True)
class Mutant:
    """One change: where, what, and the lines of the statement that it is in.

    Attributes:
        unit: hash of the function or method, or of the statement outside of any.
        index: its number among the mutants of that unit.
    """

    file: str
    line: int
    column: int
    change: str
    statement: str
    lines: range
    unit: str
    index: int

    @property
    def key(self) -> Key:
        return self.file, self.unit, self.index


def verdicts() -> dict[str, dict[str, str]]:
    """Why survivors are no faults, for each file by mutant as `named` writes it."""
    argued: dict[str, dict[str, str]] = defaultdict(dict)
    for group in tomllib.loads(VERDICTS.read_text())["group"]:
        for name in group["mutants"]:
            argued[group["file"]][name] = group["why"]
    return argued


def named(record: dict[str, Any]) -> str:
    """A mutant of a report, by what it says and not by its line, which moves."""
    return f"{record['change']}  in  {record['statement']}"


def mutants(file: str, text: str) -> Iterator[Mutant]:
    """All mutants of a file, in the order of its text."""
    count: Counter[str] = Counter()
    hashes: dict[Any, str] = {}
    for place, change, _ in _all_changes(ast.parse(text)):
        node, statement = place.node, place.statement
        if place.unit not in hashes:
            hashes[place.unit] = _hash(ast.unparse(place.unit))
        unit = hashes[place.unit]
        where = file, node.lineno, node.col_offset
        yield Mutant(*where, change, _short(statement), _own_lines(statement), unit, count[unit])
        count[unit] += 1


def mutated(mutant: Mutant, text: str) -> ast.Module:
    """The file with one change."""
    tree = ast.parse(text)
    for (node, *_), change, do in _all_changes(tree):
        if (node.lineno, node.col_offset, change) == (mutant.line, mutant.column, mutant.change):
            do()
            return ast.fix_missing_locations(tree)
    raise ValueError(f"no such mutant: {mutant}")


class _Place(NamedTuple):
    """A node, its statement, and the function or method, or else the statement, that it is in."""

    node: Any
    statement: Any
    unit: Any


def _all_changes(tree: ast.Module) -> Iterator[tuple[_Place, str, Callable[[], None]]]:
    """A place, a change and what makes it."""
    for place in _code(tree, None, None):
        for change, do in _changes(place.node):
            yield place, change, do


def _code(node: ast.AST, statement: Any, function: Any) -> Iterator[_Place]:
    """What runs: no annotations, no documentation, no messages."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, (ast.JoinedStr, ast.ImportFrom)):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue
            inner = child if isinstance(child, ast.stmt) else statement
            around = function or (child if isinstance(child, ast.FunctionDef) else None)
            if hasattr(child, "lineno"):
                yield _Place(child, inner, around or inner)
            yield from _code(child, inner, around)


def _own_lines(statement: Any) -> range:
    """Without the statements inside it."""
    body = getattr(statement, "body", None)
    end = body[0].lineno if body else statement.end_lineno + 1
    return range(statement.lineno, max(end, statement.lineno + 1))


def _changes(node: Any) -> Iterator[tuple[str, Callable[[], None]]]:
    def swap(owner: Any, field: str, new: Any) -> Callable[[], None]:
        return lambda: setattr(owner, field, new)

    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        new = COMPARISONS[type(node.ops[0])]()
        yield f"{_short(node)} with {type(new).__name__}", swap(node, "ops", [new])
    elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in ARITHMETIC:
        new_op = ARITHMETIC[type(node.op)]()
        yield f"{_short(node)} with {type(new_op).__name__}", swap(node, "op", new_op)
    elif isinstance(node, ast.BoolOp):
        new_op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield f"{_short(node)} with {type(new_op).__name__}", swap(node, "op", new_op)
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant):
        twice = ast.UnaryOp(node.op, node.operand)
        yield f"{_short(node)} without {type(node.op).__name__}", swap(node, "operand", twice)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"not {node.value}", swap(node, "value", not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield f"{node.value} + 1", swap(node, "value", node.value + 1)
    elif isinstance(node, (ast.If, ast.IfExp)):
        for value in (True, False):
            yield f"if {value} for {_short(node.test)}", swap(node, "test", ast.Constant(value))
    elif isinstance(node, ast.Expr):  # a call for its effect
        yield f"without {_short(node)}", swap(node, "value", ast.Constant(None))
    elif (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and not (node.args or node.keywords or node.func.attr in MOVES)
    ):  # x.contiguous() and the like
        yield f"{_short(node)} without the call", swap(node, "func", _identity(node.func))


def _identity(method: ast.Attribute) -> ast.Lambda:
    """(lambda: x) for x.method, so that x.method() becomes x."""
    return ast.Lambda(ast.arguments([], [], None, [], [], None, []), method.value)


def _short(node: ast.AST) -> str:
    text = ast.unparse(node).splitlines()[0]
    return text if len(text) < 80 else text[:77] + "..."


# ------------------------------------------------------- exchanged code


def functions_of(path: Path) -> list[FunctionType]:
    """All functions that were made from a file."""
    everything = (x for x in gc.get_objects() if type(x) is FunctionType)
    return [f for f in everything if f.__code__.co_filename == str(path)]


def exchange(functions: list[FunctionType], module: CodeType) -> None:
    """Give functions the code that they have in another version of their module."""
    codes = defaultdict(list)
    for code in _codes(module):
        codes[_place(code)].append(code)
    for function in functions:
        found = codes[_place(function.__code__)]
        if len(found) == 1:  # else lambdas on one line, made at import
            function.__code__ = found[0]


def _codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)


def _place(code: CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


# ------------------------------------------------------- children


def fork(work: Callable[[], int], timeout: int) -> int | str:
    """Exit code of `work` in a child of this process, or 'hung'; `UNEXPECTED` if it raised."""
    child = os.fork()
    if child == 0:
        signal.alarm(timeout)
        code = UNEXPECTED
        try:
            code = work()
        except Exception:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGALRM:
        return "hung"
    return os.waitstatus_to_exitcode(status)


def quiet() -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


def fails(items: Sequence[pytest.Item]) -> bool:
    from _pytest.runner import runtestprotocol

    pytest.Function.repr_failure = lambda *_: ""  # type: ignore[assignment]  # which takes a second
    return any(
        report.failed
        for item in items
        for report in runtestprotocol(item, log=False, nextitem=None)
    )


class Session:
    """A pytest plugin that collects the tests and hands them to `work` instead of running them."""

    def __init__(self, work: Callable[[list[pytest.Item]], None], recorder: Any = None) -> None:
        self.work, self.recorder = work, recorder

    def pytest_collection(self, session: pytest.Session) -> None:
        """The package is imported here, after the hook of `conftest.py` was installed."""
        from hypothesis import Phase, settings

        phases = (Phase.explicit, Phase.generate)  # no shrinking
        settings.register_profile("mutation", settings.get_profile("ci"), phases=phases)
        settings.load_profile("mutation")
        if self.recorder:
            self.recorder.trace_import()

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.work([item for item in session.items if "compile" not in item.nodeid])  # slow
        return True


def collect(copy: Path, files: Sequence[str], session: Session) -> int:
    """Run pytest on a copy of the repository."""
    os.chdir(copy)
    sys.path[:] = [str(copy), *(p for p in sys.path if Path(p or ".").resolve() != ROOT)]
    for name in [n for n in sys.modules if n.split(".")[0] in ("diffpoisson", "tests")]:
        del sys.modules[name]
    sys.dont_write_bytecode = True  # a stale file of the last mutant might have its time stamp
    warm = "ignore::pytest.PytestAssertRewriteWarning"  # of what is imported already
    options = ["-q", "-s", "-p", "no:cacheprovider", "-W", warm]
    return int(pytest.main([*options, *files], plugins=[session]))


class Recorder:
    """Which statements of the core each test executes, and how long it takes."""

    def __init__(self, package: Path) -> None:
        self.package = package
        self.at_import: set[tuple[str, int]] = set()  # lines
        self.reached: dict[str, set[tuple[str, int]]] = {}
        self.seconds: dict[str, float] = {}

    def trace_import(self) -> None:
        def line(frame: FrameType, event: str, argument: Any) -> Any:
            self.at_import.add((Path(frame.f_code.co_filename).stem, frame.f_lineno))
            return line

        ours = str(self.package)
        sys.settrace(lambda f, *_: line if f.f_code.co_filename.startswith(ours) else None)
        for name in FILES:
            importlib.import_module(f"diffpoisson.{name}")
        sys.settrace(None)

    def record(self, items: list[pytest.Item]) -> None:
        hits: set[tuple[str, int]] = set()
        setattr(builtins, PROBE, lambda file, line: hits.add((file, line)))
        for file in FILES:
            path = self.package / f"{file}.py"
            exchange(functions_of(path), compile(probed(file, path), str(path), "exec"))
        for item in tqdm(items, desc="what each test runs"):
            hits.clear()
            began = time.perf_counter()
            if fails([item]):  # such as one that compiles, and meets the probes
                tqdm.write(f"left out: {item.nodeid}")
                continue
            self.seconds[item.nodeid] = time.perf_counter() - began
            self.reached[item.nodeid] = set(hits)

    def save(self, path: Path) -> None:
        path.write_bytes(pickle.dumps((self.at_import, self.reached, self.seconds)))

    def load(self, path: Path) -> None:
        self.at_import, self.reached, self.seconds = pickle.loads(path.read_bytes())


def probed(file: str, path: Path) -> ast.Module:
    """A module that reports each statement inside functions before it runs."""
    tree = ast.parse(path.read_text())
    for function in [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]:
        for node in ast.walk(function):
            for field in ("body", "orelse", "finalbody"):
                block = getattr(node, field, None)
                if isinstance(block, list) and not getattr(node, f"{field}_probed", False):
                    setattr(node, f"{field}_probed", True)
                    setattr(node, field, [x for s in block for x in (_probe(file, s), s)])
    return tree


def _probe(file: str, statement: ast.stmt) -> ast.stmt:
    call = ast.parse(f"{PROBE}({file!r}, {statement.lineno})").body[0]
    for node in ast.walk(call):
        ast.copy_location(node, statement)
    return call


# ------------------------------------------------------- the run


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


class Run:
    """All mutants of some files, their outcomes so far, and the tests for each."""

    def __init__(self, copy: Path, files: list[str], seconds: float, state: Path) -> None:
        self.copy, self.seconds, self.state = copy, seconds, state
        self.package = copy / "diffpoisson"
        self.texts = {file: (self.package / f"{file}.py").read_text() for file in FILES}
        everything = [m for file, text in self.texts.items() for m in mutants(file, text)]
        self.all = [mutant for mutant in everything if mutant.file in files]
        self.existing = {mutant.key: mutant for mutant in everything}
        self.population = Counter(mutant.file for mutant in everything)
        self.done: dict[Key, dict[str, Any]] = {}
        self.load()

    def load(self) -> None:
        """What was done before, of what has not changed since."""
        if not self.state.exists():
            return
        for record in json.loads(self.state.read_text())["mutants"]:
            mutant = self.existing.get((record["file"], record["unit"], record["index"]))
            if mutant is not None:
                self.done[mutant.key] = record | {"line": mutant.line}

    def forget_survivors(self) -> None:
        """But for those that are argued away."""
        argued = verdicts()
        self.done = {
            key: record
            for key, record in self.done.items()
            if record["outcome"] != "survived" or named(record) in argued[record["file"]]
        }

    def todo(self) -> list[Mutant]:
        return [mutant for mutant in self.all if mutant.key not in self.done]

    def tests(self, mutant: Mutant, recorder: Recorder) -> list[str]:
        """Those that execute the changed line: the fastest on each path, then the next."""
        places = {(mutant.file, mutant.lines[0])}
        if self.at_import(mutant, recorder):
            places = {
                p for found in recorder.reached.values() for p in found if p[0] == mutant.file
            }
        touching = [test for test, found in recorder.reached.items() if found & places]
        touching.sort(key=recorder.seconds.__getitem__)
        met: Counter[frozenset[tuple[str, int]]] = Counter()  # how often each path was met
        rank = {}
        for test in touching:
            path = frozenset(p for p in recorder.reached[test] if p[0] == mutant.file)
            rank[test], met[path] = met[path], met[path] + 1
        chosen, total = [], 0.0
        for test in sorted(touching, key=lambda test: (rank[test], recorder.seconds[test])):
            total += recorder.seconds[test]
            if total > self.seconds and chosen:
                break
            chosen.append(test)
        return chosen

    @staticmethod
    def at_import(mutant: Mutant, recorder: Recorder) -> bool:
        return bool(recorder.at_import & {(mutant.file, n) for n in mutant.lines})

    def finish(self, mutant: Mutant, tests: list[str], code: int | str) -> None:
        outcome = "hung" if code == "hung" else "survived" if code == 0 else "killed"
        self.done[mutant.key] = {
            "file": mutant.file,
            "unit": mutant.unit,
            "index": mutant.index,
            "line": mutant.line,
            "change": mutant.change,
            "statement": mutant.statement,
            "tests": len(tests),
            "outcome": outcome,
        }
        if outcome == "survived":
            tqdm.write(f"{mutant.file}.py:{mutant.line}: {mutant.change}  in  {mutant.statement}")
        records = sorted(self.done.values(), key=lambda r: (r["file"], r["line"], r["index"]))
        report = {"population": dict(sorted(self.population.items())), "mutants": records}
        self.state.write_text(json.dumps(report, indent=1) + "\n")


def exchanged(run: Run, todo: list[Mutant], recorder: Recorder, items: list[pytest.Item]) -> None:
    """Each mutant in a child of this process, which has collected the tests."""
    by_id = {item.nodeid: item for item in items}
    functions = {file: functions_of(run.package / f"{file}.py") for file in FILES}
    for mutant in tqdm(todo):
        tests = run.tests(mutant, recorder)

        def work(mutant: Mutant = mutant, tests: list[str] = tests) -> int:
            quiet()
            tree = mutated(mutant, run.texts[mutant.file])
            path = run.package / f"{mutant.file}.py"
            exchange(functions[mutant.file], compile(tree, str(path), "exec"))
            return fails([by_id[test] for test in tests])

        code = fork(work, 30 + int(3 * run.seconds))
        if code != UNEXPECTED:  # as where a function has other free variables
            run.finish(mutant, tests, code)


def reimported(run: Run, todo: list[Mutant], recorder: Recorder) -> None:
    """Each mutant written to the copy, and the tests collected by a child."""
    for mutant in tqdm(todo):
        tests = run.tests(mutant, recorder)
        files = sorted({test.split("::")[0] for test in tests})
        path = run.package / f"{mutant.file}.py"
        original = run.texts[mutant.file]

        def work(tests: list[str] = tests, files: list[str] = files) -> int:
            quiet()
            found: list[bool] = []

            def check(items: list[pytest.Item]) -> None:
                by_id = {item.nodeid: item for item in items}
                found.append(fails([by_id[test] for test in tests]))

            collect(run.copy, files, Session(check))
            return 0 if found == [False] else 1

        path.write_text(ast.unparse(mutated(mutant, original)))
        code = fork(work, 60 + int(3 * run.seconds))
        path.write_text(original)
        run.finish(mutant, tests, code)


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

    torch.set_num_threads(1)
    os.environ["CI"] = "1"  # derandomised examples


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", nargs="*", default=FILES)
    parser.add_argument("--seconds", type=float, default=10, help="of tests for each mutant")
    parser.add_argument("--again", action="store_true", help="the survivors too")
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    _warm_up()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder).resolve() / "copy"
        for part in ("diffpoisson", "njf_models", "tests", "examples"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        run = Run(copy, arguments.files, arguments.seconds, arguments.json.resolve())
        if arguments.again:
            run.forget_survivors()
        everything(run)


def everything(run: Run) -> None:
    """In processes of their own: which test runs what, all mutants, those that need an import."""
    paths = sorted((run.copy / "tests").glob("test_*.py"))
    files = [f"tests/{path.name}" for path in paths if path.stem not in LEFT_OUT]
    recorder, table = Recorder(run.package), run.copy / "reached.pickle"

    def record() -> int:
        code = collect(run.copy, files, Session(recorder.record, recorder))
        recorder.save(table)
        return code

    def exchange_all() -> int:
        todo = [m for m in run.todo() if not run.at_import(m, recorder)]
        return collect(
            run.copy, files, Session(lambda tests: exchanged(run, todo, recorder, tests))
        )

    if fork(record, 10**6):
        sys.exit("the tests could not be collected")
    recorder.load(table)
    fork(exchange_all, 10**6)
    run.load()
    reimported(run, run.todo(), recorder)


if __name__ == "__main__":
    main()
