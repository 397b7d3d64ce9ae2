"""One HTML file to look at a UV map: views of the surface and the layout, histogram, figures.

It works offline: three.js comes from trimesh's own viewer page, everything else is in
`templates/`. Figures are of the whole mesh; of a large one the views show a simplified copy.
"""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
import zipfile
from collections.abc import Sequence
from importlib import resources
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float, Int

import diffpoisson as dp
from njf_models.comparison import MeasuredMap

FACES_SHOWN = 100_000  # at most, in the views: about 4 MB of page

# matplotlib's viridis at ten places, linear in between.
_VIRIDIS = (
    *("#440154", "#482878", "#3e4989", "#31688e", "#26828e"),
    *("#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"),
)
_LIMITS = (1.25, 1.5, 2.0, 4.0, 8.0, 16.0)  # candidates for the end of the colour scale
_FLIPPED = 255  # the level of a flipped triangle; the colour scale has 0 … 254


def uv_page(
    name: str, mesh: dp.Mesh, uvmap: dp.UVMap, maps: Sequence[MeasuredMap], *, y_up: bool = True
) -> str:
    """The page as text.

    Args:
        name: what was mapped, such as a file's name.
        mesh: the surface before it was cut.
        uvmap: the map.
        maps: the maps to show, from `comparison.compare`; the first is the map itself.
        y_up: whether +y is up on the surface, rather than +z.
    """
    limit = _colour_limit(maps)
    shown = _simplified(uvmap, FACES_SHOWN)
    flipped_maps = [m.title for m in maps if m.flipped]
    words = {
        "name": html.escape(name),
        "counts": _counts(mesh, uvmap),
        "facts": _facts(maps[0]),
        "tabs": _tabs(maps),
        "ramp": f"linear-gradient(90deg, {', '.join(_VIRIDIS)})",
        "ticks": _ticks(limit),
        "simplified": _simplified_note(len(shown[0]), mesh.n_faces),
        "histogram": histogram(maps, uvmap.mesh.areas.numpy(), max(limit, 1.5)),
        "flips_note": f" Flipped triangles ({html.escape(', '.join(flipped_maps))}) are not in it."
        if flipped_maps
        else "",
        "table": _table(maps),
        "explanation": _EXPLANATION,
        "version": version("diffpoisson"),
        "data": json.dumps(
            _shape_data(mesh, uvmap, shown[1], y_up) | {"maps": _map_data(mesh, maps, limit, shown)}
        ),
        "css": _template("page.css"),
        "three": three_js(),
        "js": _template("page.js"),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: words[match[1]], _template("page.html"))


def three_js() -> str:
    """three.js and its trackball controls, which trimesh ships for notebooks (MIT).

    Raises:
        RuntimeError: this version of trimesh has another viewer.
    """
    archive = resources.files("trimesh").joinpath("resources", "templates", "viewer.zip")
    with zipfile.ZipFile(io.BytesIO(archive.read_bytes())) as viewer:
        page = viewer.read("viewer.html.template").decode("utf-8")
    library = re.search(
        r"<script>(.*?THREE\.TrackballControls=TrackballControls;\}\)\(\);)", page, re.DOTALL
    )
    if library is None:
        raise RuntimeError(
            f"three_js: trimesh {version('trimesh')} has no three.js viewer of the known form; "
            "install the version that constraints.txt names"
        )
    return library[1]


def _template(name: str) -> str:
    return resources.files("njf_models").joinpath("templates", name).read_text(encoding="utf-8")


# -------------------------------------------------------------------- words and figures

_EXPLANATION = (
    "Means are weighted by area. Energy: symmetric Dirichlet, 4 at an isometry. Stretch: "
    "max(σ₁, 1/σ₂). Area: max(det J, 1/det J). Angle: σ₁/σ₂. All three are 1 where nothing is "
    "distorted and ∞ at a flip. A chart whose triangles are all upright and whose boundary "
    "does not meet itself is one-to-one; both are decided in exact arithmetic. The other maps are "
    "of the same charts: SLIM from Tutte’s embedding, and LSCM scaled to the surface’s area, each "
    "chart moved rigidly onto this map’s."
)


