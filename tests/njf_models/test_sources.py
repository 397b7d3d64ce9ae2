from __future__ import annotations

import dataclasses
import importlib.machinery
import importlib.util
import inspect
import itertools
import subprocess
import sys
import types
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh

from njf_models.datasets.sources import Bent, CSGParts, DogBones, MeshFolder, RawMesh, Thingi10K
from tests import meshes

needs_dm_control = pytest.mark.skipif(
    importlib.util.find_spec("dm_control") is None, reason="needs the dm_control wheel"
)


def assert_closed_manifold(raw: RawMesh) -> None:
    faces = np.ascontiguousarray(raw.faces)
    assert igl.is_edge_manifold(faces)[0]
    assert igl.is_vertex_manifold(faces).all()
    assert len(igl.boundary_facets(faces)[0]) == 0
    assert (igl.doublearea(raw.vertices, faces) > 0).all()


# ------------------------------------------------------- bent copies


def lengths(raw: RawMesh) -> np.ndarray:
    a, b = raw.vertices[raw.faces[:, 0]], raw.vertices[raw.faces[:, 1]]
    return np.linalg.norm(a - b, axis=1)


def test_bent_copies_follow_their_original_and_belong_to_its_family() -> None:
    parts = list(CSGParts(2, n_faces=500))
    bent = list(Bent(parts, 3, seed=4))
    assert [raw.name for raw in bent[:4]] == [
        "csg/0/0000",
        *(f"csg/0/0000~4.{i}" for i in range(3)),
    ]
    assert bent[0] is parts[0]
    assert bent[4] is parts[1]
    assert {raw.family for raw in bent[:4]} == {"csg/0/0000"}
    assert bent[2].origin == f"{parts[0].origin}, bent (seed 4, copy 1)"
    for raw in bent:
        assert_closed_manifold(raw)
    # Bending stretches by amounts that differ over the surface, not by one affine map.
    stretch = lengths(bent[1]) / lengths(parts[0])
    assert 0.3 < stretch.min() < stretch.max() < 2.5
    affine = np.column_stack([parts[0].vertices, np.ones(len(parts[0].vertices))])
    fitted = affine @ np.linalg.lstsq(affine, bent[1].vertices)[0]
    assert np.abs(fitted - bent[1].vertices).max() > 0.02 * np.ptp(bent[1].vertices)


def test_a_bent_copy_depends_on_the_mesh_and_its_number_only() -> None:
    first, second = list(CSGParts(2, n_faces=500))
    alone = list(Bent([second], 2))[2]
    (again,) = (raw for raw in Bent([first, second], 3) if raw.name == alone.name)
    np.testing.assert_array_equal(alone.vertices, again.vertices)
    moved = dataclasses.replace(second, vertices=1000 * second.vertices + 7)
    np.testing.assert_allclose(
        list(Bent([moved], 2))[2].vertices, 1000 * alone.vertices + 7, rtol=1e-9
    )
    assert len({tuple(raw.vertices[0]) for raw in Bent([first], 5)}) == 6


# ------------------------------------------------------- bones


@needs_dm_control
def test_bones_are_the_left_half_of_the_skeleton() -> None:
    source = DogBones(min_faces=1180, n_faces=1)
    stems = {path.stem for path in source.folder.glob("BONE*.stl")}
    assert {"BONETibia_L", "BONETibia_R", "BONEhumerus_R"} <= stems
    bones = {bone.name: bone for bone in source}
    assert {"dog/Tibia_L", "dog/L_1", "dog/Pelvis", "dog/MergedSkull"} <= bones.keys()
    assert not any("_R" in name for name in bones)
    assert {bones[name].family for name in ("dog/L_1", "dog/L_7")} == {"dog/L"}
    assert {bone.licence for bone in bones.values()} == {"Apache-2.0"}
    assert len(bones["dog/L_1"].faces) == 3228
    assert_closed_manifold(bones["dog/L_1"])


@needs_dm_control
def test_coarse_bones_are_subdivided() -> None:
    coarse, fine = (
        next(bone for bone in DogBones(min_faces=1500, n_faces=n) if bone.name == "dog/Ca_1")
        for n in (1508, 1509)
    )
    assert (len(coarse.faces), len(fine.faces)) == (1508, 4 * 1508)
    np.testing.assert_allclose(np.ptp(fine.vertices, 0), np.ptp(coarse.vertices, 0), rtol=0.1)


@needs_dm_control
def test_bones_are_found_without_importing_the_simulator() -> None:
    program = (
        "import sys; from njf_models.datasets.sources import DogBones;"
        "next(iter(DogBones())); assert 'dm_control' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=Path(__file__).parents[2])


def test_bones_say_how_to_get_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="pip install dm_control"):
        DogBones()


# ------------------------------------------------------- constructive solid geometry


def test_parts_are_closed_even_and_of_the_size_asked_for() -> None:
    for part in CSGParts(4, n_faces=2000):
        assert_closed_manifold(part)
        assert len(part.faces) <= 2000
        assert len(part.faces) > 1900
        lengths = igl.edge_lengths(part.vertices, part.faces)
        assert lengths.max() < 4 * lengths.mean()


def test_parts_depend_on_seed_and_index_only() -> None:
    first, again = CSGParts(3, seed=5, n_faces=500), CSGParts(2, seed=5, n_faces=500)
    for a, b in zip(itertools.islice(first, 2), again, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.faces, b.faces)
    other = next(iter(CSGParts(1, seed=6, n_faces=500)))
    assert other.name != a.name
    assert not np.array_equal(other.vertices, next(iter(first)).vertices)


