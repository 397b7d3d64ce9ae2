"""`njf uv`: UV maps for mesh files: one, several, or a folder of them."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from njf_models.commands import CommandError, UsageError, how_to_install

_DESCRIPTION = """\
Give a mesh UVs: cut into charts where it is no disk, flattened with little distortion, no triangle
flipped, and checked in exact arithmetic. Geometry is not touched: vertices, polygons, normals and
groups of an OBJ stay as they are, only its UVs are replaced. Pictures on the surface are baked into
one for the new UVs.
"""

_EPILOG = """\
examples:
  njf uv bunny.obj bunny_uv.obj
  njf uv scan.ply scan.glb --checkerboard --report scan.html
  njf uv a.obj b.ply c.stl unwrapped/
  njf uv scans/ unwrapped/ --recursive --format glb --jobs 4 --json results.json
  njf uv part.stl --json -              only the figures

Of several names the last is the output. It is a folder after several inputs, where it exists as
one, or with a slash at its end; what is written there is called like its input.
UVs lie in the unit square, both axes by the same scale.
exit codes: 0 every file was mapped, 1 some were not, 2 wrong usage, 130 interrupted
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Register the command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "uv",
        help="give meshes UVs",
        usage="njf uv [options] INPUT [OUTPUT]\n       njf uv [options] INPUT... FOLDER",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "names",
        nargs="+",
        metavar="INPUT",
        help="obj, ply, off, stl or glb files, or a folder of them; then where to write: an obj or "
        "glb file, or a folder",
    )
    _add_options(parser)
    _add_batch_options(parser.add_argument_group("several files"))
    return parser


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--report",
        type=Path,
        metavar="PAGE.html",
        help="write a page to look at the map, beside SLIM and LSCM; of several files, a folder",
    )
    add("--json", metavar="FILE", help="write figures and failures as JSON; - for stdout")
    add(
        "--start",
        choices=("network", "tutte"),
        default="network",
        help="what makes the first map of a chart (default: network)",
    )
    add(
        "--model",
        default="uv",
        metavar="WEIGHTS",
        help="the network's: a name, or a .safetensors or .ckpt of `njf train` (default: uv)",
    )
    add("--no-cut", action="store_true", help="fail where the mesh is no disk, instead of cutting")
    add(
        "--tolerance",
        type=_positive,
        default=1e-6,
        metavar="T",
        help="SLIM stops when an iteration gains less than this fraction (default: 1e-6)",
    )
    add(
        "--checkerboard",
        action="store_true",
        help="texture the output with a checkerboard, unless it has pictures of its own",
    )


def _add_batch_options(group: Any) -> None:
    add = group.add_argument
    add("--format", choices=("obj", "glb"), default="obj", help="written to folders (default: obj)")
    add("--recursive", action="store_true", help="look into subfolders of the input too")
    add("--jobs", type=_count, default=1, metavar="N", help="files at a time (default: 1)")


def run(options: argparse.Namespace) -> int:
    """Map what was named; 1 if any file failed."""
    *names, last = options.names
    sources = [Path(name) for name in names or [last]]
    target = last if names else None
    if len(sources) > 1 or sources[0].is_dir():
        tasks = _tasks_of_batch(options, sources, target and Path(target))
        return _finish(_batch(tasks, options), options, _root(sources))
    return _finish([convert(_task_of_file(options, sources[0], target))], options, None)


def _root(sources: list[Path]) -> Path:
    """What the names of a batch's files are shown relative to."""
    return sources[0] if sources[0].is_dir() else Path()


# -------------------------------------------------------------------- what to do


@dataclass(frozen=True)
class Task:
    """One file to map."""

    input: Path
    output: Path | None
    report: Path | None
    start: str
    model: str
    cut: bool
    tolerance: float
    checkerboard: bool
    threads: int
    debug: bool