def _counts(mesh: dp.Mesh, uvmap: dp.UVMap) -> str:
    length, area = seam_length(mesh, uvmap), float(mesh.areas.sum())
    charts = len(uvmap.charts)
    seams = f", {_number(length)} of seams" if length else ", no seams"
    return (
        f"{mesh.n_vertices:,} vertices, {mesh.n_faces:,} triangles, area {_number(area)}; "
        f"{charts:,} chart{'s' if charts > 1 else ''}{seams}"
    )


def _facts(ours: MeasuredMap) -> str:
    sure = ("good", "One-to-one") if ours.certified else ("bad", "Overlaps")
    facts = [
        (f'<b class="{sure[0]}">{sure[1]}</b>', "certified" if ours.certified else "not certified"),
        (f'<b class="{"bad" if ours.flipped else "good"}">{ours.flipped:,}</b>', "flipped"),
        (f"<b>{_number(ours.mean_distortion)}</b>", "mean stretch"),
        (f"<b>{_number(ours.max_distortion)}</b>", "largest stretch"),
        (f"<b>{_time(sum(ours.milliseconds.values()))}</b>", "to map"),
    ]
    return "\n".join(f"    <li>{value}<span>{label}</span></li>" for value, label in facts)


def _tabs(maps: Sequence[MeasuredMap]) -> str:
    return "\n".join(
        f'    <button type="button" role="tab" id="tab-{i}" aria-controls="views" '
        f'aria-selected="{str(i == 0).lower()}">{html.escape(m.title)}</button>'
        for i, m in enumerate(maps)
    )


def _table(maps: Sequence[MeasuredMap]) -> str:
    rows: list[tuple[str, list[str]]] = [
        ("Energy", [_number(m.energy) for m in maps]),
        ("Mean stretch", [_number(m.mean_distortion) for m in maps]),
        ("Largest stretch", [_number(m.max_distortion) for m in maps]),
        ("Mean area distortion", [_number(m.area_distortion) for m in maps]),
        ("Mean angle distortion", [_number(m.angle_distortion) for m in maps]),
        ("Flipped triangles", [f"{m.flipped:,}" for m in maps]),
        ("Charts whose boundary meets itself", [f"{m.overlapping:,}" for m in maps]),
        ("One-to-one", ["certified" if m.certified else "no" for m in maps]),
        ("Time", [_time(sum(m.milliseconds.values())) for m in maps]),
        ("by stage", [_stages(m) for m in maps]),
    ]
    head = "".join(f'<th scope="col">{html.escape(m.title)}</th>' for m in maps)
    body = "\n".join(
        f'<tr><th scope="row">{name}</th>' + "".join(f"<td>{c}</td>" for c in cells) + "</tr>"
        for name, cells in rows
    )
    return f"<table><thead><tr><td></td>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table>"


def _stages(measured: MeasuredMap) -> str:
    stages = measured.milliseconds.items()
    return "<br>".join(f"{html.escape(stage)} {_time(t)}" for stage, t in stages)


def _simplified_note(n_shown: int, n_faces: int) -> str:
    if n_shown == n_faces:
        return ""
    return (
        f'<p class="hint">The views show a simplified copy of {n_shown:,} triangles. All figures '
        f"are of the whole mesh of {n_faces:,}.</p>"
    )


def _number(value: float) -> str:
    """Four significant digits."""
    if not math.isfinite(value):
        return "∞"
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def _time(milliseconds: float) -> str:
    return f"{milliseconds:.3g} ms" if milliseconds < 999.5 else f"{milliseconds / 1000:.3g} s"


def seam_length(mesh: dp.Mesh, uvmap: dp.UVMap) -> float:
    """Length of the edges that were cut, in the surface's units."""
    cut, whole = _border(uvmap.mesh), _border(mesh)
    return (_length(uvmap.mesh, cut) - _length(mesh, whole)) / 2


def _border(mesh: dp.Mesh) -> Int[np.ndarray, "b 2"]:
    """Edges of one face, and of three or more."""
    faces = mesh.faces.numpy()
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    distinct, counts = np.unique(edges, axis=0, return_counts=True)
    return distinct[counts != 2]


