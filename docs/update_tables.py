"""Write the tables in README.md, CONTRIBUTING.md and docs/ from the JSON results beside this file.

A table stands between the lines `<!-- table:NAME -->` and `<!-- end -->`. `--check` only says
whether anything would change.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

from tests import coverage_table  # noqa: E402  (found by the line above)
from tests.benchmarks import report  # noqa: E402
from tests.mutation import named, verdicts  # noqa: E402

RESULTS = DOCS / "results"


def uv_train() -> str:
    """The example's test split, beside the paper's network and its figures on other data."""
    ours, theirs = (
        json.loads((RESULTS / f"{name}.json").read_text())
        for name in ("uv_train", "uv_train_paper")
    )
    assert ours["splits"] == theirs["splits"]
    steps, after = ours["summary"]["untrained"], ours["summary"]["trained"]
    before, papers = theirs["summary"]["untrained"], theirs["summary"]["trained"]
    paper = {  # Table 1 of the paper: Thingi10K patches / other meshes
        "patches with a flip, raw, %": "19 / 10",
        "flips per patch, raw": "3.44 / 0.77",
        "D>10 per patch, raw": "5.67 / 1.99",
    }
    rows = [
        f"| {name} | {number(before[name])} | {number(papers[name])} | {number(steps[name])} "
        f"| {number(after[name])} | {paper.get(name, '–')} |"
        for name in after
        if name not in ("patches", "milliseconds per patch, median")  # times depend on the load
    ]
    return "\n".join(
        [
            f"| {after['patches']:.0f} patches of unseen meshes | projection "
            "| the paper's network | local/global steps | ours | paper, other data |",
            "|---|---|---|---|---|---|",
            *rows,
        ]
    )


def transforms() -> str:
    """Peers under torch's transforms, from `tests/benchmarks/transforms_table.py`."""
    results = json.loads((RESULTS / "transforms.json").read_text())
    columns = {
        f"{name}, {what}": cells
        for name, kinds in results["rows"].items()
        if "missing" not in kinds
        for what, cells in kinds.items()
    }
    # Where a long name may break.
    titles = [
        name.replace("torchsparsegradutils", "torch&shy;sparse&shy;gradutils") for name in columns
    ]
    lines = ["| | " + " | ".join(titles) + " |", "|---|" + "---|" * len(columns)]
    for name in results["transforms"]:
        row = [transforms_cell(cells[name]) for cells in columns.values()]
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    missing = [name for name, kinds in results["rows"].items() if "missing" in kinds]
    listed = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    absent = f" Not installed: {', '.join(missing)}." if missing else ""
    return "\n".join([*lines, "", f"Measured with {listed}.{absent}"])


def transforms_cell(result: dict) -> str:
    """✓, raises, or WRONG with the relative error."""
    if result["outcome"] == "WRONG":
        return f"**WRONG** ({result['relative error']:.0e})"
    return {"correct": "✓", "raises": "raises"}[result["outcome"]]


def poisson_cost() -> str:
    """Seconds of the Poisson layer over mesh sizes."""
    rows = json.loads((RESULTS / "poisson_cost.json").read_text())["rows"]
    columns = ("vertices", "mesh_and_factor", "solve", "solve_and_backward")
    head = (
        "| vertices | mesh, operators and factor | solve | solve and backward |\n|---|---|---|---|"
    )
    body = (
        "| " + " | ".join(f"{row[column]:.3g}" for column in columns[1:]) + " |" for row in rows
    )
    return "\n".join(
        [head, *(f"| {r['vertices']:,} {line}" for r, line in zip(rows, body, strict=True))]
    )


