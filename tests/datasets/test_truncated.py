"""Files that lack their end, or whose header claims too much, are refused with what is missing, in each format."""

import struct

import pytest
import trimesh

from datasets.meshes import load_mesh
from datasets.truncated import check_whole

BALL = trimesh.creation.icosphere(2)  # 162 vertices, 320 faces
FORMATS = {
    "obj": BALL.export(file_type="obj").encode(),
    "ply": BALL.export(file_type="ply"),
    "ascii.ply": BALL.export(file_type="ply", encoding="ascii"),
    "stl": BALL.export(file_type="stl"),
    "ascii.stl": BALL.export(file_type="stl_ascii").encode(),
    "off": BALL.export(file_type="off").encode(),
    "glb": BALL.export(file_type="glb"),
}
MISSING = {  # what is said of half of a file
    "ply": r"its header claims 162 vertices and 320 faces, in 6104 bytes at least, and \d+ follow",
    "ascii.ply": r"its header claims 162 vertices and 320 faces, and it holds \d+ vertices and 0 faces",
    "stl": r"its header claims 320 faces, and it holds 159",
    "ascii.stl": r"it ends after 160 faces, without 'endsolid'",
    "off": r"its header claims 162 vertices and 320 faces, and it holds \d+ vertices and \d+ faces",
    "glb": r"its header claims \d+ bytes, and it has \d+",
}


@pytest.mark.parametrize("name", FORMATS)
def test_a_whole_file_is_whole(name, tmp_path):
    path = tmp_path / f"ball.{name}"
    for ending in (b"", b"\n\n") if name in ("obj", "ascii.ply", "ascii.stl", "off") else (b"",):
        path.write_bytes(FORMATS[name].rstrip(b"\n") + ending if ending else FORMATS[name])
        assert check_whole(path) == ()
        assert load_mesh(path).repairs == ()


@pytest.mark.parametrize("name", MISSING)
def test_half_of_a_file_says_what_is_missing(name, tmp_path):
    path = tmp_path / f"half.{name}"
    path.write_bytes(FORMATS[name][: len(FORMATS[name]) // 2])
    message = rf"half\.{name}': must be a whole \.\w+ file, but it is truncated: {MISSING[name]}; .*export"
    with pytest.raises(ValueError, match=message):
        load_mesh(path)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.8, 0.99])
@pytest.mark.parametrize("name", MISSING)
def test_a_file_without_its_end_is_truncated_wherever_it_was_cut(name, share, tmp_path):
    path = tmp_path / f"cut.{name}"
    path.write_bytes(FORMATS[name][: int(share * len(FORMATS[name]))])
    with pytest.raises(ValueError, match=r"but it is truncated: "):
        load_mesh(path)


def test_a_file_without_its_last_face_is_truncated(tmp_path):
    (tmp_path / "cut.stl").write_bytes(FORMATS["stl"][:-50])
    with pytest.raises(ValueError, match="its header claims 320 faces, and it holds 319"):
        load_mesh(tmp_path / "cut.stl")


def test_a_header_of_four_thousand_million_faces_is_not_believed(tmp_path):
    data = bytearray(FORMATS["stl"])
    data[80:84] = struct.pack("<I", 4_000_000_000)
    (tmp_path / "huge.stl").write_bytes(data)
    with pytest.raises(ValueError, match="its header claims 4000000000 faces, and it holds 320"):
        load_mesh(tmp_path / "huge.stl")


VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
SPARE = "v 5 5 5\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FACES.replace("2 4", "2 7") + VERTICES, "the face in line 2 names vertex 7, and there are 4"),
        (VERTICES + "f -4 -2 -3\nf 1 2 -6\n", "the face in line 6 names vertex -1, and there are 4"),
        (VERTICES + FACES[:-4], "it ends within line 8, 'f 1 '"),
        (VERTICES + FACES + "v 1.5 0.2", "it ends within line 9, 'v 1.5 0.2'"),
        (VERTICES + SPARE + FACES[:-1], "it ends within line 9, and 1 of 5 vertices are in no face"),
    ],
)
def test_an_obj_is_truncated_where_its_faces_or_its_last_line_lack_something(text, message, tmp_path):
    (tmp_path / "cut.obj").write_text(text)
    with pytest.raises(ValueError, match=f"must be a whole .obj file, but it is truncated: {message}; export or copy"):
        load_mesh(tmp_path / "cut.obj")


@pytest.mark.parametrize(
    "text",
    [
        VERTICES + FACES,
        VERTICES + FACES.rstrip(),
        FACES + VERTICES,  # names before what they name
        VERTICES + "f -4 -2 -3\nf -4/1 -3/1 -1/1\nf -3//1 -2//1 -1//1\nf 1 4 3 # the last\n",
        VERTICES.replace("v 0 0 1", "v 0 0 \\\n1") + FACES,
        VERTICES + SPARE + FACES + "p 5",
    ],
)
def test_an_obj_that_is_whole_is_not_doubted(text, tmp_path):
    (tmp_path / "whole.obj").write_text(text)
    assert check_whole(tmp_path / "whole.obj") == ()


def test_an_obj_cut_between_two_lines_is_doubted_and_the_mesh_says_so(tmp_path):
    lines = FORMATS["obj"].decode().splitlines()
    faces = [number for number, line in enumerate(lines) if line.startswith("f ")]
    (tmp_path / "half.obj").write_text("\n".join(lines[: faces[100]]) + "\n")
    repairs = load_mesh(tmp_path / "half.obj").repairs
    assert any(
        told.startswith("warning: ") and "of 162 vertices are in no face: the file may be" in told for told in repairs
    )


def test_the_counts_of_an_off_may_stand_beside_its_name(tmp_path):
    whole = FORMATS["off"].replace(b"OFF\n", b"# a ball\nOFF ", 1)
    (tmp_path / "ball.off").write_bytes(whole)
    assert load_mesh(tmp_path / "ball.off").repairs == ()
    (tmp_path / "ball.off").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="truncated: its header claims 162 vertices and 320 faces"):
        load_mesh(tmp_path / "ball.off")


def test_rows_that_are_no_numbers_are_left_to_the_reader(tmp_path):
    for name, text in {
        "words.off": "OFF\n1 1 0\n0 0 0\nx y z\n",
        "odd.ply": "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nend_header\nx y\n",
        "odd_header.ply": "ply\nformat ascii 1.0\nelement face many\nend_header\n",
        "words.obj": "v 0 0 0\nf a b c\n",
        "odd.obj": "v 0 0 0\nf 1 /2 1\nf 1 1 99999999999999999999\n",
        "odd.off": "OFF BINARY\n1 1 0\n",
    }.items():
        (tmp_path / name).write_text(text)
        assert check_whole(tmp_path / name) == ()
        with pytest.raises(ValueError, match="mesh file"):
            load_mesh(tmp_path / name)
