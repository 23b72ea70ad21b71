"""Meshes to show: the visual meshes of a robot's URDF, and sticks, balls, boxes and arrows."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from slomo.errors import InvalidData
from slomo.raycast import Part
from slomo.robot import Robot
from slomo.terrain import Terrain

GREY = (0.62, 0.63, 0.65)
CELL = 0.0025  # m, what a picture of half a metre in 300 px can show


def robot_parts(robot: Robot) -> tuple[dict[str, Part], dict[str, str]]:
    """The robot's visual meshes as parts in their links' frames, and part name -> link name.

    A named material of the URDF colours a mesh, else the mesh's own, else grey. Detail below `CELL` is merged.

    Raises:
        InvalidData: a mesh that the URDF names is missing or cannot be read.
    """
    root = ET.parse(robot.urdf).getroot()
    named = {m.get("name", ""): _color(m) for m in root.iter("material") if _color(m) is not None}
    files: dict[Path, list[trimesh.Trimesh]] = {}
    parts: dict[str, Part] = {}
    links: dict[str, str] = {}
    for link in root.iter("link"):
        for i, visual in enumerate(link.iter("visual")):
            shape = visual.find("geometry/*")
            if shape is None:
                continue
            meshes = _meshes(shape, robot, files)
            material = visual.find("material")
            color = named.get(material.get("name", "")) if material is not None and material.get("name") else None
            T = _origin(visual)
            for k, mesh in enumerate(meshes):
                vertices, triangles = merge_detail(np.asarray(mesh.vertices), np.asarray(mesh.faces), CELL)
                if not len(triangles):
                    continue
                own = getattr(getattr(mesh.visual, "material", None), "main_color", None)
                rgb = color if color is not None else np.array(own[:3]) / 255 if own is not None else np.array(GREY)
                name = f"{link.get('name')}/{i}/{k}"
                # Neither pure black nor pure white: light must show the shape. Flat: meshes meant for display
                # have faces of either orientation, whose normals must not be averaged.
                vertices = vertices @ T[:3, :3].T + T[:3, 3]
                parts[name] = Part(vertices, triangles, np.clip(rgb, 0.10, 0.86), smooth=False)
                links[name] = str(link.get("name"))
    if not parts:
        raise InvalidData("has no visual geometry", where=robot.urdf)
    return parts, links


def _color(material: ET.Element) -> np.ndarray | None:
    color = material.find("color")
    return None if color is None else np.array(color.get("rgba", "").split(), float)[:3]


def _origin(element: ET.Element) -> np.ndarray:
    T = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        T[:3, 3] = np.array(origin.get("xyz", "0 0 0").split(), float)
        T[:3, :3] = Rotation.from_euler("xyz", np.array(origin.get("rpy", "0 0 0").split(), float)).as_matrix()
    return T


def _meshes(shape: ET.Element, robot: Robot, files: dict[Path, list[trimesh.Trimesh]]) -> list[trimesh.Trimesh]:
    """Meshes of one <geometry>; files are read once."""
    number = {k: np.array(v.split(), float) for k, v in shape.attrib.items() if k != "filename"}
    if shape.tag == "box":
        return [trimesh.creation.box(number["size"])]
    if shape.tag == "sphere":
        return [trimesh.creation.icosphere(3, float(number["radius"][0]))]
    if shape.tag in ("cylinder", "capsule"):
        make = getattr(trimesh.creation, shape.tag)
        return [make(radius=float(number["radius"][0]), height=float(number["length"][0]))]
    name = shape.get("filename", "")
    inside = name.removeprefix("package://").removeprefix("file://")
    candidates = [Path(d) / inside for d in (*robot.package_dirs, robot.urdf.parent)]
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise InvalidData(f"mesh {name!r} is not there", where=robot.urdf)
    if path not in files:
        try:
            scene = trimesh.load_scene(path)
        except Exception as e:
            raise InvalidData(f"cannot be read as a mesh ({type(e).__name__}: {e})", where=path) from None
        files[path] = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh)]
    scale = number.get("scale", np.ones(3))
    return [m if np.all(scale == 1) else m.copy().apply_scale(scale) for m in files[path]]


def merge_detail(vertices: np.ndarray, triangles: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices (V, 3) that share a cube of `cell` m into their mean; drop triangles that collapse or repeat."""
    index = np.floor((vertices - vertices.min(0)) / cell).astype(np.int64)
    span = index.max(0) + 1
    key = (index[:, 0] * span[1] + index[:, 1]) * span[2] + index[:, 2]
    _, cluster, count = np.unique(key, return_inverse=True, return_counts=True)
    merged = np.stack([np.bincount(cluster, vertices[:, k]) for k in range(3)], 1) / count[:, None]
    faces = cluster[triangles]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    a, b, c = np.sort(faces, axis=1).T
    _, first = np.unique((a * len(merged) + b) * len(merged) + c, return_index=True)
    return merged, faces[np.sort(first)]


def unit_ball() -> trimesh.Trimesh:
    """Radius 1."""
    return trimesh.creation.icosphere(2, 1.0)


def unit_stick() -> trimesh.Trimesh:
    """Cylinder of radius 1 from z = 0 to z = 1."""
    mesh = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=14)
    mesh.apply_translation([0, 0, 0.5])
    return mesh


def unit_arrow() -> trimesh.Trimesh:
    """Arrow along z whose shaft has radius 1; its tip is at z = 1, and the head takes the last quarter."""
    shaft = trimesh.creation.cylinder(radius=1.0, height=0.75, sections=14)
    shaft.apply_translation([0, 0, 0.375])
    head = trimesh.creation.cone(radius=2.6, height=0.25, sections=18)
    head.apply_translation([0, 0, 0.75])
    return shaft + head


def between(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """(4, 4) affine map that puts a unit stick or arrow from `a` to `b` (3,), scaled to `radius` m."""
    d = b - a
    length = float(np.linalg.norm(d))
    z = d / length if length > 1e-9 else np.array([0.0, 0, 1])
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([radius * x, radius * np.cross(z, x), max(length, 1e-6) * z], 1)
    T[:3, 3] = a
    return T


def at(p: np.ndarray, radius: float) -> np.ndarray:
    """(4, 4) map that puts a unit ball at `p` (3,), scaled to `radius` m."""
    T = np.diag([radius, radius, radius, 1.0])
    T[:3, 3] = p
    return T


def terrain_parts(terrain: Terrain) -> dict[str, Part]:
    """The terrain's boxes."""
    parts = {}
    for i, b in enumerate(terrain.boxes):
        low, high = np.array([b.x_min, b.y_min, -0.01]), np.array([b.x_max, b.y_max, b.height])
        mesh = trimesh.creation.box(high - low)
        mesh.apply_translation((low + high) / 2)
        color = np.array([0.70, 0.62, 0.50])
        parts[f"terrain{i}"] = Part(mesh.vertices, mesh.faces, color, smooth=False, grain=0.1, grain_size=0.05)
    return parts