def _length(mesh: dp.Mesh, edges: Int[np.ndarray, "b 2"]) -> float:
    ends = mesh.vertices.numpy()[edges]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


# -------------------------------------------------------------------- colours


def _colour_limit(maps: Sequence[MeasuredMap]) -> float:
    """The least candidate that leaves one face in twenty of the first map beyond the scale."""
    distortion = maps[0].distortion.numpy()
    reached = np.quantile(distortion, 0.95, method="inverted_cdf")
    return next((limit for limit in _LIMITS if reached <= limit), _LIMITS[-1])


def _levels(distortion: Float[np.ndarray, "m"], limit: float) -> Any:
    """Place of each face on the logarithmic scale, 0 … 254; 255 if it is flipped."""
    with np.errstate(invalid="ignore"):
        place = np.log(np.maximum(distortion, 1)) / math.log(limit)
    levels = np.rint(254 * np.clip(place, 0, 1))
    return np.where(np.isfinite(distortion), levels, _FLIPPED).astype(np.uint8)


def _ticks(limit: float) -> str:
    middle = math.sqrt(limit)
    return f"<span>1</span><span>{middle:.3g}</span><span>≥ {limit:g}</span>"


# -------------------------------------------------------------------- histogram


def histogram(
    maps: Sequence[MeasuredMap], areas: Float[np.ndarray, "m"], limit: float, bins: int = 48
) -> str:
    """Shares of the area over distortion on a logarithmic axis, the last bin for all beyond.

    Args:
        maps: one outline each.
        areas: (m,) weights of the faces.
        limit: end of the axis.
        bins: of equal width in log distortion.
    """
    edges = np.linspace(0, math.log(limit), bins + 1)
    shares = [_shares(m.distortion.numpy(), areas, edges) for m in maps]
    # The last bin may outgrow the others by far: it is cut off at their height, its share written.
    largest = max(float(share[:-1].max()) for share in shares) or 1.0  # zero if none are in range
    outlines = [_steps(100 * np.maximum(1 - share / largest, 0)) for share in shares]
    groups = "".join(
        f'<g class="map-{i}"><polygon class="area" points="0,100 {points} {bins + 1},100"/>'
        f'<polyline class="outline" points="{points}"/></g>'
        for i, points in enumerate(outlines)
    )
    titles = [html.escape(m.title) for m in maps]
    key = "".join(
        f'<li class="map-{i}"><i></i>{title}, {100 * share[-1]:.3g}% beyond {limit:g}</li>'
        for i, (title, share) in enumerate(zip(titles, shares, strict=True))
    )
    return (
        f'<ul class="key">{key}</ul>\n<div class="histogram"><svg viewBox="0 0 {bins + 1} 100" '
        f'preserveAspectRatio="none" role="img" aria-label="Histogram: {", ".join(titles)}">'
        f"{groups}</svg>"
        f'<span class="most">{100 * largest:.3g}%</span>{_marks(limit, bins)}</div>'
    )


def _steps(heights: Float[np.ndarray, "b"]) -> str:
    """The outline of bars of width one, as points of an SVG."""
    return " ".join(f"{k},{y:.2f} {k + 1},{y:.2f}" for k, y in enumerate(heights.tolist()))


def _marks(limit: float, bins: int) -> str:
    """Numbers below a logarithmic axis of `bins` bins and one more."""
    places = np.linspace(0, 100 * bins / (bins + 1), 5)[:-1]
    numbers = np.geomspace(1, limit, 5)[:-1]
    marks = "".join(
        f'<span style="left: {place:.1f}%">{number:.3g}</span>'
        for place, number in zip(places, numbers, strict=True)
    )
    return f'<div class="marks">{marks}<span>beyond {limit:g}</span></div>'


def _shares(
    distortion: Float[np.ndarray, "m"], areas: Float[np.ndarray, "m"], edges: np.ndarray
) -> Float[np.ndarray, "b"]:
    """Share of the area in each bin of log distortion, flipped faces in none."""
    upright = np.isfinite(distortion)
    place = np.log(np.maximum(distortion[upright], 1))
    index = np.clip(np.searchsorted(edges, place, side="right") - 1, 0, len(edges) - 1)
    return np.bincount(index, areas[upright], len(edges)) / areas.sum()