def _task(
    options: argparse.Namespace, source: Path, output: Path | None, page: Path | None
) -> Task:
    threads = max(1, (os.cpu_count() or 1) // options.jobs)
    return Task(
        source,
        output,
        page,
        options.start,
        options.model,
        not options.no_cut,
        options.tolerance,
        options.checkerboard,
        threads,
        options.debug,
    )


def _task_of_file(options: argparse.Namespace, source: Path, target: str | None) -> Task:
    """Of a single file, whose output may be a file or go into a folder."""
    from njf_models.meshfiles import WRITABLE  # noqa: PLC0415  (imports torch)

    if options.report is not None and options.report.is_dir():
        raise UsageError(f"{options.report} is a folder, but the input is a file: name a file")
    if target is None:
        return _task(options, source, None, options.report)
    output = Path(target)
    if target.endswith("/") or output.is_dir():
        output = _inside(output, source.name, options.format)
    if output.suffix.lower() not in WRITABLE:
        raise UsageError(f"{output}: only {' and '.join(WRITABLE)} files are written")
    _require_others([output], [source])
    return _task(options, source, output, options.report)


def _tasks_of_batch(
    options: argparse.Namespace, sources: list[Path], target: Path | None
) -> list[Task]:
    """A task for each file of several, or of a folder, whose outputs are named alike."""
    many = "the input is a folder" if len(sources) == 1 else "there are several inputs"
    for path in (target, options.report):
        if path is not None and _is_a_file(path):
            raise UsageError(f"{path} is a file, but {many}: name a folder")
    names = _in_folder(options, sources[0], target) if len(sources) == 1 else _several(sources)
    tasks = [
        _task(
            options,
            path,
            target and _inside(target, name, options.format),
            options.report and _inside(options.report, name, "html"),
        )
        for path, name in names.items()
    ]
    _require_others([task.output for task in tasks if task.output is not None], list(names))
    return tasks


def _is_a_file(path: Path) -> bool:
    """Also one that is not there yet, by a name that nobody gives a folder."""
    named = path.suffix.lower() in (".glb", ".html", ".obj", ".off", ".ply", ".stl")
    return path.is_file() or (named and not path.is_dir())


def _inside(folder: Path, name: Path | str, suffix: str) -> Path:
    return (folder / name).with_suffix(f".{suffix}")


def _several(sources: list[Path]) -> dict[Path, Path]:
    """Each file, and its name without folders."""
    for path in sources:
        if path.is_dir():
            raise UsageError(f"{path} is a folder, but there are several inputs: name files")
    return {path: Path(path.name) for path in sources}


def _in_folder(options: argparse.Namespace, root: Path, target: Path | None) -> dict[Path, Path]:
    """The mesh files in a folder, and their names below it; but none that was written there."""
    from njf_models.meshfiles import READABLE  # noqa: PLC0415  (imports torch)

    own = [folder.resolve() for folder in (target, options.report) if folder is not None]
    if root.resolve() in own:
        raise UsageError("input and output are the same folder: name another one")
    found = {
        path: path.relative_to(root)
        for path in sorted(root.rglob("*") if options.recursive else root.glob("*"))
        if path.suffix.lower() in READABLE
        and path.is_file()
        and not any(path.resolve().is_relative_to(folder) for folder in own)
    }
    if not found:
        hint = "" if options.recursive else "; --recursive looks into subfolders"
        raise CommandError(f"no {', '.join(READABLE)} file in {root}{hint}")
    return found


def _require_others(outputs: list[Path], sources: list[Path]) -> None:
    """No input may be overwritten."""
    inputs = {path.resolve() for path in sources}
    for path in outputs:
        if path.resolve() in inputs:
            raise UsageError(f"{path} is both input and output: name another place")


# -------------------------------------------------------------------- one file


def convert(task: Task) -> dict[str, Any]:
    """Map one file and write what was asked for; failures become records, too."""
    from diffpoisson import MeshError  # noqa: PLC0415  (imports torch)
    from njf_models.meshfiles import MeshFileError  # noqa: PLC0415

    start = time.perf_counter()
    record: dict[str, Any] = {"input": str(task.input), "status": "failed"}
    try:
        record |= _convert(task) | {"status": "ok"}
    except (MeshFileError, MeshError, CommandError) as error:
        record["error"] = str(error)
    except ModuleNotFoundError as error:
        record["error"] = how_to_install(error)
    except Exception as error:  # one bad file must not end a batch
        if task.debug:
            raise
        record["error"] = f"{' '.join(str(error).split())} ({type(error).__name__})"
    return record | {"seconds": round(time.perf_counter() - start, 3)}


def _convert(task: Task) -> dict[str, Any]:
    import torch  # noqa: PLC0415  (imports are slow, and --help must not be)

    from njf_models import meshfiles  # noqa: PLC0415

    torch.set_num_threads(task.threads)
    file = meshfiles.read_mesh_file(task.input)
    cleaned = file.cleaned()
    uvmap = _parameterize(cleaned.mesh, task)
    layout = meshfiles.unit_square_layout(file, cleaned, uvmap)
    record = _figures(file, cleaned, uvmap)
    if task.output is not None:
        written = meshfiles.write_mesh_file(
            task.output, file, layout, checkerboard=task.checkerboard
        )
        record |= {"output": str(task.output), "files": [path.name for path in written]}
        record["notes"] += _notes_on_output(file, layout, task.output.suffix.lower())
    if task.report is not None:
        record["report"] = str(task.report)
        _write_report(task, cleaned.mesh, uvmap)
    return record


def _parameterize(mesh: Any, task: Task) -> Any:
    import diffpoisson as dp  # noqa: PLC0415

    if task.start == "tutte":
        return dp.parameterize(mesh, cut=task.cut, tolerance=task.tolerance)
    from njf_models import parameterize  # noqa: PLC0415

    return parameterize(mesh, model=task.model, cut=task.cut, tolerance=task.tolerance)


def _figures(file: Any, cleaned: Any, uvmap: Any) -> dict[str, Any]:
    dropped = len(file.faces) - cleaned.mesh.n_faces
    notes = [f"{dropped:,} triangles without area have no UVs of their own"] if dropped else []
    return {
        "vertices": len(file.vertices),
        "triangles": len(file.faces),
        "charts": len(uvmap.charts),
        "flipped": uvmap.flipped,
        "certified": uvmap.certified,
        "energy": uvmap.energy,
        "mean_distortion": uvmap.mean_distortion,
        "max_distortion": uvmap.max_distortion,
        "method": uvmap.method,
        "slim_iterations": uvmap.slim_iterations,
        "milliseconds": {stage: round(t, 3) for stage, t in uvmap.milliseconds.items()},
        "notes": notes,
    }


def _notes_on_output(file: Any, layout: Any, suffix: str) -> list[str]:
    """What is not as it was, apart from the UVs."""
    from njf_models.meshfiles import count_crossed_polygons, not_written  # noqa: PLC0415

    notes = []
    if file.paint is not None:
        notes.append("pictures were baked into one for the new UVs")
    if suffix == ".obj" and (crossed := count_crossed_polygons(file, layout)):
        notes.append(f"{crossed:,} polygons that seams cross were written as triangles")
    if missing := not_written(file, suffix):
        notes.append(f"not carried over: {', '.join(missing)}")
    return notes


def _write_report(task: Task, mesh: Any, uvmap: Any) -> None:
    from njf_models.comparison import compare  # noqa: PLC0415
    from njf_models.meshfiles import whole_file  # noqa: PLC0415
    from njf_models.page import uv_page  # noqa: PLC0415

    assert task.report is not None
    title = "njf" if task.start == "network" else "njf from Tutte"
    maps = compare(uvmap, title, tolerance=task.tolerance)
    y_up = task.input.suffix.lower() in (".obj", ".glb")  # as these formats have it by custom
    text = uv_page(task.input.name, mesh, uvmap, maps, y_up=y_up)
    with whole_file(task.report) as path:
        path.write_text(text, encoding="utf-8")


# -------------------------------------------------------------------- many files


def _batch(tasks: list[Task], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Records of all tasks, in their order; a process each, so that even a crash is one file's."""
    from tqdm import tqdm  # noqa: PLC0415

    records: list[dict[str, Any] | None] = [None] * len(tasks)
    taken: dict[Path, Path] = {}
    todo = []
    for i, task in enumerate(tasks):
        place = task.output or task.report
        if place is not None and taken.setdefault(place, task.input) != task.input:
            error = f"{place} is what {taken[place]} becomes: rename one of them"
            records[i] = {"input": str(task.input), "status": "failed", "error": error}
        else:
            todo.append(i)
    with _Workers(options.jobs) as workers:
        futures = {workers.submit(tasks[i]): i for i in todo}
        progress = tqdm(as_completed(futures), total=len(todo), unit="file", disable=None)
        for future in progress:
            records[futures[future]] = future.result()
    return [record for record in records if record is not None]


class _Workers:
    """Runs each task in a process of its own, some at a time; leaving early ends them."""

    def __init__(self, jobs: int) -> None:
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["njf_models.meshfiles", "njf_models.commands.uv"])
        self.threads = ThreadPoolExecutor(jobs)
        self.starting = threading.Lock()  # a process can only be ended once it has started
        self.running: set[Any] = set()
        self.stopped = False

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            with self.starting:
                self.stopped = True
                for process in self.running:
                    process.terminate()
        self.threads.shutdown(cancel_futures=True)

    def submit(self, task: Task) -> Future[dict[str, Any]]:
        """Run a task as soon as a process is free."""
        return self.threads.submit(self._isolated, task)

    def _isolated(self, task: Task) -> dict[str, Any]:
        receiver, sender = self.context.Pipe(duplex=False)
        process = self.context.Process(target=_child, args=(task, sender))
        with self.starting:
            if self.stopped:
                raise CancelledError
            process.start()
            self.running.add(process)
        sender.close()
        try:
            record: dict[str, Any] = receiver.recv()
        except EOFError:
            process.join()
            error = f"the process ended without a result (exit code {process.exitcode})"
            record = {"input": str(task.input), "status": "failed", "error": error}
        process.join()
        with self.starting:
            self.running.discard(process)
        return record


def _child(task: Task, sender: Connection) -> None:
    """In a process of its own: map one file. Both signals unwind, so that no half file stays."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        sender.send(convert(task))
    except KeyboardInterrupt:
        os._exit(130)


# -------------------------------------------------------------------- what came of it


def _finish(records: list[dict[str, Any]], options: argparse.Namespace, root: Path | None) -> int:
    failures = [record for record in records if record["status"] != "ok"]
    lines = list(_summary(records, root))
    to_stdout = options.json == "-"
    if lines:
        print("\n".join(lines), file=sys.stderr if to_stdout else sys.stdout)
    for record in failures:
        print(f"njf uv: {record['input']}: {record['error']}", file=sys.stderr)
    if options.json:
        _write_json(records, len(failures), options.json)
    return 1 if failures else 0


def _summary(records: list[dict[str, Any]], root: Path | None) -> Iterator[str]:
    """A line per file, and of a batch, whose names are shown below its root, the counts."""
    paths = [Path(record["input"]) for record in records]
    names = [path.name if root is None else _shown(path, root) for path in paths]
    width = max(map(len, names))
    for name, record in zip(names, records, strict=True):
        if record["status"] == "ok":
            yield f"{name:<{width}}  {_line(record)}"
            yield from (f"{'':<{width}}  {note}" for note in record["notes"])
        elif root is not None:
            yield f"{name:<{width}}  FAILED"
    if root is not None:
        failed = sum(record["status"] != "ok" for record in records)
        yield f"{len(records)} files: {len(records) - failed} mapped, {failed} failed"


def _shown(path: Path, root: Path) -> str:
    return str(path.relative_to(root) if path.is_relative_to(root) else path)


def _line(record: dict[str, Any]) -> str:
    charts = f"{record['charts']} chart{'s' if record['charts'] > 1 else ''}"
    sure = "certified" if record["certified"] else "NOT one-to-one"
    return (
        f"{record['triangles']:>9,} triangles  {charts:>10}  distortion "
        f"{record['mean_distortion']:.3f} mean, {record['max_distortion']:.2f} max  "
        f"{record['flipped']} flipped  {sure}  {record['seconds']:.1f} s"
    )


def _write_json(records: list[dict[str, Any]], failed: int, where: str) -> None:
    result = {"files": [_finite(record) for record in records], "failed": failed}
    text = json.dumps(result, indent=1, allow_nan=False) + "\n"
    if where == "-":
        sys.stdout.write(text)
        return
    from njf_models.meshfiles import whole_file  # noqa: PLC0415

    try:
        with whole_file(Path(where)) as path:
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CommandError(f"{where}: {error.strerror}") from error


def _finite(value: Any) -> Any:
    """JSON has no infinity: null stands for it."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _count(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive whole number")
    return int(text)
