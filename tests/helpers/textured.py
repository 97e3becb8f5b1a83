"""Textured meshes for tests, written by hand or by trimesh: seams, quads, groups, two materials."""

import io
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

RED, BLUE = (200, 30, 30), (30, 30, 200)


def png(color: tuple[int, int, int], size: int = 8) -> bytes:
    """A picture with one corner of another colour, so that its orientation shows."""
    image = Image.new("RGB", (size, size), color)
    image.putpixel((0, 0), (255, 255, 255))
    stream = io.BytesIO()
    image.save(stream, format="PNG")
    return stream.getvalue()


def tube(n_around: int = 12, n_along: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A closed bar of round section: vertices, quads (with caps of quads left to fans), angles of the vertices."""
    angle = np.arange(n_around) * 2 * np.pi / n_around
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heights = np.linspace(0, 6, n_along)
    rings = [np.column_stack([ring * (1 + 0.1 * np.sin(h)), np.full(n_around, h)]) for h in heights]
    vertices = np.concatenate([*rings, [[0, 0, -0.5], [0, 0, 6.5]]])
    first = np.arange(n_around * (n_along - 1))
    following = first - first % n_around + (first + 1) % n_around
    quads = np.stack([first, following, following + n_around, first + n_around], axis=1)
    return vertices, quads, angle


def bend(x: np.ndarray, turn: float = 0.9) -> np.ndarray:
    """Bend a bar of length 6 along z by an angle."""
    radius = 6 / turn
    angle, height = x[:, 2] / radius, radius - x[:, 0]
    return np.stack([radius - height * np.cos(angle), x[:, 1], height * np.sin(angle)], 1)


def textured_obj(folder: Path, name: str, shape: np.ndarray | None = None, blanks: bool = True) -> Path:
    """An OBJ with quads, caps of triangles, texture coordinates with a seam, shared normals, groups, two materials."""
    n = 12
    vertices, quads, _ = tube(n)
    vertices = vertices if shape is None else shape
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "textures").mkdir(exist_ok=True)
    (folder / "textures" / "red skin.png").write_bytes(png(RED))
    (folder / "blue.png").write_bytes(png(BLUE))
    (folder / "my bar.mtl").write_text(
        "# two materials\nnewmtl skin\nKa 0 0 0\nKd 1 1 1\nNs 10\nmap_Kd -s 1 1 1 textures/red skin.png\n\n"
        "newmtl cap\nKd 0.5 0.6 0.7\nmap_Kd blue.png\n"
    )
    lines = ["# a bar", "mtllib my bar.mtl", "o bar"]
    lines += [f"v {x!r} {y!r} {z!r} 0.5 0.25 1.0" for x, y, z in vertices.tolist()]
    lines += [f"vt {i / n!r} {r / 7!r}" for r in range(8) for i in range(n + 1)] + ["vt 0.5 0.5"]
    # Faces around a ring share a normal along the bar: each vn belongs to several vertices.
    around = [(float(np.cos(2 * np.pi * i / n)), float(np.sin(2 * np.pi * i / n))) for i in range(n)]
    lines += [f"vn {x!r} {y!r} 0.0" for x, y in around] + ["vn 0 0 -1", "vn 0 0 1"]
    lines += ["g body", "usemtl skin", "s 1"]
    for k, quad in enumerate(quads.tolist()):
        r, i = divmod(k, n)
        texcoords = [r * (n + 1) + i, r * (n + 1) + i + 1, (r + 1) * (n + 1) + i + 1, (r + 1) * (n + 1) + i]
        normals = [i, (i + 1) % n, (i + 1) % n, i]
        corners = zip(quad, texcoords, normals, strict=True)
        lines.append("f " + " ".join(f"{v + 1}/{t + 1}/{m + 1}" for v, t, m in corners))
    lines += ["g caps", "usemtl cap", "s off"]
    last, t = 7 * n, 8 * (n + 1) + 1
    for i in range(n):
        j = (i + 1) % n
        lines.append(f"f {8 * n + 1}/{t}/{n + 1} {j + 1}/{t}/{n + 1} {i + 1}/{t}/{n + 1}")
        lines.append(f"f {8 * n + 2}/{t}/{n + 2} {last + i + 1}/{t}/{n + 2} {last + j + 1}/{t}/{n + 2}")
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    if not blanks:  # trimesh does not read names with blanks, nor options of textures
        path.write_text(path.read_text().replace("my bar.mtl", "bar.mtl"))
        text = (folder / "my bar.mtl").read_text().replace("-s 1 1 1 textures/red skin", "red")
        (folder / "bar.mtl").write_text(text)
        (folder / "textures" / "red skin.png").replace(folder / "red.png")
    return path


def triangles_of_tube(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """The closed bar as triangles: vertices, faces."""
    vertices, quads, _ = tube(n)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    around = np.arange(n)
    following, last = (around + 1) % n, 7 * n
    bottom = np.stack([np.full(n, 8 * n), following, around], axis=1)
    top = np.stack([np.full(n, 8 * n + 1), last + around, last + following], axis=1)
    return vertices, np.concatenate([faces, bottom, top])


def split_at_seams(faces: np.ndarray, n: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As Blender's exporters split: a vertex for each texture coordinate, and the caps apart by their hard edge.

    Returns:
        The original vertex of each new one, the new faces, texture coordinates.
    """
    cap = np.arange(len(faces))[:, None] >= 2 * n * 7
    column = faces % n
    wraps = (column == 0) & (np.ptp(column, axis=1, keepdims=True) > 1)
    u, v = np.where(cap, 0.5, np.where(wraps, 1.0, column / n)), np.where(cap, 0.5, faces // n / 7)
    corners = np.stack([faces, u, v, np.broadcast_to(cap, faces.shape)], -1).reshape(-1, 4)
    split, rows = np.unique(corners, axis=0, return_inverse=True)
    return split[:, 0].astype(int), rows.reshape(-1, 3), split[:, 1:3]


def textured_glb(path: Path, shape: np.ndarray | None = None) -> Path:
    """By trimesh: a split body with a texture, caps with another, each in a node that moves and scales it."""
    vertices, faces = triangles_of_tube()
    vertices = vertices if shape is None else shape
    original, split, uv = split_at_seams(faces)
    scene = trimesh.Scene()
    n_body = 2 * 12 * 7
    for name, rows, color in (("body", split[:n_body], RED), ("caps", split[n_body:], BLUE)):
        used, own = np.unique(rows, return_inverse=True)
        transform = np.diag([2.0, 2.0, 2.0, 1.0])
        transform[:3, 3] = [1, 2, 3]
        local = (vertices[original[used]] - [1, 2, 3]) / 2
        material = trimesh.visual.material.PBRMaterial(
            name=name,
            baseColorTexture=Image.open(io.BytesIO(png(color))),
            metallicFactor=0.25,
            roughnessFactor=0.5,
            baseColorFactor=[255, 255, 255, 255],
        )
        visual = trimesh.visual.TextureVisuals(uv=uv[used], material=material)
        mesh = trimesh.Trimesh(local, own.reshape(-1, 3), process=False, visual=visual)
        assert len(mesh.vertex_normals) == len(used)  # so that they are exported
        scene.add_geometry(mesh, node_name=f"{name}-node", geom_name=name, transform=transform)
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
    return path