# ------------------------------------------------------- folders


def test_a_folder_is_read_in_all_formats_and_bad_files_are_counted(tmp_path: Path) -> None:
    vertices, faces = meshes.sphere()
    (tmp_path / "sub").mkdir()
    for name in ("a.obj", "b.ply", "c.off", "sub/d.STL"):
        exported = trimesh.Trimesh(vertices, faces, process=False)
        exported.export(tmp_path / name, file_type=name[-3:].lower())
    (tmp_path / "garbage.stl").write_bytes(b"\x07" * 200)
    (tmp_path / "empty.obj").write_text("# nothing\n")
    (tmp_path / "notes.txt").write_text("not a mesh")

    source = MeshFolder(tmp_path, licence="MIT")
    with pytest.warns(UserWarning, match=r"skipped .*(garbage\.stl|empty\.obj)") as warned:
        raw = list(source)
    assert len(warned) == 2
    assert sorted(Path(name).name for name in source.failures) == ["empty.obj", "garbage.stl"]
    assert [mesh.name.removeprefix("folder/") for mesh in raw] == [
        *("a.obj", "b.ply", "c.off", "sub/d.STL")
    ]
    area = igl.doublearea(vertices, faces).sum()
    for mesh in raw:
        assert len(mesh.vertices) == len(vertices)  # an STL repeats every vertex of every face
        assert mesh.licence == "MIT"
        assert_closed_manifold(mesh)
        assert igl.doublearea(mesh.vertices, mesh.faces).sum() == pytest.approx(area, rel=1e-5)


def test_a_folder_without_meshes_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no \.obj, \.off, \.ply, \.stl file below"):
        MeshFolder(tmp_path)


def test_raw_meshes_have_one_dtype() -> None:
    vertices, faces = meshes.disk()
    with pytest.raises(ValueError, match=r"faces must be .* int64, got .* int32"):
        RawMesh("a", vertices, faces.astype(np.int32), "MIT", "test", "a")


# ------------------------------------------------------- Thingi10K


def test_thingi10k_asks_its_package_for_manifolds_and_counts_failures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vertices, faces = meshes.sphere()
    calls = {}
    entries = [
        {"file_id": i, "thing_id": i // 2, "file_path": f"{i}", "license": "CC-BY", "author": "A"}
        for i in range(3)
    ]

    def init(**arguments: object) -> None:
        calls["init"] = arguments

    def dataset(**arguments: object) -> list[dict]:
        calls["dataset"] = arguments
        return entries

    def load_file(path: str) -> meshes.Arrays:
        if path == "1":
            raise ValueError("Failed to load mesh file")
        return vertices, faces.astype(np.int32)

    package = types.ModuleType("thingi10k")
    package.__spec__ = importlib.machinery.ModuleSpec("thingi10k", None)
    package.init, package.dataset, package.load_file = init, dataset, load_file
    monkeypatch.setitem(sys.modules, "thingi10k", package)

    source = Thingi10K(max_faces=1000, download_folder=Path("here"))
    with pytest.warns(UserWarning, match="skipped thingi10k/1: ValueError: Failed to load"):
        raw = list(source)
    assert calls["init"] == {"variant": "npz", "cache_dir": "here"}
    assert calls["dataset"]["num_facets"] == (None, 1000)
    assert [mesh.name for mesh in raw] == ["thingi10k/0", "thingi10k/2"]
    assert [mesh.family for mesh in raw] == ["thingi10k/thing/0", "thingi10k/thing/1"]
    assert list(source.failures) == ["thingi10k/1"]
    assert raw[0].licence == "CC-BY"

    # The stand-in was called as the real package allows, where that is installed.
    monkeypatch.delitem(sys.modules, "thingi10k")
    real = pytest.importorskip("thingi10k")
    inspect.signature(real.init).bind(**calls["init"])
    inspect.signature(real.dataset).bind(**calls["dataset"])
    inspect.signature(real.load_file).bind("path")


def test_a_manifest_tells_where_meshes_are_from(tmp_path):
    for name in ("goat_1", "goat_2", "boot"):
        trimesh.Trimesh(*meshes.sphere()).export(tmp_path / f"{name}.ply")
    rows = ["name\tlicence\tsource", "goat_1\tCC BY 4.0\tgithub someone/meshes"]
    (tmp_path / "manifest.tsv").write_text("\n".join(rows) + "\n")
    boot, first, second = MeshFolder(tmp_path, licence="MIT")
    assert (first.licence, first.origin) == ("CC BY 4.0", "github someone/meshes: goat_1.ply")
    assert (boot.licence, boot.origin) == ("MIT", "boot.ply")
    assert first.family == second.family != boot.family


@pytest.mark.parametrize(
    ("stem", "family"),
    [
        ("dog_L_6", "dog"),
        ("link12", "link"),
        ("koala_low_resolution", "koala"),
        ("cat-lowres", "cat"),
        ("wrist_v2", "wrist"),
        ("bowl", "bowl"),  # ends in l, but not as a side
        ("hammer", "hammer"),
        ("7", "7"),  # nothing would be left
    ],
)
def test_names_of_near_copies_are_one_family(tmp_path, stem, family):
    trimesh.Trimesh(*meshes.sphere()).export(tmp_path / f"{stem}.ply")
    (mesh,) = MeshFolder(tmp_path)
    assert mesh.family == f"folder/{family}"
