"""The window of `njf view`: viser's page of a mesh, its handles and its UV map."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import torch
import trimesh
import viser
from jaxtyping import Float
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffpoisson as dp
from njf_models.meshfiles import checker_picture
from njf_models.posing import Kind, PosedMesh, hit_vertex
from njf_models.pretrained import parameterize
from njf_models.window import Window

_AT_REST = 1e-4  # of the diagonal: moves that no one sees end the following
_SQUARES = 32  # of the checkerboard, along the unit square


class Viewer(Window):
    """A page that shows a mesh, and moves it with its handles.

    Args:
        mesh: a surface in space.
        title: of the page.
        host: whose browsers may open it; 127.0.0.1 for this machine's.
        port: of the page; another one where it is taken.

    Attributes:
        pose: the mesh and its handles.
    """

    def __init__(
        self, mesh: dp.Mesh, title: str = "mesh", host: str = "127.0.0.1", port: int = 8080
    ) -> None:
        self.pose = PosedMesh(mesh)
        self._faces = mesh.faces.numpy()
        self._gizmos: dict[str, viser.TransformControlsHandle] = {}
        super().__init__(f"njf view: {title}", self.pose.vertices, mesh.faces, host, port)
        self._surface.on_click(self._clicked)
        self._add_controls(title)

    def follow(self) -> None:
        """One step of the surface; the next one is due until it rests."""
        with self._lock:
            moved = self.pose.follow()
            self._surface.vertices = self.pose.vertices.numpy().astype(np.float32)
        if moved > _AT_REST:
            self._changed.set()
        self._status.content = (
            f"{self.pose.mesh.n_vertices:,} vertices, {self.pose.mesh.n_faces:,} triangles, "
            f"{len(self.pose.handles)} handles"
        )

    # ---------------------------------------------------------------- handles

    def add_handle(self, vertex: int) -> str | None:
        """A handle around a vertex, and what one drags it by."""
        with self._lock:
            name = self.pose.add(vertex)
            if name is None:
                return None
            handle = self.pose.handles[name]
        x, y, z, w = Rotation.from_matrix(handle.rotation.numpy()).as_quat()
        gizmo = self._server.scene.add_transform_controls(
            f"/handles/{name}",
            scale=0.12 * self.pose.diagonal,
            wxyz=(w, x, y, z),
            position=(handle.centre + handle.translation).numpy(),
            depth_test=False,
        )
        gizmo.on_update(lambda _: self._move(name))
        self._gizmos[name] = gizmo
        self._changed.set()
        return name

    def move_handle(
        self, name: str, position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"]
    ) -> None:
        """Bring a handle somewhere, as a drag does."""
        gizmo = self._gizmos[name]
        gizmo.position, gizmo.wxyz = position, wxyz
        self._move(name)

    def _move(self, name: str) -> None:
        gizmo = self._gizmos[name]
        w, x, y, z = gizmo.wxyz
        rotation = torch.from_numpy(Rotation.from_quat([x, y, z, w]).as_matrix())
        with self._lock:
            self.pose.move(name, torch.as_tensor(gizmo.position).double(), rotation)
        self._changed.set()

    def _reset(self) -> None:
        with self._lock:
            self.pose.reset()
        for gizmo in self._gizmos.values():
            gizmo.remove()
        self._gizmos.clear()
        self._changed.set()

    def _clicked(self, event: viser.SceneNodePointerEvent[viser.MeshHandle]) -> None:
        vertex = hit_vertex(
            self.pose.vertices.numpy(),
            self._faces,
            np.array(event.ray_origin),
            np.array(event.ray_direction),
        )
        if vertex is not None:
            self.add_handle(vertex)

    # ---------------------------------------------------------------- the page

    def _add_controls(self, title: str) -> None:
        gui = self._server.gui
        gui.add_markdown(f"**{title}**\n\nClick on the surface to add a handle; drag it.")
        self._status = gui.add_markdown("")
        kinds: tuple[Kind, ...] = ("as rigid as possible", "Poisson")
        kind = gui.add_dropdown("The rest follows", kinds, initial_value=kinds[0])
        reset, uv = gui.add_button("Reset"), gui.add_checkbox("UV map", initial_value=False)
        reset.on_click(lambda _: self._reset())
        uv.on_update(lambda _: self.show_uv(uv.value))

        @kind.on_update
        def _(_: object) -> None:
            self.pose.kind = kind.value
            self._changed.set()

    # ---------------------------------------------------------------- UV map

    def show_uv(self, shown: bool) -> None:
        """The surface as it is with a checkerboard, and its layout beside it; or neither."""
        for part in ("/textured", "/layout"):
            self._server.scene.remove_by_name(part)
        self._surface.visible = not shown
        for gizmo in self._gizmos.values():
            gizmo.visible = not shown
        with self._lock:
            mesh = dp.Mesh(self.pose.vertices, self.pose.mesh.faces)
        if not shown:
            self._aim(mesh.vertices)
            return
        uvmap = parameterize(mesh, cut=True)
        layout = _beside(mesh.vertices, uvmap.uv)
        self._server.scene.add_mesh_trimesh("/textured", _textured(uvmap))
        self._server.scene.add_mesh_trimesh("/layout", _coloured(uvmap, layout))
        self._aim(torch.cat([mesh.vertices, layout]))


def _beside(vertices: Float[Tensor, "n 3"], uv: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
    """The layout, upright on the right of the surface, and as large as that."""
    low, high = vertices.amin(0), vertices.amax(0)
    size = float(torch.linalg.vector_norm(high - low))
    flat = size * _in_unit_square(uv)
    middle = flat.amax(0) / 2
    x, y = high[0] + size / 10, (low[1] + high[1]) / 2
    z = (low[2] + high[2]) / 2
    return torch.stack([x + flat[:, 0], y - middle[1] + flat[:, 1], z.expand(len(flat))], dim=1)


def _in_unit_square(uv: Float[Tensor, "k 2"]) -> Float[Tensor, "k 2"]:
    low = uv.amin(0)
    return (uv - low).double() / (uv.amax(0) - low).amax()


def _textured(uvmap: dp.UVMap) -> trimesh.Trimesh:
    """The surface under a checkerboard."""
    uv = _in_unit_square(uvmap.uv)
    picture = Image.fromarray(checker_picture(_SQUARES)).convert("RGB")
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(uv=uv.numpy(), material=material)
    mesh = uvmap.mesh
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), visual=visual, process=False)


def _coloured(uvmap: dp.UVMap, layout: Float[Tensor, "n 3"]) -> trimesh.Trimesh:
    """The layout, its triangles coloured by max(σ₁, 1/σ₂), from one to two."""
    distortion = dp.isometric_distortion(dp.jacobians(uvmap.mesh, uvmap.uv.double()))
    level = distortion.log2().clamp(max=1).numpy()
    colours = (255 * mpl.colormaps["viridis"](level)).astype(np.uint8)
    vertices = layout.numpy()[uvmap.mesh.faces.numpy()].reshape(-1, 3)
    return trimesh.Trimesh(
        vertices,
        np.arange(len(vertices)).reshape(-1, 3),
        vertex_colors=np.repeat(colours, 3, axis=0),
        process=False,
    )
