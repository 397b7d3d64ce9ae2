"""Draw images/architecture.svg: the files of both packages, each below all that it imports.

`--check` only says whether the picture would change.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
PACKAGES = {"diffpoisson": "#dbe9f6", "njf_models": "#fbe6d0"}
CHAR, HEIGHT, GAP, WIDTH = 7.3, 26, 8, 680  # of a letter, a box, between boxes, all


def modules(package: str) -> dict[str, list[Path]]:
    """The files of a package that others import, those of each folder as one."""
    groups = defaultdict(list)
    for path in sorted((ROOT / package).rglob("*.py")):
        first, *rest = path.relative_to(ROOT / package).parts
        if path.name not in ("__init__.py", "__main__.py") or rest:
            groups[f"{first}/" if rest else first.removesuffix(".py")].append(path)
    return dict(groups)


def imports(package: str) -> dict[str, set[str]]:
    """Which modules of the package each of them imports, at whatever place."""
    groups = modules(package)

    def named(path: Path) -> set[str]:
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                top, *rest = node.module.split(".")
                names = rest[:1] or [alias.name for alias in node.names]
                found |= {name for name in names if top == package}
        return found

    def known(names: set[str]) -> set[str]:
        return {name if name in groups else f"{name}/" for name in names} & set(groups)

    return {
        group: known(set().union(*map(named, paths))) - {group} for group, paths in groups.items()
    }


def rows(package: str) -> list[list[str]]:
    """The modules by the length of the longest chain of imports below each.

    Raises:
        ValueError: modules import each other in a circle.
    """
    left, done, result = imports(package), set(), []
    while left:
        row = sorted(name for name, needs in left.items() if needs <= done)
        if not row:
            raise ValueError(f"a circle of imports among {', '.join(sorted(left))}")
        result.append(row)
        done |= set(row)
        left = {name: needs for name, needs in left.items() if name not in done}
    return result


def picture() -> str:
    """The SVG."""
    parts, y = [], GAP
    for package, colour in PACKAGES.items():
        parts.append(text(GAP, y + 18, package, "bold"))
        y += HEIGHT + GAP
        for row in rows(package):
            x = GAP
            for name in row:
                width = CHAR * len(name) + 16
                if x + width > WIDTH - GAP:
                    x, y = GAP, y + HEIGHT + GAP // 2
                parts.append(
                    f'<rect x="{x:.0f}" y="{y}" width="{width:.0f}" height="{HEIGHT}" rx="4" '
                    f'fill="{colour}" stroke="#888"/>'
                )
                parts.append(text(x + 8, y + 17, name))
                x += width + GAP
            y += HEIGHT + GAP
        y += GAP
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y}" '
    return "\n".join(
        [
            f'{head}font-family="monospace" font-size="12">',
            '<rect width="100%" height="100%" fill="white"/>',
            *parts,
            "</svg>\n",
        ]
    )


def text(x: float, y: float, words: str, weight: str = "normal") -> str:
    """A line of it."""
    return f'<text x="{x:.0f}" y="{y:.0f}" font-weight="{weight}">{words}</text>'


def main() -> bool:
    """Draw; true if `--check` found the picture to be stale."""
    stale = not PICTURE.exists() or PICTURE.read_text() != picture()
    if stale and "--check" not in sys.argv:
        PICTURE.write_text(picture())
    print("changed" if stale else "unchanged")
    return stale and "--check" in sys.argv


if __name__ == "__main__":
    sys.exit(main())