def mutations() -> str:
    """Mutants of each file: how many there are, how many were run, and what came of them."""
    result = json.loads((RESULTS / "mutations.json").read_text())
    argued = verdicts()
    counts: Counter[tuple[str, str]] = Counter()
    for mutant in result["mutants"]:
        outcome = mutant["outcome"]
        if outcome == "survived" and named(mutant) in argued[mutant["file"]]:
            outcome = "argued"
        counts[mutant["file"], outcome] += 1
    rows = []
    for file, total in result["population"].items():
        killed = counts[file, "killed"] + counts[file, "hung"]
        left = counts[file, "argued"], counts[file, "survived"]
        rows.append((f"`{file}.py`", total, killed + sum(left), killed, *left))
    rows.append(("all", *(sum(column) for column in list(zip(*rows, strict=True))[1:])))
    head = "| file | mutants | run | killed | argued below | left |\n|---|---|---|---|---|---|"
    return "\n".join([head, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def survivors() -> str:
    """Each survivor with the reason that it is no fault, and those that have none."""
    argued = verdicts()
    groups: dict[tuple[str, str], list[str]] = defaultdict(list)
    for mutant in json.loads((RESULTS / "mutations.json").read_text())["mutants"]:
        if mutant["outcome"] == "survived":
            file = mutant["file"]
            why = argued[file].get(named(mutant), "**Not argued away.**")
            groups[file, why].append(f"{mutant['line']} `{mutant['change']}`")
    lines = [f"- `{file}`, {', '.join(mutants)}. {why}" for (file, why), mutants in groups.items()]
    return "\n".join(lines)


def cli_trial() -> str:
    """What `njf uv` made of meshes of many kinds, from `tests/benchmarks/cli_trial.py`."""
    rows = json.loads((RESULTS / "cli_trial.json").read_text())["files"]
    lines = ["| input | | charts | mean stretch | outcome |", "|---|---|---|---|---|"]
    for row in rows:
        if row["exit code"] == 0:
            sure = "one-to-one, certified" if row["certified"] else "**overlaps**"
            outcome = f"{row['charts']} | {row['mean_distortion']:.3f} | {sure}"
        else:
            outcome = f"– | – | `{row['stderr']}`"
        lines.append(f"| `{row['file']}` | {row['kind']} | {outcome} |")
    return "\n".join(lines)


def uv_robustness() -> str:
    """Cut and mapped meshes, from `tests/benchmarks/uv_robustness.py`."""
    records = json.loads((RESULTS / "uv_robustness.json").read_text())
    done = [record for record in records.values() if "error" not in record]

    def spread(values: list[float]) -> str:
        ordered = sorted(values)
        middle, ninetieth = ordered[len(ordered) // 2], ordered[int(0.9 * len(ordered))]
        return f"{middle:.3g} / {ninetieth:.3g} / {ordered[-1]:.3g}"

    rows = {
        "meshes": f"{len(records)}, of up to {max(r['faces'] for r in done):,} faces",
        "mapped": f"{len(done)}",
        "flipped triangles": f"{sum(r['flipped'] for r in done)}",
        "certified": f"{sum(r['certified'] for r in done)}",
        "charts, median / 90% / most": spread([r["charts"] for r in done]),
        "symmetric Dirichlet, median / 90% / worst": spread([r["energy"] for r in done]),
        "largest max(σ₁, 1/σ₂), median / 90% / worst": spread([r["max_distortion"] for r in done]),
    }
    return "\n".join(
        ["| | |", "|---|---|", *(f"| {name} | {cell} |" for name, cell in rows.items())]
    )


def uv_overlap() -> str:
    """What keeping overlaps off costs, from `tests/benchmarks/uv_overlap.py`."""
    result = json.loads((RESULTS / "uv_overlap.json").read_text())
    ratio = {name: f"{(result[name] - 1) * 100:.3g} %" for name in result if "ratio" in name}
    times = result["mean_seconds"]
    rows = {
        "patches of 500 to 2,000 faces": f"{result['patches']:,}",
        "flipped triangles": f"{result['flips']}",
        "overlapping after SLIM alone": f"{result['overlapping_percent']:.3g} %",
        "certified": f"{result['certified_percent']:.4g} %",
        "energy above SLIM's, median of those": ratio["energy_ratio_median_of_overlapping"],
        "energy above SLIM's, 99% of all": ratio["energy_ratio_p99"],
        "energy above SLIM's, worst": ratio["energy_ratio_worst"],
        "mean time, of SLIM alone": f"{times['injective'] / times['free']:.2f} ×",
    }
    return "\n".join(
        ["| | |", "|---|---|", *(f"| {name} | {cell} |" for name, cell in rows.items())]
    )


def uv() -> str:
    """The UV network on unseen meshes, from `tests/benchmarks/uv_results.py`."""
    results = json.loads((RESULTS / "uv.json").read_text())
    everything, filtered = results["raw"]["all"], results["raw"]["filtered"]
    paper = {
        "patches with a flip, raw, %": "19 / 10",
        "flips per patch, raw": "3.44 / 0.77",
        "D>10 per patch, raw": "5.67 / 1.99",
    }
    rows = [
        f"| {name} | {number(filtered[name])} | {number(value)} | {paper.get(name, '–')} |"
        for name, value in everything.items()
        if name != "milliseconds per patch, median"
    ]
    after, steps, rates = (
        results[name] for name in ("parameterize", "iterations to 1%, hardest quarter", "rates")
    )
    speed = rates["patches per second"]
    over_slim = [record["energy_over_slim"] for record in results["records"]]
    theirs, ours = zip(*_hardest_iterations(results["records"]), strict=True)
    more = {
        "after `parameterize`: patches with a flip": after["patches with a flip"],
        "not certified": after["not certified"],
        "started from the network's map, %": 100 * after["from the network"],
        "energy over converged SLIM's, median": f"{after['energy over SLIM, median']:.5f}",
        "its quartiles": " … ".join(f"{value:.5f}" for value in _quartiles(over_slim)),
        "energy over converged SLIM's, 99%": f"{after['energy over SLIM, p99']:.5f}",
        "SLIM iterations to 1%, hardest quarter: from Tutte's map, median (quartiles)": _spread(
            steps["from Tutte"], theirs
        ),
        "the same from the network's": _spread(steps["ours"], ours),
        "raw maps over 20 SLIM iterations, patches per second": list(
            rates["prepared over SLIM"].values()
        )[-1],
        "the same from (V, F), with Tutte's map": rates["from (V, F) over Tutte and SLIM"],
    }
    rows += [
        f"| {name} | | {value if isinstance(value, str) else number(value)} | – |"
        for name, value in more.items()
    ]
    head = f"| {results['patches']} patches of {len(results['meshes'])} unseen meshes"
    speeds = ", ".join(
        f"{name} {number(median)} ({number(low)} … {number(high)})"
        for name, (low, median, high) in speed.items()
    )
    return "\n".join(
        [
            f"{head} | filtered | all | paper, other data |",
            "|---|---|---|---|",
            *rows,
            "",
            f"Patches per second on {rates['threads']} thread(s), {rates['faces per patch']:.0f} "
            f"faces per patch, medians (least … most) of {rates['rounds']} turns: {speeds}.",
        ]
    )


def _quartiles(values: Sequence[float]) -> list[float]:
    first, _, third = statistics.quantiles(values, n=4, method="inclusive")
    return [first, third]


def _spread(median: float, values: Sequence[float]) -> str:
    return f"{number(median)} ({' … '.join(map(number, _quartiles(values)))})"


def _hardest_iterations(records: list[dict[str, Any]]) -> list[tuple[int, int]]:
    """From Tutte's map and from ours; see `quartile_of_iterations` in `uv_results.py`."""
    pairs = []
    for record in records:
        theirs, ours = record["iterations_from_tutte"], record.get("iterations_from_network")
        pairs.append((theirs, theirs if ours is None else ours))
    return sorted(pairs, reverse=True)[: -(-len(pairs) // 4)]


def uv_rounds() -> str:
    """The UV network stopped after each of its rounds, from the same results."""
    results = json.loads((RESULTS / "uv.json").read_text())
    columns = (
        "patches with a flip, raw, %",
        "flips per patch, raw",
        "D>10 per patch, raw",
        "patches with a flip, %",
        "symmetric Dirichlet, median",
    )
    ratios = results["rates"]["prepared over SLIM"]
    lines = [f"| rounds | {' | '.join(columns)} | patches per second over 20 SLIM iterations |"]
    lines.append("|---" * (2 + len(columns)) + "|")
    for rounds, summary in results["raw"]["rounds"].items():
        cells = [number(summary["filtered"][column]) for column in columns]
        lines.append(f"| {rounds} | {' | '.join(cells)} | {ratios[rounds]:.1f} |")
    return "\n".join(lines)


def uv_weights() -> str:
    """Both weights for UV maps, on the same patches and machine."""
    results = {
        "`uv`: DiffusionNet, 32 eigenpairs": "uv",
        "`uv-pointnet`: PointNet, no eigenpairs": "uv_pointnet",
    }
    lines = [
        "| filtered patches | patches with a flip, raw, % | patches with a flip, % | symmetric "
        "Dirichlet, median | SLIM iterations to 1%, hardest quarter | over 20 SLIM iterations: "
        "prepared | from (V, F) | bytes |",
        "|---" * 8 + "|",
    ]
    for title, name in results.items():
        result = json.loads((RESULTS / f"{name}.json").read_text())
        raw, rates = result["raw"]["filtered"], result["rates"]
        weights = DOCS.parent / "njf_models" / "weights" / f"{name.replace('_', '-')}.safetensors"
        cells = [
            number(raw["patches with a flip, raw, %"]),
            number(raw["patches with a flip, %"]),
            number(raw["symmetric Dirichlet, median"]),
            number(result["iterations to 1%, hardest quarter"]["ours"]),
            number(list(rates["prepared over SLIM"].values())[-1]),
            number(rates["from (V, F) over Tutte and SLIM"]),
            f"{weights.stat().st_size:,}",
        ]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def uv_ablation() -> str:
    """Variants of the UV network, from `tests/benchmarks/uv_ablation.py`."""
    result = json.loads((RESULTS / "uv_ablation.json").read_text())
    columns = [name for name in next(iter(result["variants"].values())) if name != "patches"]
    lines = [f"| | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for name, row in result["variants"].items():
        cells = [f"{row[c]:,}" if c == "steps" else number(row[c]) for c in columns]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    patches = next(iter(result["variants"].values()))["patches"]
    return "\n".join(
        [
            *lines,
            "",
            f"{result['minutes']:.0f} minutes of processor time each, one seed; "
            f"{result['training patches']:,} patches to train on, {patches} to validate.",
        ]
    )


def uv_diffusion() -> str:
    """DiffusionNet in two places, from `tests/benchmarks/uv_diffusion.py`."""
    result = json.loads((RESULTS / "uv_diffusion.json").read_text())
    columns = {
        "D>10 per patch, raw": "D>10 per patch, raw",
        "D>10 per patch": "D>10 per patch",
        "flips per patch, raw": "flips per patch, raw",
        "patches with a flip, %": "patches with a flip, %",
        "energy over SLIM's, median": "energy over SLIM's, median",
        "L2-J, median": "L2-J, median",
    }
    lines = [f"| | {' | '.join(columns)} | steps |", "|---" * (2 + len(columns)) + "|"]
    for name, row in result["models"].items():
        cells = [number(row[column]) for column in columns]
        lines.append(f"| {name} | {' | '.join(cells)} | {row['steps']:,} |")
    lines.append("| paper: NJF / DiffusionNet | 5.67 / 158.7 |" + " – |" * len(columns))
    patches = next(iter(result["models"].values()))["patches"]
    return "\n".join(
        [
            *lines,
            "",
            f"{result['minutes']:.0f} minutes of processor time each, one seed; "
            f"{result['training patches']:,} patches to train on, {patches} to validate; the "
            "paper's data are others.",
        ]
    )


def uv_certified() -> str:
    """Patches that no network saw, from `tests/benchmarks/uv_certified.py`, by either weights."""
    names = {"`uv`": "uv_certified", "`uv-pointnet`": "uv_certified_pointnet"}
    results = [json.loads((RESULTS / f"{name}.json").read_text()) for name in names.values()]

    def several(result: dict[str, Any], what: str, *keys: str) -> str:
        return ", ".join(number(result[f"{what}, {key}"]) for key in keys)

    def methods(result: dict[str, Any]) -> str:
        return ", ".join(f"{name} {count:,}" for name, count in result["methods"].items())

    rows: dict[str, Callable[[dict[str, Any]], str]] = {
        "patches of 500 to 2,000 faces": lambda r: f"{r['patches']:,} of {r['meshes']:,} meshes",
        "with a flip": lambda r: f"{r['patches with a flip']}",
        "not certified to be one-to-one": lambda r: f"{r['not certified']}",
        "symmetric Dirichlet, median, 99%, worst": lambda r: several(
            r, "energy", "median", "99%", "worst"
        ),
        "processor seconds each, median, worst": lambda r: several(
            r, "processor seconds", "median", "worst"
        ),
        "came through": methods,
    }
    lines = [f"| | {' | '.join(names)} |", "|---|---|---|"]
    lines += [
        f"| {title} | {' | '.join(row(result) for result in results)} |"
        for title, row in rows.items()
    ]
    return "\n".join(lines)


def uv_card() -> str:
    """The card of the shipped weights."""
    weights = DOCS.parent / "njf_models" / "weights"
    card = json.loads((weights / "uv.json").read_text())
    plain = {name: value for name, value in card.items() if isinstance(value, (str, int, float))}
    # As code: a dollar sign of the shell would begin a formula.
    plain["commands"] = "<br>".join(f"`{command}`" for command in plain["commands"].split(" ; "))
    return "\n".join(["| | |", "|---|---|", *(f"| {n} | {v} |" for n, v in plain.items())])


def repose_card() -> str:
    """The cards of the shipped weights for poses."""
    weights = DOCS.parent / "njf_models" / "weights"
    names = ("repose", "repose-any")
    cards = [json.loads((weights / f"{name}.json").read_text()) for name in names]
    lines = [f"| {' | '.join(str(card[row]) for card in cards)} |" for row in cards[0]]
    rows = [f"| {row} {line}" for row, line in zip(cards[0], lines, strict=True)]
    return "\n".join([f"| | {' | '.join(f'`{name}`' for name in names)} |", "|---|---|---|", *rows])


def notices() -> str:
    """Where the meshes come from that the shipped weights were trained on."""
    weights = DOCS.parent / "njf_models" / "weights"
    names = ("uv", "uv-pointnet")
    counts = [
        Counter(
            (source.split(":")[0].split("(seed")[0].strip(), terms)
            for _, terms, source in json.loads((weights / f"{name}.json").read_text())["meshes"]
        )
        for name in names
    ]
    sources = sorted(set.union(*map(set, counts)), key=lambda row: (-counts[0][row], row))
    return "\n".join(
        [
            f"| source | licence | {' | '.join(f'meshes of `{name}`' for name in names)} |",
            "|---|---|---|---|",
            *(
                f"| {' | '.join(row)} | {' | '.join(str(count[row]) for count in counts)} |"
                for row in sources
            ),
        ]
    )


def repose() -> str:
    """Re-posing of unseen bodies, from `examples/body_maps.py`."""
    results = json.loads((RESULTS / "repose.json").read_text())
    summary, options, costs = (results[name] for name in ("summary", "options", "training"))
    paper = {"ours": 0.84, "displacement": 4.21, "cages": 3.87}  # L2-V from the T-pose
    theirs = [name for name in summary if name not in ("untrained", "ours")]
    head = ["untrained: identity", "ours", *theirs, *(f"{name} / ours" for name in theirs)]
    maps = f"{summary['ours']['maps']:.0f} maps of {options['held_out']} unseen bodies"
    lines = [f"| {maps} | {' | '.join(head)} |", "|---" * (1 + len(head)) + "|"]
    for name, ours in summary["ours"].items():
        if name != "maps":
            others = [summary[other][name] for other in theirs]
            cells = [summary["untrained"][name], ours, *others, *(x / ours for x in others)]
            lines.append(f"| {name} | {' | '.join(map(number, cells))} |")
    figures = [paper["ours"], *(paper.get(name) for name in theirs)]
    figures += [x and x / paper["ours"] for x in figures[1:]]
    cells = ["–" if figure is None else number(figure) for figure in figures]
    lines.append(f"| L2-V of the paper, on STAR | – | {' | '.join(cells)} |")
    spent = "; ".join(f"{name}: {spent_on(cost)}" for name, cost in costs.items())
    return "\n".join(
        [
            *lines,
            "",
            f"Trained on {options['bodies']} bodies in {options['poses']} poses each, of "
            f"{options['faces']:,} faces, code of size {options['code_size']}, one seed. "
            f"{spent[0].upper()}{spent[1:]}.",
        ]
    )


def spent_on(cost: dict) -> str:
    """Steps and time of a training of `examples/body_maps.py`."""
    steps = " and ".join(f"{n:,} {phase}" for phase, n in cost["steps"].items())
    if recipe := cost.get("recipe"):
        poses = "pose" if recipe["targets"] == 1 else "poses"
        steps += f" (of {recipe['per_step']} bodies in {recipe['targets']} {poses} each)"
    spent = f"{steps} steps, {cost['cpu seconds'] / 60:.1f} minutes of CPU time"
    if seconds := cost.get("earlier, cpu seconds"):
        spent += f", after {seconds / 60:.1f} of earlier trainings"
    if seconds := cost.get("cages, cpu seconds"):
        spent += f", and {seconds / 60:.1f} for the cages of the training bodies before it"
    return spent


def body_tasks() -> str:
    """The other tasks of `examples/body_maps.py`, beside the paper's figures."""
    paper = {  # L2-V, L2-J, L2-N
        "unpose": None,
        "unpose-2": None,
        "any-pose": (1.84, 1.55, 4.4),
        "registration": (3.24, 3.01, 9.9),
        "morphing": (2.00, 2.80, 8.2),
    }
    columns = ("L2-V", "L2-J", "L2-N, degrees")
    head = [f"{c}: identity / ours / paper" for c in columns]
    lines = [f"| | from | maps | {' | '.join(head)} | training |", "|---" * 7 + "|"]
    for task, figures in paper.items():
        results = json.loads((RESULTS / f"{task}.json").read_text())
        before, after = (results["summary"][name] for name in ("untrained", "ours"))
        theirs = ["–"] * 3 if figures is None else [number(x) for x in figures]
        cells = [
            f"{number(before[c])} / {number(after[c])} / {x}"
            for c, x in zip(columns, theirs, strict=True)
        ]
        start = "the rest pose" if results["options"]["sources"] == 0 else "any pose"
        spent = spent_on(results["training"]["ours"])
        lines.append(f"| {task} | {start} | {after['maps']:.0f} | {' | '.join(cells)} | {spent} |")
    return "\n".join(lines)


def body_pose() -> str:
    """Poses read off shapes, from `examples/body_pose.py`."""
    results = json.loads((RESULTS / "body_pose.json").read_text())
    degrees, options = results["degrees"], results["options"]
    joints = sorted(degrees["joints"].items(), key=lambda row: row[1])
    ends = [f"{name}, {number(angle)}°" for name, angle in (joints[0], joints[-1])]
    seconds = results["training"]["cpu seconds"]
    head = "| bodies to learn from | training | unseen bodies | mean angle | least | largest |"
    cells = [
        f"{results['bodies']['train']:,}",
        f"{options['steps']:,} steps of {options['per_step']} bodies, "
        f"{seconds / 60:.1f} minutes of CPU time",
        f"{results['bodies']['test']:,}",
        f"{number(degrees['mean'])}°",
        *ends,
    ]
    return "\n".join([head, "|---" * 6 + "|", f"| {' | '.join(cells)} |"])


def body_tricks() -> str:
    """Variants of the re-posing network, from `tests/benchmarks/body_tricks.py`."""
    results = json.loads((RESULTS / "body_tricks.json").read_text())
    minutes = f"{results['minutes']:g} minute{'s' * (results['minutes'] != 1)}"
    lines = [f"| {minutes} of CPU time each | steps | L2-V | L2-J |"]
    lines.append("|---" * 4 + "|")
    for name, row in results["variants"].items():
        lines.append(
            f"| {name} | {row['steps']:,} | {number(row['L2-V'])} | {number(row['L2-J'])} |"
        )
    return "\n".join(lines)


def far_bodies() -> str:
    """Bodies outside the range of training, from `examples/far_body.py`."""
    results = json.loads((RESULTS / "far_bodies.json").read_text())
    columns = ("L2-V", "L2-J", "L2-N, degrees")
    lines = [f"| body | maps | {' | '.join(columns)} |", "|---" * 5 + "|"]
    for name, row in results.items():
        cells = [number(row[column]) for column in columns]
        lines.append(f"| {name} | {row['maps']:.0f} | {' | '.join(cells)} |")
    return "\n".join(lines)


def repose_rate() -> str:
    """Maps per second of the shipped network, from `tests/benchmarks/repose_rate.py`."""
    lines = ["| triangles | preparation, ms | a map, ms | maps per second |", "|---" * 4 + "|"]
    for row in json.loads((RESULTS / "repose_rate.json").read_text())["meshes"]:
        cells = [1000 * row["preparation, s"], row["a map, ms"], row["maps per second"]]
        lines.append(f"| {row['faces']:,} | {' | '.join(map(number, cells))} |")
    return "\n".join(lines)


def triangulations() -> str:
    """Maps of the same bodies on several triangulations, from `examples/triangulations.py`."""
    results = json.loads((RESULTS / "triangulations.json").read_text())
    ours = results["deviations"].pop("ours")
    head = ["faces", "error, mm", "deviation, mm", "of exact maps, mm", "deviation / own error, %"]
    also = json.loads((RESULTS / "triangulations_also.json").read_text())["deviations"]["ours"]
    results["deviations"]["ours, trained on four"] = also
    for name in results["deviations"]:
        head += [f"error, mm, {name}", f"deviation, mm, {name}"]
    lines = [f"| triangulation | {' | '.join(head)} |", "|---" * (1 + len(head)) + "|"]
    for name, row in ours.items():
        cells = [1000 * row[x] for x in ("error", "deviation", "exact")] + [100 * row["share"]]
        for others in results["deviations"].values():
            cells += [1000 * others[name][x] for x in ("error", "deviation")]
        lines.append(f"| {name} | {row['n_faces']:,} | {' | '.join(map(number, cells))} |")
    about = f"{results['bodies']} unseen bodies in {results['poses']} poses each."
    return "\n".join([*lines, "", about])


def arap() -> str:
    """Deformation of a solid from its handles, from `examples/arap.py`."""
    results = json.loads((RESULTS / "arap.json").read_text())
    summary, options, solver = (results[name] for name in ("summary", "options", "solver"))
    ours, theirs = summary["ours"], summary["global MLP"]
    maps = f"{ours['maps']:.0f} unseen positions of the handles"
    others = [name for name in summary if name not in ("untrained", "ours", "global MLP")]
    head = ["untrained: identity", "ours", "global MLP", "global MLP / ours", *others]
    lines = [f"| {maps} | {' | '.join(head)} |", "|---" * (1 + len(head)) + "|"]
    for name in ours:
        if name not in ("maps", "CPU milliseconds, median"):  # of which there is a table below
            cells = [
                summary["untrained"][name],
                ours[name],
                theirs[name],
                theirs[name] / ours[name],
            ]
            cells += [summary[of_model][name] for of_model in others]
            lines.append(f"| {name} | {' | '.join(map(number, cells))} |")
    spreads = [results["spread"][name]["L2-V"] for name in ("ours", "global MLP")]
    cells = ["–", *map(number, spreads), "–"]
    cells += [number(results["spread"][name]["L2-V"]) for name in others]
    lines.append(f"| L2-V, largest less smallest of the seeds | {' | '.join(cells)} |")
    rest = ["0.64" if name == "the paper's field" else "–" for name in others]
    lines.append(f"| L2-V of the paper, on Raptor | – | 0.64 | 3.66 | 5.7 | {' | '.join(rest)} |")
    return "\n".join(
        [
            *lines,
            "",
            f"Learned from {options['maps']:,} maps of {solver['tetrahedra']:,.0f} tetrahedra; "
            f"means of {len(options['seeds'])} seeds. {spent(results['training'])} The solver on "
            f"the test maps: {solver['iterations, mean']:.0f} accelerated steps in the mean, "
            "residual at most "
            f"{solver['largest residual']:.1e} of the size, "
            f"{solver['flipped tetrahedra, mean']:.1f} flipped tetrahedra in the mean, "
            f"{solver['flipped tetrahedra, most']:.0f} at most.",
        ]
    )


def arap_speed() -> str:
    """The network against the ARAP solver, from `tests/benchmarks/arap_speed.py`."""
    results = json.loads((RESULTS / "arap_speed.json").read_text())
    columns = {
        "tetrahedra": "tetrahedra",
        "faces": "faces",
        "solver, iterations": "solver, steps",
        "solver, s": "solver, s",
        "accelerated, s": "accelerated, s",
        "preparation, s": "preparation, s",
        "network, s": "a map, s",
        "speed-up": "speed-up",
        "speed-up over the accelerated": "over the accelerated",
        "L2-V": "L2-V",
        "L2-N, degrees": "L2-N, degrees",
        "maps": "maps",
    }
    lines = ["| " + " | ".join(columns.values()) + " |", "|---" * len(columns) + "|"]
    rows = [[size(row[name]) for name in columns] for row in results.values()]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def contact() -> str:
    """The block and the star, from `examples/contact.py`."""
    results = json.loads((RESULTS / "contact.json").read_text())
    summary, options = results["summary"], results["options"]
    head = ["untrained: identity", "ours", "offsets"]
    maps = f"{summary['ours']['maps']:.0f} states of {options['held_out']} unseen trajectories"
    lines = [f"| {maps} | {' | '.join(head)} |", "|---|---|---|---|"]
    for name in summary["ours"]:
        if name not in ("maps", "CPU milliseconds, median"):
            cells = [summary[of][name] for of in ("untrained", "ours", "offsets")]
            lines.append(f"| {name} | {' | '.join(map(number, cells))} |")
    spreads = [number(results["spread"][of]["L2-V"]) for of in ("ours", "offsets")]
    lines.append(f"| L2-V, largest less smallest of the seeds | – | {' | '.join(spreads)} |")
    lines.append("| L2-V of the paper, on Romero et al.'s data | – | 0.398 | 0.424 |")
    return "\n".join(
        [
            *lines,
            "",
            f"Learned from the states of {options['trajectories']} trajectories; means of "
            f"{len(options['seeds'])} seeds. {spent(results['training'])}",
        ]
    )


def spent(costs: dict[str, dict]) -> str:
    """CPU time of each model, and its steps if they were planned, as a sentence."""
    parts = []
    for name, cost in costs.items():
        steps = f"{cost['steps']:,.0f} steps, " if "steps" in cost else ""
        parts.append(f"{name}: {steps}{cost['cpu seconds'] / 60:.1f} minutes of CPU time")
    sentence = "; ".join(parts)
    return f"{sentence[0].upper()}{sentence[1:]}."


def size(value: float) -> str:
    """A number, with its thousands apart if it is large."""
    return f"{value:,.0f}" if value >= 1000 else number(value)


class Row(NamedTuple):
    """A row of the paper's Tables 1 and 2, and where its counterpart is.

    Attributes:
        experiment: its name.
        quantity: what the paper counts, our name for it in the result.
        ours: the paper's figure of its method.
        theirs: that of the baseline.
        baseline: its name.
        result: file of the counterpart, None where there is none yet.
        columns: of the summary, of our method and of the baseline; None if that is not there.
        data: what the counterpart was measured on.
    """

    experiment: str
    quantity: str
    ours: float
    theirs: float | None = None
    baseline: str = ""
    result: str | None = None
    columns: tuple[str, str | None] = ("ours", None)
    data: str = ""


_PATCHES = "unfiltered patches of other meshes, by the shipped network"
_ANNY = "anny's bodies, not STAR"
PAPER = [
    Row("UV", "patches with a flip, raw, %", 19, None, "", "uv", ("all", None), _PATCHES),
    Row("UV", "flips per patch, raw", 3.44, None, "", "uv", ("all", None), _PATCHES),
    Row(
        "UV",
        "D>10 per patch, raw",
        5.67,
        158.7,
        "DiffusionNet",
        "uv_diffusion",
        ("NJF of the paper: PointNet and WKS, 1 round", "DiffusionNet predicts UVs"),
        "validation patches of other meshes",
    ),
    Row(
        "re-posing from rest",
        "L2-V",
        0.84,
        4.21,
        "displacement field",
        "repose",
        ("ours", "displacement"),
        _ANNY,
    ),
    Row(
        "re-posing from rest",
        "L2-V",
        0.84,
        3.87,
        "Neural Cages",
        "repose",
        ("ours", "cages"),
        _ANNY,
    ),
    *(
        Row(experiment, quantity, value, result=result, data=_ANNY)
        for experiment, result, values in (
            ("re-posing, any to any", "any-pose", (1.84, 1.55, 4.4)),
            ("registration", "registration", (3.24, 3.01, 9.9)),
            ("morphing", "morphing", (2.00, 2.80, 8.2)),
        )
        for quantity, value in zip(("L2-V", "L2-J", "L2-N, degrees"), values, strict=True)
    ),
    Row(
        "volumetric ARAP",
        "L2-V",
        0.64,
        3.66,
        "global MLP",
        "arap",
        ("ours", "global MLP"),
        "a generated lizard, not Raptor",
    ),
    Row(
        "contact",
        "L2-V",
        0.398,
        0.424,
        "offsets of vertices",
        "contact",
        ("ours", "offsets"),
        "a block and a star, not Romero et al.'s data",
    ),
]


def paper() -> str:
    """All rows of the paper's Tables 1 and 2 beside what there is here."""
    head = ["experiment", "quantity", "paper: ours", "baseline", "ratio"]
    head += [
        "here: ours",
        "baseline",
        "ratio",
        "CPU minutes",
        "seed spread",
        "baseline is",
        "data here",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in PAPER:
        cells = [row.experiment, row.quantity, *ratio(row.ours, row.theirs), *counterpart(row)]
        lines.append("| " + " | ".join([*cells, row.baseline or "–", row.data or "–"]) + " |")
    return "\n".join(lines)


def ratio(ours: float, theirs: float | None) -> list[str]:
    """Two errors and the quotient of the second and the first."""
    if theirs is None:
        return [number(ours), "–", "–"]
    return [number(ours), number(theirs), number(theirs / ours)]


def counterpart(row: Row) -> list[str]:
    """The same of our result, its training and the spread of its seeds."""
    path = RESULTS / f"{row.result}.json"
    if row.result is None or not path.exists():
        return ["not yet", "not yet" if row.baseline else "–", "–", "–", "–"]
    results = json.loads(path.read_text())
    summary = results.get("summary") or results.get("raw") or results["models"]
    ours, theirs = row.columns
    if ours not in summary:
        return ["not yet", "not yet", "–", "–", "–"]
    cells = ratio(summary[ours][row.quantity], None)
    if theirs in summary:
        cells = ratio(summary[ours][row.quantity], summary[theirs][row.quantity])
    elif row.baseline:
        cells[1] = "not yet"
    cost = results.get("training", {}).get(ours, {})
    seconds = cost.get("cpu seconds", 0) + cost.get("earlier, cpu seconds", 0)
    minutes = seconds / 60 if seconds else results.get("minutes")
    spread = results.get("spread", {}).get(ours, {}).get(row.quantity)
    return [*cells, *("–" if value is None else number(value) for value in (minutes, spread))]


def data_cost() -> str:
    """Stages and bytes of UV training data, from `tests/benchmarks/data_cost.py`."""
    result = json.loads((RESULTS / "data_cost.json").read_text())
    lines = []
    for quantity, unit in (("milliseconds per patch", 1), ("bytes per patch", 1000)):
        costs = result[quantity]
        total = sum(costs.values())
        name = quantity.replace("bytes", "kB")
        lines += (
            [f"| | {name} | share, % |", "|---|---|---|"] if not lines else [f"| **{name}** | | |"]
        )
        rows = [*costs.items(), ("all", total)]
        lines += [f"| {n} | {number(c / unit)} | {number(100 * c / total)} |" for n, c in rows]
    per_mesh = ", ".join(f"{n} {number(c)} ms" for n, c in result["milliseconds per mesh"].items())
    return "\n".join(
        [
            *lines,
            "",
            f"{result['patches']} patches of {result['meshes']} meshes of "
            f"{result['mesh_faces']:,} faces; on average {result['mean_faces']:.0f} faces, "
            f"{result['mean_vertices']:.0f} vertices and {result['energies']} energies. Besides, "
            f"once per mesh and shard: {per_mesh}.",
        ]
    )


def coverage() -> str:
    """What of the packages the tests run, from `tests/coverage_table.py`."""
    return coverage_table.table(json.loads((RESULTS / "coverage.json").read_text()))


def gallery() -> str:
    """Processor time of the examples: of all from `tests/benchmarks/gallery_times.py`, or training.

    Those that train take a quarter of an hour and more. What they trained for they record; the
    making of data and the evaluation come on top.
    """
    measured = json.loads((RESULTS / "gallery.json").read_text())
    recorded = {"uv_train": "uv_train", "arap": "arap", "contact": "contact", "body_maps": "repose"}
    rows = [
        f"| `examples/{name}.py` | {minutes(result['cpu seconds'])} | – |"
        for name, result in measured.items()
    ]
    for name, record in recorded.items():
        training = json.loads((RESULTS / f"{record}.json").read_text())["training"]
        costs = [training] if "cpu seconds" in training else list(training.values())
        spent = sum(sum(v for k, v in cost.items() if "cpu seconds" in k) for cost in costs)
        rows.append(f"| `examples/{name}.py` | – | {minutes(spent)} |")
    head = ("| example | all of it | training of the run shown |", "|---|---|---|")
    return "\n".join([*head, *rows])


def minutes(seconds: float) -> str:
    """A time, to two digits or so."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


TABLES = {
    "coverage": coverage,
    "gallery": gallery,
    "paper": paper,
    "arap": arap,
    "arap_speed": arap_speed,
    "contact": contact,
    "repose": repose,
    "body_tasks": body_tasks,
    "body_pose": body_pose,
    "body_tricks": body_tricks,
    "far_bodies": far_bodies,
    "repose_rate": repose_rate,
    "triangulations": triangulations,
    "data_cost": data_cost,
    "uv": uv,
    "uv_rounds": uv_rounds,
    "uv_weights": uv_weights,
    "uv_ablation": uv_ablation,
    "uv_certified": uv_certified,
    "uv_diffusion": uv_diffusion,
    "uv_card": uv_card,
    "repose_card": repose_card,
    "notices": notices,
    "cli_trial": cli_trial,
    "uv_robustness": uv_robustness,
    "uv_overlap": uv_overlap,
    "uv_train": uv_train,
    "transforms": transforms,
    "poisson_cost": poisson_cost,
    "mutations": mutations,
    "survivors": survivors,
    **report.TABLES,
}


def number(value: float | None) -> str:
    """Three significant digits; JSON's null stands for infinity."""
    return "∞" if value is None else f"{value:.3g}"


def updated(text: str) -> str:
    """The text with each of its tables made anew."""

    def table(match: re.Match[str]) -> str:
        return f"<!-- table:{match[1]} -->\n{TABLES[match[1]]()}\n<!-- end -->"

    return re.sub(r"<!-- table:(\w+) -->\n.*?<!-- end -->", table, text, flags=re.DOTALL)


def main() -> bool:
    """Update every page; true if `--check` found one to be stale."""
    stale = []
    at_the_root = [DOCS.parent / name for name in ("README.md", "CONTRIBUTING.md")]
    for path in (*at_the_root, *sorted(DOCS.glob("*.md"))):
        text = path.read_text()
        if (new := updated(text)) != text:
            stale.append(path.name)
            if "--check" not in sys.argv:
                path.write_text(new)
    print("changed: " + (", ".join(stale) or "nothing"))
    return bool(stale) and "--check" in sys.argv


if __name__ == "__main__":
    sys.exit(main())
