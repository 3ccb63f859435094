"""Meshes are drawn, or replaced by tubes, within bounds of time and memory; pipes are never opened."""

import base64
import contextlib
import json
import os
import resource
import struct
import subprocess
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from time_bounds import in_time

from spelgen.render.scene import scene
from spelgen.urdf import geometry
from spelgen.urdf.geometry import mesh_file

ARM = """<robot name="r"><link name="a"/><link name="b"><visual><geometry><mesh filename="FILE"/></geometry></visual>
</link><joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>"""
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
MANY = 400_000_000  # number of vertices, which would take 4.8 GB


def test_triangles_without_common_corners_stay_one_surface(tmp_path):
    """A mesh whose triangles have vertices of their own, as in STL, is simplified without holes."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    apart = trimesh.Trimesh(
        ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3), process=False
    )
    (tmp_path / "m.obj").write_text(trimesh.exchange.obj.export_obj(apart, include_normals=True))
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(ARM.replace("FILE", "m.obj"))
    (shape,) = [link.shape for link in scene(urdf, ["j"]).links if link.name == "b"]
    drawn = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    assert len(drawn.faces) < 0.5 * len(ball.faces)
    assert drawn.is_watertight
    assert drawn.area == pytest.approx(ball.area, rel=0.02)


def test_an_arm_of_fine_meshes_is_drawn(tmp_path):
    # the mesh has 327,680 faces
    trimesh.creation.icosphere(subdivisions=7, radius=0.1).export(tmp_path / "m.stl")
    visual = '<visual><geometry><mesh filename="m.stl"/></geometry></visual>'
    links = [f"l{k}" for k in range(6)]
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        f'<robot name="r">{"".join(f"""<link name="{x}">{visual}</link>""" for x in links)}</robot>'
    )
    found = geometry.link_shapes(urdf, "visual", links, 4000)
    assert [shape.link for shape in found.shapes] == links and not found.unread


def gltf(buffer: dict[str, object], count: int = 3, view: int | None = 0) -> str:
    """Return a glTF file with one mesh of ``count`` vertices, whose positions are in ``buffer``, the glTF description.

    view: index of the bufferView of the positions; None: all positions are zero, as glTF defines.
    """
    positions = {"componentType": 5126, "count": count, "type": "VEC3"}
    if view is not None:
        positions["bufferView"] = view
    content = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "accessors": [positions],
        "bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36} | buffer],
    }  # fmt: skip
    return json.dumps(content)


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4").tobytes()
INLINE = {"uri": "data:application/octet-stream;base64," + base64.b64encode(CORNERS).decode()}


def plain_obj(folder: Path) -> str:
    (folder / "m.obj").write_text(TRIANGLE)
    return "m.obj"


def plain_gltf(folder: Path) -> str:
    (folder / "m.gltf").write_text(gltf(INLINE))
    return "m.gltf"


def gltf_with_a_file(folder: Path) -> str:
    (folder / "m.bin").write_bytes(CORNERS)
    (folder / "m.gltf").write_text(gltf({"uri": "m.bin"}))
    return "m.gltf"


def obj_whose_material_is_a_pipe(folder: Path) -> str:
    os.mkfifo(folder / "m.mtl")
    (folder / "m.obj").write_text(f"mtllib m.mtl\nusemtl x\n{TRIANGLE}")
    return "m.obj"


def pipe(folder: Path) -> str:
    os.mkfifo(folder / "m.obj")
    return "m.obj"


def gltf_whose_buffer_is_a_pipe(folder: Path) -> str:
    os.mkfifo(folder / "m.bin")
    (folder / "m.gltf").write_text(gltf({"uri": "m.bin"}))
    return "m.gltf"


def gltf_whose_buffer_lies_elsewhere(folder: Path) -> str:
    (folder / "inner").mkdir()
    (folder / "m.bin").write_bytes(CORNERS)
    (folder / "inner" / "m.gltf").write_text(gltf({"uri": "../m.bin"}))
    return "inner/m.gltf"


def gltf_of_gigabytes(folder: Path) -> str:
    (folder / "m.gltf").write_text(gltf(INLINE, MANY, None))
    return "m.gltf"


def archive_of_gigabytes(folder: Path) -> str:
    with (
        zipfile.ZipFile(folder / "m.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("m.stl", "w", force_zip64=True) as file,
    ):
        file.write(bytes(80) + struct.pack("<I", MANY))
        for _ in range(6):
            file.write(bytes(10**8))
    return "m.zip"


def stl_that_states_more_than_it_has(folder: Path) -> str:
    (folder / "m.stl").write_bytes(bytes(80) + struct.pack("<I", MANY) + bytes(5000))
    return "m.stl"


def ply_that_states_more_than_it_has(folder: Path) -> str:
    fields = "property float x\nproperty float y\nproperty float z\n"
    (folder / "m.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {MANY}\n{fields}end_header\n0 0 0\n"
    )
    return "m.ply"


def corners_that_are_no_numbers(folder: Path) -> str:
    (folder / "m.obj").write_text(TRIANGLE.replace("v 1", "v nan"))
    return "m.obj"


def gltf_of_triangles_without_corners(folder: Path) -> str:
    content = json.loads(gltf(INLINE))
    content["meshes"][0]["primitives"][0]["indices"] = 1
    content["accessors"].append({"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"})
    # The floats of the second vertex, read as indices of a triangle, are 0, 16256 and 0: there is no vertex 16256.
    content["bufferViews"].append({"buffer": 0, "byteOffset": 12, "byteLength": 6})
    (folder / "m.gltf").write_text(json.dumps(content))
    return "m.gltf"


def triangle_beyond_all_areas(folder: Path) -> str:
    return plain_obj(folder) + '" scale="1e200 1e200 1e200'


def box_without_size(folder: Path) -> str:
    shown = '"/></geometry></visual><visual><geometry><box size="0 0 0"/></geometry></visual>'
    balls = '<visual><geometry><sphere radius="0'
    return f"{plain_obj(folder)}{shown}{balls}"


DRAWN = (box_without_size, plain_obj, plain_gltf, gltf_with_a_file, obj_whose_material_is_a_pipe)
OMITTED = (
    pipe, gltf_whose_buffer_is_a_pipe, gltf_whose_buffer_lies_elsewhere, gltf_of_gigabytes, archive_of_gigabytes,
    stl_that_states_more_than_it_has, ply_that_states_more_than_it_has, corners_that_are_no_numbers,
    gltf_of_triangles_without_corners, triangle_beyond_all_areas,
)  # fmt: skip


@contextlib.contextmanager
def bounds() -> Iterator[None]:
    """Assert that child processes within the block take at most 10 s and 1.1 GB."""
    begin, used = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    yield
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert in_time(after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime, 10)
    # the peak memory [kB] is the largest of all children so far, and a child begins as a copy of this process
    copied = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after.ru_maxrss <= max(used.ru_maxrss, copied, 1_100_000)
    # a bound of wall time too, as a process that waits for a pipe uses no processor time
    assert time.monotonic() - begin < 60


def test_meshes_of_all_formats_are_drawn_within_bounds(tmp_path):
    """Meshes of all formats in one arm are drawn, which requires that each of them can be read."""
    links, joints = [], []
    for make in DRAWN:
        name = make.__name__
        (tmp_path / name).mkdir()
        mesh = f'<mesh filename="{name}/{make(tmp_path / name)}"/>'
        links.append(f'<link name="{name}"><visual><geometry>{mesh}</geometry></visual></link>')
        joints.append(f'<joint name="{name}" type="fixed"><parent link="b"/><child link="{name}"/></joint>')
    path = tmp_path / "r.urdf"
    arm = ARM.replace("FILE", plain_obj(tmp_path))
    path.write_text(arm.replace("</robot>", f"{''.join(links + joints)}</robot>"))
    with bounds():
        found = scene(path, ["j"])
    assert not found.tubes
    assert {link.name for link in found.links if len(link.shape.faces)} >= {make.__name__ for make in DRAWN}


@pytest.mark.parametrize("make", OMITTED)
def test_hostile_meshes_are_omitted_within_bounds(tmp_path, make):
    path = tmp_path / "r.urdf"
    path.write_text(ARM.replace("FILE", make(tmp_path)))
    with bounds():
        assert scene(path, ["j"]).tubes


@pytest.mark.parametrize(
    "name", ["package://arm/meshes/m.obj", "../meshes/m.obj", "file://FOLDER/meshes/m.obj"]
)
def test_meshes_are_found_by_each_form_of_path(tmp_path, name):
    (tmp_path / "meshes").mkdir()
    plain_obj(tmp_path / "meshes")
    (tmp_path / "urdf").mkdir()
    urdf = tmp_path / "urdf" / "arm.urdf"
    assert mesh_file(urdf, name.replace("FOLDER", str(tmp_path))).samefile(tmp_path / "meshes" / "m.obj")
    for missing in ("package://arm/m.obj", "package://arm", "", "m" * 5000, "m\0"):
        with pytest.raises(FileNotFoundError):
            mesh_file(urdf, missing)


@pytest.mark.parametrize("printed", [b"", b"a warning\n", b"PK\x03\x04", None])
def test_no_answer_of_the_process_is_an_error(tmp_path, monkeypatch, printed):
    """Without a usable answer of the mesh process, tubes are drawn instead of an error.

    printed: output of the process; None: it must not be started, since the mesh does not exist.
    """
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(ARM.replace("FILE", "m.obj"))
    answers = []
    if printed is not None:
        plain_obj(tmp_path)
        answers.append(subprocess.CompletedProcess([], 0, printed))
    monkeypatch.setattr(geometry.subprocess, "run", lambda *_, **__: answers.pop())
    assert scene(urdf, ["j"]).tubes and not answers
