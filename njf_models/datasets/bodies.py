"""Random human bodies in random poses, with exact correspondence for any triangulation of them.

The bodies are anny's (https://github.com/naver/anny; code Apache-2.0, assets CC0), which the extra
`bodies` installs. STAR and SMPL, the paper's, are licensed and not to be had here. A body is drawn
once, with all of its poses, and kept in a file, so that one source serves many targets.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from tqdm import tqdm

import diffpoisson as dp
from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.poses import JOINTS, sample_pose
from njf_models.datasets.store import StoreError, write_atomically
from njf_models.datasets.triangulation import Triangulation
from njf_models.rotation_vectors import rotation_matrices

POSE_SIZE = 3 * len(JOINTS)
_FORMAT = 1  # change it with anything that changes the bodies
_ARRAYS = ("phenotype", "faces", "rest", "poses", "posed")

# The range of each of anny's parameters; all adults, none extreme.
PHENOTYPES: dict[str, tuple[float, float]] = {
    "gender": (0.0, 1.0),
    "age": (0.55, 0.95),
    "muscle": (0.1, 0.9),
    "weight": (0.1, 0.9),
    "height": (0.2, 0.8),
    "proportions": (0.2, 0.9),
}


class BodyModel:
    """The parametric body: phenotype and pose to vertices, by linear blend skinning, in metres.

    Building it the first time takes a minute or more, in which anny reads its targets and warp
    compiles kernels; both keep the result in ~/.cache (or ANNY_CACHE_DIR, WARP_CACHE_PATH), more
    than half a gigabyte. Nothing is downloaded.

    Args:
        topology: one of anny's. By default a closed surface of genus 0 with 26,692 faces: eyes and
            tongue, its other components, are left out.

    Raises:
        ModuleNotFoundError: anny is not installed.
    """

    def __init__(self, topology: str = "anny-noeyes-notongue") -> None:
        if importlib.util.find_spec("anny") is None:
            raise ModuleNotFoundError(
                'BodyModel needs the package anny: pip install "diffpoisson[bodies]"'
            )
        import warp  # noqa: PLC0415  (seconds to import, and only here)

        warp.config.log_level = warp.LOG_ERROR  # it would print a dozen lines, also without errors
        import anny  # noqa: PLC0415
        from anny.utils.collision import SelfInterpenetrationModule  # noqa: PLC0415

        model = anny.Anny(topology=topology, skinning_method="lbs")
        if tuple(model.phenotype_labels) != tuple(PHENOTYPES):
            raise RuntimeError(
                f"BodyModel: this version of anny has the phenotypes {model.phenotype_labels}, not "
                f"{list(PHENOTYPES)}; install the one that constraints.txt names"
            )
        self._anny = model.to(dtype=torch.float32).eval()
        self._joints = [model.bone_labels.index(name) for name in JOINTS]
        self._collisions = SelfInterpenetrationModule(self._anny)

    @cached_property
    def reference(self) -> dp.Mesh:
        """The average body in its rest pose, for triangulations to be embedded in; float64."""
        middle = torch.tensor([sum(limits) / 2 for limits in PHENOTYPES.values()])
        vertices = self.vertices(middle, torch.zeros(1, POSE_SIZE))[0].double()
        faces = torch.as_tensor(self._anny.get_triangular_faces()).long()
        return dp.Mesh(vertices, faces)

    @torch.no_grad()
    def vertices(
        self, phenotype: Float[Tensor, "k=6"], poses: Float[Tensor, "p 60"]
    ) -> Float[Tensor, "p n 3"]:
        """Vertices of one identity in several poses.

        Args:
            phenotype: (6,) values of `PHENOTYPES`.
            poses: (p, 60) rotation vectors of `JOINTS`, see `poses`; zero is the rest pose.

        Returns:
            (p, n, 3) float32.
        """
        transforms = torch.eye(4).repeat(len(poses), self._anny.bone_count, 1, 1)
        transforms[:, self._joints, :3, :3] = rotation_matrices(
            poses.float().unflatten(-1, (-1, 3))
        )
        phenotypes = phenotype.float().expand(len(poses), -1)
        return self._anny(pose_parameters=transforms, phenotype_kwargs=phenotypes)["vertices"]

    def intersecting(self, vertices: Float[Tensor, "n 3"]) -> float:
        """Share of the faces that cut another one; of faces that follow one bone, none counts."""
        return float((self._collisions.detect_self_intersections(vertices) >= 0).float().mean())


@dataclass(frozen=True, eq=False)
class Body:
    """One identity in several poses, on one triangulation.

    Attributes:
        number: which identity of its data set.
        phenotype: (6,) float32 values of `PHENOTYPES`.
        faces: (m, 3) int64.
        rest: (n, 3) float32 vertices in the rest pose, in metres.
        poses: (p, 60) float32 pose parameters.
        posed: (p, n, 3) float32 vertices in these poses.
        carried: (s, n, 3) float32 where networks took its vertices from the first s poses, for
            others to start from; None where none did.
    """

    number: int
    phenotype: Float[Tensor, "k=6"]
    faces: Int[Tensor, "m 3"]
    rest: Float[Tensor, "n 3"]
    poses: Float[Tensor, "p 60"]
    posed: Float[Tensor, "p n 3"]
    carried: Float[Tensor, "s n 3"] | None = None


@dataclass(frozen=True)
class BodySettings:
    """What the bodies of a data set have in common.

    Attributes:
        seed: identity i and its poses depend on (seed, i) only, whatever the triangulation:
            different seeds give training, validation and test sets apart in both.
        n_poses: of each identity.
        heading: largest turn about the vertical, in radians; see `poses.sample_pose`.
        max_intersecting: poses in which a larger share of the faces cuts others are drawn again,
            and so is an identity whose rest pose is one. A limb through the trunk cuts it in rings
            of few faces.
    """

    seed: int = 0
    n_poses: int = 32
    heading: float = 0.0
    max_intersecting: float = 0.0


def draw_body(
    model: BodyModel, triangulation: Triangulation, settings: BodySettings, number: int
) -> Body:
    """Identity number `number` of a data set, in poses without self-intersections."""
    rng = np.random.default_rng([settings.seed, number])
    rest = None
    while rest is None:
        phenotype = torch.tensor([rng.uniform(*limits) for limits in PHENOTYPES.values()])
        rest = _screened(model, phenotype, torch.zeros(POSE_SIZE), settings)
    poses: list[Tensor] = []
    vertices = [rest]
    while len(poses) < settings.n_poses:
        pose = torch.from_numpy(sample_pose(rng, settings.heading)).float().flatten()
        posed = _screened(model, phenotype, pose, settings)
        if posed is not None:
            poses.append(pose)
            vertices.append(posed)
    rest, *others = triangulation.deformed(torch.stack(vertices).double()).float()
    return Body(
        number, phenotype, triangulation.faces, rest, torch.stack(poses), torch.stack(others)
    )


def _screened(
    model: BodyModel, phenotype: Tensor, pose: Tensor, settings: BodySettings
) -> Tensor | None:
    """Vertices in a pose, unless too many faces cut each other."""
    vertices = model.vertices(phenotype, pose[None])[0]
    return vertices if model.intersecting(vertices) <= settings.max_intersecting else None


def retriangulated(model: BodyModel, triangulation: Triangulation, body: Body) -> Body:
    """The same identity in the same poses, on another triangulation."""
    poses = torch.cat([torch.zeros(1, POSE_SIZE), body.poses])
    vertices = triangulation.deformed(model.vertices(body.phenotype, poses).double()).float()
    return replace(body, faces=triangulation.faces, rest=vertices[0], posed=vertices[1:])


# -------------------------------------------------------------------- files


class BodyStore:
    """A folder of bodies, one file each, read when asked for.

    Args:
        folder: as `build_bodies` made it.
        n_bodies: read the first only; all of them if omitted.

    Raises:
        StoreError: there are no bodies in it.
    """

    def __init__(self, folder: Path | str, n_bodies: int | None = None) -> None:
        self.paths = sorted(Path(folder).glob("body-*.safetensors"))[:n_bodies]
        if not self.paths:
            raise StoreError(f"{folder} holds no bodies: make some with build_bodies")

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> Body:
        arrays = _read(self.paths[index])[0]
        arrays["faces"] = arrays["faces"].long()
        return Body(number=int(self.paths[index].stem.split("-")[1]), **arrays)

    def __iter__(self) -> Iterator[Body]:
        return (self[i] for i in range(len(self)))


def build_bodies(
    folder: Path | str,
    n_bodies: int,
    n_faces: int,
    settings: BodySettings | None = None,
    *,
    progress: bool = True,
) -> BodyStore:
    """A data set of bodies on one decimated triangulation; the average body's, for all of them.

    Bodies that are there already are kept: an interrupted call goes on where it stopped when it is
    repeated, and a call with more bodies adds to a data set, whose first ones stay the same. Where
    nothing is missing, anny is not needed.

    Args:
        folder: of the data set.
        n_bodies: how many identities.
        n_faces: of the triangulation.
        settings: of all bodies.
        progress: show a progress bar.

    Raises:
        StoreError: the folder holds bodies of other settings.
        ModuleNotFoundError: anny is not installed.
    """
    folder, settings = Path(folder), settings or BodySettings()
    key = fingerprint(_FORMAT, settings, n_faces)
    missing = [n for n in range(n_bodies) if not _present(_path(folder, n), key)]
    if missing:
        model = BodyModel()
        triangulation = Triangulation.decimated(model.reference, n_faces)
        for number in tqdm(missing, desc="bodies", disable=not progress):
            body = draw_body(model, triangulation, settings, number)
            write_atomically(_path(folder, number), _encode(body, key))
    return BodyStore(folder, n_bodies)


def build_retriangulated(
    folder: Path | str,
    bodies: BodyStore,
    n_faces: int,
    grading: float = 0.0,
    *,
    progress: bool = True,
) -> BodyStore:
    """The bodies of a data set, in the same poses, on another triangulation; kept in files.

    Interrupted, it goes on where it stopped when it is repeated.

    Args:
        folder: for the files.
        bodies: the data set.
        n_faces: of the triangulation.
        grading: of `Triangulation.decimated`.
        progress: show a progress bar.

    Raises:
        StoreError: the folder holds other bodies.
        ModuleNotFoundError: some are missing, and anny is not installed.
    """
    folder = Path(folder)
    key = fingerprint(_FORMAT, _read(bodies.paths[0])[1], n_faces, grading)
    missing = [body for body in bodies if not _present(_path(folder, body.number), key)]
    if missing:
        model = BodyModel()
        triangulation = Triangulation.decimated(model.reference, n_faces, grading)
        for body in tqdm(missing, desc=f"on {n_faces} faces", disable=not progress):
            moved = retriangulated(model, triangulation, body)
            write_atomically(_path(folder, body.number), _encode(moved, key))
    return BodyStore(folder, len(bodies))


def _path(folder: Path, number: int) -> Path:
    return folder / f"body-{number:06d}.safetensors"


def _encode(body: Body, key: str) -> bytes:
    arrays = {name: getattr(body, name) for name in _ARRAYS} | {"faces": body.faces.int()}
    return save({name: x.contiguous() for name, x in arrays.items()}, metadata={"key": key})


def _read(path: Path) -> tuple[dict[str, Tensor], str]:
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in _ARRAYS}, file.metadata()["key"]
    except (SafetensorError, OSError) as error:
        raise StoreError(
            f"{path} cannot be read ({error}): delete it and build the bodies again"
        ) from error


def _present(path: Path, key: str) -> bool:
    if not path.exists():
        return False
    if _read(path)[1] != key:
        raise StoreError(
            f"build_bodies: {path.parent} holds bodies of other settings; use another folder"
        )
    return True