# -------------------------------------------------------------------- data of the views


def _shape_data(
    mesh: dp.Mesh, uvmap: dp.UVMap, faces: Int[np.ndarray, "k 3"], y_up: bool
) -> dict[str, Any]:
    """The surface that `templates/page.js` draws, in a ball of radius one around the origin."""
    used, index = np.unique(faces, return_inverse=True)
    index = index.reshape(-1, 3)
    positions = uvmap.mesh.vertices.numpy()
    centre = (positions.min(0) + positions.max(0)) / 2
    radius = np.linalg.norm(positions - centre, axis=1).max()
    eye, up = _viewpoint(mesh, y_up)
    return {
        "positions": _packed((positions[used] - centre) / radius, "<f4"),
        "faces": _packed(index, "<u4"),
        "seams": _packed(_outline(index), "<u4"),
        "ramp": [[int(c[k : k + 2], 16) / 255 for k in (1, 3, 5)] for c in _VIRIDIS],
        "eye": eye,
        "up": up,
    }


def _map_data(
    mesh: dp.Mesh, maps: Sequence[MeasuredMap], limit: float, shown: tuple[np.ndarray, np.ndarray]
) -> list[dict[str, str]]:
    """The maps that it draws, on a square of the surface's area."""
    kept, faces = shown
    used = np.unique(faces)
    unit = math.sqrt(float(mesh.areas.sum()))
    return [
        {
            "uv": _packed((m.uv.numpy() - m.uv.numpy().mean(0))[used] / unit, "<f4"),
            "colour": _packed(_levels(m.distortion.numpy(), limit)[kept], "u1"),
        }
        for m in maps
    ]


def _packed(values: np.ndarray, dtype: str) -> str:
    """An array as base64 of its little-endian numbers."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def _outline(faces: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "b 2"]:
    """Edges of one face: seams and the surface's own boundary."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    distinct, counts = np.unique(edges, axis=0, return_counts=True)
    return distinct[counts == 1]


def _viewpoint(mesh: dp.Mesh, y_up: bool) -> tuple[list[float], list[float]]:
    """Direction of the camera and its up: an open surface seen from its front."""
    up = np.array([0.0, 1.0, 0.0] if y_up else [0.0, 0.0, 1.0])
    aside = np.array([0.6, 0.4, 0.7] if y_up else [0.6, -0.7, 0.4])
    areas = mesh.areas.numpy()
    front = (mesh.normals.numpy() * areas[:, None]).sum(0) / areas.sum()
    eye = front + 0.8 * aside if np.linalg.norm(front) > 0.3 else aside
    eye = eye / np.linalg.norm(eye)
    if abs(eye @ up) > 0.9:
        up = np.array([0.0, 0.0, -1.0] if y_up else [0.0, 1.0, 0.0])
    return eye.tolist(), up.tolist()


def _simplified(uvmap: dp.UVMap, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """At most about `limit` faces: vertices of a chart in one cell of a grid become one of them.

    Returns:
        (k,) the faces that are left, and (k, 3) their vertices in the cut mesh.
    """
    faces = uvmap.mesh.faces.numpy()
    kept = np.arange(len(faces))
    vertices = uvmap.mesh.vertices.numpy()
    chart = np.zeros(len(vertices), dtype=np.int64)
    chart[faces] = uvmap.chart_of_face.numpy()[:, None]
    size = np.sqrt(float(uvmap.mesh.areas.sum()) / (limit / 2)) / 2
    left = faces
    while len(left) > limit:
        cells = np.floor((vertices - vertices.min(0)) / size).astype(np.int64)
        _, first, group = np.unique(
            np.column_stack([chart, cells]), axis=0, return_index=True, return_inverse=True
        )
        left = first[group.ravel()][faces]
        distinct = (left != np.roll(left, 1, axis=1)).all(axis=1)
        kept = np.flatnonzero(distinct)
        left = left[kept]
        size *= 1.25
    return kept, left
